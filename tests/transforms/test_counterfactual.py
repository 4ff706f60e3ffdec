"""Tests of what augmentations share, through one of three lines."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms import CAIACTransform, CoDATransform
from torchrl_caiac.transforms.counterfactual import CounterfactualTransform
from torchrl_caiac.transforms.donors import SwapDraw

LAYOUT = EntityLayout({"cup": [0], "lid": [1]})
SETTINGS: dict[str, Any] = {
    "threshold": 0.1,
    "counterfactual_ratio": 0.5,
    "swap_prob": 1.0,
    "window": 1,
    "donors": None,
    "score_key": "age",
    "reward_fn": None,
    "reward_key": ("next", "reward"),
    "goals": None,
    "generator": None,
    "counterfactual_key": ("caiac", "counterfactual"),
    "swapped_key": ("caiac", "swapped"),
    "relabeled_key": ("hindsight", "relabeled"),
    "trajectory_key": "episode",
    "done_key": ("next", "done"),
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
    other = transform(LAYOUT)
    assert other.counterfactual_key == made.counterfactual_key
    assert other.swapped_key == made.swapped_key
