"""Scores that are computed when transitions are written."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer

from tests.influence.scoring import (
    KEY,
    LAYOUT,
    Read,
    definition,
    episodes,
    ready,
    square,
)
from torchrl_caiac.influence import CAI, ScoreOnWrite, score_buffer
from torchrl_caiac.influence.estimator_digest import estimator_digest
from torchrl_caiac.modules import GaussianWorldModel


def buffer(estimator, **kwargs):
    return ReplayBuffer(
        storage=LazyTensorStorage(50), transform=ScoreOnWrite(estimator, **kwargs)
    )


@pytest.mark.parametrize("batch_size", [1, 5, 4096])
def test_scores_are_those_of_the_definition(batch_size):
    rows = episodes([5, 7])
    rb = buffer(Read(), batch_size=batch_size)
    rb.extend(rows)
    wanted = definition(rows, square, 1, 1)
    torch.testing.assert_close(rb.storage[:][KEY], wanted)


def test_the_state_of_the_buffer_leaves_the_model_alone():
    rows = episodes([5])
    first, model = Read(3.0), Read(1.0)
    saved, rb = buffer(first), buffer(model)
    saved.extend(rows)
    rb.extend(rows)
    state = saved.state_dict()
    assert not any("scale" in str(name) for name in state["_transforms"])
    rb.load_state_dict(state)
    assert model.scale == 1.0
    transform = ScoreOnWrite(model)
    assert transform.estimator is model
    assert not list(transform.modules())[1:]
    assert not transform.state_dict()


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_copies_carry_their_own_estimator(copied):
    model, rows = Read(3.0), episodes([5])
    transform = ScoreOnWrite(model)
    transform.inv(rows.clone())
    again = copied(transform)
    assert again.estimator is not model and again.estimator.scale == 3.0
    model.scale.fill_(0.0)
    found = again.inv(rows.clone())[KEY]
    torch.testing.assert_close(found, 9 * definition(rows, square, 1, 1))


@pytest.mark.parametrize("batch_size", [0, -1, 2.7, True, "4", None])
def test_batch_sizes_that_are_refused(batch_size):
    with pytest.raises((TypeError, ValueError), match=f"batch_size.*{batch_size!r}"):
        ScoreOnWrite(Read(), batch_size=batch_size)


class Bare:
    """No module; it has one."""

    layout = LAYOUT

    def __init__(self):
        self.parts = [Read()]

    def __call__(self, td):
        return self.parts[0](td)


def fill(model):
    model.scale.fill_(2.0)


def load(model):
    model.load_state_dict({"scale": torch.tensor(2.0)})


def replace(model):
    model.scale = torch.tensor(2.0)


@pytest.mark.parametrize("change", [fill, load, replace])
@pytest.mark.parametrize("make", [Read, Bare])
def test_a_change_of_the_model_is_noticed_at_the_next_write(make, change):
    estimator, rows = make(), episodes([5, 7])
    rb = buffer(estimator)
    rb.extend(rows[:5])
    change(estimator if make is Read else estimator.parts[0])
    rb.extend(rows[5:])
    with pytest.raises(ValueError, match="other settings"):
        score_buffer(rb, estimator, lookahead=1, progress=False, check=False)
    wanted = definition(rows, square, 1, 1)
    wanted[5:] *= 4
    torch.testing.assert_close(rb.storage[:][KEY], wanted)


def test_weights_are_hashed_once(monkeypatch):
    hashed = []

    def counted(estimator):
        hashed.append(estimator)
        return estimator_digest(estimator)

    monkeypatch.setattr(
        "torchrl_caiac.influence.estimator_digest.estimator_digest", counted
    )
    model, rows = Read(), episodes([5])
    rb = buffer(model)
    for _ in range(3):
        rb.extend(rows)
    assert len(hashed) == 1
    model.scale.add_(1.0)
    rb.extend(rows)
    assert len(hashed) == 2


def world_model():
    return ready(GaussianWorldModel(LAYOUT, 2, (8,)))


def test_a_fast_estimator_must_have_scored_a_buffer():
    rows = episodes([5, 7])
    fast = CAI(world_model(), mode="fast", threshold=0.1)
    assert not fast.is_ready and CAI(world_model()).is_ready
    with pytest.raises(ValueError, match=r"mode='exact', or score a buffer"):
        ScoreOnWrite(fast)
    rb = ReplayBuffer(storage=LazyTensorStorage(50))
    rb.extend(rows)
    score_buffer(rb, fast, progress=False, check=False)
    assert fast.is_ready
    written = buffer(fast)
    written.extend(rows)
    assert written.storage[:][KEY].shape == (12, 3)
    buffer(CAI(world_model())).extend(rows)
