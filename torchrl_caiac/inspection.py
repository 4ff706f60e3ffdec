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
from torchrl_caiac._column_motion import (
    explained_shares,
    motion_correlations,
    position_columns,
)
from torchrl_caiac._columns import column_spans
from torchrl_caiac._files import plain
from torchrl_caiac._keys import as_key, floating, get_leaf, join, jsonable, missing_key
from torchrl_caiac._keys import path as path_of
from torchrl_caiac.data import action_bounds
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.trajectories import trajectory_index

__all__ = ["ColumnFacts", "Inspection", "LeafFacts", "MovingGroup", "inspect_dataset"]

_CHUNK = 1 << 22  # numbers read at a time
_MOST_NUMBERS = 20_000_000  # of the states in which columns are looked at
_MOST_COLUMNS = 1024  # a wider leaf is an image
_MOVES = 1e-3  # of a column's range: a change above it counts as motion
_JITTER = 5e-3  # of the median range: a column with a smaller one does not move
_ALWAYS = 0.5  # share of rows in which a column of the robot moves
_EXPLAINED = 0.6  # share of a change's variance that the action explains, in the robot
_TOGETHER = 0.5  # correlation of columns of one entity, next to each other
_APART = 0.7  # the same, of columns that are not next to each other
_TENTHS = 10
_LACK = "the data lack"
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
class ColumnFacts:
    """One column of the observation, in the rows that were looked at.

    Args:
        column (int): its number; in a nested observation, its place in the leaf.
        low (float, optional): the lowest value; ``None`` if none is finite.
        high (float, optional): the highest value.
        moves (float): the share of rows in which it moves: changes by more than a
            thousandth of its range.
        step (float): the median size of a change when it moves, in the data's units.
        explained (float): the share of its changes' variance that a linear function of
            the action explains, in [0, 1].
        key (NestedKey): the leaf. Defaults to ``"observation"``.

    Examples:
        >>> from torchrl_caiac.inspection import ColumnFacts
        >>> ColumnFacts(3, 0.0, 1.0, 0.25, 0.01, 0.0).moves
        0.25
    """

    column: int
    low: float | None
    high: float | None
    moves: float
    step: float
    explained: float
    key: NestedKey = "observation"


