"""Layout, distances and reward against gymnasium-robotics and plain Python."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import OBS_ELEMENT_INDICES
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.envs.kitchen.tasks import (
    KITCHEN_LAYOUT,
    KITCHEN_TASKS,
    kitchen_distances,
    kitchen_reward,
)


def test_layout_fits_the_observation():
    layout = KITCHEN_LAYOUT
    assert layout.names == (
        "robot",
        "bottom_right_burner",
        "bottom_burner",
        "top_right_burner",
        "top_burner",
        "light_switch",
        "slide_cabinet",
        "hinge_cabinet",
        "microwave",
        "kettle",
    )
    assert layout.fixed == ("robot",)
    assert layout.goal_width == 21
    owned = [c for columns in layout.columns.values() for c in columns]
    assert owned == list(range(30))
    for name in layout.names[1:]:
        assert list(layout.columns[name]) == [c + 9 for c in layout.goal[name]]
        assert layout.achieved[name] == layout.columns[name]
    for task in KITCHEN_TASKS:
        own = set(OBS_ELEMENT_INDICES[task.replace("_", " ")].tolist())
        assert own == set(layout.columns[task])


def slow_success(achieved: np.ndarray, desired: np.ndarray) -> float:
    """The criterion in plain Python."""
    for name in KITCHEN_LAYOUT.names[1:]:
        columns = KITCHEN_LAYOUT.goal[name]
        total = sum((float(achieved[c]) - float(desired[c])) ** 2 for c in columns)
        if not total**0.5 < 0.3:
            return 0.0
    return 1.0


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    batch=st.lists(st.integers(0, 3), max_size=3),
    double=st.booleans(),
)
def test_any_batch_equals_plain_python(seed, batch, double):
    rng = np.random.default_rng(seed)
    dtype = np.float64 if double else np.float32
    desired = rng.normal(size=(*batch, 21)).astype(dtype)
    achieved = desired + rng.uniform(-0.2, 0.2, (*batch, 21)).astype(dtype)
    achieved[..., 14:] = desired[..., 14:] + 0.08 * rng.normal(size=(*batch, 7))
    reward = kitchen_reward(achieved, desired)
    assert reward.shape == tuple(batch) and reward.dtype == np.float32
    for index in np.ndindex(*batch):
        assert reward[index] == slow_success(achieved[index], desired[index])
    tensor = kitchen_reward(torch.tensor(achieved), torch.tensor(desired))
    assert tensor.dtype == torch.float32
    assert np.array_equal(tensor.numpy(), reward)


def test_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"achieved goal has shape \(2, 20\)"):
        kitchen_reward(torch.zeros(2, 20), torch.zeros(21))
    with pytest.raises(ValueError, match="desired goal"):
        kitchen_distances(np.zeros(21), np.zeros(30))


def test_threshold():
    achieved, desired = np.zeros(21), np.zeros(21)
    achieved[13] = 0.25
    assert kitchen_reward(achieved, desired) == 1
    assert kitchen_reward(achieved, desired, threshold=0.2) == 0
