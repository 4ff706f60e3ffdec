"""Tests of what augmentations share, through one of three lines."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict

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
    "swap_prob": 1.0,
    "window": 1,
    "donors": None,
    "score_key": "age",
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
        assert settings == {"window": 1, "swap_prob": 1.0, "generator": None}
        tail = free[len(free) - num_counterfactual :]
        return SwapDraw(torch.zeros_like(tail, dtype=torch.int64), tail, tail.sum(0))


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


def test_it_moves_as_any_module() -> None:
    transform = FromTheFirst(LAYOUT, **SETTINGS).to("cpu").float()
    assert (transform(batch())["observation"] == batch()["observation"]).any()
    assert list(transform.parameters()) == [] and transform.state_dict() == {}


def test_what_a_subclass_lacks_is_named() -> None:
    with pytest.raises(TypeError, match="abstract method"):
        CounterfactualTransform(LAYOUT, **SETTINGS)  # type: ignore[abstract]


@pytest.mark.parametrize("transform", [CAIACTransform, CoDATransform])
def test_both_augmentations_take_the_same_options(transform: Any) -> None:
    options = {k: v for k, v in SETTINGS.items() if k != "score_key"}
    made = transform(LAYOUT, **options)
    assert isinstance(made, CounterfactualTransform)
    for name, value in options.items():
        if name != "goals":
            assert getattr(made, name) == value
    assert transform(LAYOUT).keys == TransformKeys()


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
    assert made.in_keys == [*state, "age"] and made.out_keys == [*state, *flags]
    goals = ["achieved_goal", ("next", "achieved_goal")]
    goals += ["desired_goal", ("next", "desired_goal")]
    made = CAIACTransform(
        goal, reward_fn=lambda a, d: a, keys=TransformKeys(reward="r")
    )
    assert made.in_keys == [*state, *goals, ("caiac", "score"), "r"]
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
