"""What is kept of trajectories after writes, against what is built from all rows."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
)

from torchrl_caiac import EntityLayout
from torchrl_caiac.influence.score_on_write import ScoreOnWrite
from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index
from torchrl_caiac.trajectory_cache import TrajectoryCache
from torchrl_caiac.transforms.keys import TransformKeys
from torchrl_caiac.transforms.lookahead import Lookahead

SIZE = 40
LAYOUT = EntityLayout({"arm": [0], "cup": [1], "lid": [2]}, fixed=["arm"])


class Height(torch.nn.Module):
    """An entity's own value is its score."""

    layout = LAYOUT

    def forward(self, td: TensorDict) -> torch.Tensor:
        return td["observation"]


class Source:
    """Episodes, of which a write takes the next rows."""

    def __init__(self, seed: int, reused: bool) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.number, self.reused = 0, reused

    def rows(self, count: int, interleaved: bool) -> TensorDict:
        ids, done = [], []
        for _ in range(count):
            ends = bool(torch.rand((), generator=self.generator) < 0.2)
            swaps = interleaved and bool(torch.rand((), generator=self.generator) < 0.2)
            ids.append((self.number - swaps) % (3 if self.reused else 10**6))
            done.append(ends and bool(torch.rand((), generator=self.generator) < 0.5))
            self.number += ends
        state = torch.rand(count + 1, 3, generator=self.generator)
        next_rows = {"observation": state[1:], "done": torch.tensor(done)[:, None]}
        return TensorDict(
            {
                "observation": state[:-1],
                "episode": torch.tensor(ids),
                "next": next_rows,
            },
            [count],
        )


def assert_same(found: TrajectoryIndex, expected: TrajectoryIndex) -> None:
    for name, own, other in zip(found._fields, found, expected, strict=True):
        if isinstance(other, torch.Tensor):
            assert own.dtype == other.dtype, name
            assert torch.equal(own, other), name
        else:
            assert own == other, name


def lookahead(rule: int | str, keys: TransformKeys) -> Lookahead:
    return Lookahead(
        rule,
        LAYOUT,
        score_key=("caiac", "score"),
        keys=keys,
        free=lambda scores: scores <= 0.8,
        competing=lambda: ~LAYOUT.fixed_mask,
    )


writes = st.tuples(
    st.sampled_from(["extend"] * 8 + ["add", "set_at_", "write_at", "raw", "empty"]),
    st.one_of(st.integers(1, 6), st.integers(1, 6), st.integers(1, SIZE + 2)),
    st.sampled_from([False, False, False, True]),
    st.sampled_from([False, True, True, True]),
)


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("ids", ["episode", None])
@given(
    st.lists(writes, min_size=1, max_size=16),
    st.sampled_from(["next", "goal", 0, 2]),
    st.integers(0, 2**20),
    st.booleans(),
    st.sampled_from([TensorDictReplayBuffer, ReplayBuffer]),
)
@settings(max_examples=50, deadline=None)
def test_what_is_kept_is_what_would_be_built(
    storage, ids, calls, rule, seed, reused, kind
) -> None:
    source = Source(seed, reused)
    rb = kind(storage=storage(SIZE), batch_size=2)
    rb.append_transform(ScoreOnWrite(Height()))
    rb.extend(source.rows(20, False))
    keys = TransformKeys(trajectory=ids)
    own = lookahead(rule, keys)
    cache = TrajectoryCache(trajectory_key=ids, done_key=("next", "done"))
    for name, count, interleaved, looks in calls:
        few = min(count, len(rb))
        if name == "extend":
            rb.extend(source.rows(count, interleaved))
        elif name == "add":
            for row in source.rows(min(count, 3), interleaved).unbind(0):
                rb.add(row)
        elif name == "set_at_":
            rows = torch.arange(few)
            rb.set_at_(("next", "done"), torch.ones(few, 1, dtype=torch.bool), rows)
        elif name == "write_at":
            new = rb[:few].clone()
            new["observation"] += 0.5
            rb.writer.write_at(torch.arange(few), new)
        elif name == "raw":
            new = rb[:few].clone()
            new["episode"] += 10**6
            rb.storage[torch.arange(few)] = new
        elif name == "empty":
            rb.empty()
            rb.extend(source.rows(count, interleaved))
        if looks:
            whole = trajectory_index(rb, trajectory_key=ids)
            assert_same(cache.get(rb.storage), whole)
            assert torch.equal(own.table(rb), lookahead(rule, keys).table(rb))


