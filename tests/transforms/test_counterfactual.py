"""Tests of what augmentations share, through one of three lines."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from tests.transforms.oracle import FLAT, N, small
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms import (
    CAIACTransform,
    CoDATransform,
    HindsightGoal,
    TransformKeys,
)
from torchrl_caiac.transforms.counterfactual import CounterfactualTransform
from torchrl_caiac.transforms.draws import SwapDraw

LAYOUT = EntityLayout({"cup": [0], "lid": [1]})
KEYS = TransformKeys(trajectory="run")
SETTINGS: dict[str, Any] = {
    "threshold": 0.1,
    "counterfactual_ratio": 0.5,
    "rows": "last",
    "swap_prob": 1.0,
    "window": 1,
    "donors": None,
    "score_key": "age",
    "unscored": "raise",
    "reward_fn": None,
    "goals": None,
    "generator": None,
    "keys": KEYS,
    "check": True,
}


class FromTheFirst(CounterfactualTransform):
    """Takes every young entity from the first window."""

    def swappable(self, scores: torch.Tensor) -> torch.Tensor:
        return scores <= self.threshold

    @staticmethod
    def draw_in_batch(
        free: torch.Tensor, num_counterfactual: int, **settings: Any
    ) -> SwapDraw:
        chosen = settings.pop("chosen")
        assert settings == {"window": 1, "swap_prob": 1.0, "generator": None}
        tail = free[len(free) - num_counterfactual :]
        if chosen is not None:
            tail = tail & chosen.unsqueeze(-1)
        donors = torch.zeros_like(tail, dtype=torch.int64)
        return SwapDraw(donors, tail, tail.sum(0), chosen=chosen)


def batch() -> TensorDict:
    state = torch.arange(8.0).view(4, 2)
    age = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    return TensorDict(
        {"observation": state, "next": {"observation": state + 0.5}, "age": age}, [4]
    )


def test_a_subclass_says_what_is_swapped_and_with_whom() -> None:
    td = batch()
    transform = FromTheFirst(LAYOUT, **SETTINGS)
    out = transform(td)
    assert out["observation"].tolist() == [[0, 1], [2, 3], [0, 1], [6, 1]]
    after = [[0.5, 1.5], [2.5, 3.5], [0.5, 1.5], [6.5, 1.5]]
    assert out["next", "observation"].tolist() == after
    assert out["caiac", "counterfactual"].flatten().tolist() == [False] * 2 + [True] * 2
    assert out["caiac", "swapped"][2:].tolist() == [[True, True], [False, True]]
    assert transform.no_donor_count.tolist() == [1, 2]
    assert (td == batch()).all()


def test_a_subclass_gets_the_windows_that_were_drawn() -> None:
    td, seen = batch(), set()
    transform = FromTheFirst(LAYOUT, **{**SETTINGS, "rows": "random"})
    transform.set_generator(None)
    for _ in range(60):
        out = transform(td)
        marked = out["caiac", "counterfactual"]
        seen.add(tuple(marked.flatten().tolist()))
        young = (td["age"] <= 0.1) & marked
        assert torch.equal(out["caiac", "swapped"], young)
        expected = torch.where(young, td["observation"][0], td["observation"])
        assert torch.equal(out["observation"], expected)
    assert len(seen) == 6 and all(sum(marked) == 2 for marked in seen)


def test_it_moves_as_any_module() -> None:
    transform = FromTheFirst(LAYOUT, **SETTINGS).to("cpu").float()
    assert (transform(batch())["observation"] == batch()["observation"]).any()
    assert list(transform.parameters()) == []
    assert list(transform.state_dict()) == ["_extra_state"]


def test_the_state_of_the_generator_is_saved() -> None:
    td = batch()
    td["age"] = torch.zeros(4, 2)

    def transform(seed: int) -> CAIACTransform:
        generator = torch.Generator().manual_seed(seed)
        return CAIACTransform(LAYOUT, score_key="age", generator=generator)

    one, other = transform(0), transform(1)
    one(td)
    other.load_state_dict(one.state_dict())
    for _ in range(5):
        assert (one(td) == other(td)).all()
    without = CAIACTransform(LAYOUT, score_key="age")
    without.load_state_dict(one.state_dict())  # has no generator, and gets none
    assert without.generator is None
    state = other.generator.get_state()
    other.load_state_dict(without.state_dict())  # keeps its own
    assert torch.equal(other.generator.get_state(), state)


def test_the_state_of_a_buffer_contains_that_of_the_generator() -> None:
    def buffer() -> ReplayBuffer:
        rb = ReplayBuffer(storage=LazyTensorStorage(4), batch_size=4)
        td = batch()
        td["age"] = torch.zeros(4, 2)
        rb.extend(td)
        generator = torch.Generator().manual_seed(7)
        rb.append_transform(
            CAIACTransform(LAYOUT, score_key="age", generator=generator)
        )
        return rb

    one, other = buffer(), buffer()
    for _ in range(3):
        one.sample()
    other.load_state_dict(one.state_dict())
    for _ in range(3):
        assert (one[:] == other[:]).all()


def test_what_a_subclass_lacks_is_named() -> None:
    with pytest.raises(TypeError, match="abstract method"):
        CounterfactualTransform(LAYOUT, **SETTINGS)  # type: ignore[abstract]


@pytest.mark.parametrize("transform", [CAIACTransform, CoDATransform])
def test_both_augmentations_take_the_same_options(transform: Any) -> None:
    options = {k: v for k, v in SETTINGS.items() if k != "score_key"}
    made = transform(LAYOUT, **options)
    assert isinstance(made, CounterfactualTransform)
    for name, value in options.items():
        if name not in ("goals", "rows"):
            assert getattr(made, name) == value
    assert made.chosen_rows == "last" and transform(LAYOUT).chosen_rows == "random"
    assert transform(LAYOUT).keys == TransformKeys()
    assert transform(LAYOUT).unscored == "raise"
    for name in ("rows", "unscored"):
        with pytest.raises(ValueError, match=f"{name} must be '.*' or '.*', got 'no'"):
            transform(LAYOUT, **{name: "no"})


@pytest.mark.parametrize("transform", [CAIACTransform, CoDATransform])
def test_arguments_beyond_the_third_are_named(transform: Any) -> None:
    made = transform(LAYOUT, 0.1, 0.25)
    assert (made.threshold, made.counterfactual_ratio) == (0.1, 0.25)
    with pytest.raises(TypeError, match="positional"):
        transform(LAYOUT, 0.1, 0.25, 1)


def test_keys_that_are_read_and_written() -> None:
    goal = EntityLayout(
        {"cup": [0], "lid": [1]},
        goal={"cup": [0], "lid": ()},
        achieved={"cup": [0], "lid": ()},
    )
    state = ["observation", ("next", "observation")]
    made = CAIACTransform(LAYOUT, score_key="age")
    flags = [("caiac", "counterfactual"), ("caiac", "swapped")]
    assert made.in_keys == [*state, "age", "age_fingerprint"]
    assert made.out_keys == [*state, *flags]
    goals = ["achieved_goal", ("next", "achieved_goal")]
    goals += ["desired_goal", ("next", "desired_goal")]
    made = CAIACTransform(
        goal, reward_fn=lambda a, d: a, keys=TransformKeys(reward="r")
    )
    scores = [("caiac", "score"), ("caiac", "score_fingerprint")]
    assert made.in_keys == [*state, *goals, *scores, "r"]
    assert made.out_keys == [*state, *goals, "r", *flags]
    relabel = HindsightGoal(goal, lambda a, d: a)
    assert relabel.in_keys[:2] == [("next", "observation"), "desired_goal"]
    assert relabel.out_keys[-1] == ("hindsight", "relabeled")


@pytest.mark.parametrize(
    ("transform", "scores"),
    [(CAIACTransform, ("caiac", "score")), (CoDATransform, ("coda", "graph"))],
)
def test_hindsight_goals_come_after_the_augmentation(
    transform: Any, scores: Any
) -> None:
    layout = EntityLayout({"cup": [0], "lid": [1]}, goal={"cup": [0], "lid": [1]})
    made, td = transform(layout), batch()
    td[scores] = torch.zeros(4, *made.feature_shape)
    td["next", "achieved_goal"] = td["next", "observation"]
    td["desired_goal"] = torch.zeros(4, 2)
    td["next", "reward"] = torch.zeros(4, 1)
    relabel = HindsightGoal(layout, lambda a, d: (a - d).sum(-1), future=0.0)
    assert relabel(made(td))["hindsight", "relabeled"].shape == (4, 1)
    expected = f"append {transform.__name__} first, HindsightGoal after it"
    with pytest.raises(RuntimeError, match=expected):
        made(relabel(td))


# --- which rows become counterfactual ------------------------------------------------


@pytest.mark.parametrize("window", [1, 3])
@pytest.mark.parametrize("ratio", [0.0, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("rows", ["random", "last"])
def test_share_of_counterfactuals(window: int, ratio: float, rows: str) -> None:
    rb = small(window=window, batch=7)
    rb.append_transform(CAIACTransform(FLAT, 0.05, ratio, rows=rows, window=window))
    count = round(ratio * 7)
    for _ in range(5):
        batch = rb.sample()
        marked = batch["caiac", "counterfactual"].view(7, window)
        assert marked.sum() == count * window
        assert (marked.all(1) == marked.any(1)).all()  # windows stay whole
        # There is always a donor here, so that every chosen window is swapped.
        swapped = batch["caiac", "swapped"][:, 1:]
        assert torch.equal(swapped, marked.view(-1, 1).expand(-1, 2))
        if rows == "last":
            assert marked[7 - count :].all()


@pytest.mark.parametrize("window", [1, 2])
@pytest.mark.parametrize("donor", [False, True])
def test_each_window_is_as_likely_to_be_counterfactual(window: int, donor) -> None:
    transform = CAIACTransform(
        FLAT,
        0.05,
        0.3,
        window=window,
        donors=small() if donor else None,
        generator=torch.Generator().manual_seed(0),
    )
    batches, total = 3000, 8  # of which two are chosen
    scores = torch.zeros(total * window, N)
    pairs = torch.zeros(total, total)
    for _ in range(batches):
        chosen = transform.generate_parameters(scores).chosen
        assert chosen.dtype == torch.bool and chosen.shape == (total,)
        first, second = chosen.nonzero()[:, 0]  # exactly two
        pairs[first, second] += 1
    # All 28 pairs are drawn as often as each other.
    expected = batches / 28
    counts = pairs[torch.ones(total, total).triu(1).bool()]
    assert ((counts - expected) ** 2 / expected).sum() < 55.5  # 27 degrees, p = 0.001


def test_a_single_window_may_be_any() -> None:
    transform = CAIACTransform(FLAT, counterfactual_ratio=0.1)
    transform.set_generator(torch.Generator().manual_seed(0))
    td, counts = small(batch=8).sample(), torch.zeros(8)
    for _ in range(800):
        counts += transform(td)["caiac", "counterfactual"][:, 0]
    assert counts.sum() == 800 and (counts - 100).abs().max() < 5 * 100**0.5


def test_the_share_of_swapped_rows_is_the_same_wherever_they_are() -> None:
    td = small(batch=20).sample()
    for ratio in (0.3, 1.0):
        counts = []
        for rows in ("random", "last"):
            out = CAIACTransform(FLAT, counterfactual_ratio=ratio, rows=rows)(td)
            counts.append(out["caiac", "swapped"].sum(0).tolist())
        assert counts[0] == counts[1] == [0, round(20 * ratio), round(20 * ratio)]


def test_chosen_rows_are_drawn_by_the_generator_alone() -> None:
    td = small(batch=50).sample()
    transform = CAIACTransform(FLAT)
    transform.set_generator(torch.Generator().manual_seed(1))
    torch.manual_seed(0)
    one, state = transform(td), torch.get_rng_state()
    torch.manual_seed(0)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(5)
    transform.set_generator(torch.Generator().manual_seed(1))
    assert (transform(td) == one).all()
    marked = [transform(td)["caiac", "counterfactual"] for _ in range(2)]
    assert not torch.equal(*marked)
