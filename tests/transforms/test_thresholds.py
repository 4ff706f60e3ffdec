"""Thresholds of single entities, and those chosen from the data."""

from __future__ import annotations

import logging
import math
import pickle
import warnings

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    ReplayBuffer,
    ReplayBufferEnsemble,
    TensorDictReplayBuffer,
)

from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac.evaluation import Candidate, compare_influence, swap_shares
from torchrl_caiac.influence import suggest_thresholds
from torchrl_caiac.transforms.thresholds import EntityThresholds

LAYOUT = EntityLayout(
    {"arm": [0], "cup": [1], "lid": [2]},
    fixed=["arm"],
    positions={"cup": [1], "lid": [2]},
    variance_floor=0.01,
)


def rows(count: int = 400, *, lid_moves: bool = False) -> TensorDict:
    """A cup that is pushed in every fourth row, a lid whose scores say nothing."""
    number = torch.arange(count)
    pushed = number % 4 == 0
    state = torch.stack([number, -number, 1000.0 + number], -1).float()
    after = state.clone()
    after[pushed, 1] += 1.0
    if lid_moves:
        after[number % 5 == 0, 2] += 1.0
    cup = torch.where(pushed, 0.5, 0.001) * (1 + number / count)
    lid = 0.1 * (1 + (number % 7) / 7)
    return TensorDict(
        {
            "observation": state,
            "next": {"observation": after, "done": (number % 50 == 49).unsqueeze(-1)},
            "episode": number // 50,
            "caiac": {"score": torch.stack([torch.ones(count), cup, lid], -1)},
        },
        [count],
    )


def buffer(data: TensorDict, **kwargs) -> ReplayBuffer:
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(data)), batch_size=64, **kwargs
    )
    rb.extend(data)
    return rb


# --- numbers -------------------------------------------------------------------------


def test_each_entity_has_its_own() -> None:
    score = torch.tensor([[9.0, 0.3, 0.3], [0.0, 0.1, 0.1]])
    transform = CAIACTransform(LAYOUT, {"lid": 0.2, "cup": 0.3})
    assert transform.swappable(score).tolist() == [
        [False, True, False],
        [False, True, True],
    ]
    assert transform.threshold == {"cup": 0.3, "lid": 0.2}
    assert list(transform.thresholds) == ["cup", "lid"]
    assert "threshold={'cup': 0.3, 'lid': 0.2}" in repr(transform)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
def test_a_number_means_the_same_for_one_as_for_all(dtype: torch.dtype) -> None:
    # 0.1 as float32 is above 0.1 as float64
    score = torch.full((2, 3), 0.1, dtype=dtype)
    one, each = (
        CAIACTransform(LAYOUT, 0.1),
        CAIACTransform(LAYOUT, dict.fromkeys(("cup", "lid"), 0.1)),
    )
    assert torch.equal(one.swappable(score), each.swappable(score))
    assert each.swappable(score)[:, 1:].all()


def test_below_zero_an_entity_is_never_swapped() -> None:
    transform = CAIACTransform(LAYOUT, {"cup": -1, "lid": 0})
    free = transform.swappable(torch.tensor([[0.0, 0.0, 0.0]]))
    assert free.tolist() == [[False, False, True]]


def test_scores_that_are_missing_are_not_below_any_threshold() -> None:
    transform = CAIACTransform(LAYOUT, {"cup": 1e30, "lid": 1e30})
    assert not transform.swappable(torch.full((1, 3), math.nan)).any()


@pytest.mark.parametrize(
    ("threshold", "error", "message"),
    [
        ({"cup": 0.1}, ValueError, r"threshold lacks \['lid'\]"),
        ({}, ValueError, r"threshold lacks \['cup', 'lid'\]"),
        ({"cup": 0.1, "lid": 0.1, "mug": 0.1}, ValueError, r"names \['mug'\]"),
        ({"arm": 0.1, "cup": 0.1, "lid": 0.1}, ValueError, r"\['arm'\], which are fix"),
        ({"cup": math.nan, "lid": 0.1}, ValueError, "'cup' must be finite"),
        ({"cup": 0.1, "lid": math.inf}, ValueError, "'lid' must be finite"),
        ({"cup": "0.1", "lid": 0.1}, TypeError, "'cup' must be a number"),
        ({"cup": True, "lid": 0.1}, TypeError, "'cup' must be a number"),
        ("otsu", TypeError, "or 'auto'; got 'otsu'"),
        ([0.1, 0.1], TypeError, "threshold must be a number"),
    ],
)
def test_wrong_thresholds(threshold, error, message) -> None:
    with pytest.raises(error, match=message):
        CAIACTransform(LAYOUT, threshold)


