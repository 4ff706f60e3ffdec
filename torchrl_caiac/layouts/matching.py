"""Which ready layouts fit data."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey

from torchrl_caiac._keys import path
from torchrl_caiac._spread import spread_rows
from torchrl_caiac.layouts.description import Columns, LayoutDescription
from torchrl_caiac.layouts.ready import describe_layout, layout_names

__all__ = ["matching_layouts"]

_MOST_ROWS = 2000
# Some rows may break the rules: objects fall off tables.
_SHARE = 0.95
_TOLERANCE = 0.01


def matching_layouts(data: TensorDictBase) -> list[str]:
    """Returns the ready layouts whose columns look like those of the data.

    The entry and its width must be the layout's, quaternions must have unit length,
    differences must be those of the columns they are differences of, and values must be
    in their bounds. Tasks with the same columns, such as those of Fetch, all fit.

    Args:
        data (TensorDictBase): transitions ``[T]``. Up to 2,000 rows are read.

    Returns:
        list of str: the names, in the order of
        :func:`~torchrl_caiac.layouts.layout_names`. Empty if none fits.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.layouts import matching_layouts
        >>> observation = 1 + torch.rand(100, 25)
        >>> observation[:, 6:9] = observation[:, 3:6] - observation[:, 0:3]
        >>> matching_layouts(TensorDict({"observation": observation}, [100]))
        ['fetch/push', 'fetch/slide', 'fetch/pick-and-place']
        >>> observation[:, 6] += 1
        >>> matching_layouts(TensorDict({"observation": observation}, [100]))
        []
    """
    if not data.numel():
        return []
    return [n for n in layout_names() if _fits(describe_layout(n), data)]


def _fits(description: LayoutDescription, data: TensorDictBase) -> bool:
    value = _entry(data, description.observation_key)
    if not isinstance(value, torch.Tensor) or value.ndim != data.ndim + 1:
        return False
    if value.shape[-1] != description.width:
        return False
    layout = description.layout()
    assert layout.desired_goal_key is not None  # the layout is flat
    goal = _entry(data, layout.desired_goal_key)
    has_goals = isinstance(goal, torch.Tensor) and layout.goal
    if has_goals and goal.shape[-1] != layout.goal_width:
        return False
    rows = value.reshape(-1, value.shape[-1])
    if len(rows) > _MOST_ROWS:
        rows = rows[spread_rows(len(rows), _MOST_ROWS)]
    rows = rows.to(torch.float64)
    return all(
        _share(part, rows, place) >= _SHARE for part, place in description.places
    )


def _entry(data: Any, key: NestedKey) -> Any:
    for name in path(key):
        # get() raises below a tensor.
        data = data.get(name, None) if is_tensor_collection(data) else None
    return data


def _share(part: Columns, rows: torch.Tensor, place: range) -> float:
    """Returns the share of rows in which columns are what they should be."""
    values = rows[:, place.start : place.stop]
    good = values.isfinite().all(-1)
    if part.is_unit:
        good &= (values.norm(dim=-1) - 1).abs() < _TOLERANCE
    if part.is_not_zero:
        good &= (values != 0).any(-1)
    if part.bounds is not None:
        low, high = part.bounds
        inside = (values >= low - _TOLERANCE) & (values <= high + _TOLERANCE)
        good &= inside.all(-1)
    if part.difference is not None:
        first, second = (rows[:, c : c + part.width] for c in part.difference)
        good &= ((first - second - values).abs() < _TOLERANCE).all(-1)
        good &= ((first != 0) | (second != 0)).any(-1)  # padding proves nothing
    return float(good.float().mean())
