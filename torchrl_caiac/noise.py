"""How much the columns of an entity change while it rests, and while it moves."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer

from torchrl_caiac._checks import check_int, check_local
from torchrl_caiac._layout_units import position_features
from torchrl_caiac._spread import spread_rows
from torchrl_caiac._torchrl import storage_rows
from torchrl_caiac.entities import EntityLayout

__all__ = ["EntityNoise", "resting_noise", "sample_rows"]

# Of the median change while it moves: smaller changes do not matter to a model, and
# much smaller ones are no motion.
_SHARE, _LEAST = 0.1, 0.02
_DEVIATIONS = 4.0  # of the noise: larger changes are motion
_LARGE = 0.999  # the quantile of the changes that stands for fast motion
# Of fast motion: differences between smaller changes do not matter, at first, and then
# among the rows that seem to rest, in which much slower motion may hide.
_STILL = (1e-2, 1e-3)
# Of the median change of the fastest entity, at least.
_FLOOR_BESIDE, _TOLERANCE_BESIDE = 0.05, 0.002
_BINS = 120
_SPREAD = 0.1  # decades: the smallest deviation of a mode
# Nats for each row of the smaller mode, by which two modes must explain the data better
# than one. The sizes of one Gaussian reach 1.2.
_GAIN = 1.4
_FEWEST = 5  # rows in a mode


@dataclass(frozen=True)
class EntityNoise:
    """How the columns of an entity change, see :func:`resting_noise`.

    Args:
        floor (tuple of float): for each of its ``W`` features the standard deviation
            below which a change does not matter.
        tolerance (tuple of float): for each feature the largest change that is noise.
        noise (tuple of float): the root mean square of the changes while it rests,
            without the largest 1 %; NaN if it never rests.
        moving (tuple of float): the median size of the changes while it clearly moves,
            NaN if it never moves.
        rest_share (float): the share of the rows in which it rests.
        reason (str): how the floor was found.
    """

    floor: tuple[float, ...]
    tolerance: tuple[float, ...]
    noise: tuple[float, ...]
    moving: tuple[float, ...]
    rest_share: float
    reason: str


def resting_noise(
    data: TensorDictBase | ReplayBuffer,
    layout: EntityLayout,
    *,
    max_rows: int = 100_000,
) -> dict[str, EntityNoise]:
    """Measures the noise of every entity at rest, and the size of its motion.

    An entity's changes from a state to the next one have two modes if it both rests and
    moves. They are told apart on a logarithmic scale, by the split with the smallest
    classification error of two Gaussians (Kittler and Illingworth, 1986). The changes
    are those of ``layout.positions`` if they are known, else of all columns, each
    divided by its 99.9 % quantile.

    The rows that seem to rest are split once more, because slow motion hides beside
    fast motion.

    The floor of a column is the largest of three numbers: the noise at rest, a tenth of
    the median change while the entity moves, and the resolution of the numbers. The
    tolerance is the largest of four times the noise, the 99.9 % quantile of the changes
    at rest, a fiftieth of the median change while the entity moves, and the resolution.
    For positions that the layout names, the floor is also at least a twentieth, and the
    tolerance a 500th, of the median change of the fastest entity: next to it, a
    simulator's jitter is no motion. (A fixed entity with another number of positions
    than the others, such as joint angles of a robot, is left out.)

    Args:
        data (TensorDictBase or ReplayBuffer): transitions, ``[*B]``.
        layout (EntityLayout): the entities.

    Keyword Args:
        max_rows (int): the number of rows to read, evenly spaced. Defaults to 100,000.

    Returns:
        dict of str to EntityNoise: the noise of each entity, in layout order.

    Raises:
        KeyError: the state or the next state is missing.
        ValueError: there are no rows, or the data have NaN or infinite values.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.noise import resting_noise
        >>> change = torch.full((100, 1), 0.5)
        >>> change[:60] = 0.001 * (-1) ** torch.arange(60).view(60, 1)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.zeros(100, 1),
        ...         ("next", "observation"): change,
        ...     },
        ...     [100],
        ... )
        >>> cup = resting_noise(data, EntityLayout({"cup": [0]}))["cup"]
        >>> print(cup.reason)
        rests in 60.0 % of 100 rows with noise 0.001; changes by 0.5 (median) where it
        moves, of which a tenth is the floor
        >>> round(cup.floor[0], 4), round(cup.noise[0], 4)
        (0.05, 0.001)
    """
    rows = sample_rows(data, max_rows)
    layout.check(rows, next=True)
    stored = layout.read(rows)
    now = stored.cpu().double().flatten(0, -2)
    after = layout.read(rows, next=True).cpu().double().flatten(0, -2)
    change = (after - now).abs()
    if not bool(change.isfinite().all()):
        bad = [
            name
            for name, where in layout.slices(rows).items()
            if not bool(change[:, where].isfinite().all())
        ]
        raise ValueError(
            f"the states or next states of {bad} have NaN or infinite values: remove "
            "or repair these rows"
        )
    rounding = _rounding(stored.dtype, torch.cat([now, after]))
    result = {}
    for name, where in layout.slices(rows).items():
        columns = position_features(layout, name, where.stop - where.start)
        result[name] = _entity(change[:, where], rounding[where], columns)
    return _beside_the_fastest(result, layout, layout.slices(rows))


def _rounding(dtype: torch.dtype, values: torch.Tensor) -> torch.Tensor:
    """Returns the rounding of stored numbers ``[n, W]``, ``[W]``.

    Double precision numbers are often made of single precision ones. If not, changes
    that are tiny next to the range of a column are those of a simulator at rest. Whole
    numbers, which integers are read as, have no rounding.
    """
    largest = values.abs().amax(0)
    if dtype != torch.float64:
        return torch.finfo(dtype).eps * largest
    single = torch.finfo(torch.float32).eps
    is_single = (values.float().double() == values).all(0)
    spread = values.amax(0) - values.amin(0)
    fine = torch.maximum(single * spread, torch.finfo(dtype).eps * largest)
    found = torch.where(is_single, single * largest, fine)
    return found.masked_fill((values == values.round()).all(0), 0.0)


def _beside_the_fastest(
    found: dict[str, EntityNoise], layout: EntityLayout, slices: dict[str, slice]
) -> dict[str, EntityNoise]:
    """Raises floors and tolerances that are tiny next to the motion of other entities.

    A simulator's jitter is not the motion of an entity that never really moves. Only
    positions are compared, which have similar units, and no others with those of a
    fixed entity that has another number of them, such as joint angles.
    """
    places = {
        name: position_features(layout, name, slices[name].stop - slices[name].start)
        for name in layout.positions
    }
    sizes = {len(own) for name, own in places.items() if name not in layout.fixed}
    motion = {
        name: max(
            (found[name].moving[c] for c in own if found[name].moving[c] > 0), default=0
        )
        for name, own in places.items()
        if name not in layout.fixed or not sizes or len(own) in sizes
    }
    fastest = max(motion, key=lambda name: motion[name], default="")
    for name, own in places.items():
        noise, most = found[name], motion[fastest]
        floor = _raised(noise.floor, own, _FLOOR_BESIDE * most)
        tolerance = _raised(noise.tolerance, own, _TOLERANCE_BESIDE * most)
        reason = noise.reason
        if floor != noise.floor:
            reason += (
                f"; raised to {_FLOOR_BESIDE * most:.3g}, a twentieth of the median "
                f"change of {fastest!r}"
            )
        found[name] = replace(noise, floor=floor, tolerance=tolerance, reason=reason)
    return found


def _raised(
    values: tuple[float, ...], places: list[int], least: float
) -> tuple[float, ...]:
    """Raises the values of positions to a limit, other units by the same factor."""
    factor = max(1.0, least / max(values[c] for c in places))
    return tuple(
        max(v, least) if c in places else factor * v for c, v in enumerate(values)
    )


def sample_rows(data: TensorDictBase | ReplayBuffer, max_rows: int) -> TensorDictBase:
    """Returns evenly spaced rows of a dataset.

    Args:
        data (TensorDictBase or ReplayBuffer): transitions, ``[*B]``.
        max_rows (int): the largest number of rows.

    Returns:
        TensorDictBase: ``[n]``; all rows, not copied, if there are not more.

    Raises:
        ValueError: there are no rows, or ``max_rows`` is less than 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.noise import sample_rows
        >>> sample_rows(TensorDict({"x": torch.arange(9)}, [9]), 3)["x"]
        tensor([0, 4, 8])
    """
    check_int("max_rows", max_rows, 1)
    check_local("data", data)
    if isinstance(data, ReplayBuffer):
        storage = data.storage
        data = storage_rows(storage)[: len(storage)]
    elif data.batch_dims > 1:
        data = data.reshape(-1)
    if not data.batch_dims or not len(data):
        raise ValueError(
            f"the data have batch size {list(data.batch_size)}, expected at least one "
            "row: collect or load transitions first"
        )
    return data if len(data) <= max_rows else data[spread_rows(len(data), max_rows)]


def _entity(
    change: torch.Tensor, rounding: torch.Tensor, columns: list[int]
) -> EntityNoise:
    """Measures one entity from the sizes ``[n, W]`` of its changes."""
    count, width = change.shape
    resolution = torch.stack(
        [_resolution(c, float(r)) for c, r in zip(change.T, rounding, strict=True)]
    )
    large = torch.stack([_quantile(c, _LARGE) for c in change.T])
    varies = large > resolution
    tell = [c for c in columns if bool(varies[c])]
    nan = torch.full((width,), math.nan, dtype=change.dtype)
    rests = torch.ones(count, dtype=torch.bool)
    if not tell:
        noise, moving = change.square().mean(0).sqrt(), nan
        reason = f"never moves in {count} rows"
    else:
        size = (change[:, tell] / large[tell]).amax(1)
        rests = (change[:, tell] <= resolution[tell]).all(1)
        limit, moves = math.inf, ~rests
        for still in _STILL:
            split = _split((size[size <= limit] + still).log10())
            if split is None:
                continue
            if limit == math.inf:
                moves = size > 10.0**split - still
            limit = 10.0**split - still
            rests = size <= limit
        noise = _typical(change[rests]) if bool(rests.any()) else nan
        moving = torch.where(varies, change[moves].median(0).values, nan)
        reason = ""
    zero = torch.zeros_like(nan)
    motion = torch.where(moving.isnan(), zero, moving)
    quiet = torch.where(noise.isnan(), zero, noise)
    floor = torch.maximum(quiet, torch.maximum(_SHARE * motion, resolution))
    least = torch.maximum(_LEAST * motion, resolution)
    tolerance = torch.maximum(_DEVIATIONS * quiet, least)
    if bool(rests.any()):
        # Among few rows, the largest change may be motion that seems to be rest.
        share = min(_LARGE, 1 - _FEWEST / int(rests.sum()))
        at_rest = torch.stack([_quantile(c, share) for c in change[rests].T])
        tolerance = torch.maximum(tolerance, at_rest)
    if not reason:
        reason = _reason(rests, noise, moving, floor, resolution, tell)
    return EntityNoise(
        floor=tuple(floor.tolist()),
        tolerance=tuple(tolerance.tolist()),
        noise=tuple(noise.tolist()),
        moving=tuple(moving.tolist()),
        rest_share=float(rests.double().mean()),
        reason=reason,
    )


def _reason(
    rests: torch.Tensor,
    noise: torch.Tensor,
    moving: torch.Tensor,
    floor: torch.Tensor,
    resolution: torch.Tensor,
    tell: list[int],
) -> str:
    c = max(tell, key=lambda column: float(floor[column]))
    share = float(rests.double().mean())
    first = f"rests in {100 * share:.1f} % of {len(rests)} rows"
    first += f" with noise {noise[c]:.3g}" if share else ""
    then = f"changes by {moving[c]:.3g} (median) where it moves"
    if floor[c] == noise[c]:
        return f"{then}; {first}, which is the floor"
    if floor[c] == resolution[c]:
        return f"{first}; {then}; the resolution {resolution[c]:.3g} is the floor"
    return f"{first}; {then}, of which a tenth is the floor"


def _typical(change: torch.Tensor) -> torch.Tensor:
    """Returns the root mean square of changes ``[n, W]`` without the largest 1 %."""
    kept = max(1, math.floor(0.99 * len(change)))
    return change.sort(0).values[:kept].square().mean(0).sqrt()


def _quantile(values: torch.Tensor, share: float) -> torch.Tensor:
    """Returns a quantile, or the largest value if the quantile is zero."""
    found = values.kthvalue(max(1, math.ceil(share * len(values)))).values
    return found if bool(found > 0) else values.amax()


def _resolution(change: torch.Tensor, rounding: float) -> torch.Tensor:
    """Returns the step of a column whose values lie on a grid, else its rounding."""
    smallest = torch.finfo(torch.float32).tiny
    least = change.new_tensor(max(4 * rounding, smallest))
    nonzero = change[change > least]
    if len(nonzero) < _FEWEST:
        return least
    step = nonzero.amin()
    steps = nonzero / step
    # A flag that is 0 or 1 changes by one step alone, and that is motion.
    if bool((steps - steps.round()).abs().mean() < 1e-2) and bool(steps.amax() > 1.5):
        return torch.maximum(step, least)
    return least


def _split(values: torch.Tensor) -> float | None:
    """Returns the split between two modes ``[n]``, ``None`` if there is one mode."""
    low, high = float(values.amin()), float(values.amax())
    if high - low < 2 * _SPREAD:
        return None
    edges = torch.linspace(low, high, _BINS + 1, dtype=values.dtype)
    count = torch.histc(values, _BINS, low, high)
    center = (edges[:-1] + edges[1:]) / 2
    n0 = count.cumsum(0)[:-1]
    n1 = len(values) - n0
    total, total_square = (count * center).sum(), (count * center.square()).sum()
    s0, q0 = (
        (count * center).cumsum(0)[:-1],
        (count * center.square()).cumsum(0)[:-1],
    )

    def log_deviation(
        n: torch.Tensor, s: torch.Tensor, q: torch.Tensor
    ) -> torch.Tensor:
        n = n.clamp_min(1)
        variance = (q / n - (s / n).square()).clamp_min(_SPREAD**2)
        return 0.5 * variance.log()

    share0, share1 = n0 / len(values), n1 / len(values)
    cost = share0 * (log_deviation(n0, s0, q0) - share0.log())
    cost += share1 * (log_deviation(n1, total - s0, total_square - q0) - share1.log())
    cost[(n0 < _FEWEST) | (n1 < _FEWEST)] = math.inf
    one = log_deviation(values.new_tensor(len(values)), total, total_square)
    best = int(cost.argmin())
    smaller = torch.minimum(share0, share1)[best]
    if not bool(one - cost[best] > _GAIN * smaller):
        return None
    # The middle of the empty bins between the modes, if there are any.
    lowest = (cost <= cost[best] + 1e-9).nonzero()[:, 0]
    return float((edges[1 + int(lowest[0])] + edges[1 + int(lowest[-1])]) / 2)
