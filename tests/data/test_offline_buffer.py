from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import SliceSampler, TensorDictReplayBuffer, TensorStorage

from tests.pretend_cuda import nothing_waits
from torchrl_caiac import EntityLayout
from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.offline_buffer import OfflineStorage, offline_buffer
from torchrl_caiac.influence.score_buffer import score_buffer


def rows(n=12):
    x = torch.randn(n + 1, 2)
    done = torch.zeros(n, 1, dtype=torch.bool)
    done[3::4] = True
    return TensorDict(
        {
            "observation": x[:-1],
            "action": torch.randn(n, 2),
            "episode": torch.arange(n) // 4,
            "next": {"observation": x[1:], "done": done},
        },
        [n],
    )


class Read:
    layout = EntityLayout({"arm": [0], "cup": [1]})

    def __call__(self, td):
        return td["observation"].abs()


@pytest.mark.parametrize("mapped", [False, True])
def test_windows_with_scores(mapped, tmp_path):
    data = rows()
    if mapped:
        data.memmap(tmp_path / "data")
        data = load_transitions(tmp_path / "data")
    sampler = SliceSampler(slice_len=3, traj_key="episode", cache_values=True)
    rb = offline_buffer(data, 6, sampler)
    rb.sample()
    score_buffer(rb, Read(), lookahead=0, progress=False)
    assert data.is_memmap() == mapped
    for _ in range(5):
        batch = rb.sample()
        assert torch.equal(batch["caiac", "score"], batch["observation"].abs())
        windows = batch["episode"].reshape(2, 3)
        assert (windows == windows[:, :1]).all()
    if mapped:
        again = load_transitions(tmp_path / "data")
        assert torch.equal(again["caiac", "score"], again["observation"].abs())


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize(
    "index",
    [
        torch.tensor([3, 3, 0]),
        torch.tensor([-1, 2]),
        torch.tensor([], dtype=torch.int64),
        torch.tensor([1], dtype=torch.int32),
        torch.arange(12) % 3 == 0,
        torch.tensor([[0, 1], [5, 4]]),
        (torch.tensor([2, 7]),),
        slice(2, 5),
        [4, 1],
        6,
        12,
        torch.tensor([0, 12]),
    ],
    ids=str,
)
def test_rows_are_those_of_a_tensor_storage(mapped, index, tmp_path):
    data = rows()
    data["half"] = data["observation"].expand(3, 12, 2)[1]
    data["rows", "next"] = torch.arange(12).flip(0)[:, None].expand(12, 2)
    if mapped:
        data = data.memmap(tmp_path)
    else:
        data["none"] = torch.zeros(12, 0)
    before = data.clone()
    try:
        wanted = TensorStorage(data).get(index)
    except Exception as error:
        with pytest.raises(type(error)):
            OfflineStorage(data).get(index)
        return
    found = OfflineStorage(data).get(index)
    assert type(found) is type(wanted) and found.batch_size == wanted.batch_size
    assert set(found.keys(True, True)) == set(wanted.keys(True, True))
    assert (found == wanted).all()
    assert all(type(x) is type(wanted[k]) for k, x in found.items(True, True))
    if isinstance(index, torch.Tensor):
        found.apply_(lambda leaf: leaf.zero_())  # a copy
    assert (data == before).all()


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("flags", [[], ["done"], ["done", "terminated", "is_init"]])
@pytest.mark.parametrize("truncated", [None, ("next", "truncated")])
def test_slices_are_those_of_a_tensor_storage(mapped, flags, truncated, tmp_path):
    data = rows()
    done = data["next"].pop("done")
    for name in flags:
        data["next", name] = done
    data["is_init"] = done.roll(1)
    if mapped:
        data = data.memmap(tmp_path)
    found = []
    for kind in (TensorStorage, OfflineStorage):
        torch.manual_seed(0)
        sampler = SliceSampler(slice_len=3, traj_key="episode", truncated_key=truncated)
        rb = TensorDictReplayBuffer(storage=kind(data), sampler=sampler, batch_size=9)
        found.append(rb.sample(return_info=True))
    (wanted, wanted_info), (batch, info) = found
    assert set(batch.keys(True, True)) == set(wanted.keys(True, True))
    assert (batch == wanted).all()
    assert batch["is_init"].view(3, 3)[:, 0].all()
    assert set(info) == set(wanted_info)
    for key, value in wanted_info.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(info[key], value) and type(info[key]) is type(value)


def test_it_cannot_be_extended():
    rb = offline_buffer(rows(), 6)
    with pytest.raises(RuntimeError, match=r"doesn.t allow writing"):
        rb.extend(rows())


def test_bad_data():
    with pytest.raises(TypeError, match="got Tensor"):
        offline_buffer(torch.zeros(3))
    with pytest.raises(ValueError, match=r"batch size \[0\]"):
        offline_buffer(rows()[:0])
    with pytest.raises(ValueError, match=r"batch size \[3, 4\]"):
        offline_buffer(rows().reshape(3, 4))


def test_rows_are_drawn_on_the_host():
    assert offline_buffer(rows(), 6).storage.device == torch.device("cpu")


@pytest.mark.gpu
def test_rows_are_drawn_where_the_data_lie():
    data = TensorDict(rows().to("cuda").to_dict(), [12])  # which names no device
    rb = offline_buffer(data, 6)
    rb.sample()
    with nothing_waits():
        assert rb.sample()["observation"].is_cuda