@dataclass(frozen=True)
class MovingGroup:
    """Columns that move together, which may be an entity.

    Args:
        name (str): its name in the proposed layout.
        columns (tuple of int): its columns; in a nested observation, all of its leaf.
        moves (float): the share of rows in which at least one of them moves.
        when (tuple of float): the same, in each tenth of an episode, ``[10]``.
        is_robot (bool): whether it moves almost always, or with the action.
        key (NestedKey): the leaf. Defaults to ``"observation"``.
        positions (tuple of int): those of its columns of which another one is the
            velocity. Defaults to ``()``: none is known.

    Examples:
        >>> from torchrl_caiac.inspection import MovingGroup
        >>> MovingGroup("robot", (0, 1), 1.0, (1.0,) * 10, True).columns
        (0, 1)
    """

    name: str
    columns: tuple[int, ...]
    moves: float
    when: tuple[float, ...]
    is_robot: bool
    key: NestedKey = "observation"
    positions: tuple[int, ...] = ()


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
    group is its velocity: has a correlation above 0.9 with its change.

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
        raise missing_key(data, observation_key, _LACK, "pass observation_key")
    is_nested = not isinstance(observation, torch.Tensor)
    notes: list[str] = []
    keys = _vectors(data, observation_key, notes)
    width = sum(data.get(key)[0].numel() for key in keys)
    most = max(1, min(max_rows, _MOST_NUMBERS // max(1, width)))
    rows = torch.arange(0, len(data), math.ceil(len(data) / most))
    length = index.lengths[torch.searchsorted(index.ends, index.position(rows))]
    tenth = (length - 1 - index.remaining(rows)) * _TENTHS // length
    action = get_leaf(data, as_key(action_key), _LACK, "pass action_key")[rows]
    action = floating(action.flatten(1).as_subclass(torch.Tensor)).double()
    parts = [_Columns(data, key, join(next_key, key), rows, action) for key in keys]
    if is_nested:
        groups = _leaf_groups(parts, tenth)
    else:
        groups = _column_groups(parts[0], tenth, notes) if parts else []
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
        proposal=_proposal(groups, observation_key, next_key, is_nested, notes),
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


class _Columns:
    """How the columns of one leaf change."""

    def __init__(
        self,
        data: TensorDictBase,
        key: NestedKey,
        next_key: NestedKey,
        rows: torch.Tensor,
        action: torch.Tensor,
    ) -> None:
        self.key = key
        now = self._read(data, key, rows)
        change = self._read(data, next_key, rows) - now
        change = torch.nan_to_num(change, 0.0, 0.0, 0.0)
        known = now.isfinite()
        self.low = torch.where(known, now, math.inf).amin(0)
        self.high = torch.where(known, now, -math.inf).amax(0)
        span = torch.nan_to_num(self.high - self.low, 0.0, 0.0, 0.0)
        size = change.abs()
        # What is far smaller than everything else is jitter, not motion.
        usual = (
            span[span > 0].median() if bool((span > 0).any()) else span.new_zeros(())
        )
        self.moving = (size > _MOVES * span) & (span > _JITTER * usual)
        self.moves = self.moving.double().mean(0)
        large = torch.where(self.moving, size, torch.nan)
        self.step = large.nanmedian(0).values.nan_to_num(0.0)
        self.explained = explained_shares(change, action)
        self.positions = position_columns(now, change)

    @staticmethod
    def _read(data: TensorDictBase, key: NestedKey, rows: torch.Tensor) -> torch.Tensor:
        leaf = get_leaf(data, key, _LACK, "add it")[rows].as_subclass(torch.Tensor)
        return floating(leaf.flatten(1)).double()

    @property
    def is_robot(self) -> torch.Tensor:
        """Which columns move almost always, or with the action, bool ``[D]``."""
        often = (self.moves >= _ALWAYS) | (self.explained >= _EXPLAINED)
        return often & self.moving.any(0)

    def facts(self) -> list[ColumnFacts]:
        """Returns the facts of all columns."""
        table = zip(
            [low if math.isfinite(low) else None for low in self.low.tolist()],
            [high if math.isfinite(high) else None for high in self.high.tolist()],
            self.moves.tolist(),
            self.step.tolist(),
            self.explained.tolist(),
            strict=True,
        )
        return [ColumnFacts(i, *row, key=self.key) for i, row in enumerate(table)]


def _column_groups(
    part: _Columns, tenth: torch.Tensor, notes: list[str]
) -> list[MovingGroup]:
    """Groups the columns of a flat observation."""
    together = motion_correlations(part.moving)
    robot = part.is_robot
    still = ~part.moving.any(0)
    owner: list[int] = []  # of each column; 0: the robot, -1: nobody yet
    count, last = 0, -1
    for column in range(len(robot)):
        if bool(still[column]):
            owner.append(-1)
            continue
        if bool(robot[column]):
            owner.append(0)
        elif (
            last > 0
            and together[
                column, [c for c, mine in enumerate(owner) if mine == last]
            ].amax()
            >= _TOGETHER
        ):
            owner.append(last)
        else:
            count += 1
            owner.append(count)
        last = owner[-1]
    owner = _merged(_inside_robot(owner), together)
    unmoved = tuple(c for c, mine in enumerate(owner) if mine < 0)
    for column in unmoved:  # inside of a group, it belongs to the group
        before = [mine for mine in owner[:column] if mine >= 0][-1:]
        after = [mine for mine in owner[column:] if mine >= 0][:1]
        if before == after and before:
            owner[column] = before[0]
    left_out = tuple(c for c in unmoved if owner[c] < 0)
    if left_out:
        notes.append(
            f"columns {column_spans(left_out)} never move, or far less than the "
            "others, and are left out: find out which entity they belong to"
        )
    found = sorted(set(owner) - {-1}, key=owner.index)
    names = iter(f"entity{i}" for i in range(len(found)))
    return [
        _group(
            part,
            tuple(c for c, mine in enumerate(owner) if mine == number),
            "robot" if number == 0 else next(names),
            tenth,
            is_robot=number == 0,
        )
        for number in found
    ]


def _inside_robot(owner: list[int]) -> list[int]:
    """Gives single columns between columns of the robot to it: a joint that waits."""
    owner = list(owner)
    for column in range(1, len(owner) - 1):
        is_alone = owner.count(owner[column]) == 1
        if is_alone and owner[column - 1] == owner[column + 1] == 0:
            owner[column] = 0
    return owner


def _merged(owner: list[int], together: torch.Tensor) -> list[int]:
    """Joins groups that move at the same time, such as positions and velocities."""
    numbers = sorted(set(owner) - {-1, 0})
    owner = list(owner)
    for i, first in enumerate(numbers):
        for second in numbers[i + 1 :]:
            mine = [c for c, x in enumerate(owner) if x == first]
            other = [c for c, x in enumerate(owner) if x == second]
            if mine and other and together[mine][:, other].amax() >= _APART:
                owner = [first if x == second else x for x in owner]
    return owner


def _leaf_groups(parts: list[_Columns], tenth: torch.Tensor) -> list[MovingGroup]:
    """Makes each leaf of a nested observation a group."""
    return [
        _group(
            part,
            tuple(range(len(part.moves))),
            "_".join(path_of(part.key)[1:]) or "".join(path_of(part.key)),
            tenth,
            is_robot=bool(part.is_robot.any()),
        )
        for part in parts
    ]


def _group(
    part: _Columns,
    columns: tuple[int, ...],
    name: str,
    tenth: torch.Tensor,
    *,
    is_robot: bool,
) -> MovingGroup:
    moving = part.moving[:, list(columns)].any(1).double()
    counts = torch.bincount(tenth, minlength=_TENTHS)
    sums = torch.bincount(tenth, weights=moving, minlength=_TENTHS)
    when = (sums / counts.clamp(min=1)).tolist()
    known = part.positions[list(columns)][:, list(columns)].any(1).tolist()
    return MovingGroup(
        name,
        columns,
        float(moving.mean()),
        tuple(when),
        is_robot,
        part.key,
        tuple(c for c, is_position in zip(columns, known, strict=True) if is_position),
    )


def _proposal(
    groups: list[MovingGroup],
    observation_key: NestedKey,
    next_key: NestedKey,
    is_nested: bool,
    notes: list[str],
) -> EntityLayout | None:
    fixed = [group.name for group in groups if group.is_robot]
    if len(fixed) == len(groups):
        why = "everything moves almost always, or with the action"
        notes.append(f"no layout is proposed: {why if groups else 'nothing moves'}")
        return None
    if not fixed:
        notes.append("no robot was found: name it in the layout, as fixed")
    positions = {group.name: group.positions for group in groups if group.positions}
    unknown = [group.name for group in groups if not group.positions]
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
    )


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
