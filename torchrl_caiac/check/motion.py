"""Checks of how entities move: never, always, in jumps, and in which units."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch

from torchrl_caiac._column_motion import EXPLAINED_BY_ACTION, explained_shares
from torchrl_caiac.check.kinds import finding
from torchrl_caiac.check.report import Finding
from torchrl_caiac.check.sample import Sample
from torchrl_caiac.check.state import States
from torchrl_caiac.check.values import named

__all__ = ["check_jumps", "check_motion"]

_ALWAYS = 0.99  # of the rows
_REST = 0.01  # of a large change: smaller ones do not count as motion
_LARGE = 0.1  # of a large change: the rows in which the entity moves for sure
_NEGLIGIBLE = 1e-5  # of the largest deviation of a column: the jitter of a simulator
_LEAVES = 5.0  # times the floor: a column that moves less may be at rest
_FLOOR = 1e-3  # of the median change: the variance floor is too low
_JUMP = 20.0  # times the change that 0.5 % of the changes exceed
_ROBUST_Z = 50.0
_RANGE = 0.2  # of the range of a column: smaller changes are no jumps
_LEAST = 0.01  # of the largest deviation of a column: smaller changes are no jumps
_DISCRETE = 20  # values of a column, at most


def check_motion(
    sample: Sample,
    states: States,
    fixed: Collection[str],
    floors: Mapping[str, Mapping[int, float]] | None,
    action: torch.Tensor | None = None,
) -> list[Finding]:
    """Finds entities that never or always move, and floors in other units.

    Args:
        sample (Sample): the rows, without those whose next state is wrong.
        states (States): their states and next states.
        fixed (collection of str): entities that are never swapped.
        floors (mapping, optional): for each predicted entity the variance floor of its
            predicted columns, by position in the entity.
        action (torch.Tensor, optional): the actions, ``[n, A]``.

    Returns:
        list of Finding: what was found.
    """
    findings: list[Finding] = []
    if not len(sample):
        return findings
    moved: dict[str, _Motion] = {}
    for name, where in states.slices.items():
        floor = None if floors is None else floors.get(name)
        moved[name] = _Motion.of(sample, states, where, floor)
    # If not even the robot moves by more than the floors, their units are wrong.
    too_high = all(motion.below_floor for motion in moved.values())
    still = {
        name: motion.largest
        for name, motion in moved.items()
        if motion.is_negligible or (motion.below_floor and not too_high)
    }
    reported = {f"{n!r} ({most:.2g})": n for n, most in still.items() if n not in fixed}
    if reported:
        message = (
            f"never move in the {len(sample)} checked rows (at most): "
            f"{named(list(reported))}"
        )
        columns = [
            c for n in reported.values() for c in states.labels[states.slices[n]]
        ]
        findings.append(finding("never_moves", message, columns=columns))
    for name, motion in moved.items():
        if name in still:
            continue
        labels = states.labels[states.slices[name]]
        always = motion.share >= _ALWAYS and name not in fixed and len(sample) >= 100
        if always and _moves_with(action, states, states.slices[name]):
            message = f"{name!r} moves with the action, but is not fixed"
            findings.append(finding("robot_not_fixed", message, columns=labels))
        elif always:
            message = f"{name!r} moves in {motion.share:.1%} of the checked rows"
            findings.append(finding("always_moves", message, columns=labels))
        if motion.floor:
            findings += _check_floor(name, motion)
    return findings


def _moves_with(action: torch.Tensor | None, states: States, where: slice) -> bool:
    """Returns whether the action explains the motion of half of the columns."""
    if action is None:
        return False
    change = (states.next[:, where] - states.now[:, where]).double()
    moves = (change != 0).any(0)
    shares = explained_shares(change[:, moves], action.double())
    return bool((shares >= EXPLAINED_BY_ACTION).double().mean() >= 0.5)


@dataclass(frozen=True)
class _Motion:
    """How an entity moves.

    Args:
        largest (float): the largest change of a column.
        is_negligible (bool): whether it is rounding, or tiny next to other entities.
        below_floor (bool): whether no column leaves its floor in a whole trajectory.
        share (float): of the rows, in how many it moves.
        median (dict of int to float): the median change of each column that varies, in
            the rows with large changes.
        floor (dict of int to float): the floor of each predicted column.
    """

    largest: float
    is_negligible: bool
    below_floor: bool
    share: float
    median: dict[int, float]
    floor: dict[int, float]

    @classmethod
    def of(
        cls,
        sample: Sample,
        states: States,
        where: slice,
        floor: Mapping[int, float] | None,
    ) -> _Motion:
        """Measures the motion of the entity with these columns."""
        change = (states.next[:, where] - states.now[:, where]).abs().float()
        most = change.amax(0)
        tiny = _NEGLIGIBLE * states.scale.max()
        is_negligible = bool((most <= states.rounding[where].clamp_min(tiny)).all())
        size = torch.stack([_large(c) for c in change.unbind(1)])
        varies = size > states.rounding[where]
        ratio = change[:, varies] / size[varies]
        moves = (ratio > _REST).any(1)
        if floor:
            limit = torch.zeros_like(size)
            limit[list(floor)] = torch.tensor(list(floor.values())).to(limit.dtype)
            moves &= (change > limit).any(1)
        if bool((size <= tiny).all()):
            moves[:] = False  # the jitter of a simulator
        median = {}
        large = (ratio > _LARGE).any(1)
        for column in varies.nonzero()[:, 0].tolist():
            median[column] = float(change[large, column].median())
        below = bool(floor)
        for column, value in (floor or {}).items():
            extent = _extent(sample.piece, states.now[:, where.start + column])
            below &= max(extent, float(most[column])) < _LEAVES * value
        return cls(
            largest=float(most.max()),
            is_negligible=is_negligible,
            below_floor=below,
            share=float(moves.double().mean()),
            median=median,
            floor=dict(floor or {}),
        )


def _large(change: torch.Tensor) -> torch.Tensor:
    """Returns a large change of a column, not an outlier, ``[]``."""
    rank = max(1, math.ceil(0.999 * len(change)))
    value = change.kthvalue(rank).values
    return value if bool(value > 0) else change.amax()


def _extent(piece: torch.Tensor, values: torch.Tensor) -> float:
    """Returns the largest range of a column ``[n]`` in one trajectory."""
    count = int(piece[-1]) + 1
    low = values.new_full((count,), torch.inf).scatter_reduce(0, piece, values, "amin")
    high = values.new_full((count,), -torch.inf)
    high = high.scatter_reduce(0, piece, values, "amax")
    return float((high - low).max())


def _check_floor(name: str, motion: _Motion) -> list[Finding]:
    """Compares the floor of an entity with the changes of its columns."""
    median = {c: m for c, m in motion.median.items() if c in motion.floor and m > 0}
    if not median:
        return []
    ratio = {column: motion.floor[column] / value for column, value in median.items()}
    column = min(ratio, key=lambda c: ratio[c])
    if ratio[column] > 1:
        message = (
            f"variance_floor of {name!r} is {motion.floor[column]:.3g}, but where it "
            f"moves, the median change of a column is at most {median[column]:.3g}"
        )
        return [finding("floor_too_high", message)]
    column = max(ratio, key=lambda c: ratio[c])
    if ratio[column] < _FLOOR:
        message = (
            f"variance_floor of {name!r} is {motion.floor[column]:.3g}, but where it "
            f"moves, the median change of a column is at least {median[column]:.3g}"
        )
        return [finding("floor_too_low", message)]
    return []


def check_jumps(sample: Sample, states: States) -> list[Finding]:
    """Finds changes far outside the distribution of changes.

    An entity jumps where at least two of its columns do (one, if only one can). Columns
    with few values, with angles, and quaternions that change their sign do not count.

    Args:
        sample (Sample): the rows, without those whose next state is wrong.
        states (States): their states and next states.

    Returns:
        list of Finding: what was found.
    """
    findings: list[Finding] = []
    if not len(sample):
        return findings
    least = _LEAST * float(states.scale.max())
    for name, where in states.slices.items():
        votes = torch.zeros(len(sample), dtype=torch.long)
        eligible = 0
        columns: list[tuple[str, torch.Tensor]] = []
        for c in range(where.start, where.stop):
            jumps = _column_jumps(states.now[:, c], states.next[:, c], least)
            if jumps is None:
                continue
            eligible += 1
            if bool(jumps.any()):
                votes += jumps
                columns.append((states.labels[c], jumps))
        rows = votes >= min(2, max(1, eligible))
        if bool(rows.any()):
            labels = [label for label, jumps in columns if bool((jumps & rows).any())]
            message = (
                f"{name!r} jumps in {int(rows.sum())} checked rows, in {named(labels)}"
            )
            findings.append(
                finding("jump", message, columns=labels, rows=sample.rows[rows])
            )
    return findings


def _column_jumps(
    now: torch.Tensor, after: torch.Tensor, least: float
) -> torch.Tensor | None:
    """Returns where a column jumps, bool ``[n]``; ``None`` if it has no jumps."""
    change = after - now
    size = change.abs()
    largest = float(size.max())
    if largest == 0:
        return torch.zeros_like(size, dtype=torch.bool)
    moved = size[size > 1e-6 * largest]
    if len(moved) < 50:
        return None
    few = now[:: max(1, len(now) // 10_000)].unique()
    if len(few) <= _DISCRETE:
        return None
    extent = float(torch.maximum(now.abs().amax(), after.abs().amax()))
    for half_turn in (math.pi, 180.0):
        if 0.95 * half_turn < extent <= 1.001 * half_turn:
            return None  # an angle, which jumps by a turn
    rank = len(moved) - max(5, math.ceil(0.005 * len(moved)))
    usual = moved.kthvalue(max(1, rank)).values
    spread = 1.4826 * (change - change.median()).abs().median()
    low, high = (
        now.kthvalue(_rank(now, 0.01)).values,
        now.kthvalue(_rank(now, 0.99)).values,
    )
    far = (size > _JUMP * usual) & (size > _ROBUST_Z * spread)
    far &= (size > _RANGE * (high - low)) & (size > least)
    return far & ((after + now).abs() > 0.1 * size)


def _rank(values: torch.Tensor, share: float) -> int:
    return max(1, math.ceil(share * len(values)))
