from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyTensorStorage,
    ReplayBuffer,
    TensorStorage,
)

from torchrl_caiac.data.trajectories import TrajectoryEnds, newest_row


def rows(ids, done=None, wide=False):
    ids = torch.tensor(ids)
    flags = torch.zeros(len(ids), 1, dtype=torch.bool)
    flags[done or []] = True
    return TensorDict(
        {"episode": ids[:, None] if wide else ids, "next": {"done": flags}}, [len(ids)]
    )


def last(data, length=None, **kwargs):
    length = len(data) if length is None else length
    ends = TrajectoryEnds(data, length, **kwargs)
    return ends(torch.arange(length)).nonzero()[:, 0].tolist(), ends.wraps


@pytest.mark.parametrize("wide", [False, True])
def test_ids_and_done_both_end_a_trajectory(wide):
    data = rows([0, 0, 1, 1, 1, 2], done=[3], wide=wide)
    assert last(data) == ([1, 3, 4, 5], False)
    assert last(data, done_key=None) == ([1, 4, 5], False)
    assert last(data, trajectory_key=None) == ([3, 5], False)


def test_rows_beyond_the_length_do_not_matter():
    assert last(rows([0, 0, 0, 0, 5]), 3) == ([2], False)


def test_a_ring_goes_on_from_its_last_row():
    data = rows([7, 7, 4, 4, 7])
    assert last(data, newest=1) == ([1, 3], True)
    # Without a known newest row the rows are in order.
    assert last(data) == ([1, 3, 4], False)
    # The newest row is always an end, also within one trajectory.
    assert last(rows([7, 7, 7, 7, 7]), newest=2) == ([2], True)
    assert last(rows([7, 7, 7, 7, 7]), newest=4) == ([4], False)


def test_newest_row(tmp_path):
    rb = ReplayBuffer(storage=LazyTensorStorage(5), batch_size=2)
    assert newest_row(rb) is None
    for n, newest in ((3, 2), (1, 3), (3, 1)):
        rb.extend(rows([0] * n))
        assert newest_row(rb) == newest
    rb.dumps(tmp_path)
    loaded = ReplayBuffer(storage=LazyTensorStorage(5), batch_size=2)
    loaded.loads(tmp_path)
    assert newest_row(loaded) == 1
    offline = ReplayBuffer(
        storage=TensorStorage(rows([0, 0])), writer=ImmutableDatasetWriter()
    )
    assert newest_row(offline) is None


def test_missing_keys():
    data = rows([0, 0])
    with pytest.raises(KeyError, match="trajectory_key=None"):
        TrajectoryEnds(data, 2, trajectory_key="traj")
    with pytest.raises(KeyError, match="done_key=None"):
        TrajectoryEnds(data, 2, done_key="over")
    with pytest.raises(ValueError, match="both None"):
        TrajectoryEnds(data, 2, trajectory_key=None, done_key=None)
