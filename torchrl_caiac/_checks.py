"""Checks of arguments that many functions share."""

from __future__ import annotations

__all__ = ["check_int"]


def check_int(name: str, value: int, least: int) -> None:
    """Raises an error if an argument is not an int in its range.

    Args:
        name (str): the name of the argument.
        value (int): its value.
        least (int): the smallest value allowed.

    Raises:
        ValueError: it is not an int, or below ``least``.

    Examples:
        >>> from torchrl_caiac._checks import check_int
        >>> check_int("max_rows", 10, 1)
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be an int of at least {least}, got {value!r}")
