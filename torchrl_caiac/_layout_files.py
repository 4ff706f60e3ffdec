"""Layouts as files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import yaml

from torchrl_caiac._files import (
    UnreadableFileError,
    read_json,
    whole_file,
    write_json,
)
from torchrl_caiac._layout_short import layout_to_short, short_arguments
from torchrl_caiac._layout_yaml import read_yaml

if TYPE_CHECKING:
    from typing_extensions import Self

    from torchrl_caiac.entities import EntityLayout

__all__ = ["LayoutFiles"]

_LINE_ENDS = "\x85\u2028\u2029"  # which YAML changes, unless they are escaped


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
        """Writes the layout as YAML or JSON, atomically.

        Args:
            path (str or Path): the file. It is replaced if it exists. With the suffix
                ``.yaml`` or ``.yml``, it gets the short form of :meth:`load`, else
                JSON.

        Examples:
            >>> import tempfile
            >>> from torchrl_caiac import EntityLayout
            >>> layout = EntityLayout({"arm": [0, 1], "cup": [4, 7]}, fixed=["arm"])
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     layout.save(f"{folder}/layout.yaml")
            ...     print(Path(f"{folder}/layout.yaml").read_text().strip())
            ...     EntityLayout.load(f"{folder}/layout.yaml") == layout
            entities:
              arm: 0:2
              cup: [4, 7]
            fixed: [arm]
            True
        """
        if not _is_yaml(Path(path)):
            write_json(path, self.to_dict(), indent=2)
            return
        content = layout_to_short(cast("EntityLayout", self))
        text = _yaml_text(content, allow_unicode=True)
        if any(mark in text for mark in _LINE_ENDS):
            text = _yaml_text(content, allow_unicode=False)
        with whole_file(path) as partial:
            partial.write_text(text, encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a layout that :meth:`save` or a person wrote.

        A person writes the short form, in YAML (``.yaml``, ``.yml``) or JSON: the
        arguments of :class:`~torchrl_caiac.EntityLayout`, with columns as lists
        (``[10, 11, 12]``), ranges (``0:10``) or both (``0:10, 15``). Only ``entities``
        is needed. ``keys`` instead of it makes a nested layout, as
        :meth:`~torchrl_caiac.EntityLayout.from_keys` does; a key is a text, or a list
        of texts.

        Args:
            path (str or Path): the file.

        Returns:
            EntityLayout: the layout.

        Raises:
            FileNotFoundError: the file does not exist.
            UnreadableFileError: the file is truncated or does not describe a layout.
                The message has the field that is wrong, in YAML with its line.

        Examples:
            >>> import tempfile
            >>> from torchrl_caiac import EntityLayout
            >>> text = '''
            ... entities:
            ...   gripper: 0:10
            ...   cube: [10, 11, 12]
            ... fixed: [gripper]
            ... positions:
            ...   cube: 10:13
            ... variance_floor: 0.001
            ... '''
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     _ = Path(f"{folder}/layout.yaml").write_text(text)
            ...     EntityLayout.load(f"{folder}/layout.yaml")
            EntityLayout(
                gripper: observation[0:10], fixed
                cube: observation[10:13]
            )
        """
        what, path = "layout", Path(path)
        lines = None
        if _is_yaml(path):
            remedy = "correct the file"
            content, lines = read_yaml(path, what, remedy)
            is_short = True
        else:
            remedy = "save the layout again"
            content = read_json(path, what, remedy)
            is_short = isinstance(content, Mapping) and "format" not in content
        try:
            if not is_short:
                return cls.from_dict(content)
            if lines is None:
                remedy = "correct the file"
                text = path.read_text(encoding="utf-8")
                content = json.loads(text, object_pairs_hook=_each_once)
            is_flat, arguments = short_arguments(content, lines)
            create: Any = cls  # EntityLayout
            create = create if is_flat else create.from_keys
            return cast("Self", create(**arguments))
        except (ValueError, TypeError) as error:
            raise UnreadableFileError(
                f"{path} is not a readable {what} ({error}): {remedy}"
            ) from error


def _yaml_text(content: dict[str, Any], *, allow_unicode: bool) -> str:
    text = yaml.safe_dump(
        content, sort_keys=False, allow_unicode=allow_unicode, default_flow_style=None
    )
    return str(text)


def _is_yaml(path: Path) -> bool:
    return path.suffix.lower() in (".yaml", ".yml")


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"it gives {twice!r} twice")
    return content