@pytest.mark.parametrize("threshold", [{"cup": 0.1, "lid": 0.1}, "auto"])
def test_graphs_have_one(threshold) -> None:
    with pytest.raises(TypeError, match="one threshold for all of them"):
        CoDATransform(LAYOUT, threshold)


def test_it_cannot_be_set_later() -> None:
    with pytest.raises(AttributeError):
        CAIACTransform(LAYOUT).threshold = 0.3  # type: ignore[misc]


def test_the_number_of_several_is_refused() -> None:
    with pytest.raises(AttributeError, match="no single threshold"):
        _ = EntityThresholds(LAYOUT, {"cup": 0.1, "lid": 0.2}).number


def test_comparisons_take_the_threshold_of_each_entity() -> None:
    data = rows()
    truth = torch.zeros(400, 3, dtype=torch.bool)
    truth[::4, 1] = True

    class Stored:
        layout = LAYOUT

        def __call__(self, td: TensorDict) -> torch.Tensor:
            place = td["observation"][:, 0].long().clamp_max(399)
            return data["caiac", "score"][place]

    transform = CAIACTransform(LAYOUT, {"cup": 0.1, "lid": 0.15})
    found = compare_influence(
        data, truth, {"stored": Candidate(Stored(), transform)}, progress=False
    )
    by_entity = {row["entity"]: row for row in found}
    assert math.isnan(by_entity["all"]["threshold"])
    assert by_entity["cup"]["threshold"] == 0.1
    assert by_entity["cup"]["true_positive_rate"] == 1.0
    score = data["caiac", "score"]
    above = (score[:, 1] > 0.1).sum() + (score[:, 2] > 0.15).sum()
    assert by_entity["all"]["density"] == pytest.approx(above.item() / 800)
    auto = {"auto": Candidate(Stored(), CAIACTransform(LAYOUT, "auto"))}
    with pytest.raises(ValueError, match="threshold='auto', and no numbers yet"):
        compare_influence(data, truth, auto, progress=False)


# --- auto ----------------------------------------------------------------------------


def test_auto_takes_what_is_suggested_and_says_so(caplog) -> None:
    data = rows(lid_moves=True)
    rb = buffer(data)
    transform = CAIACTransform(LAYOUT, "auto")
    rb.append_transform(transform)
    assert transform.thresholds == {} and "threshold='auto'," in repr(transform)
    with (
        caplog.at_level(logging.INFO),
        pytest.warns(UserWarning, match=r"no clear threshold for \['lid'\]") as warned,
    ):
        for _ in range(3):
            batch = rb.sample()
    assert len(warned) == 1 and "pass threshold={" in str(warned[0].message)
    assert caplog.text.count("two clear modes") == 1  # the table, once
    suggested = suggest_thresholds(data, LAYOUT)
    assert transform.thresholds == suggested.thresholds
    assert suggested.confidence == {"cup": "two clear modes", "lid": "unclear"}
    assert 0.002 < transform.thresholds["cup"] < 0.5
    swapped = batch["caiac", "swapped"]
    assert swapped[:, 1].any() and not swapped[:, 2].any()
    assert not swapped[batch["observation"][:, 0] % 4 == 0, 1].any()
    assert transform.threshold == "auto"


def test_what_never_moves_is_always_free() -> None:
    rb = buffer(rows())  # the lid rests, with scores above the default threshold
    transform = CAIACTransform(LAYOUT, "auto", counterfactual_ratio=1.0)
    rb.append_transform(transform)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(40):  # so many that the lid would be warned of
            assert rb.sample()["caiac", "swapped"][:, 2].all()


def test_donors_use_the_thresholds_of_the_training_buffer() -> None:
    donors = rows()
    donors["observation"] += 10_000
    donors["caiac", "score"][:, 1] = torch.arange(400) / 400  # no modes
    transform = CAIACTransform(
        LAYOUT, "auto", counterfactual_ratio=1.0, donors=buffer(donors)
    )
    rb = buffer(rows())
    rb.append_transform(transform)
    batch = rb.sample()
    theta = transform.thresholds["cup"]
    taken = batch["observation"][batch["caiac", "swapped"][:, 1], 1]
    assert len(taken) and bool(((10_000 - taken) / 400 <= theta).all())


