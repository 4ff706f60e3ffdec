"""What the transform makes of a dataset: sampled swaps and the places they combine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac.data.offline_buffer import offline_buffer
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.report.places import Place
from torchrl_caiac.transforms import CAIACTransform

__all__ = [
    "CELLS",
    "PairCoverage",
    "SampledSwaps",
    "choose_examples",
    "pair_coverage",
    "sample_swaps",
]

#: The number of intervals into which the range of a position is divided.
CELLS = 20
_BATCH = 512
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
    limits = set(thresholds.values())
    transform = CAIACTransform(
        layout,
        limits.pop() if len(limits) == 1 else thresholds,
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
    joined = [torch.cat(items) for items in zip(*parts, strict=True)]
    return SampledSwaps(*joined, int(transform.no_donor_count.sum()))


@dataclass(frozen=True)
class PairCoverage:
    """Which places of two entities occur together, before and after swapping.

    The range of each entity's position is divided into :data:`CELLS` intervals, and two
    entities make a grid. A combination is *possible* if each of its intervals is
    occupied by its own entity in some recorded sample.

    Attributes:
        names (pair of str): the entities.
        labels (pair of str): the features that stand for their positions.
        edges (pair of torch.Tensor): float64 ``[CELLS + 1]`` each.
        before (torch.Tensor): bool ``[CELLS, CELLS]``, the recorded combinations; the
            first dimension is that of the first entity.
        after (torch.Tensor): bool ``[CELLS, CELLS]``, those after swapping.
        possible (int): the number of possible combinations.
    """

    names: tuple[str, str]
    labels: tuple[str, str]
    edges: tuple[torch.Tensor, torch.Tensor]
    before: torch.Tensor
    after: torch.Tensor
    possible: int

    @property
    def share_before(self) -> float:
        """The share of the possible combinations that were recorded."""
        return int(self.before.sum()) / self.possible

    @property
    def share_after(self) -> float:
        """The share of the possible combinations after swapping."""
        return int(self.after.sum()) / self.possible


def pair_coverage(
    swaps: SampledSwaps, places: Mapping[str, Place], fixed: frozenset[str]
) -> list[PairCoverage]:
    """Compares the combinations of places in recorded and in sampled states.

    One feature stands for the place of an entity: the position that varies most.
    Entities that never move are left out, and pairs of fixed entities.

    Args:
        swaps (SampledSwaps): the samples.
        places (mapping of str to Place): where each entity is, in layout order.
        fixed (frozenset of str): entities that are never swapped.

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
        >>> places = {"arm": Place((0,), ("x",), True), "cup": Place((1,), ("y",), True)}
        >>> pair = pair_coverage(swaps, places, frozenset(["arm"]))[0]
        >>> pair.share_before, pair.share_after
        (0.5, 0.5)
    """
    grids = {}
    for name, place in places.items():
        grid = _grid(swaps, place)
        if grid is not None:
            grids[name] = grid
    pairs = []
    for first, second in combinations(grids, 2):
        if first in fixed and second in fixed:
            continue
        a, b = grids[first], grids[second]
        before = torch.zeros(CELLS, CELLS, dtype=torch.bool)
        after = before.clone()
        before[a.before, b.before] = True
        after[a.after, b.after] = True
        pairs.append(
            PairCoverage(
                (first, second),
                (a.label, b.label),
                (a.edges, b.edges),
                before,
                after,
                int(before.any(1).sum() * before.any(0).sum()),
            )
        )
    return sorted(pairs, key=lambda p: p.share_before - p.share_after)


@dataclass(frozen=True)
class _Grid:
    label: str
    edges: torch.Tensor
    before: torch.Tensor  # int64 [M], the interval of each recorded sample
    after: torch.Tensor


def _grid(swaps: SampledSwaps, place: Place) -> _Grid | None:
    """Divides the range of an entity's place; ``None`` if it never changes."""
    features = list(place.features)
    recorded = swaps.recorded[:, features].double()
    limits = torch.tensor([_OUTLIERS, 1 - _OUTLIERS], dtype=torch.float64)
    ordered = recorded.sort(0).values
    low, high = ordered[(limits * (len(ordered) - 1)).round().long()]
    widest = int((high - low).argmax())
    if not high[widest] > low[widest]:
        # It moves so rarely that all but outliers are the same.
        low, high = ordered[0], ordered[-1]
        widest = int((high - low).argmax())
        if not high[widest] > low[widest]:
            return None
    edges = torch.linspace(low[widest], high[widest], CELLS + 1, dtype=torch.float64)

    def cells(values: torch.Tensor) -> torch.Tensor:
        # What lies outside of the range counts for the first or last interval.
        return torch.bucketize(values, edges[1:-1])

    made = swaps.made[:, features[widest]].double().contiguous()
    own = recorded[:, widest].contiguous()
    return _Grid(place.labels[widest], edges, cells(own), cells(made))


def choose_examples(
    swaps: SampledSwaps,
    influenced: torch.Tensor,
    places: Mapping[str, Place],
    fixed: frozenset[str],
    count: int,
) -> list[int]:
    """Chooses counterfactual samples that show what a swap does.

    Samples in which the action influences an entity that can be swapped come first,
    then those whose swapped entities are moved the most, each entity by its own
    standard deviation. No stored transition is chosen twice, and at most half of the
    samples (rounded up) have the same swapped entities.

    Args:
        swaps (SampledSwaps): the samples.
        influenced (torch.Tensor): bool ``[T, N]``.
        places (mapping of str to Place): where each entity is, in layout order.
        fixed (frozenset of str): entities that are never swapped.
        count (int): how many to choose, at most.

    Returns:
        list of int: their positions among the samples.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.report.places import Place
        >>> from torchrl_caiac.report.swaps import SampledSwaps, choose_examples
        >>> recorded = torch.tensor([[0.0], [1.0], [2.0]])
        >>> made = torch.tensor([[1.0], [1.0], [0.0]])
        >>> flags = torch.tensor([[True], [False], [True]])
        >>> swaps = SampledSwaps(
        ...     torch.arange(3), recorded, made, flags[:, 0], flags, 0)
        >>> influenced = torch.zeros(3, 1, dtype=torch.bool)
        >>> places = {"cup": Place((0,), ("y",), True)}
        >>> choose_examples(swaps, influenced, places, frozenset(), 1)
        [2]
    """
    movable = torch.tensor([name not in fixed for name in places])
    distance = torch.zeros(len(swaps.rows), dtype=torch.float64)
    for number, place in enumerate(places.values()):
        features = list(place.features)
        recorded = swaps.recorded[:, features].double()
        moved = (swaps.made[:, features].double() - recorded).norm(dim=-1)
        spread = recorded.std(0, unbiased=False).norm()
        if spread > 0:
            # Beyond two deviations more is not better.
            distance += (moved / spread).clamp_max(2) * swaps.swapped[:, number]
    busy = (influenced[swaps.rows] & movable).any(-1)
    rank = (distance + 100 * busy).where(distance > 0, -1.0)
    chosen: list[int] = []
    alike: dict[tuple[bool, ...], int] = {}
    used: set[int] = set()
    for sample in rank.argsort(descending=True, stable=True).tolist():
        if len(chosen) == count or rank[sample] < 0:
            break
        kind = tuple(swaps.swapped[sample].tolist())
        row = int(swaps.rows[sample])
        if row in used or alike.get(kind, 0) >= (count + 1) // 2:
            continue
        used.add(row)
        alike[kind] = alike.get(kind, 0) + 1
        chosen.append(sample)
    return chosen
