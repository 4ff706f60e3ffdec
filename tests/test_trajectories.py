"""The index of trajectories against a slow and obvious one."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    TensorStorage,
)

from torchrl_caiac.trajectories import trajectory_index


def rows(ids, done=None, wide=False):
    ids = torch.tensor(ids)
    flags = torch.zeros(len(ids), 1, dtype=torch.bool)
    flags[done or []] = True
    return TensorDict(
        {"episode": ids[:, None] if wide else ids, "next": {"done": flags}}, [len(ids)]
    )


def last(source, **kwargs):
    index = trajectory_index(source, **kwargs)
    return index.is_last(torch.arange(index.length)).nonzero()[:, 0].tolist()


def ring(ids, newest):
    """A full ring buffer whose storage holds the ids, written up to ``newest``."""
    size = len(ids)
    rb = ReplayBuffer(storage=LazyTensorStorage(size), batch_size=2)
    rb.extend(rows([0] * (newest + 1)))
    if newest + 1 < size:
        rb.extend(rows([0] * (size - newest - 1)))
        rb.extend(rows([0] * (newest + 1)))
    rb.storage[:]["episode"].copy_(torch.tensor(ids))
    return rb


@pytest.mark.parametrize("wide", [False, True])
def test_ids_and_end_flags_both_end_a_trajectory(wide):
    data = rows([0, 0, 1, 1, 1, 2], done=[3], wide=wide)
    assert last(data) == [1, 3, 4, 5]
    assert last(data, done_key=None) == [1, 4, 5]
    assert last(data, trajectory_key=None) == [3, 5]


def test_rows_beyond_the_length_do_not_matter():
    rb = ReplayBuffer(storage=LazyTensorStorage(9))
    rb.extend(rows([0, 0, 1]))
    assert last(rb) == last(rb.storage) == [1, 2]


def test_a_ring_goes_on_from_its_last_row():
    index = trajectory_index(ring([7, 7, 4, 4, 7], newest=1))
    assert index.wraps and index.oldest == 2
    assert index.rows(index.ends).tolist() == [3, 1]
    assert index.starts.tolist() == [2, 4] and index.lengths.tolist() == [2, 3]
    assert index.remaining(torch.arange(5)).tolist() == [1, 0, 1, 0, 2]
    assert index.numbers().tolist() == [1, 1, 0, 0, 1]
    assert index.later(torch.tensor([4]), 2).tolist() == [1]
    # The row written last is always an end, also within one trajectory.
    one = trajectory_index(ring([7] * 5, newest=2))
    assert one.wraps and one.rows(one.ends).tolist() == [2]
    assert not trajectory_index(ring([7] * 5, newest=4)).wraps


def test_a_buffer_loaded_from_disk_knows_its_newest_row_by_its_writer(tmp_path):
    rb = ring([7, 7, 4, 4, 7], newest=1)
    rb.dumps(tmp_path)
    loaded = ReplayBuffer(storage=LazyTensorStorage(5), batch_size=2)
    loaded.loads(tmp_path)
    assert last(loaded) == [1, 3]


def test_a_dataset_has_no_newest_row():
    data = rows([0, 0, 1])
    rb = ReplayBuffer(storage=TensorStorage(data), writer=ImmutableDatasetWriter())
    assert last(rb) == last(rb.storage) == last(data) == [1, 2]


def test_ids_of_a_collector_are_found():
    data = rows([0, 0, 1]).rename_key_("episode", ("collector", "traj_ids"))
    assert last(data, done_key=None) == [1, 2]


def test_what_is_missing_or_misshapen_is_named():
    data = rows([0, 0, 1])
    with pytest.raises(KeyError, match=r"ids .*run.*they have.*trajectory_key=None"):
        trajectory_index(data, trajectory_key="run")
    with pytest.raises(KeyError, match=r"the end flags .*end"):
        trajectory_index(data, trajectory_key=None, done_key="end")
    assert last(data, done_key="end") == [1, 2]
    with pytest.raises(ValueError, match="both None"):
        trajectory_index(data, trajectory_key=None, done_key=None)
    data["episode"] = torch.zeros(3, 2)
    with pytest.raises(ValueError, match=r"\[3, 2\], expected \[T\] or \[T, 1\]"):
        trajectory_index(data)
    with pytest.raises(TypeError, match="is a TensorDict, expected a tensor"):
        trajectory_index(data, trajectory_key="next")
    with pytest.raises(ValueError, match="empty"):
        trajectory_index(LazyTensorStorage(3))
    flat = ReplayBuffer(storage=LazyTensorStorage(6, ndim=2))
    flat.extend(TensorDict({"episode": torch.zeros(3, 2)}, [3, 2]))
    with pytest.raises(ValueError, match="ndim=2"):
        trajectory_index(flat)


@given(
    st.lists(st.tuples(st.integers(0, 2), st.booleans()), min_size=1, max_size=20),
    st.integers(0, 19),
    st.booleans(),
)
def test_against_a_walk_through_time(content, newest, memmap):
    size = len(content)
    newest %= size
    rb = ReplayBuffer(
        storage=(LazyMemmapStorage if memmap else LazyTensorStorage)(size)
    )
    order = [(newest + 1 + i) % size for i in range(size)]
    if newest != size - 1:  # fill once, then up to the newest row
        rb.extend(rows([9] * size))
    rb.extend(rows([9] * (newest + 1)))
    stored = rb.storage[:]
    for i, (number, done) in enumerate(content):
        stored["episode"][i] = number
        stored["next", "done"][i] = done
    # Walk backwards through time and count.
    left, following = {}, None
    for row in reversed(order):
        ends = (
            following is None
            or content[row][1]
            or (content[row][0] != content[following][0])
        )
        left[row] = 0 if ends else left[following] + 1
        following = row
    index = trajectory_index(rb)
    assert index.remaining(torch.arange(size)).tolist() == [
        left[i] for i in range(size)
    ]
    assert index.position(index.rows(torch.arange(size))).tolist() == list(range(size))
    assert sum(index.lengths.tolist()) == size
    assert index.wraps == (newest != size - 1 and left[size - 1] > 0)
    for row in range(size):
        same = index.numbers() == index.numbers()[row]
        assert bool(same[index.later(torch.tensor(row), left[row])])
