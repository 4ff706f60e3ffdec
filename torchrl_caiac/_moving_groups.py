"""Columns that move, and which of them move together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._column_motion import (
    EXPLAINED_BY_ACTION,
    explained_shares,
    motion_correlations,
    moving_columns,
    position_columns,
)
from torchrl_caiac._columns import column_spans
from torchrl_caiac._keys import floating, get_leaf
from torchrl_caiac._keys import path as path_of

__all__ = [
    "DATA_LACK",
    "ColumnFacts",
    "MovingColumns",
    "MovingGroup",
    "column_groups",
    "leaf_groups",
]

_ALWAYS = 0.5  # share of rows in which a column of the robot moves
_TOGETHER = 0.5  # correlation of columns of one entity, next to each other
_APART = 0.7  # the same, of columns that are not next to each other
_TENTHS = 10
#: How the error of a missing entry begins.
DATA_LACK = "the data lack"


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


class MovingColumns:
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
        self.moving = moving_columns(now, change)
        self.moves = self.moving.double().mean(0)
        large = torch.where(self.moving, change.abs(), torch.nan)
        self.step = large.nanmedian(0).values.nan_to_num(0.0)
        self.explained = explained_shares(change, action)
        self.positions = position_columns(now, change)

    @staticmethod
    def _read(data: TensorDictBase, key: NestedKey, rows: torch.Tensor) -> torch.Tensor:
        leaf = get_leaf(data, key, DATA_LACK, "add it")[rows].as_subclass(torch.Tensor)
        return floating(leaf.flatten(1)).double()

    @property
    def is_robot(self) -> torch.Tensor:
        """Which columns move almost always, or with the action, bool ``[D]``."""
        often = (self.moves >= _ALWAYS) | (self.explained >= EXPLAINED_BY_ACTION)
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


def column_groups(
    part: MovingColumns, tenth: torch.Tensor, notes: list[str]
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


def leaf_groups(parts: list[MovingColumns], tenth: torch.Tensor) -> list[MovingGroup]:
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
    part: MovingColumns,
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