@pytest.mark.parametrize("prefetch", [0, 3])
def test_auto_under_prefetch(prefetch: int, caplog) -> None:
    rb = buffer(rows(), **({"prefetch": prefetch} if prefetch else {}))
    rb.append_transform(CAIACTransform(LAYOUT, "auto"))
    with caplog.at_level(logging.INFO):
        for _ in range(4):
            assert rb.sample()["caiac", "swapped"].any()
    assert caplog.text.count("threshold='auto'") == 1


def test_the_choice_is_saved_and_pickled() -> None:
    rb = buffer(rows())
    one = CAIACTransform(LAYOUT, "auto")
    rb.append_transform(one)
    assert one.state_dict()["_extra_state"] == {}
    rb.sample()
    copy = pickle.loads(pickle.dumps(one))
    other = CAIACTransform(LAYOUT, "auto")
    other.load_state_dict(one.state_dict())
    assert copy.thresholds == other.thresholds == one.thresholds
    assert other(rows())["caiac", "swapped"].any()  # no buffer is needed


def chosen_state() -> tuple[dict[str, float], dict]:
    """The thresholds that ``"auto"`` chose, and the state that has them."""
    rb = buffer(rows())
    transform = CAIACTransform(LAYOUT, "auto", generator=torch.Generator())
    rb.append_transform(transform)
    rb.sample()
    return transform.thresholds, transform.state_dict()


def test_the_choice_is_loaded_by_name() -> None:
    numbers, state = chosen_state()
    layout = EntityLayout({"arm": [0], "lid": [2], "cup": [1]}, fixed=["arm"])
    other = CAIACTransform(layout, "auto")
    other.load_state_dict(state)
    assert other.thresholds == numbers and list(other.thresholds) == ["lid", "cup"]
    same = CAIACTransform(LAYOUT, numbers)
    same.load_state_dict(state)
    assert same.thresholds == numbers


@pytest.mark.parametrize(
    ("columns", "threshold", "message"),
    [
        ({"cup": [0]}, "auto", r"of \['cup', 'lid'\], but .* are \['cup'\]"),
        ({"mug": [1], "lid": [2]}, "auto", "it is of another layout"),
        ({"cup": [1], "lid": [2]}, 0.3, "this transform has threshold=0.3"),
        ({"cup": [1], "lid": [2]}, {"cup": 1, "lid": 1}, "create it with threshold="),
    ],
)
def test_the_choice_of_others_is_refused(columns, threshold, message) -> None:
    _, state = chosen_state()
    other = CAIACTransform(
        EntityLayout(columns), threshold, generator=torch.Generator().manual_seed(7)
    )
    before, generator = other.thresholds, other.generator.get_state()
    with pytest.raises(ValueError, match=message):
        other.load_state_dict(state)
    assert other.thresholds == before
    assert torch.equal(other.generator.get_state(), generator)


def test_a_choice_without_names_is_refused() -> None:
    _, state = chosen_state()
    del state["_extra_state"]["threshold_names"]
    with pytest.raises(ValueError, match="of an earlier version"):
        CAIACTransform(LAYOUT, "auto").load_state_dict(state)


def test_auto_needs_a_buffer() -> None:
    with pytest.raises(RuntimeError, match="no replay buffer samples here: pass numb"):
        CAIACTransform(LAYOUT, "auto")(rows())
    truth = torch.zeros(400, 3, dtype=torch.bool)
    with pytest.raises(RuntimeError, match="suggest_thresholds"):
        swap_shares(CAIACTransform(LAYOUT, "auto"), rows()["caiac", "score"], truth)


@pytest.mark.parametrize("where", ["ensemble", "member"])
def test_auto_in_an_ensemble_is_refused(where: str) -> None:
    # which samples the storages of its buffers itself
    members = [buffer(rows()), buffer(rows())]
    ensemble = ReplayBufferEnsemble(*members, batch_size=8)
    for owner in [ensemble] if where == "ensemble" else members:
        owner.append_transform(CAIACTransform(LAYOUT, "auto"))
    with pytest.raises(RuntimeError, match="StorageEnsemble: pass numbers"):
        ensemble.sample()


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64])
def test_numbers_of_numpy(kind) -> None:
    layout = EntityLayout({"a": [0], "b": [1]})
    for given in (kind(0), {"a": kind(0), "b": kind(0)}):
        CAIACTransform(layout, threshold=given)


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int64])
@pytest.mark.parametrize("given", [0.5, {"a": 0.5, "b": 0.5}])
def test_flags_are_compared_with_fractions(dtype, given) -> None:
    transform = CAIACTransform(EntityLayout({"a": [0], "b": [1]}), threshold=given)
    scores = torch.tensor([[0, 1], [1, 0]], dtype=dtype)
    assert torch.equal(transform.swappable(scores), scores == 0)
