"""Checks that next states are those of the following rows."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict.utils import NestedKey

from torchrl_caiac.check.kinds import finding
from torchrl_caiac.check.report import Finding
from torchrl_caiac.check.sample import Sample
from torchrl_caiac.check.state import States

__all__ = ["Succession", "check_succession", "locate"]

_NOISY = 0.05  # fewer exact next states than this: sensors with noise
_RELATED = 0.5  # of the distance between rows of a trajectory
_RESETS = 0.2  # of the trajectories: their ends jump further than most steps
_FEWEST_ENDS = 5  # that tell resets by single columns
_MORE_OFTEN = 4  # than elsewhere, do single columns jump where data are reset
_PROBE = 2_000  # rows that tell whether next states are those of other rows


class Succession(NamedTuple):
    """What :func:`check_succession` found.

    Attributes:
        findings (list of Finding): the findings.
        broken (torch.Tensor): rows of the sample whose next state is wrong, bool
            ``[n]``. Other checks of motion leave them out.
        linked (torch.Tensor): rows of the sample whose next state is the state of the
            following one, bool ``[n]``.
    """

    findings: list[Finding]
    broken: torch.Tensor
    linked: torch.Tensor


def locate(states: States, wanted: torch.Tensor, among: torch.Tensor) -> torch.Tensor:
    """Finds states among others.

    Args:
        states (States): gives the tolerance of each column.
        wanted (torch.Tensor): the states to find, ``[q, W]``.
        among (torch.Tensor): the states to search, ``[n, W]``.

    Returns:
        torch.Tensor: the position in ``among`` of an equal state, -1 if there is none,
        int64 ``[q]``.
    """
    found = torch.full((len(wanted),), -1)
    if not len(among) or not len(wanted):
        return found
    generator = torch.Generator().manual_seed(0)
    width = among.shape[1]
    direction = torch.rand(width, generator=generator, dtype=torch.float64) + 0.5
    varies = states.scale > states.rounding
    direction = torch.where(varies, direction / states.scale.double(), 0.0)
    # One number for each state; equal states have nearly equal numbers.
    value, order = _project(among, direction).sort()
    slack = float((states.rounding.double() * direction).sum())
    place = torch.searchsorted(value, _project(wanted, direction) - slack)
    queries = torch.arange(len(wanted))
    for _ in range(8):  # neighbours that have a similar number by chance
        candidate = order[place.clamp_max(len(order) - 1)]
        open_ = (found < 0) & (place < len(order))
        i = queries[open_]
        same = states.close(wanted, i, among, candidate[i], states.rounding)
        found[i[same]] = candidate[i[same]]
        place = place + 1
    return found


def _project(values: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    return torch.cat([part.double() @ direction for part in values.split(16_384)])


def check_succession(
    sample: Sample,
    states: States,
    starts: torch.Tensor,
    steps: torch.Tensor,
    time: torch.Tensor | None,
    next_key: NestedKey,
) -> Succession:
    """Finds next states that are not those of the following rows.

    Args:
        sample (Sample): the rows.
        states (States): their states and next states.
        starts (torch.Tensor): the first states of trajectories, ``[E, W]``.
        steps (torch.Tensor): the steps to the next state of each row, int64 ``[n]``.
        time (torch.Tensor, optional): the time of each row, ``[n]``.
        next_key (NestedKey): the key of the next state, for messages.

    Returns:
        Succession: the findings, and which rows are concerned.
    """
    none = torch.zeros(len(sample), dtype=torch.bool)
    every = torch.arange(len(sample))
    same = states.close(states.next, every, states.now, every, states.rounding)
    if len(same) > 1 and bool(same.all()):
        message = f"in all rows {next_key!r} is equal to the state"
        found = finding("next_equals_state", message, key=next_key, rows=sample.rows)
        return Succession([found], ~none, none)
    here, there = sample.following(steps)
    linked = none.clone()
    linked[here] = states.close(states.next, here, states.now, there)
    findings, broken = _check_inside(
        sample, states, here, there, linked[here], time, next_key
    )
    ends, at_ends = _check_ends(sample, states, starts, here, same, next_key)
    return Succession(findings + ends, broken | at_ends, linked)


def _check_ends(
    sample: Sample,
    states: States,
    starts: torch.Tensor,
    here: torch.Tensor,
    same: torch.Tensor,
    next_key: NestedKey,
) -> tuple[list[Finding], torch.Tensor]:
    """Finds wrong next states in the last rows of trajectories."""
    findings = []
    zero_state = (states.now == 0).all(1)
    zero = sample.last & (states.next == 0).all(1) & ~zero_state.any()
    if bool(zero.any()):
        message = (
            f"{next_key!r} is zero in {int(zero.sum())} of the "
            f"{int(sample.last.sum())} checked last rows of trajectories"
        )
        findings.append(
            finding("next_zero_at_ends", message, key=next_key, rows=sample.rows[zero])
        )
    inside = torch.zeros_like(zero)
    inside[here] = True
    last = sample.last & (sample.place > 0)
    if (
        int(last.sum()) >= 3
        and bool(inside.any())
        and float(same[last].double().mean()) >= 0.9
        and float(same[inside].double().mean()) <= 0.1
    ):
        rows = sample.rows[last & same]
        message = f"in {len(rows)} last rows of trajectories {next_key!r} is the state"
        findings.append(
            finding("next_repeats_at_ends", message, key=next_key, rows=rows)
        )
    over = torch.zeros_like(zero)
    ends = (sample.last & ~zero & ~same).nonzero()[:, 0]
    moves = (inside & ~same).nonzero()[:, 0]
    if len(ends) and len(moves) >= 10:
        usual = states.distance(states.next, moves, states.now, moves)
        change = states.distance(states.next, ends, states.now, ends)
        found = locate(states, states.next[ends], starts) >= 0
        ends, change = ends[found], change[found]
        # A long trajectory may be stored in pieces: only jumps show that it was reset.
        large = torch.quantile(usual[:1_000_000], 0.99)
        jumps = (change > large).double()
        is_far = bool((change > 2 * large).any()) and jumps.mean() > _RESETS
        if len(ends) and (is_far or _single_jumps(states, ends, moves)):
            over[ends] = True
    if bool(over.any()):
        message = (
            f"in {int(over.sum())} last rows of trajectories {next_key!r} is the first "
            "state of another trajectory, as in data with automatic resets"
        )
        findings.append(
            finding("next_over_end", message, key=next_key, rows=sample.rows[over])
        )
    return findings, zero | over


def _single_jumps(states: States, ends: torch.Tensor, moves: torch.Tensor) -> bool:
    """Returns whether single columns jump at the ends, far more often than elsewhere.

    The distance of all columns hides a reset of positions among fast velocities.
    """
    if len(ends) < _FEWEST_ENDS:
        return False
    moves = moves[:: -(-len(moves) // _PROBE)]
    usual = (states.next[moves] - states.now[moves]).abs()
    large = 2 * usual.float().quantile(0.99, dim=0) + states.tolerance
    share = (usual > large).any(1).double().mean()
    change = (states.next[ends] - states.now[ends]).abs()
    jumps = (change > large).any(1).double().mean()
    return bool(jumps > _RESETS) and bool(jumps > _MORE_OFTEN * share)


def _check_inside(
    sample: Sample,
    states: States,
    here: torch.Tensor,
    there: torch.Tensor,
    exact: torch.Tensor,
    time: torch.Tensor | None,
    next_key: NestedKey,
) -> tuple[list[Finding], torch.Tensor]:
    """Finds wrong next states in other rows than the last of trajectories."""
    broken = torch.zeros(len(sample), dtype=torch.bool)
    moving = ~states.close(states.now, there, states.now, here)
    wrong, is_noisy, shift = ~exact, False, 0
    if bool(moving.any()) and float(exact[moving].double().mean()) < _NOISY:
        probe = here[moving][:: max(1, int(moving.sum()) // _PROBE)]
        found = locate(states, states.next[probe], states.now) >= 0
        if float(found.double().mean()) < _RELATED:
            wrong, shift = _far(sample, states, here, there)
            is_noisy = not shift
    findings: list[Finding] = []
    if time is not None:
        by_time, explained = _check_time(sample, here, there, wrong, time)
        findings += by_time
        broken[here[wrong & explained]] = True
        wrong = wrong & ~explained
    rows = here[wrong]
    if shift:
        found_at = (rows + shift).clamp(0, len(sample) - 1)
    else:
        found_at = locate(states, states.next[rows], states.now)
    alone = _independent(sample, here, rows, found_at, is_noisy)
    if bool(alone.any()):
        message = (
            f"in {int(alone.sum())} rows {next_key!r} is neither the state of the "
            "following row nor of another one"
        )
        concerned = sample.rows[rows[alone]]
        findings.append(
            finding("next_unrelated", message, key=next_key, rows=concerned)
        )
    rows, found_at = rows[~alone], found_at[~alone]
    if len(rows):
        findings.append(_classify(sample, rows, found_at, len(here), next_key))
        broken[rows] = True
    return findings, broken


def _far(
    sample: Sample, states: States, here: torch.Tensor, there: torch.Tensor
) -> tuple[torch.Tensor, int]:
    """Finds pairs that do not follow each other, in data with the noise of sensors.

    Args:
        sample (Sample): the rows.
        states (States): their states and next states.
        here (torch.Tensor): rows of the sample, ``[p]``.
        there (torch.Tensor): the rows that should follow, ``[p]``.

    Returns:
        tuple: which pairs do not, bool ``[p]``, and by how many rows all next states
        are shifted, 0 if they are not.
    """
    near = states.distance(states.next, here, states.now, there)
    for shift in (-1, 2):
        inside = (here + shift >= 0) & (here + shift < len(sample))
        inside[inside.clone()] = (
            sample.piece[here[inside] + shift] == sample.piece[here[inside]]
        )
        if bool(inside.any()):
            rows = here[inside]
            other = states.distance(states.next, rows, states.now, rows + shift)
            if float(other.median()) < _RELATED * float(near.median()):
                return torch.ones_like(here, dtype=torch.bool), shift
    size = torch.bincount(sample.piece)[sample.piece[here]]
    first = torch.searchsorted(sample.piece, sample.piece[here])
    other = first + (here - first + size // 2) % size
    usual = states.distance(states.next, here, states.now, other)
    if float(near.median()) >= _RELATED * float(usual.median()):
        return torch.ones_like(here, dtype=torch.bool), 0
    return (near > 10 * near.median()) & (near > _RELATED * usual.median()), 0


def _check_time(
    sample: Sample,
    here: torch.Tensor,
    there: torch.Tensor,
    wrong: torch.Tensor,
    time: torch.Tensor,
) -> tuple[list[Finding], torch.Tensor]:
    """Finds wrong pairs whose time goes back, and which pairs that explains."""
    back = wrong & (time[there] < time[here])
    if not bool(back.any()):
        return [], back
    rows = sample.rows[here[back]]
    pieces = int(sample.piece[-1]) + 1
    least = torch.full((pieces,), float("inf"), dtype=torch.float64)
    least = least.scatter_reduce(0, sample.piece, time.double(), "amin")
    piece = sample.piece[here]
    restarts = back & (time[there] <= least[piece])
    if 2 * int(restarts.sum()) >= int(back.sum()):
        message = f"the time starts again within {len(rows)} trajectories"
        return [finding("end_missing", message, rows=rows)], back
    message = f"the time goes back after {len(rows)} rows within trajectories"
    found = finding("rows_out_of_order", message, rows=rows)
    unsorted = torch.zeros(pieces, dtype=torch.bool)
    unsorted[piece[back]] = True
    return [found], unsorted[piece]


def _independent(
    sample: Sample,
    here: torch.Tensor,
    rows: torch.Tensor,
    found_at: torch.Tensor,
    is_noisy: bool,
) -> torch.Tensor:
    """Returns which rows are of trajectories of independent transitions.

    In these no next state is that of the following row, or of any other row.
    """
    pieces = int(sample.piece[-1]) + 1 if len(sample) else 0
    pairs = torch.bincount(sample.piece[here], minlength=pieces)
    wrong = torch.bincount(sample.piece[rows], minlength=pieces)
    found = torch.bincount(sample.piece[rows[found_at >= 0]], minlength=pieces)
    if is_noisy:  # judged together: noise hides what single trajectories show
        is_alone = 10 * found.sum() < wrong.sum()
        is_alone = is_alone & (10 * wrong.sum() > 9 * pairs.sum())
        return torch.full((len(rows),), bool(is_alone))
    return ((wrong == pairs) & (10 * found < pairs) & (pairs > 1))[sample.piece[rows]]


def _classify(
    sample: Sample,
    rows: torch.Tensor,
    found_at: torch.Tensor,
    pairs: int,
    next_key: NestedKey,
) -> Finding:
    """Returns the finding for wrong next states, by where these states are."""
    count = len(rows)
    known = found_at >= 0
    own = known & (sample.piece[found_at.clamp_min(0)] == sample.piece[rows])
    share = f"{count} of {pairs} checked rows"
    named = sample.rows[rows]
    if 2 * int(own.sum()) >= count:
        offset = (found_at - rows)[own]
        usual = int(offset.mode().values)
        constant = 10 * int((offset == usual).sum()) >= 9 * len(offset)
        if constant and usual == 0:
            message = f"in {share} {next_key!r} is equal to the state"
            return finding("next_equals_state", message, key=next_key, rows=named)
        if constant and usual > 1:
            message = f"in {share} {next_key!r} is the state {usual} rows later"
            return finding("next_skips_rows", message, key=next_key, rows=named)
        way = "in reverse" if constant else "out of order"
        message = (
            f"in {share} {next_key!r} is the state of another row of the trajectory "
            f"than the following one: time runs {way}"
        )
        return finding("rows_out_of_order", message, key=next_key, rows=named)
    if 2 * int(known.sum()) >= count:
        message = f"in {share} {next_key!r} is the state of an unrelated row"
        return finding("next_of_other_rows", message, key=next_key, rows=named)
    message = f"in {share} {next_key!r} is not the state of the following row"
    return finding("next_not_following", message, key=next_key, rows=named)
