"""The index of trajectories against a slow and obvious one."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictMaxValueWriter,
    TensorDictReplayBuffer,
    TensorStorage,
)

from torchrl_caiac.trajectories import flat_rows, trajectory_index


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
    assert index.oldest == 2 and not index.is_storage_order
    assert index.rows(index.ends).tolist() == [3, 1]
    assert index.starts.tolist() == [2, 4] and index.lengths.tolist() == [2, 3]
    assert index.remaining(torch.arange(5)).tolist() == [1, 0, 1, 0, 2]
    assert index.numbers().tolist() == [1, 1, 0, 0, 1]
    assert index.later(torch.tensor([4]), 2).tolist() == [1]
    # The row written last is always an end, also within one trajectory.
    one = trajectory_index(ring([7] * 5, newest=2))
    assert one.rows(one.ends).tolist() == [2]
    assert trajectory_index(ring([7] * 5, newest=4)).is_storage_order


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
    with pytest.raises(ValueError, match=r"batch size \[3, 2\], expected \[T\]"):
        trajectory_index(TensorDict({"episode": torch.zeros(3, 2)}, [3, 2]))


def test_rows_of_parallel_environments_may_be_interleaved():
    index = trajectory_index(rows([5, 3, 5, 3, 5, 3], done=[2, 3]))
    assert index.rows(torch.arange(6)).tolist() == [0, 2, 1, 3, 4, 5]
    assert index.lengths.tolist() == [2, 2, 1, 1]
    assert index.remaining(torch.arange(6)).tolist() == [1, 1, 0, 0, 0, 0]
    assert index.starts.tolist() == [0, 1, 4, 5]
    assert index.numbers().tolist() == [0, 1, 0, 1, 2, 3]
    # An id may come again after its trajectory has ended.
    again = trajectory_index(rows([0, 0, 1, 0, 0], done=[1]))
    assert again.is_storage_order and again.lengths.tolist() == [2, 1, 2]


@pytest.mark.parametrize("ids, size", [([0, 0, 0, 1, 1], 4), ([0, 1, 0, 1, 0], 12)])
def test_bytes_of_each_row(ids, size):
    index = trajectory_index(rows(ids))
    of_rows = [x for x in (index.left, index.order, index.place) if x is not None]
    assert sum(x.element_size() * x.numel() for x in of_rows) == size * len(ids)


def test_dimensions_that_are_transposed_in_memory_are_refused():
    data = TensorDict({"episode": torch.zeros(2, 3, 4)}, [2, 3, 4])
    rb = ReplayBuffer(storage=LazyTensorStorage(24, ndim=3))
    rb.extend(data)  # stored as [4, 3, 2], in the memory order of [4, 2, 3]
    with pytest.raises(ValueError, match=r"\[4, 3, 2\] of 'episode'.*LazyMemmapStora"):
        trajectory_index(rb)
    for rb, stored in (
        (ReplayBuffer(storage=LazyMemmapStorage(24, ndim=3)), data),
        (
            ReplayBuffer(storage=LazyTensorStorage(24, ndim=3), dim_extend=0),
            data.permute(2, 0, 1),
        ),
    ):
        rb.extend(stored.contiguous())
        assert trajectory_index(rb).length == 24


def test_the_end_flags_of_one_environment_may_be_in_two_leaves():
    data = rows([0, 0, 0])
    data["next", "terminated"] = data["next"].pop("done")
    data["next", "truncated"] = torch.tensor([[False], [True], [False]])
    assert last(data, trajectory_key=None) == [1, 2]


def test_steps_to_the_next_observation_place_the_end_flags():
    data = rows([0] * 4, done=[1, 2, 3])
    data["steps_to_next_obs"] = torch.tensor([[3], [3], [2], [1]])
    assert last(data) == [3]


def test_a_writer_that_replaces_any_row_is_refused():
    writer = TensorDictMaxValueWriter(rank_key="rank")
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(2), writer=writer)
    rb.extend(rows([0, 0]).set("rank", torch.ones(2)))
    with pytest.raises(ValueError, match="not in the order of time: use a round-robin"):
        trajectory_index(rb)
    with pytest.raises(ValueError, match="not in the order of time"):
        trajectory_index(rb.storage)


@pytest.mark.parametrize("way", ["dumps", "state_dict", "Checkpoint"])
@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
def test_a_loaded_storage_knows_its_newest_row_by_the_writer(tmp_path, way, storage):
    rb = ring([7, 7, 4, 4, 7], newest=1)
    loaded = ReplayBuffer(storage=storage(5), batch_size=2)
    # The buffer has been used before: its storage remembers another row.
    loaded.extend(rows([1] * 5))
    if way == "dumps":
        rb.dumps(tmp_path / "rb")
        loaded.loads(tmp_path / "rb")
    elif way == "state_dict":
        loaded.load_state_dict(rb.state_dict())
    else:
        Checkpoint(rb=rb).save(tmp_path / "checkpoint")
        Checkpoint(rb=loaded).load(tmp_path / "checkpoint")
    assert last(loaded) == last(loaded.storage) == [1, 3]


def walk(order, content):
    """For each row, the rows of the same trajectory after it; by a slow walk."""
    later = {}
    for place, row in enumerate(order):
        number, done = content[row]
        later[row] = []
        for following in order[place + 1 :] if not done else []:
            if content[following][0] == number:
                later[row].append(following)
                if content[following][1]:
                    break
    return later


def check(index, later):
    count = len(later)
    assert index.remaining(torch.arange(count)).tolist() == [
        len(later[i]) for i in range(count)
    ]
    for row, following in later.items():
        for steps, other in enumerate(following):
            assert index.later(torch.tensor([row]), steps + 1).item() == other
    rows = torch.arange(count)
    for steps in (0, 1, 2, 100):
        wanted = [(row, *later[row])[: steps + 1][-1] for row in range(count)]
        assert index.ahead(rows, torch.full_like(rows, steps)).tolist() == wanted
    every = torch.arange(count)
    assert index.position(index.rows(every)).tolist() == every.tolist()
    assert sum(index.lengths.tolist()) == count
    numbers = index.numbers().tolist()
    for row, following in later.items():
        assert {numbers[other] for other in following} <= {numbers[row]}
    assert sorted(set(numbers)) == list(range(len(index.ends)))
    assert index.remaining(index.rows(index.ends)).tolist() == [0] * len(index.ends)
    assert index.remaining(index.starts).tolist() == (index.lengths - 1).tolist()


CONTENT = st.lists(st.tuples(st.integers(0, 2), st.booleans()), min_size=1, max_size=16)


@settings(deadline=None, max_examples=60)
@given(CONTENT, st.integers(0, 15), st.booleans())
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
    check(trajectory_index(rb), walk(order, content))


@settings(deadline=None, max_examples=60)
@given(CONTENT, st.integers(0, 15), st.integers(2, 3))
def test_environments_in_a_second_dimension(content, newest, streams):
    steps = -(-len(content) // streams)
    content = (content * streams)[: steps * streams]
    newest %= steps
    storage = LazyTensorStorage(steps * streams, ndim=2)
    rb = ReplayBuffer(storage=storage, dim_extend=0, batch_size=1)

    def fill(count):
        part = rows([9] * count * streams)
        rb.extend(part.reshape(count, streams))

    fill(steps)
    if newest != steps - 1:
        fill(newest + 1)
    stored = rb.storage[:].flatten(0, 1)
    for i, (number, done) in enumerate(content):
        stored["episode"][i] = number
        stored["next", "done"][i] = done
    assert rb.storage[:]["episode"].flatten().tolist() == [n for n, _ in content]
    later = {}
    for stream in range(streams):
        order = [(newest + 1 + i) % steps * streams + stream for i in range(steps)]
        later.update(walk(order, content))
    index = trajectory_index(rb)
    check(index, later)
    # Coordinates and rows are the same.
    coordinates = torch.arange(steps * streams)
    drawn = coordinates // streams, coordinates % streams
    assert flat_rows(drawn, storage).tolist() == coordinates.tolist()
    assert flat_rows(coordinates, storage).tolist() == coordinates.tolist()
    stacked = torch.stack(drawn, -1)
    assert flat_rows(stacked, storage).tolist() == coordinates.tolist()
    # 4 bytes for each row and each of three parts.
    parts = (index.left, index.order, index.place)
    assert {part.dtype for part in parts} == {torch.int32}
