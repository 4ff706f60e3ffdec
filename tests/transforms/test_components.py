"""Components and their donors, against scipy and plain Python."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components
from torchrl.data import ReplayBuffer

from tests.transforms.test_donors import storages
from torchrl_caiac.trajectories import trajectory_index
from torchrl_caiac.transforms import components as module
from torchrl_caiac.transforms.components import (
    ComponentIndex,
    component_starts,
    components,
    draw_batch_components,
    draw_buffer_components,
)
from torchrl_caiac.transforms.draws import draw_windows

THRESHOLD = 0.3


def sparse_graphs(
    rows: int, entities: int, links: float, generator: torch.Generator
) -> torch.Tensor:
    """Random graphs in which each entity has so many links on average."""
    shape = (rows, entities + 1, entities)
    graphs = torch.rand(shape, generator=generator) * THRESHOLD
    linked = torch.rand(shape, generator=generator) < links / entities
    return torch.where(linked, THRESHOLD + 0.1 + graphs, graphs)


def by_scipy(graphs: torch.Tensor, fixed: set[int]) -> list[frozenset[int]]:
    """The free component of each entity of one window ``[window, N + 1, N]``."""
    entities = graphs.shape[-1]
    links = np.zeros((entities + 1, entities + 1), dtype=bool)
    links[:, :entities] = (~(graphs <= THRESHOLD)).any(0).numpy()
    _, label = connected_components(links, directed=False)
    found = []
    for own in label[:entities]:
        same = frozenset(np.flatnonzero(label[:entities] == own).tolist())
        held = own == label[entities] or bool(same & fixed)
        found.append(frozenset() if held else same)
    return found


def unpacked(mask: int) -> frozenset[int]:
    return frozenset(i for i in range(64) if mask >> i & 1)


def sets(masks: torch.Tensor) -> list[list[frozenset[int]]]:
    return [[unpacked(mask) for mask in row] for row in masks.tolist()]


@settings(deadline=None)
@given(
    entities=st.one_of(st.integers(1, 12), st.integers(1, 64), st.just(64)),
    window=st.integers(1, 4),
    links=st.floats(0.0, 2.0),
    fixed=st.sets(st.integers(0, 63), max_size=2),
    unscored=st.booleans(),
    seed=st.integers(0, 2**31),
    dtype=st.sampled_from([torch.float32, torch.float64, torch.float16]),
)
def test_components_are_those_of_scipy(
    entities: int,
    window: int,
    links: float,
    fixed: set[int],
    unscored: bool,
    seed: int,
    dtype: torch.dtype,
) -> None:
    generator = torch.Generator().manual_seed(seed)
    graphs = sparse_graphs(6 * window, entities, links / window, generator).to(dtype)
    if unscored:
        graphs[0] = torch.nan
    never = torch.tensor([i in fixed for i in range(entities)])
    masks = components(graphs, THRESHOLD, window=window, fixed=never)
    assert masks.shape == (6, entities) and masks.dtype == torch.int64
    parts = graphs.unflatten(0, (6, window))
    assert sets(masks) == [by_scipy(part, fixed) for part in parts]
    if unscored:
        assert not masks[0].any()
    if not any(i < entities for i in fixed):
        again = components(graphs, THRESHOLD, window=window)
        assert torch.equal(again, masks)
    leads = [[min(s, default=-1) == i for i, s in enumerate(r)] for r in sets(masks)]
    assert module._leads(masks).tolist() == leads
    leader = [[min(s, default=0) for s in row] for row in sets(masks)]
    assert module._leader(masks).tolist() == leader


def test_a_link_of_any_direction_and_step_counts() -> None:
    graphs = torch.zeros(4, 5, 4)
    graphs[0, 0, 1] = graphs[1, 2, 1] = 1.0  # 0 to 1, and later 2 to 1
    assert sets(components(graphs, 0.5, window=2)) == [
        [frozenset({0, 1, 2})] * 3 + [frozenset({3})],
        [frozenset({i}) for i in range(4)],
    ]
    graphs[3, 4, 0] = 1.0  # the action holds entity 0 in the last row
    assert components(graphs, 0.5, window=2)[1].tolist() == [0, 2, 4, 8]
    # A score equal to the threshold is no link.
    assert components(torch.full((1, 3, 2), 0.5), 0.5).tolist() == [[1, 2]]


@settings(deadline=None)
@given(
    windows=st.integers(1, 12),
    entities=st.sampled_from([1, 3, 5, 64]),
    links=st.floats(0.0, 1.5),
    share=st.floats(0.0, 1.0),
    swap_prob=st.sampled_from([0.0, 0.5, 1.0]),
    window=st.integers(1, 3),
    rows=st.sampled_from(["random", "last"]),
    seed=st.integers(0, 2**31),
)
def test_batch_donors_have_the_same_component(
    windows: int,
    entities: int,
    links: float,
    share: float,
    swap_prob: float,
    window: int,
    rows: str,
    seed: int,
) -> None:
    generator = torch.Generator().manual_seed(seed)
    # Few different graphs, so that components come back.
    kinds = sparse_graphs(3, entities, links, generator)
    which = torch.randint(3, (windows,), generator=generator)
    masks = components(kinds[which], THRESHOLD)
    count, chosen = round(share * windows), None
    last = [True] * count
    if rows == "random":
        chosen = draw_windows(windows, count, device=masks.device, generator=generator)
        last, count = chosen.tolist(), windows
    draw = draw_batch_components(
        masks,
        count,
        window=window,
        swap_prob=swap_prob,
        chosen=chosen,
        generator=generator,
    )
    assert draw.chosen is chosen
    assert draw.donors.shape == draw.swapped.shape == (count, entities)
    found, missing = sets(masks), [0] * entities
    for c in range(count):
        own = windows - count + c
        for i, component in enumerate(found[own]):
            donors = [
                b for b in range(windows) if b != own and found[b][i] == component
            ]
            swapped = bool(draw.swapped[c, i])
            if not component or not donors or swap_prob == 0.0 or not last[c]:
                assert not swapped
            elif swap_prob == 1.0:
                assert swapped
            missing[i] += last[c] and bool(component) and not donors
            if swapped:
                assert int(draw.donors[c, i]) in [b * window for b in donors]
            for j in component:  # all of a component do the same
                assert bool(draw.swapped[c, j]) == swapped
                assert draw.donors[c, j] == draw.donors[c, i] or not swapped
    if swap_prob == 1.0:
        assert draw.no_donor.tolist() == missing


def test_batch_donors_are_uniform_and_independent() -> None:
    masks = torch.tensor([[3, 3, 4], [3, 3, 4], [1, 2, 4], [3, 3, 0], [3, 3, 4]])
    generator = torch.Generator().manual_seed(0)
    pairs = Counter()
    for _ in range(4000):
        draw = draw_batch_components(masks, 2, generator=generator)
        assert draw.swapped.tolist() == [[True, True, False], [True] * 3]
        pairs[tuple(draw.donors[1, 1:].tolist())] += 1
    # Three donors of {0, 1} times three of {2}, never the row itself.
    assert sorted(pairs) == [(a, b) for a in (0, 1, 3) for b in (0, 1, 2)]
    for count in pairs.values():
        assert abs(count - 4000 / 9) < 5 * (4000 / 9) ** 0.5


def test_swap_prob_is_that_of_a_component() -> None:
    masks = torch.tensor([[3, 3, 4]] * 4000)
    generator = torch.Generator().manual_seed(0)
    draw = draw_batch_components(masks, 4000, swap_prob=0.3, generator=generator)
    assert torch.equal(draw.swapped[:, 0], draw.swapped[:, 1])
    share = draw.swapped.double().mean(0)
    torch.testing.assert_close(share, torch.full((3,), 0.3).double(), atol=0.03, rtol=0)
    both = (draw.swapped[:, 0] & draw.swapped[:, 2]).double().mean()
    assert abs(both - 0.09) < 0.02


@settings(deadline=None)
@given(
    case=storages(),
    window=st.integers(1, 5),
    entities=st.sampled_from([1, 3, 64]),
    elements=st.sampled_from([1, 40, 1 << 24]),
    seed=st.integers(0, 1000),
)
def test_component_starts_are_all_windows(
    case: tuple[ReplayBuffer, list[int]],
    window: int,
    entities: int,
    elements: int,
    seed: int,
) -> None:
    rb, order = case
    generator = torch.Generator().manual_seed(seed)
    graphs = sparse_graphs(len(order), entities, 0.4, generator)
    graphs[torch.rand(len(order), generator=generator) < 0.1] = torch.nan
    trajectories = trajectory_index(rb.storage)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_CHUNK_ELEMENTS", elements)
        index = component_starts(
            graphs,
            THRESHOLD,
            torch.arange(entities) == 1,
            window=window,
            trajectories=trajectories,
        )
    expected = Counter()
    for start in range(len(order) - window + 1):
        rows = order[start : start + window]
        left = trajectories.remaining(torch.tensor(rows[:1]))
        if int(left) >= window - 1:
            for component in set(by_scipy(graphs[rows], {1})) - {frozenset()}:
                expected[component, rows[0]] += 1
    found = Counter()
    for mask, offset, size in zip(
        index.masks.tolist(), index.offset.tolist(), index.size.tolist(), strict=True
    ):
        for row in index.starts[offset : offset + size].tolist():
            if mask:
                found[unpacked(mask), row] += 1
    assert found == expected and max(found.values(), default=1) == 1
    assert index.masks.tolist() == sorted(set(index.masks.tolist()))


def test_buffer_donors_are_uniform_over_the_windows_of_a_component() -> None:
    index = ComponentIndex(
        torch.tensor([1, 6]),
        torch.tensor([5, 9, 4, 7, 2], dtype=torch.int32),
        torch.tensor([0, 2]),
        torch.tensor([2, 3]),
    )
    masks = torch.tensor([[1, 6, 6], [1, 2, 4], [0, 6, 6]] * 2000)
    generator = torch.Generator().manual_seed(0)
    draw = draw_buffer_components(masks, index, generator=generator)
    assert draw.donors.dtype == torch.int64
    wanted = [[True] * 3, [True, False, False], [False, True, True]]
    assert draw.swapped[:3].tolist() == wanted
    assert draw.no_donor.tolist() == [0, 2000, 2000]
    assert torch.equal(draw.donors[::3, 1], draw.donors[::3, 2])
    pairs = Counter(map(tuple, draw.donors[::3, :2].tolist()))
    assert sorted(pairs) == [(a, b) for a in (5, 9) for b in (2, 4, 7)]
    for count in pairs.values():
        assert abs(count - 2000 / 6) < 5 * (2000 / 6) ** 0.5
    none = draw_buffer_components(masks, index, swap_prob=0.0, generator=generator)
    assert not none.swapped.any() and not none.no_donor.any()


def test_an_index_of_nothing_gives_no_donor() -> None:
    graphs = torch.ones(4, 3, 2)
    index = component_starts(graphs, 0.2, torch.tensor([False, False]))
    draw = draw_buffer_components(torch.tensor([[1, 2], [0, 0]]), index)
    assert not draw.swapped.any() and draw.no_donor.tolist() == [1, 1]


def test_starts_that_cannot_be_found() -> None:
    graphs, fixed = torch.zeros(4, 3, 2), torch.tensor([False, False])
    with pytest.raises(ValueError, match="need the trajectories"):
        component_starts(graphs, 0.2, fixed, window=2)
    graphs[2, 1, 0] = torch.inf
    with pytest.raises(ValueError, match="graphs of the donors are infinite in row 2"):
        component_starts(graphs, 0.2, fixed)


def test_graphs_that_change_while_they_are_indexed_are_refused(monkeypatch):
    graphs = torch.zeros(4, 3, 2)
    scan = module.scan_donors

    def changing(values, *args):
        yield from scan(values, *args)
        graphs[1, 0, 1] = 1.0  # one component instead of two

    monkeypatch.setattr(module, "scan_donors", changing)
    with pytest.raises(RuntimeError, match="written to while they were indexed"):
        component_starts(graphs, 0.2, torch.tensor([False, False]))
