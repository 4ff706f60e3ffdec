"""A layout of columns that move together, and of the goals that mirror them."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._columns import column_spans
from torchrl_caiac._keys import floating
from torchrl_caiac._moving_groups import MovingGroup
from torchrl_caiac.entities import EntityLayout

__all__ = ["propose_layout"]

_EQUAL = 1e-5  # of a column's range: rounding
_DESIRED, _ACHIEVED = "desired_goal", "achieved_goal"


def propose_layout(
    data: TensorDictBase,
    rows: torch.Tensor,
    groups: list[MovingGroup],
    observation_key: NestedKey,
    next_key: NestedKey,
    notes: list[str],
) -> EntityLayout | None:
    """Returns a layout of groups of columns, ``None`` if none could be swapped.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.
        rows (torch.Tensor): the rows to compare goals and observations in, ``[n]``.
        groups (list of MovingGroup): the entities.
        observation_key (NestedKey): the observation.
        next_key (NestedKey): the key of the next state.
        notes (list of str): gets what to look at before the proposal is used.

    Returns:
        EntityLayout, optional: the layout.
    """
    fixed = [group.name for group in groups if group.is_robot]
    if len(fixed) == len(groups):
        why = "everything moves almost always, or with the action"
        notes.append(f"no layout is proposed: {why if groups else 'nothing moves'}")
        return None
    if not fixed:
        notes.append("no robot was found: name it in the layout, as fixed")
    observation = data.get(observation_key)
    is_nested = not isinstance(observation, torch.Tensor)
    goals = {} if is_nested else _goals(data, rows, groups, observation[rows], notes)
    positions = {group.name: group.positions for group in groups if group.positions}
    for name, columns in goals.get("achieved", {}).items():
        if columns:
            positions.setdefault(name, columns)
    unknown = [group.name for group in groups if group.name not in positions]
    if unknown:
        notes.append(
            f"the positions of {', '.join(unknown)} are unknown, as no column is the "
            "velocity of another: name them in the layout, as positions"
        )
    if is_nested:
        keys = {group.name: group.key for group in groups}
        return EntityLayout.from_keys(
            keys, fixed=fixed, next_key=next_key, positions=positions
        )
    return EntityLayout(
        {group.name: group.columns for group in groups},
        observation_key=observation_key,
        fixed=fixed,
        next_key=next_key,
        positions=positions,
        **goals,
    )


def _goals(
    data: TensorDictBase,
    rows: torch.Tensor,
    groups: list[MovingGroup],
    observation: torch.Tensor,
    notes: list[str],
) -> dict[str, Any]:
    """Returns ``goal`` and ``achieved``, by the columns that achieved goals equal."""
    achieved, desired = data.get(_ACHIEVED, None), data.get(_DESIRED, None)
    is_vector = isinstance(achieved, torch.Tensor) and achieved.ndim == 2
    if not is_vector or (desired is not None and desired.shape != achieved.shape):
        return {}
    mirrored = floating(achieved[rows].as_subclass(torch.Tensor)).double()
    states = floating(observation.as_subclass(torch.Tensor)).double()
    owners = {column: group.name for group in groups for column in group.columns}
    goal: dict[str, list[int]] = {}
    equal: dict[str, tuple[int, ...]] = {}
    unknown = []
    for column, values in enumerate(mirrored.unbind(1)):
        limit = _EQUAL * (values.amax() - values.amin())
        same = ((states - values.unsqueeze(1)).abs() <= limit).all(0)
        found = [c for c in same.nonzero()[:, 0].tolist() if c in owners]
        if len(found) != 1:  # none, or a copy
            unknown.append(column)
            continue
        name = owners[found[0]]
        goal.setdefault(name, []).append(column)
        equal[name] = (*equal.get(name, ()), found[0])
    if unknown:
        notes.append(
            f"columns {column_spans(unknown)} of {_ACHIEVED!r} do not equal exactly "
            "one column of an entity: name goal and achieved in the layout"
        )
        return {}
    if goal:
        for group in groups:
            if not group.is_robot:  # the goal may be that of some objects alone
                goal.setdefault(group.name, [])
                equal.setdefault(group.name, ())
    return {"goal": goal, "achieved": equal}
