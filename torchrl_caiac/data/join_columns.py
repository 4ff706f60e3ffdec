"""Joins several arrays of one episode to a flat observation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["columns_text", "join_columns", "joined_columns"]


def join_columns(parts: Mapping[str, Any], where: str) -> NDArray[Any]:
    """Joins arrays side by side, in their order.

    Args:
        parts (mapping of str to arrays): ``[L]`` or ``[L, D]`` each.
        where (str): the episode's name in error messages.

    Returns:
        numpy.ndarray: one array, ``[L, sum of D]``. An array ``[L]`` becomes a column.

    Raises:
        ValueError: an array has further dimensions, or another length.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.join_columns import join_columns
        >>> join_columns({"arm": np.zeros((3, 2)), "time": np.arange(3.0)}, "demo_0")
        array([[0., 0., 0.],
               [0., 0., 1.],
               [0., 0., 2.]])
    """
    arrays = {name: np.asarray(part) for name, part in parts.items()}
    wrong = {
        name: list(array.shape)
        for name, array in arrays.items()
        if array.ndim not in (1, 2)
    }
    if wrong:
        raise ValueError(
            f"{where} has the shapes {wrong}, expected [L] or [L, D] for what is "
            "joined to a flat observation: leave these entries out of keys="
        )
    lengths = {name: len(array) for name, array in arrays.items()}
    if len(set(lengths.values())) != 1:
        raise ValueError(
            f"{where} has entries of different lengths, {lengths}: remove the episode"
        )
    columns = [
        array[:, None] if array.ndim == 1 else array for array in arrays.values()
    ]
    return np.concatenate(columns, axis=1)


def joined_columns(parts: Mapping[str, Any]) -> dict[str, list[int]]:
    """Returns the columns of each array after :func:`join_columns`.

    Args:
        parts (mapping of str to arrays): as for :func:`join_columns`.

    Returns:
        dict of str to list of int: the first column and the one after the last.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.join_columns import joined_columns
        >>> joined_columns({"arm": np.zeros((3, 2)), "time": np.arange(3.0)})
        {'arm': [0, 2], 'time': [2, 3]}
    """
    ranges, first = {}, 0
    for name, part in parts.items():
        width = int(np.prod(np.shape(part)[1:]))
        ranges[name] = [first, first + width]
        first += width
    return ranges


def columns_text(columns: Mapping[str, list[int]]) -> str:
    """Returns the columns of joined arrays as text, for the log.

    Args:
        columns (mapping of str to list of int): from :func:`joined_columns`.

    Returns:
        str: the text.

    Examples:
        >>> from torchrl_caiac.data.join_columns import columns_text
        >>> columns_text({"arm": [0, 2], "time": [2, 3]})
        'arm 0 to 1, time 2 to 2'
    """
    return ", ".join(f"{key} {a} to {b - 1}" for key, (a, b) in columns.items())
