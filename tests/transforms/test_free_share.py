"""Warnings of entities that are swapped always or never."""

from __future__ import annotations

import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from tests.pretend_cuda import nothing_waits
from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.transforms.free_share import FreeShare

LAYOUT = EntityLayout({"arm": [0], "cup": [1], "lid": [2]}, fixed=["arm"])


def buffer(cup: float, lid: float, **kwargs) -> TensorDictReplayBuffer:
    state = torch.arange(1500.0).view(500, 3)
    score = torch.tensor([1.0, cup, lid]).expand(500, 3)
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(500), batch_size=100)
    rb.extend(
        TensorDict(
            {"observation": state, "next": {"observation": state}, "s": score}, [500]
        )
    )
    rb.append_transform(CAIACTransform(LAYOUT, score_key="s", **kwargs))
    return rb


def messages(rb: TensorDictReplayBuffer, batches: int) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(batches):
            rb.sample()
    return [str(w.message) for w in caught]


def test_says_once_what_is_never_or_always_free() -> None:
    rb = buffer(0.3, 0.01)
    assert messages(rb, 19) == []
    (message,) = messages(rb, 1)
    assert "['cup'] in none of the first 2000 windows" in message
    assert "['lid'] in all of the first 2000 windows" in message
    assert "arm" not in message and "suggest_thresholds" in message
    assert messages(rb, 50) == []


def test_says_nothing_where_an_entity_is_free_now_and_then() -> None:
    rb = buffer(0.3, 0.01)
    data = rb.storage[:].clone()
    data["s"] = torch.rand(500, 3) / 10
    rb.empty()
    rb.extend(data)
    assert messages(rb, 40) == []


def test_few_windows_say_nothing() -> None:
    share = FreeShare(LAYOUT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(100):
            share.add(torch.zeros(19, 3, dtype=torch.bool))
    with pytest.warns(UserWarning, match=r"\['cup', 'lid'\] in none of the first 2000"):
        share.add(torch.zeros(100, 3, dtype=torch.bool))


def test_what_is_expected_is_not_named() -> None:
    share = FreeShare(LAYOUT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(20):
            share.add(torch.ones(100, 3, dtype=torch.bool), {"cup", "lid"})
    assert share.is_done


def test_a_threshold_below_zero_is_meant() -> None:
    rb = buffer(0.3, 0.01, threshold={"cup": -1.0, "lid": 0.05})
    (message,) = messages(rb, 30)
    assert "cup" not in message and "['lid'] in all" in message


def test_windows_count_once() -> None:
    transform = CAIACTransform(LAYOUT, score_key="s", window=4, check=False)
    state = torch.zeros(400, 3)
    td = TensorDict(
        {"observation": state, "next": {"observation": state}, "s": state}, [400]
    )
    with pytest.warns(UserWarning, match="all of the first 2000 windows"):
        for _ in range(20):
            transform(td)


@pytest.mark.gpu
def test_an_accelerator_is_not_waited_for() -> None:
    share = FreeShare(LAYOUT)
    free = torch.zeros(100, 3, dtype=torch.bool, device="cuda")
    with nothing_waits():
        for _ in range(20):
            share.add(free)
    torch.cuda.synchronize()  # until the copy has arrived
    with pytest.warns(UserWarning, match="in none of"), nothing_waits():
        share.add(free)
