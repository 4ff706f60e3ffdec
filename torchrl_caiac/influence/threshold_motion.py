"""In which rows entities visibly move, as evidence of influence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._columns import check_names
from torchrl_caiac._layout_units import position_places
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.threshold_rule import MOVES, RESTS
from torchrl_caiac.noise import resting_noise
from torchrl_caiac.trajectories import trajectory_index

__all__ = [
    "SampledRows",
    "doubt_of_zeros",
    "motion_of_rows",
    "position_tolerances",
    "sample_blocks",
    "without_near_rests",
]

# A change above this multiple of the tolerance is motion, one up to it is rest.
_CLEAR = 3.0
_NEITHER = -1
# Rows at rest this near a row that is not: the entity is likely to be in reach.
_NEAR = 3
_BLOCK = 1000  # successive rows that are sampled together
_CHUNK = 20_000  # rows that are read together


class SampledRows(NamedTuple):
    """Rows of a dataset, in blocks that follow each other in time.

    Attributes:
        rows (torch.Tensor): int64 ``[K, B]``.
        remaining (torch.Tensor, optional): int64 ``[K, B]``, later rows of the
            trajectory; ``None`` if they do not matter.
    """

    rows: torch.Tensor
    remaining: torch.Tensor | None


def sample_blocks(
    data: TensorDictBase,
    length: int,
    *,
    lookahead: int,
    max_rows: int,
    trajectory_key: NestedKey | None,
    done_key: NestedKey | None,
) -> SampledRows:
    """Chooses rows of a dataset, always the same ones.

    Args:
        data (TensorDictBase): the rows, at least ``length``.
        length (int): how many of them there are.

    Keyword Args:
        lookahead (int): the number of later rows that the score of a row covers.
        max_rows (int): about how many rows to choose.
        trajectory_key (NestedKey, optional): the trajectory ids.
        done_key (NestedKey, optional): the end flags.

    Returns:
        SampledRows: all rows if there are at most ``max_rows``.

    Raises:
        KeyError: the trajectories are needed, and both keys are missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.influence.threshold_motion import sample_blocks
        >>> data = TensorDict({"episode": torch.tensor([0, 0, 0, 1, 1])}, [5])
        >>> sample_blocks(data, 5, lookahead=1, max_rows=9, trajectory_key="episode",
        ...     done_key=None).remaining
        tensor([[2, 1, 0, 1, 0]])
    """
    if length <= max_rows:
        place = torch.arange(length).unsqueeze(0)
    else:
        size = min(max(_BLOCK, 10 * (lookahead + 1)), max_rows)
        starts = torch.arange(0, length - size + 1, size)
        generator = torch.Generator().manual_seed(0)
        chosen = torch.randperm(len(starts), generator=generator)[: max_rows // size]
        place = starts[chosen.sort().values].unsqueeze(-1) + torch.arange(size)
    if not lookahead:
        return SampledRows(place, None)
    index = trajectory_index(
        data[:length], trajectory_key=trajectory_key, done_key=done_key
    )
    rows = index.rows(place.to(index.device))
    return SampledRows(rows.cpu().long(), index.remaining(rows).cpu().long())


def position_tolerances(
    data: TensorDictBase,
    layout: EntityLayout,
    given: Mapping[str, float] | float | None = None,
) -> dict[str, torch.Tensor]:
    """Returns the change of each position that is noise, in the units of the data.

    Args:
        data (TensorDictBase): transitions ``[T]``, whose noise is measured if neither
            ``given`` nor the layout has a tolerance.
        layout (EntityLayout): the entities, with positions.
        given (float or mapping of str to float, optional): the tolerance.

    Returns:
        dict of str to torch.Tensor: float64, for each entity with positions one number
        for each of them.

    Raises:
        ValueError: a tolerance is not positive, or that of no entity.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence.threshold_motion import position_tolerances
        >>> layout = EntityLayout(
        ...     {"cup": [0, 1, 2]}, positions={"cup": [0, 1]},
        ...     variance_floor={"cup": [0.5, 0.25, 9.0]})
        >>> position_tolerances(TensorDict(), layout)["cup"]
        tensor([0.5000, 0.2500], dtype=torch.float64)
    """
    names = list(layout.positions)
    if given is not None:
        numbers = given if isinstance(given, Mapping) else dict.fromkeys(names, given)
        check_names(numbers, layout.names, "tolerance")
        for name, number in numbers.items():
            if not 0 < number < math.inf:
                raise ValueError(
                    f"tolerance of entity {name!r} is {number!r}, expected a number in "
                    "the units of the data, positive and finite"
                )
        return {
            name: torch.full(
                (len(layout.positions[name]),), float(numbers[name])
            ).double()
            for name in names
            if name in numbers
        }
    floors: Mapping[str, float | tuple[float, ...]] = layout.variance_floor
    if not floors and names:
        noise = resting_noise(data, layout)
        floors = {name: noise[name].tolerance for name in names}
    result = {}
    for name in names:
        places, floor = position_places(layout, name), floors[name]
        if isinstance(floor, float):
            result[name] = torch.full((len(places),), floor).double()
        else:
            result[name] = torch.tensor([floor[place] for place in places]).double()
    return result


def motion_of_rows(
    data: TensorDictBase,
    layout: EntityLayout,
    sampled: SampledRows,
    tolerances: Mapping[str, torch.Tensor],
    *,
    lookahead: int = 0,
) -> dict[str, torch.Tensor]:
    """Returns where entities move in the recorded transitions, or up to a later one.

    Args:
        data (TensorDictBase): transitions ``[T]``.
        layout (EntityLayout): the entities.
        sampled (SampledRows): the rows to look at.
        tolerances (mapping of str to torch.Tensor): see :func:`position_tolerances`.

    Keyword Args:
        lookahead (int): the number of later rows that count too. Defaults to 0.

    Returns:
        dict of str to torch.Tensor: for each entity with a tolerance int8 ``[K * B]``:
        ``MOVES`` if a position changes by more than three tolerances, ``RESTS`` if none
        changes by more than one, else another number.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence.threshold_motion import (
        ...     motion_of_rows, position_tolerances, sample_blocks)
        >>> layout = EntityLayout({"cup": [0]}, positions={"cup": [0]})
        >>> data = TensorDict({
        ...     "observation": torch.tensor([[0.0], [0.0], [0.9]]),
        ...     ("next", "observation"): torch.tensor([[0.0], [0.9], [1.1]])}, [3])
        >>> sampled = sample_blocks(data, 3, lookahead=0, max_rows=9,
        ...     trajectory_key=None, done_key=None)
        >>> tolerances = position_tolerances(data, layout, 0.1)
        >>> motion_of_rows(data, layout, sampled, tolerances)["cup"]
        tensor([ 0,  1, -1], dtype=torch.int8)
    """
    if not tolerances:
        return {}
    rows = sampled.rows.reshape(-1)
    parts = [_changes(data, layout, part, tolerances) for part in rows.split(_CHUNK)]
    changes = torch.cat(parts).view(*sampled.rows.shape, -1)
    is_whole = torch.ones(sampled.rows.shape, dtype=torch.bool)
    if sampled.remaining is not None and lookahead:
        changes, is_whole = _with_later(changes, sampled.remaining, lookahead)
    motion = torch.full(changes.shape, _NEITHER, dtype=torch.int8)
    motion[(changes <= 1) & is_whole.unsqueeze(-1)] = RESTS
    motion[changes > _CLEAR] = MOVES
    return dict(zip(tolerances, motion.flatten(0, 1).unbind(-1), strict=True))


def doubt_of_zeros(
    data: TensorDictBase, layout: EntityLayout, rows: torch.Tensor, name: str
) -> str | None:
    """Returns why an entity could be influenced although all of its scores are 0.

    Args:
        data (TensorDictBase): transitions ``[T]``.
        layout (EntityLayout): the entities.
        rows (torch.Tensor): int64 ``[n]``, the rows to look at.
        name (str): an entity whose positions are unknown.

    Returns:
        str, optional: the reason: a column changes by more than the layout's
        ``variance_floor`` (at all, if there is none), or the states are missing;
        ``None`` if it always rests.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence.threshold_motion import doubt_of_zeros
        >>> data = TensorDict({
        ...     "observation": torch.zeros(2, 2),
        ...     ("next", "observation"): torch.tensor([[0.0, 0.0], [0.0, 0.1]])}, [2])
        >>> layout = EntityLayout({"cup": [0], "lid": [1]})
        >>> doubt_of_zeros(data, layout, torch.arange(2), "cup")
        >>> doubt_of_zeros(data, layout, torch.arange(2), "lid")
        'its state changes'
    """
    keys = [*layout.in_keys, *(layout.next(key) for key in layout.in_keys)]
    missing = [key for key in keys if data.get(key, None) is None]
    if missing:
        return f"{missing} are missing, so that it is not known to rest"
    for part in rows.split(_CHUNK):
        td = _read(data, layout, part)
        change = layout.read(td, next=True).double() - layout.read(td).double()
        own = change[:, layout.slices(td)[name]].abs().cpu()
        floor = torch.tensor(layout.variance_floor.get(name, 0.0)).double()
        if not bool((own <= floor).all()):
            return "its state changes"
    return None


def without_near_rests(motion: torch.Tensor) -> torch.Tensor:
    """Returns motion without the rows at rest just before or after motion.

    There the agent is often about to move the entity, or has just let it go: it could
    be moved by another action, although it rests.

    Args:
        motion (torch.Tensor): of one entity, int8 ``[K, B]``, successive rows.

    Returns:
        torch.Tensor: int8 ``[K, B]``. Rows at rest up to three rows from one that does
        not rest are neither; if fewer than half would be left, all are kept.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence.threshold_motion import without_near_rests
        >>> without_near_rests(torch.tensor([[0, 0, 0, 0, 0, 0, 0, 0, 0, 1]]).char())
        tensor([[ 0,  0,  0,  0,  0,  0, -1, -1, -1,  1]], dtype=torch.int8)
    """
    rests = motion == RESTS
    is_near = ~rests
    for step in range(1, min(_NEAR + 1, motion.shape[1])):
        is_near[:, :-step] |= ~rests[:, step:]
        is_near[:, step:] |= ~rests[:, :-step]
    left = rests & ~is_near
    if 2 * int(left.sum()) < int(rests.sum()):
        return motion
    return motion.masked_fill(rests & is_near, _NEITHER)


def _changes(
    data: TensorDictBase,
    layout: EntityLayout,
    rows: torch.Tensor,
    tolerances: Mapping[str, torch.Tensor],
) -> torch.Tensor:
    """Returns the largest change of each entity in tolerances, ``[n, E]``."""
    part = _read(data, layout, rows)
    change = layout.read(part, next=True).double() - layout.read(part).double()
    slices = layout.slices(part)
    found = []
    for name, tolerance in tolerances.items():
        places = [slices[name].start + place for place in position_places(layout, name)]
        size = change[:, torch.tensor(places, device=change.device)].abs().cpu()
        found.append((size / tolerance).amax(-1))
    return torch.stack(found, -1)


def _read(
    data: TensorDictBase, layout: EntityLayout, rows: torch.Tensor
) -> TensorDictBase:
    """Returns the states and the next states of some rows."""
    device = data.device or next(iter(data.values(True, True))).device
    part = data.select(*layout.in_keys, *(layout.next(key) for key in layout.in_keys))
    return part[rows.to(device)]


def _with_later(
    changes: torch.Tensor, remaining: torch.Tensor, lookahead: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the largest change up to ``lookahead`` rows later, ``[K, B, E]``.

    And bool ``[K, B]``, whether all these rows are in the block.
    """
    size = changes.shape[1]
    span, largest = 1, changes
    while span < lookahead + 1:
        step = min(span, lookahead + 1 - span)
        later = torch.zeros_like(largest)
        later[:, :-step] = largest[:, step:]
        # A later row of another trajectory says nothing.
        later[remaining < step] = 0
        largest = torch.maximum(largest, later)
        span += step
    last = torch.arange(size) + remaining.clamp_max(lookahead)
    return largest, last < size
