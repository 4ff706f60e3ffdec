"""What the transform makes of a dataset: sampled swaps and the places they combine."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac.data.offline_buffer import offline_buffer
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.report.places import Place
from torchrl_caiac.trajectories import TrajectoryIndex
from torchrl_caiac.transforms import CAIACTransform

__all__ = [
    "CELLS",
    "PLANE",
    "Cells",
    "PairCoverage",
    "SampledSwaps",
    "choose_examples",
    "moved_entities",
    "pair_coverage",
    "sample_swaps",
]

#: The number of intervals into which the range of a position is divided.
CELLS = 20
#: The number of intervals of each of two coordinates.
PLANE = 8
_BATCH = 512
_NOISE = 2  # times the floor of the layout, what may still be noise
_OUTLIERS = 0.005  # the share of positions below and above the range


@dataclass(frozen=True)
class SampledSwaps:
    """Samples of a replay buffer, before and after its transform.

    Attributes:
        rows (torch.Tensor): int64 ``[M]``, the stored transition of each sample.
        recorded (torch.Tensor): ``[M, W]``, its state as it was stored.
        made (torch.Tensor): ``[M, W]``, its state as it was sampled.
        counterfactual (torch.Tensor): bool ``[M]``, which samples were chosen.
        swapped (torch.Tensor): bool ``[M, N]``, which of their entities were swapped.
        no_donor (int): how often an entity could have been swapped, but no other sample
            of the batch had it uninfluenced.
    """

    rows: torch.Tensor
    recorded: torch.Tensor
    made: torch.Tensor
    counterfactual: torch.Tensor
    swapped: torch.Tensor
    no_donor: int


def sample_swaps(
    data: TensorDictBase,
    layout: EntityLayout,
    thresholds: Mapping[str, float],
    *,
    score_key: NestedKey = ("caiac", "score"),
    rows: int = 20_480,
    ratio: float = 0.5,
    seed: int = 0,
) -> SampledSwaps:
    """Samples a replay buffer with a :class:`~torchrl_caiac.CAIACTransform`.

    Args:
        data (TensorDictBase): transitions ``[T]`` with scores.
        layout (EntityLayout): the entities.
        thresholds (mapping of str to float): θ of each entity that is not fixed.

    Keyword Args:
        score_key (NestedKey): the scores. Defaults to ``("caiac", "score")``.
        rows (int): the number of samples, rounded up to whole batches of 512. Defaults
            to 20,480.
        ratio (float): the share of counterfactual samples. Defaults to 0.5.
        seed (int): the seed of the samples. Defaults to 0.

    Returns:
        SampledSwaps: the samples.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.report.swaps import sample_swaps
        >>> layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])
        >>> state = torch.rand(40, 2)
        >>> data = TensorDict({
        ...     "observation": state, "next": {"observation": state},
        ...     "caiac": {"score": torch.zeros(40, 2)}}, [40])
        >>> swaps = sample_swaps(data, layout, {"cup": 0.1}, rows=512)
        >>> int(swaps.counterfactual.sum()), swaps.swapped.sum(0).tolist()
        (256, [0, 256])
    """
    keys = [*layout.in_keys, *map(layout.next, layout.in_keys), score_key]
    generator = torch.Generator().manual_seed(seed)
    transform = CAIACTransform(
        layout,
        dict(thresholds),
        ratio,
        score_key=score_key,
        generator=generator,
    )
    # Other entries, such as images, would be copied in every batch.
    keys += [key for key in transform.in_keys if key in data.keys(True)]
    stored = data.select(*keys, strict=False)
    rb = offline_buffer(stored, _BATCH)
    rb.set_rng(generator)
    rb.append_transform(transform)
    parts: list[tuple[torch.Tensor, ...]] = []
    with warnings.catch_warnings():
        # The report says itself what is always free, or never.
        warnings.filterwarnings("ignore", message="entities are free")
        for _ in range(-(-rows // _BATCH)):
            batch, info = rb.sample(return_info=True)
            drawn = torch.as_tensor(info["index"]).reshape(-1)
            parts.append(
                (
                    drawn,
                    layout.read(stored[drawn]),
                    layout.read(batch).clone(),
                    batch[transform.keys.counterfactual].reshape(-1),
                    batch[transform.keys.swapped],
                )
            )
    drawn, recorded, made, chosen, swapped = (
        torch.cat(items) for items in zip(*parts, strict=True)
    )
    no_donor = int(transform.no_donor_count.sum())
    return SampledSwaps(drawn, recorded, made, chosen, swapped, no_donor)


@dataclass(frozen=True)
class Cells:
    """The places of an entity, divided into cells.

    An entity at a point in space has :data:`PLANE` by :data:`PLANE` cells of its first
    two coordinates, as seen from above. Any other one, and one that moves along a line,
    has :data:`CELLS` intervals of the position that varies most.

    Attributes:
        name (str): the entity.
        labels (tuple of str): the features that were divided.
        edges (torch.Tensor, optional): float64 ``[CELLS + 1]``, the ends of intervals;
            ``None`` for cells of a plane.
        recorded (torch.Tensor): int64 ``[M]``, the cell of each recorded sample.
        made (torch.Tensor): int64 ``[M]``, the cell of each sample after swapping.
        known (bool): whether the layout says that the features are positions. Defaults
            to ``True``.
    """

    name: str
    labels: tuple[str, ...]
    edges: torch.Tensor | None
    recorded: torch.Tensor
    made: torch.Tensor
    known: bool = True

    @property
    def count(self) -> int:
        """The number of cells."""
        return PLANE**2 if self.edges is None else CELLS


@dataclass(frozen=True)
class PairCoverage:
    """Which places of two entities occur together, before and after swapping.

    Attributes:
        cells (pair of Cells): the places of the two entities.
        before (torch.Tensor): bool ``[C0, C1]``, the recorded combinations of cells.
        after (torch.Tensor): bool ``[C0, C1]``, those after swapping.
    """

    cells: tuple[Cells, Cells]
    before: torch.Tensor
    after: torch.Tensor

    @property
    def names(self) -> tuple[str, str]:
        """The entities."""
        return self.cells[0].name, self.cells[1].name

    @property
    def known(self) -> bool:
        """Whether the layout says where both entities are."""
        return self.cells[0].known and self.cells[1].known

    @property
    def possible(self) -> int:
        """The number of combinations of two cells that were both recorded."""
        return int(self.before.any(1).sum() * self.before.any(0).sum())

    @property
    def share_before(self) -> float:
        """The share of the possible combinations that were recorded."""
        return int(self.before.sum()) / self.possible

    @property
    def share_after(self) -> float:
        """The share of the possible combinations after swapping."""
        return int(self.after.sum()) / self.possible


def pair_coverage(
    swaps: SampledSwaps, places: Mapping[str, Place], fixed: Collection[str]
) -> list[PairCoverage]:
    """Compares the combinations of places in recorded and in sampled states.

    Left out are pairs of fixed entities, and entities that never move: whose positions
    all stay within four times the noise of the layout's ``variance_floor``.

    Args:
        swaps (SampledSwaps): the samples.
        places (mapping of str to Place): where each entity is, in layout order.
        fixed (collection of str): entities that are never swapped.

    Returns:
        list of PairCoverage: the pairs, those that gain most first.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.report.places import Place
        >>> from torchrl_caiac.report.swaps import SampledSwaps, pair_coverage
        >>> recorded = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
        >>> flags = torch.tensor([[False, True], [False, True]])
        >>> swaps = SampledSwaps(
        ...     torch.arange(2), recorded, torch.tensor([[0.0, 1.0], [1.0, 1.0]]),
        ...     flags[:, 1], flags, 0)
        >>> places = {
        ...     "arm": Place((0,), ("x",), (0.0,)), "cup": Place((1,), ("y",), (0.0,))}
        >>> pair = pair_coverage(swaps, places, ["arm"])[0]
        >>> pair.possible, pair.share_before, pair.share_after
        (4, 0.5, 0.5)
    """
    cells = [
        found
        for name, place in places.items()
        if (found := _cells(swaps, name, place)) is not None
    ]
    pairs = []
    for a, b in combinations(cells, 2):
        if a.name in fixed and b.name in fixed:
            continue
        before = torch.zeros(a.count, b.count, dtype=torch.bool)
        after = before.clone()
        before[a.recorded, b.recorded] = True
        after[a.made, b.made] = True
        pairs.append(PairCoverage((a, b), before, after))
    return sorted(pairs, key=lambda p: p.share_before - p.share_after)


def _cells(swaps: SampledSwaps, name: str, place: Place) -> Cells | None:
    """Divides the places of an entity; ``None`` if it never moves."""
    features = list(place.features)
    recorded, made = swaps.recorded[:, features], swaps.made[:, features]
    ordered = recorded.double().sort(0).values
    limits = torch.tensor([_OUTLIERS, 1 - _OUTLIERS], dtype=torch.float64)
    low, high = ordered[(limits * (len(ordered) - 1)).round().long()]
    least = 2 * _NOISE * torch.tensor(place.floors, dtype=torch.float64)
    if not (high - low > least).any():
        low, high = ordered[0], ordered[-1]  # it may move in outliers alone
    moves = high - low > least
    if not moves.any():
        return None

    def divided(values: torch.Tensor, feature: int, count: int) -> torch.Tensor:
        edges = torch.linspace(low[feature], high[feature], count + 1).double()
        # What lies outside of the range counts for the first or last interval.
        return torch.bucketize(values[:, feature].double().contiguous(), edges[1:-1])

    if not place.is_point or not moves[:2].all():
        widest = int((high - low).argmax())
        edges = torch.linspace(low[widest], high[widest], CELLS + 1).double()
        before, after = (divided(values, widest, CELLS) for values in (recorded, made))
        label = (place.labels[widest],)
        return Cells(name, label, edges, before, after, place.known)

    def planar(values: torch.Tensor) -> torch.Tensor:
        row, column = (divided(values, feature, PLANE) for feature in (0, 1))
        # Back and forth, so that successive cells are neighbours.
        return row * PLANE + torch.where(row % 2 == 0, column, PLANE - 1 - column)

    return Cells(name, place.labels[:2], None, planar(recorded), planar(made))


def moved_entities(
    swaps: SampledSwaps, places: Mapping[str, Place]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns which entities a swap has put elsewhere, and how far.

    Args:
        swaps (SampledSwaps): the samples.
        places (mapping of str to Place): where each entity is, in layout order.

    Returns:
        tuple of torch.Tensor: bool ``[M, N]``, whether a position has changed by more
        than twice its noise and by more than a twentieth of its standard deviation;
        and float64 ``[M, N]``, the distance in standard deviations.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.report.places import Place
        >>> from torchrl_caiac.report.swaps import SampledSwaps, moved_entities
        >>> recorded = torch.tensor([[0.0], [2.0]])
        >>> flags = torch.tensor([[True], [False]])
        >>> swaps = SampledSwaps(
        ...     torch.arange(2), recorded, recorded[[1, 1]], flags[:, 0], flags, 0)
        >>> moved_entities(swaps, {"cup": Place((0,), ("y",), (0.1,))})[0].tolist()
        [[True], [False]]
    """
    moved, distances = [], []
    for place in places.values():
        features = list(place.features)
        recorded = swaps.recorded[:, features].double()
        change = (swaps.made[:, features].double() - recorded).abs()
        spread = recorded.std(0, unbiased=False)
        least = _NOISE * torch.tensor(place.floors, dtype=torch.float64)
        moved.append((change > torch.maximum(least, 0.05 * spread)).any(-1))
        distances.append(change.norm(dim=-1) / spread.norm().clamp_min(1e-300))
    return torch.stack(moved, -1), torch.stack(distances, -1)


