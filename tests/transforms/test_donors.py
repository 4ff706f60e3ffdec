"""The index of a storage, and the draws, against plain Python."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorStorage

from torchrl_caiac import EntityLayout
from torchrl_caiac.transforms import donors as module
from torchrl_caiac.transforms.donors import (
    TrajectoryIndex,
    _Leaf,
    _window_index,
    call_reward,
    draw_batch_donors,
    draw_buffer_donors,
    eligible_starts,
    trajectory_index,
    uninfluenced,
)


@st.composite
def storages(draw: st.DrawFn) -> tuple[ReplayBuffer, list[int]]:
    """A buffer, perhaps a ring, and the time order of its rows."""
    lengths = draw(st.lists(st.integers(1, 7), min_size=1, max_size=6))
    total = sum(lengths)
    size = draw(st.integers(max(1, total // 2), total + 2))
    done = torch.zeros(total, 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    data = TensorDict(
        {
            "time": torch.arange(total),
            "episode": torch.repeat_interleave(
                # ids come back: only neighbours tell trajectories apart
                torch.arange(len(lengths)) % 2,
                torch.tensor(lengths),
            ),
            ("next", "done"): done,
        },
        [total],
    )
    rb = ReplayBuffer(storage=LazyTensorStorage(size))
    step = draw(st.integers(1, size))
    for begin in range(0, total, step):
        rb.extend(data[begin : begin + step])
    order = torch.argsort(rb.storage[:]["time"]).tolist()
    return rb, order


@settings(deadline=None)
@given(case=storages(), ids=st.booleans())
def test_trajectory_index(case, ids: bool) -> None:
    rb, order = case
    data = rb.storage[:]
    key = "episode" if ids else "no such leaf"
    index = trajectory_index(rb.storage, trajectory_key=key)
    assert index.rows(torch.arange(len(order))).tolist() == order
    assert index.position(torch.tensor(order)).tolist() == list(range(len(order)))
    for i, row in enumerate(order):
        left = 0
        while i + left + 1 < len(order) and not bool(
            data["next", "done"][order[i + left]]
        ):
            left += 1
        assert int(index.remaining(torch.tensor([row]))) == left
    rows = torch.arange(len(order))
    searched = index._replace(left=None).remaining(rows)
    assert torch.equal(index.remaining(rows), searched)


@pytest.mark.parametrize(("length", "dtype"), [(9, "int32"), (1 << 30, "int64")])
def test_places_in_long_storages(length: int, dtype: str) -> None:
    layout = EntityLayout({"arm": [0], "cup": [1]})
    leaf = _Leaf("observation", torch.zeros(4, 2), torch.tensor([0, 1]))
    rows = torch.tensor([[length - 2, 3, 0]])
    index = _window_index(layout, rows, leaf, 2, length, None)
    assert str(index.dtype) == f"torch.{dtype}"
    assert index.tolist() == [2 * length - 4, 7, 2 * length - 2, 9]
    ring = _window_index(layout, rows, leaf, 2, length, length - 1)
    assert ring.tolist() == [2 * length - 4, 7, 0, 9]


@settings(deadline=None)
@given(
    case=storages(),
    window=st.integers(1, 5),
    seed=st.integers(0, 1000),
    chunk=st.sampled_from([1, 3, 1 << 20]),
)
def test_eligible_starts(case, window: int, seed: int, chunk: int) -> None:
    rb, order = case
    generator = torch.Generator().manual_seed(seed)
    length = len(order)
    scores = torch.rand(length, 3, generator=generator)
    scores[torch.rand(length, 3, generator=generator) < 0.1] = math.nan
    trajectories = trajectory_index(rb.storage)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_CHUNK", chunk)
        index = eligible_starts(
            scores,
            0.7,
            torch.tensor([True, False, True]),
            window=window,
            trajectories=trajectories,
        )
    episode = rb.storage[:]["next", "done"].squeeze(-1)
    for entity in range(3):
        wanted = []
        for i in range(length - window + 1):
            rows = order[i : i + window]
            if (
                entity != 1
                and not episode[rows[:-1]].any()
                and all(scores[r, entity] <= 0.7 for r in rows)
            ):
                wanted.append(rows[0])
        begin = int(index.offset[entity])
        found = index.starts[begin : begin + int(index.size[entity])]
        assert sorted(found.tolist()) == sorted(wanted)


def test_a_full_storage_without_a_cursor_does_not_wrap() -> None:
    data = TensorDict({"episode": torch.tensor([0, 0, 1, 0])}, [4])
    index = trajectory_index(TensorStorage(data))
    assert (index.oldest, index.ends.tolist()) == (0, [1, 2, 3])


def test_infinite_scores_and_missing_trajectories() -> None:
    swappable = torch.tensor([True])
    with pytest.raises(ValueError, match="infinite in row 1"):
        eligible_starts(torch.tensor([[0.0], [-math.inf]]), 0.1, swappable)
    with pytest.raises(ValueError, match="need the trajectories"):
        eligible_starts(torch.zeros(3, 1), 0.1, swappable, window=2)
    short = eligible_starts(
        torch.zeros(3, 1),
        0.1,
        swappable,
        window=4,
        trajectories=TrajectoryIndex(3, 0, torch.tensor([2])),
    )
    assert short.size.tolist() == [0]
    assert not draw_buffer_donors(
        torch.ones(2, 1, dtype=torch.bool), short
    ).swapped.any()


@given(
    rows=st.lists(
        st.lists(
            st.sampled_from([0.0, 0.5, 0.50001, math.nan]), min_size=2, max_size=2
        ),
        min_size=1,
        max_size=24,
    ),
    window=st.integers(1, 4),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
@settings(deadline=None)
def test_uninfluenced(rows, window: int, dtype: torch.dtype) -> None:
    rows = (rows * window)[: len(rows) // window * window] or rows * window
    found = uninfluenced(torch.tensor(rows, dtype=dtype), 0.5, window)
    wanted = [
        [all(row[n] <= 0.5 for row in rows[b : b + window]) for n in range(2)]
        for b in range(0, len(rows), window)
    ]
    assert found.tolist() == wanted


@settings(deadline=None)
@given(
    seed=st.integers(0, 1000),
    windows=st.integers(1, 12),
    window=st.integers(1, 3),
    share=st.floats(0, 1),
    swap_prob=st.sampled_from([0.0, 0.4, 1.0]),
)
def test_batch_donors(seed, windows, window, share, swap_prob) -> None:
    generator = torch.Generator().manual_seed(seed)
    free = torch.rand(windows, 3, generator=generator) < 0.5
    count = round(share * windows)
    draw = draw_batch_donors(
        free, count, window=window, swap_prob=swap_prob, generator=generator
    )
    assert draw.donors.shape == draw.swapped.shape == (count, 3)
    for c in range(count):
        for n in range(3):
            own = windows - count + c
            options = [b for b in range(windows) if free[b, n] and b != own]
            if draw.swapped[c, n]:
                assert free[own, n] and int(draw.donors[c, n]) % window == 0
                assert int(draw.donors[c, n]) // window in options
            elif swap_prob == 1.0:
                assert not (free[own, n] and options)
            assert 0 <= int(draw.donors[c, n]) < windows * window
    if swap_prob == 1.0:
        alone = free[windows - count :].sum(0) * (free.sum(0) == 1)
        assert draw.no_donor.tolist() == alone.tolist()


def test_buffer_donors_are_uniform() -> None:
    scores = torch.ones(50, 2)
    scores[10:30, 0] = 0.0
    scores[5:8, 1] = 0.0
    index = eligible_starts(scores, 0.1, torch.tensor([True, True]))
    draw = draw_buffer_donors(
        torch.ones(40_000, 2, dtype=torch.bool),
        index,
        generator=torch.Generator().manual_seed(0),
    )
    for entity, begin, end in ((0, 10, 30), (1, 5, 8)):
        share = torch.bincount(draw.donors[:, entity], minlength=50) / 40_000
        assert share[begin:end].sum() == pytest.approx(1.0)
        assert (share[begin:end] - 1 / (end - begin)).abs().max() < 0.01
    assert draw.swapped.all() and not draw.no_donor.any()


@pytest.mark.parametrize("shape", [(4,), (4, 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64])
def test_call_reward(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    like = torch.zeros(shape, dtype=dtype)
    goals = torch.arange(8.0).view(4, 2)
    for out in (goals[:, 1], goals[:, 1:], goals[:, 1] > 3):
        found = call_reward(lambda a, d, out=out: out, goals, goals, like)
        assert found.shape == like.shape and found.dtype == dtype
        assert found.flatten().tolist() == out.flatten().tolist()
    for wrong in (goals, goals[:2], 1.0):
        with pytest.raises(ValueError, match=r"reward_fn returned .*wanted \[4\]"):
            call_reward(lambda a, d, wrong=wrong: wrong, goals, goals, like)