def ring(size: int = 100) -> ReplayBuffer:
    rb = ReplayBuffer(storage=LazyTensorStorage(size), batch_size=2)
    rb.extend(rows(0, size - 20))
    return rb


def rows(first: int, count: int) -> TensorDict:
    number = torch.arange(first, first + count)
    state = number[:, None].expand(-1, 3).float().contiguous()
    return TensorDict(
        {
            "observation": state,
            "episode": number // 10,
            "caiac": {"score": (state % 7 == 0).float()},
            "next": {"observation": state + 1},
        },
        [count],
    )


def test_trajectories_that_were_not_written_to_are_not_read_again() -> None:
    rb, keys = ring(), TransformKeys()
    cache = TrajectoryCache(trajectory_key="episode", done_key=None)
    own = lookahead("next", keys)
    before, table = cache.get(rb.storage), own.table(rb)
    rb.storage[:]["episode"][45] = -1  # which no storage can notice
    rb.storage[:]["caiac", "score"][45] = 1.0
    for first in (80, 95, 110):  # the ring becomes full, and begins again
        rb.extend(rows(first, 15))
        left = cache.get(rb.storage).remaining(torch.arange(30, 70))
        assert torch.equal(left, before.left[30:70].long())
        assert torch.equal(own.table(rb)[30:70], table[30:70])
    rb.storage[torch.tensor([60])] = rb.storage[:][60:61].clone()
    assert cache.get(rb.storage).remaining(torch.tensor(45)) == 0


@pytest.mark.parametrize("later", [rows(20, 10), rows(200, 5)])
def test_rows_that_continue_an_earlier_trajectory_are_joined_with_it(later) -> None:
    rb, keys = ring(), TransformKeys()
    cache = TrajectoryCache(trajectory_key="episode", done_key=None)
    own = lookahead("next", keys)
    cache.get(rb.storage), own.table(rb)
    rb.extend(later)
    assert_same(cache.get(rb.storage), trajectory_index(rb, done_key=None))
    assert torch.equal(own.table(rb), lookahead("next", keys).table(rb))


def test_rows_at_other_places_are_not_taken_for_later_ones() -> None:
    rb = ring()
    cache = TrajectoryCache(trajectory_key="episode", done_key=None)
    cache.get(rb.storage)
    rb.writer.write_at(torch.arange(80, 90), rows(70, 10))  # as the last ones
    assert_same(cache.get(rb.storage), trajectory_index(rb, done_key=None))


def test_an_index_in_use_is_not_changed_by_a_write() -> None:
    rb = ring()
    cache = TrajectoryCache(trajectory_key="episode", done_key=None)
    index = cache.get(rb.storage)
    left = index.left.clone()
    rb.extend(rows(80, 35))
    assert len(cache.get(rb.storage).left) == 100
    assert torch.equal(index.left, left)


@pytest.mark.parametrize(
    "send", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))]
)
def test_a_copy_of_a_storage_has_its_own_writes(send) -> None:
    rb = ring()
    cache = TrajectoryCache(trajectory_key="episode", done_key=None)
    cache.get(rb.storage)
    other = ReplayBuffer(storage=send(rb.storage), batch_size=2)
    rb.extend(rows(80, 15))
    other.extend(rows(500, 40))
    for source in (other, rb):
        assert_same(
            cache.get(source.storage),
            trajectory_index(source, done_key=None),
        )
