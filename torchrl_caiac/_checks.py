"""Checks of arguments that many functions share."""

from __future__ import annotations

from typing import Any

from torchrl_caiac._torchrl import is_in_another_process

__all__ = ["check_int", "check_local"]


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


def check_local(name: str, source: Any) -> None:
    """Raises an error if a replay buffer is in another process.

    Its storage cannot be read here: it would end in an obscure ``AttributeError``.

    Args:
        name (str): the name of the argument.
        source (Any): the argument; anything but such a buffer passes.

    Raises:
        TypeError: it is a :class:`~torchrl.data.RayReplayBuffer`, a client of one, or
            another reference to a buffer of another process.

    Examples:
        >>> from torchrl.data import ReplayBuffer
        >>> from torchrl_caiac._checks import check_local
        >>> check_local("rb", ReplayBuffer())
    """
    if is_in_another_process(source):
        raise TypeError(
            f"{name} is a {type(source).__name__}, a buffer in another process, whose "
            "storage cannot be read here: work on the folder of its data "
            "(load_transitions) before the buffer is created, or create a "
            "CAIACReplayBuffer there, which opens donors itself and scores by "
            "rb.client().score(estimator)"
        )
