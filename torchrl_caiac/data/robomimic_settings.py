"""What robomimic files say about their environment."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_caiac.data.minari_checks import check_hdf5_array

__all__ = ["controller_bounds", "environment_settings"]

_logger = logging.getLogger("torchrl_caiac.data.robomimic_settings")


def environment_settings(data: Any) -> dict[str, Any]:
    """Returns what a robomimic file says about the environment.

    Args:
        data (h5py.Group): the group ``data`` of the file.

    Returns:
        dict: the attribute ``env_args``, which is JSON; empty if it is missing or
        damaged.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl_caiac.data.robomimic_settings import environment_settings
        >>> environment_settings(SimpleNamespace(attrs={"env_args": '{"type": 1}'}))
        {'type': 1}
    """
    try:
        content = json.loads(data.attrs["env_args"])
    except Exception:  # h5py and JSON raise many kinds, and it is only a remark
        return {}
    return content if isinstance(content, dict) else {}


def controller_bounds(
    data: Any, demos: Sequence[str], file: Path
) -> tuple[Any, Any] | None:
    """Returns the bounds of the actions, if robosuite's controllers say them.

    The grippers of robosuite take inputs from -1 to 1.

    Args:
        data (h5py.Group): the group ``data`` of a robomimic file.
        demos (sequence of str): the demonstrations whose actions count.
        file (Path): the file.

    Returns:
        tuple of list, optional: the lowest and the highest action. ``None`` if the file
        does not say that all controllers take inputs from -1 to 1, or if an action is
        outside.

    Raises:
        UnreadableFileError: actions are not whole.

    Examples:
        >>> from pathlib import Path
        >>> from types import SimpleNamespace
        >>> from torchrl_caiac.data.robomimic_settings import controller_bounds
        >>> controller_bounds(SimpleNamespace(attrs={}), [], Path("lift.hdf5"))
    """
    limits = list(_limits(environment_settings(data).get("env_kwargs")))
    if not limits or any(limit != (-1, 1) for limit in limits):
        return None
    widths = set()
    for name in demos:
        actions = data[name].get("actions")
        shape: tuple[int, ...] = getattr(actions, "shape", None) or ()
        if len(shape) != 2 or not shape[0]:
            return None  # which is refused when it is read
        check_hdf5_array(actions, file)
        if not np.abs(actions[()]).max() <= 1:
            _logger.warning(
                "the controllers of %s take inputs from -1 to 1, but the actions of %s "
                "are outside: their bounds count as unknown",
                file,
                name,
            )
            return None
        widths.add(shape[1])
    if len(widths) != 1:
        return None
    _logger.info("%s: the actions are in [-1, 1], as its env_args say", file)
    width = widths.pop()
    return [-1.0] * width, [1.0] * width


def _limits(settings: Any) -> Iterator[tuple[Any, Any]]:
    """Yields the limits of all controllers: a number, or one for each input."""
    if not isinstance(settings, Mapping):
        return
    if "input_max" in settings:
        low, high = (
            value if isinstance(value, list) else [value]
            for value in (settings.get("input_min"), settings["input_max"])
        )
        yield from zip_longest(low, high)
    for value in settings.values():
        yield from _limits(value)