def choose_examples(
    swaps: SampledSwaps,
    influenced: torch.Tensor,
    places: Mapping[str, Place],
    fixed: Collection[str],
    index: TrajectoryIndex,
    count: int,
) -> list[int]:
    """Chooses counterfactual samples that show what a swap does.

    They are in the order in which they were drawn, among samples in which a swap has
    put an entity elsewhere, by at least half of its standard deviation where there are
    such. Samples come first in which the action influences an entity that can be
    swapped. No two have the same trajectory or the same moved and influenced entities,
    as far as possible.

    Args:
        swaps (SampledSwaps): the samples.
        influenced (torch.Tensor): bool ``[T, N]``.
        places (mapping of str to Place): where each entity is, in layout order.
        fixed (collection of str): entities that are never swapped.
        index (TrajectoryIndex): the trajectories of the stored transitions.
        count (int): how many to choose, at most.

    Returns:
        list of int: their positions among the samples.
    """
    movable = torch.tensor([name not in fixed for name in places])
    moved, distances = moved_entities(swaps, places)
    busy = influenced[swaps.rows] & movable
    far = (distances.where(moved, 0.0)).amax(-1) >= 0.5
    rank = busy.any(-1).long() * 2 + far
    order = rank.argsort(descending=True, stable=True)
    order = order[moved.any(-1)[order]]
    kinds = torch.cat([moved, busy], -1)[order].unique(dim=0, return_inverse=True)[1]
    trajectories = index.numbers()[swaps.rows[order]]
    rows = swaps.rows[order]
    chosen: list[int] = []
    # With less and less variety, until there are enough.
    for differ in ((trajectories, kinds), (trajectories,), (rows,)):
        used = [set(values[chosen].tolist()) for values in differ]
        for i in range(len(order)):
            if len(chosen) == count:
                break
            own = [int(values[i]) for values in differ]
            if i in chosen or any(x in s for x, s in zip(own, used, strict=True)):
                continue
            chosen.append(i)
            for x, seen in zip(own, used, strict=True):
                seen.add(x)
    return order[sorted(chosen)].tolist()
