"""Buffers that TorchRL's collectors fill, in processes of their own."""

from __future__ import annotations

import pytest
import torch
from torchrl.collectors import MultiAsyncCollector, MultiSyncCollector
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.envs import DoubleToFloat, EnvBase, StepCounter, TransformedEnv

from torchrl_caiac import CAIACTransform
from torchrl_caiac.envs import fetch_push_layout, fetch_push_reward, make_fetch_push_env
from torchrl_caiac.influence import DistanceInfluence, ScoreOnWrite, score_buffer
from torchrl_caiac.transforms import HindsightGoal

LAYOUT = fetch_push_layout(2)
KEY = ("caiac", "score")


def make_env() -> EnvBase:
    env = TransformedEnv(make_fetch_push_env(num_cubes=2), DoubleToFloat())
    return TransformedEnv(env, StepCounter(15))


def distances() -> DistanceInfluence:
    """A rule without a model: near the gripper is influenced."""
    positions = {name: LAYOUT.columns[name][:3] for name in LAYOUT.names}
    return DistanceInfluence(LAYOUT, positions, distance=0.2, action_only=True)


def started(kind, rb):
    collector = kind(
        [make_env] * 2,
        frames_per_batch=60,
        total_frames=600,
        replay_buffer=rb,
        extend_buffer=True,
    )
    return collector, iter(collector)


def assert_scores_of_their_states(rb):
    data = rb.storage[:]
    rule = distances()
    expected = torch.maximum(rule(data), rule(data["next"]))
    assert torch.equal(data[KEY], expected)


@pytest.mark.parametrize(
    ("kind", "storage"),
    [
        (MultiSyncCollector, LazyMemmapStorage),
        (MultiAsyncCollector, LazyTensorStorage),
    ],
)
def test_workers_that_started_before_scoring(kind, storage):
    """First way: score again. Second way: keep unscored rows as they are."""
    goals = HindsightGoal(LAYOUT, fetch_push_reward)
    rb = TensorDictReplayBuffer(
        storage=storage(150), batch_size=64, shared=True, sample_unit=goals
    )
    collector, batches = started(kind, rb)
    try:
        for _ in range(3):
            next(batches)
        score_buffer(rb, distances(), progress=False)
        assert_scores_of_their_states(rb)
        keep = CAIACTransform(LAYOUT, 0.5, unscored="keep")
        raises = CAIACTransform(LAYOUT, 0.5)
        # The next batches of asynchronous workers may have been written before.
        while not keep.unscored_count:
            next(batches)
            data = rb.storage[:].clone()  # workers go on
            out = keep(data)
        assert 0 < keep.unscored_count < 150
        with pytest.raises(ValueError, match="of other states than their own"):
            raises(data)
        swapped = out["caiac", "swapped"].any(-1)
        is_stale = (data[KEY] != distances()(data)).any(-1)
        assert swapped.any()
        assert not (swapped & is_stale).all()
        rb.append_transform(keep)
        rb.append_transform(goals)
        assert rb.sample()["hindsight", "relabeled"].any()
    finally:
        collector.shutdown()
    score_buffer(rb, distances(), progress=False)
    assert_scores_of_their_states(rb)
    assert not rb.sample()[KEY].isnan().any()


@pytest.mark.parametrize(
    ("kind", "storage"),
    [
        (MultiSyncCollector, LazyMemmapStorage),
        (MultiAsyncCollector, LazyTensorStorage),
    ],
)
def test_rows_are_scored_as_they_are_written(kind, storage):
    """Third way: a transform of the buffer scores at write time."""
    rb = TensorDictReplayBuffer(
        storage=storage(150),
        batch_size=64,
        shared=True,
        transform=ScoreOnWrite(distances()),
    )
    collector, batches = started(kind, rb)
    rb.append_transform(CAIACTransform(LAYOUT, 0.5))
    try:
        for _ in range(4):
            next(batches)
            assert rb.sample()["caiac", "swapped"].any()
    finally:
        collector.shutdown()
    assert len(rb) == 150
    assert_scores_of_their_states(rb)

    def never(self, tensordict):
        raise AssertionError("nothing is left to score")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DistanceInfluence, "forward", never)
        score_buffer(rb, distances(), progress=False)


def test_batches_of_a_collector_may_be_extended_by_hand():
    rb = ReplayBuffer(storage=LazyTensorStorage(120, ndim=2), batch_size=32)
    collector = MultiSyncCollector(
        [make_env] * 2, frames_per_batch=60, total_frames=120, cat_results="stack"
    )
    for batch in collector:
        rb.extend(batch)
    collector.shutdown()
    assert rb.storage[:].batch_size == (60, 2)
    score_buffer(rb, distances(), smoothing=3, lookahead=5, progress=False)
    rb.append_transform(CAIACTransform(LAYOUT, 0.5))
    assert rb.sample()["caiac", "swapped"].any()
