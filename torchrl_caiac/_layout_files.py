"""Layouts as files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_caiac._files import UnreadableFileError, read_json, write_json

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["LayoutFiles"]


class LayoutFiles:
    """What :class:`~torchrl_caiac.EntityLayout` inherits: saving and loading."""

    def to_dict(self) -> dict[str, Any]:
        """Returns the layout as JSON-compatible values."""
        raise NotImplementedError

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Self:
        """Creates the layout that :meth:`to_dict` described."""
        raise NotImplementedError

    def save(self, path: str | Path) -> None:
        """Writes the layout as JSON, atomically.

        Args:
            path (str or Path): the file. It is replaced if it exists.

        Examples:
            >>> import tempfile
            >>> from torchrl_caiac import EntityLayout
            >>> layout = EntityLayout({"arm": [0, 1]})
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     layout.save(f"{folder}/layout.json")
            ...     EntityLayout.load(f"{folder}/layout.json") == layout
            True
        """
        write_json(path, self.to_dict(), indent=2)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a layout that :meth:`save` wrote.

        Args:
            path (str or Path): the file.

        Returns:
            EntityLayout: the layout.

        Raises:
            FileNotFoundError: the file does not exist.
            UnreadableFileError: the file is truncated or does not describe a layout.

        Examples:
            >>> import tempfile
            >>> from torchrl_caiac import EntityLayout
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     EntityLayout({"arm": [0, 1]}).save(f"{folder}/layout.json")
            ...     EntityLayout.load(f"{folder}/layout.json").names
            ('arm',)
        """
        what, remedy = "layout", "save the layout again"
        content = read_json(path, what, remedy)
        try:
            return cls.from_dict(content)
        except (ValueError, TypeError) as error:
            raise UnreadableFileError(
                f"{path} is not a readable {what} ({error}): {remedy}"
            ) from error
