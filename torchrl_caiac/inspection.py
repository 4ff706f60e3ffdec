"""What is in a dataset: enough to write a layout, and a proposal of one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._checks import check_int
from torchrl_caiac._columns import column_spans
from torchrl_caiac._files import plain
from torchrl_caiac._keys import as_key, floating, get_leaf, join, jsonable, missing_key
from torchrl_caiac._keys import path as path_of
from torchrl_caiac._layout_proposal import propose_layout
from torchrl_caiac._moving_groups import (
    DATA_LACK,
    ColumnFacts,
    MovingColumns,
    MovingGroup,
    column_groups,
    leaf_groups,
)
from torchrl_caiac.data import action_bounds
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.trajectories import trajectory_index

__all__ = ["ColumnFacts", "Inspection", "LeafFacts", "MovingGroup", "inspect_dataset"]

_CHUNK = 1 << 22  # numbers read at a time
_MOST_NUMBERS = 20_000_000  # of the states in which columns are looked at
_MOST_COLUMNS = 1024  # a wider leaf is an image
_TENTHS = 10
_BARS = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True)
class LeafFacts:
    """One entry of the transitions.

    Args:
        key (NestedKey): its key.
        dtype (str): its type.
        shape (tuple of int): the shape of one row.
        low (float, optional): the lowest value; ``None`` if none is finite.
        high (float, optional): the highest value.
        not_finite (int): the number of values that are NaN or infinite.

    Examples:
        >>> from torchrl_caiac.inspection import LeafFacts
        >>> LeafFacts("action", "float32", (2,), -1.0, 1.0, 0).high
        1.0
    """

    key: NestedKey
    dtype: str
    shape: tuple[int, ...]
    low: float | None
    high: float | None
    not_finite: int


@dataclass(frozen=True)
class Inspection:
    """What :func:`inspect_dataset` found.

    Args:
        num_transitions (int): the number of transitions.
        num_looked_at (int): the number of them that the columns were looked at in.
        lengths (tuple of int): the lengths of the episodes.
        leaves (tuple of LeafFacts): the entries.
        columns (tuple of ColumnFacts): the columns of the observation.
        groups (tuple of MovingGroup): which of them move together.
        bounds (tuple, optional): the lowest and highest action that are stored.
        proposal (EntityLayout, optional): a layout of the groups. ``None`` if there are
            none that could be swapped.
        notes (tuple of str): what to look at before the proposal is used.
        layouts (tuple of str): the ready layouts that fit. Defaults to ``()``.

    Examples:
        See :func:`inspect_dataset`.
    """

    num_transitions: int
    num_looked_at: int
    lengths: tuple[int, ...]
    leaves: tuple[LeafFacts, ...]
    columns: tuple[ColumnFacts, ...]
    groups: tuple[MovingGroup, ...]
    bounds: tuple[list[float], list[float]] | None
    proposal: EntityLayout | None
    notes: tuple[str, ...]
    layouts: tuple[str, ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """Returns what was found as JSON-compatible values.

        Returns:
            dict: the entries of this class; of the episodes, the number and the
            shortest, median and longest length.
        """
        lengths = torch.tensor(self.lengths)
        found: dict[str, Any] = {
            "num_transitions": self.num_transitions,
            "num_looked_at": self.num_looked_at,
            "episodes": {
                "count": len(self.lengths),
                "shortest": int(lengths.min()),
                "median": int(lengths.median()),
                "longest": int(lengths.max()),
            },
            "leaves": [{**asdict(x), "key": jsonable(x.key)} for x in self.leaves],
            "columns": [{**asdict(x), "key": jsonable(x.key)} for x in self.columns],
            "groups": [{**asdict(x), "key": jsonable(x.key)} for x in self.groups],
            "action_bounds": self.bounds,
            "proposal": None if self.proposal is None else self.proposal.to_dict(),
            "notes": list(self.notes),
            "layouts": list(self.layouts),
        }
        content: dict[str, Any] = plain(found)
        return content

    def __str__(self) -> str:
        found = self.to_dict()["episodes"]
        lines = [
            f"{self.num_transitions} transitions, {found['count']} episodes of "
            f"{found['shortest']} to {found['longest']} (median {found['median']})",
            "",
            "entry                          type      shape          lowest    highest",
        ]
        lines += [_leaf_line(leaf) for leaf in self.leaves]
        if self.bounds is not None:
            lines += ["", f"action bounds: {self.bounds[0]} to {self.bounds[1]}"]
        else:
            lines += ["", "action bounds: not stored"]
        width = max([12, *(len(group.name) for group in self.groups)])
        lines += [
            "",
            f"what moves when ({self.num_looked_at} transitions; from the beginning to "
            "the end of an episode)",
            f"{'group':<{width}} columns              moves    when",
        ]
        for group in self.groups:
            bars = "".join(_BARS[math.ceil(8 * share - 1e-9)] for share in group.when)
            columns = column_spans(group.columns)
            if group.key != "observation":
                columns = f"{'.'.join(path_of(group.key))} {columns}"
            robot = "  moves with the action" if group.is_robot else ""
            lines.append(
                f"{group.name:<{width}} {columns:<20} {group.moves:>6.1%}   "
                f"|{bars}|{robot}"
            )
        if self.layouts:
            lines += ["", f"ready layouts that fit: {', '.join(self.layouts)}"]
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join(lines)


@torch.no_grad()
def inspect_dataset(
    data: TensorDictBase,
    *,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
    next_key: NestedKey = "next",
    trajectory_key: NestedKey | None = "episode",
    done_key: NestedKey | None = ("next", "done"),
    layouts: Sequence[str] = (),
    max_rows: int = 100_000,
) -> Inspection:
    """Describes a dataset, and proposes a layout.

    A column moves in a transition if it changes by more than a thousandth of its range.
    Columns belong together if they move at the same time and lie next to each other, or
    if they move at the same time almost without exception. Those that move almost
    always, or whose changes the action explains, are the robot's. In a nested
    observation, each leaf is a group. A column is a position if another column of its
    group is its velocity: has a correlation above 0.9 with its change. Goals are mapped
    if each column of ``"achieved_goal"`` equals one column of a flat observation.

    The proposal is where to start: look at it, name its entities, and check it with
    :func:`~torchrl_caiac.check_dataset`.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.

    Keyword Args:
        observation_key (NestedKey): the observation, ``[T, D]``, or a tensordict of
            leaves. Defaults to ``"observation"``.
        action_key (NestedKey): the action, ``[T, A]``. Defaults to ``"action"``.
        next_key (NestedKey): the key of the next state. Defaults to ``"next"``.
        trajectory_key (NestedKey, optional): the trajectory ids. Defaults to
            ``"episode"``.
        done_key (NestedKey, optional): the end flags. Defaults to ``("next", "done")``.
        layouts (sequence of str): the ready layouts that fit. Defaults to ``()``.
        max_rows (int): the number of transitions, spread evenly, in which columns are
            looked at. Defaults to ``100_000``.

    Returns:
        Inspection: what was found.

    Raises:
        KeyError: the data lack an entry.
        ValueError: the data are empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.inspection import inspect_dataset
        >>> time = torch.arange(201.0)
        >>> states = torch.stack(
        ...     [torch.sin(time), torch.cos(time), (time - 150).clamp(min=0)], -1
        ... )
        >>> data = TensorDict(
        ...     {
        ...         "observation": states[:-1],
        ...         "action": torch.cos(time[:-1, None]),
        ...         "episode": torch.zeros(200, dtype=torch.int64),
        ...         "next": {"observation": states[1:]},
        ...     },
        ...     [200],
        ... )
        >>> found = inspect_dataset(data, done_key=None)
        >>> found.proposal
        EntityLayout(
            robot: observation[0:2], fixed
            entity0: observation[2]
        )
        >>> found.groups[1].moves
        0.25
    """
    check_int("max_rows", max_rows, 1)
    index = trajectory_index(data, trajectory_key=trajectory_key, done_key=done_key)
    observation_key = as_key(observation_key)
    observation = data.get(observation_key, None)
    if observation is None:
        raise missing_key(data, observation_key, DATA_LACK, "pass observation_key")
    is_nested = not isinstance(observation, torch.Tensor)
    notes: list[str] = []
    keys = _vectors(data, observation_key, notes)
    width = sum(data.get(key)[0].numel() for key in keys)
    most = max(1, min(max_rows, _MOST_NUMBERS // max(1, width)))
    rows = torch.arange(0, len(data), math.ceil(len(data) / most))
    length = index.lengths[torch.searchsorted(index.ends, index.position(rows))]
    tenth = (length - 1 - index.remaining(rows)) * _TENTHS // length
    action = get_leaf(data, as_key(action_key), DATA_LACK, "pass action_key")[rows]
    action = action.as_subclass(torch.Tensor).reshape(len(action), -1)
    action = floating(action).double()
    parts = [
        MovingColumns(data, key, join(next_key, key), rows, action) for key in keys
    ]
    if is_nested:
        groups = leaf_groups(parts, tenth)
    else:
        groups = column_groups(parts[0], tenth, notes) if parts else []
    bounds = action_bounds(data)
    if bounds is None:
        notes.append(
            "the action bounds are unknown: influence by a world model (CAI) "
            "takes the range of the data"
        )
    return Inspection(
        num_transitions=len(data),
        num_looked_at=len(rows),
        lengths=tuple(index.lengths.tolist()),
        leaves=tuple(_leaf_facts(data)),
        columns=tuple(fact for part in parts for fact in part.facts()),
        groups=tuple(groups),
        bounds=None if bounds is None else (bounds[0].tolist(), bounds[1].tolist()),
        proposal=propose_layout(data, rows, groups, observation_key, next_key, notes),
        notes=tuple(notes),
        layouts=tuple(layouts),
    )


def _vectors(
    data: TensorDictBase, observation_key: NestedKey, notes: list[str]
) -> list[NestedKey]:
    """Returns the leaves of the observation that are vectors of numbers."""
    observation = data.get(observation_key)
    keys: list[NestedKey] = [observation_key]
    if not isinstance(observation, torch.Tensor):
        keys = [join(observation_key, key) for key in observation.keys(True, True)]
    wide = [key for key in keys if data.get(key)[0].numel() > _MOST_COLUMNS]
    if wide:
        notes.append(
            f"{wide} have more than {_MOST_COLUMNS} numbers, like images, and are not "
            "looked at: entities are parts of vectors"
        )
    return [key for key in keys if 0 < data.get(key)[0].numel() <= _MOST_COLUMNS]


def _leaf_facts(data: TensorDictBase) -> list[LeafFacts]:
    facts = []
    for key, leaf in data.items(True, True):
        if path_of(key)[0] == "caiac":
            continue
        low, high, bad = math.inf, -math.inf, 0
        rows = max(1, _CHUNK // max(1, leaf[0].numel()))
        for begin in range(0, len(leaf), rows):
            part = leaf[begin : begin + rows].as_subclass(torch.Tensor)
            if part.is_floating_point():
                finite = part[part.isfinite()]
                bad += part.numel() - finite.numel()
                part = finite
            if part.numel():
                low, high = min(low, float(part.min())), max(high, float(part.max()))
        known = low <= high
        facts.append(
            LeafFacts(
                key,
                str(leaf.dtype).removeprefix("torch."),
                tuple(leaf.shape[1:]),
                low if known else None,
                high if known else None,
                bad,
            )
        )
    return sorted(facts, key=lambda fact: path_of(fact.key))


def _leaf_line(leaf: LeafFacts) -> str:
    low, high = ("-" if x is None else f"{x:.4g}" for x in (leaf.low, leaf.high))
    bad = f"  {leaf.not_finite} values are not finite" if leaf.not_finite else ""
    return (
        f"{'.'.join(path_of(leaf.key)):<30} {leaf.dtype:<9} "
        f"{list(leaf.shape)!s:<10} {low:>10} {high:>10}{bad}"
    )
