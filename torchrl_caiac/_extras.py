"""Imports of packages that only some functions need."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["extra"]


@contextmanager
def extra(name: str, what: str) -> Iterator[None]:
    """Context manager for imports, which says how to install what is missing.

    Args:
        name (str): the extra of this package that has the imported packages.
        what (str): what needs them, the beginning of the error message.

    Raises:
        ImportError: a package is not installed.

    Examples:
        >>> from torchrl_caiac._extras import extra
        >>> with extra("report", "a figure"):
        ...     import a_package_that_is_missing
        Traceback (most recent call last):
        ...
        ImportError: a figure needs the package a_package_that_is_missing: install it
        with pip install 'torchrl-caiac[report]'
    """
    try:
        yield
    except ImportError as error:
        package = (error.name or str(error)).split(".")[0]
        raise ImportError(
            f"{what} needs the package {package}: install it with "
            f"pip install 'torchrl-caiac[{name}]'"
        ) from error
