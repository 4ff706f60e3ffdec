"""Tests of buffers that mix offline and online transitions."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    OfflineToOnlineReplayBuffer,
    ReplayBuffer,
    ReplayBufferEnsemble,
)
from torchrl.envs.transforms import Transform

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.data import offline_to_online_buffer
from torchrl_caiac.transforms import HindsightGoal

LAYOUT = EntityLayout(
    {"arm": [0], "cup": [1], "box": [2]},
    goal={"cup": [0], "box": [1]},
    achieved={"cup": [1], "box": [2]},
    fixed=("arm",),
)
ROWS = 60
SCORE = ("caiac", "score")


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return -(achieved != desired).any(-1).float()


def rows(first: int) -> TensorDict:
    """Transitions whose every number is that of its row."""
    number = torch.arange(first, first + ROWS).float()
    state = number.unsqueeze(-1).expand(-1, 3).clone()
    # The arm influences the cup in every second row.
    score = torch.zeros(ROWS, 3)
    score[::2, 1] = 1.0
    end = (torch.arange(ROWS) % 10 == 9).unsqueeze(-1)
    return TensorDict(
        {
            "observation": state,
            "action": number.unsqueeze(-1),
            "desired_goal": state[:, 1:] + 0.25,
            "episode": torch.arange(ROWS) // 10 + first,
            "caiac": {"score": score},
            "next": {
                "observation": state + 0.5,
                "reward": -torch.ones(ROWS, 1),
                "done": end,
                "terminated": torch.zeros_like(end),
            },
        },
        [ROWS],
    )


def buffer(first: int | None, lookahead: str | None = None) -> ReplayBuffer:
    goals = HindsightGoal(LAYOUT, reward)
    rb = ReplayBuffer(
        storage=LazyTensorStorage(ROWS), sample_unit=goals, batch_size=400
    )
    if first is not None:
        rb.extend(rows(first))
    rb.append_transform(CAIACTransform(LAYOUT, 0.5, lookahead=lookahead))
    rb.append_transform(goals)
    return rb


def plain(data: TensorDict, *transforms: Transform) -> ReplayBuffer:
    rb = ReplayBuffer(storage=LazyTensorStorage(ROWS), batch_size=40)
    rb.extend(data)
    for transform in transforms:
        rb.append_transform(transform)
    return rb


def unscored(first: int, how: str) -> TensorDict:
    """The rows, without scores or with NaN."""
    data = rows(first)
    if how == "missing":
        return data.exclude(SCORE)
    data[SCORE].fill_(float("nan"))
    return data


def assert_from_its_own_buffer(batch: TensorDict, first: int) -> None:
    state, after = batch["observation"], batch["next", "observation"]
    own = batch["action"].flatten()
    assert torch.equal(state[:, 0], own)  # the arm is never swapped
    assert torch.equal(after, state + 0.5)
    assert ((state >= first) & (state < first + ROWS)).all()
    influenced = (own - first) % 2 == 0
    swapped = batch["caiac", "swapped"]
    assert torch.equal(state[influenced, 1], own[influenced])
    assert not swapped[influenced, 1].any() and swapped[:, 1:].any(0).all()
    # A donor of the cup is a row in which it is not influenced.
    assert ((state[swapped[:, 1], 1] - first) % 2 == 1).all()
    kept = ~batch["caiac", "counterfactual"].flatten()
    assert (state[kept] == own[kept, None]).all()
    relabeled = batch["hindsight", "relabeled"].flatten()
    future = batch["desired_goal"][kept & relabeled] - 0.5
    now = own[kept & relabeled, None]
    assert len(now) and (future >= now).all()
    assert ((future - first) // 10 == (now - first) // 10).all()
    stored = ~relabeled
    assert torch.equal(batch["desired_goal"][stored], state[stored, 1:] + 0.25)


@pytest.mark.parametrize("lookahead", [None, "next"])
def test_each_buffer_augments_its_own_rows(lookahead: str | None) -> None:
    offline, online = buffer(0, lookahead), buffer(None, lookahead)
    rb = offline_to_online_buffer(offline, online, offline_fraction=0.25)
    if lookahead is None:
        assert_from_its_own_buffer(rb.sample(400), 0)  # nothing is online yet
    rb.extend(rows(1000))
    assert rb.online_buffer is online and len(rb) == 2 * ROWS
    batch = rb.sample(400)
    if lookahead is None:
        assert_from_its_own_buffer(batch[:100], 0)
        assert_from_its_own_buffer(batch[100:], 1000)
    assert (batch["action"][:100] < ROWS).all()
    assert (batch["action"][100:] >= 1000).all()
    rb.anneal(1, 1)
    assert (rb.sample(400)["action"] >= 1000).all()


def test_arguments() -> None:
    rb = buffer(0)
    with pytest.raises(TypeError, match="online must be a ReplayBuffer, got"):
        offline_to_online_buffer(rb, rb.storage)
    with pytest.raises(ValueError, match="the same buffer"):
        offline_to_online_buffer(rb, rb)
    with pytest.raises(ValueError, match="offline_fraction"):
        offline_to_online_buffer(rb, buffer(None), offline_fraction=1.0)


def test_hindsight_goals_without_a_sample_unit_are_refused() -> None:
    goals = HindsightGoal(LAYOUT, reward)
    mixed = OfflineToOnlineReplayBuffer(
        buffer(0), online_capacity=ROWS, batch_size=40, offline_fraction=0.5
    )
    mixed.online_buffer.append_transform(goals)
    mixed.extend(rows(1000))
    with pytest.raises(RuntimeError, match="no future goals were drawn"):
        mixed.sample()
    ensemble = ReplayBufferEnsemble(buffer(0), buffer(1000), batch_size=40)
    with pytest.raises(RuntimeError, match=r"ReplayBufferEnsemble .* by itself"):
        ensemble.sample()


@pytest.mark.parametrize("how", ["missing", "nan"])
def test_an_unscored_member_is_refused(how: str) -> None:
    """By a transform of each buffer, and by one of all samples."""
    make = partial(CAIACTransform, LAYOUT, 0.5)
    scored, other = rows(0), unscored(1000, how)
    each = [plain(data, make()) for data in (scored, other)]
    wanted = r"no scores in .*call score_buffer on the" if how == "missing" else "NaN"
    error = KeyError if how == "missing" else ValueError
    mixed = offline_to_online_buffer(*each)
    with pytest.raises(error, match=wanted):
        mixed.sample(40)
    ensemble = ReplayBufferEnsemble(
        plain(scored), plain(other), batch_size=40, sample_from_all=True
    )
    ensemble.append_transform(make())
    wanted = wanted.replace("on the", "on each buffer of the ensemble")
    with pytest.raises(error, match=wanted):
        ensemble.sample()


def test_unscored_rows_of_a_member_may_be_kept() -> None:
    keep = CAIACTransform(LAYOUT, 0.5, counterfactual_ratio=1.0, unscored="keep")
    ensemble = ReplayBufferEnsemble(
        plain(rows(0)),
        plain(unscored(1000, "nan")),
        batch_size=40,
        sample_from_all=True,
    )
    ensemble.append_transform(keep)
    own, online = ensemble.sample()
    assert keep.unscored_count == 20
    assert own["caiac", "swapped"].any()
    assert ((own["observation"] >= 0) & (own["observation"] < ROWS)).all()
    assert not online["caiac", "swapped"].any()
    assert (online["observation"] == online["action"]).all()


def test_entries_of_one_buffer_only_are_named() -> None:
    augmented = plain(rows(0), CAIACTransform(LAYOUT, 0.5))
    mixed = offline_to_online_buffer(augmented, plain(rows(1000)), batch_size=40)
    with pytest.raises(KeyError, match=r"only the offline buffer's .*'swapped'.*score"):
        mixed.sample()
    mixed = offline_to_online_buffer(
        plain(unscored(0, "missing")), plain(rows(1000)), batch_size=40
    )
    with pytest.raises(KeyError, match=r"the online one .*'caiac', 'score'"):
        mixed.sample()
