"""Transforms of replay buffers are refused by environments, as TorchRL's own are."""

from __future__ import annotations

import pytest
from torchrl.envs import TransformedEnv
from torchrl.testing.mocking_classes import CountingEnv

from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac.transforms import HindsightGoal, WindowGoal

LAYOUT = EntityLayout({"cup": [0]}, goal={"cup": [0]}, achieved={"cup": [0]})


@pytest.mark.parametrize(
    "transform",
    [
        CAIACTransform(LAYOUT),
        CoDATransform(LAYOUT),
        HindsightGoal(LAYOUT, lambda achieved, desired: achieved[:, 0]),
        WindowGoal(LAYOUT, 2),
    ],
    ids=lambda transform: type(transform).__name__,
)
def test_an_environment_refuses_it(transform) -> None:
    env = TransformedEnv(CountingEnv(), transform)
    message = f"{type(transform).__name__} can only be appended to a ReplayBuffer"
    with pytest.raises(RuntimeError, match=message):
        env.reset()
    with pytest.raises(RuntimeError, match=message):
        env.rollout(2)
