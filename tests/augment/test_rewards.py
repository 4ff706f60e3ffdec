"""Sparse rewards that are recognised in stored ones."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_caiac import EntityLayout
from torchrl_caiac.augment import find_sparse_reward

FLAT = EntityLayout(
    {"arm": [0], "cup": [1, 2], "box": [3]},
    fixed=["arm"],
    goal={"cup": [0, 1], "box": [2]},
    achieved={"cup": [1, 2], "box": [3]},
)
NESTED = EntityLayout.from_keys(
    {"arm": "arm", "cup": "cup", "box": "box"},
    fixed=["arm"],
    goal={"cup": ("goal", "cup"), "box": ("goal", "box")},
    achieved={"cup": ("at", "cup"), "box": ("at", "box")},
)


def transitions(
    layout: EntityLayout, joint: bool, tolerance: float, low: float, high: float
) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    at, goal = (torch.rand(500, 3, generator=generator) for _ in range(2))
    gap = at - goal
    if joint:
        distance = gap.norm(dim=-1)
    else:
        distance = torch.maximum(gap[:, :2].norm(dim=-1), gap[:, 2].abs())
    reward = torch.where(distance <= tolerance, high, low).unsqueeze(-1)
    if layout is FLAT:
        entries = {
            "desired_goal": goal,
            "next": {"reward": reward, "achieved_goal": at},
        }
    else:
        entries = {
            "goal": {"cup": goal[:, :2], "box": goal[:, 2:]},
            "next": {"reward": reward, "at": {"cup": at[:, :2], "box": at[:, 2:]}},
        }
    return TensorDict(entries, [500])


@pytest.mark.parametrize("layout", [FLAT, NESTED])
@given(
    joint=st.booleans(),
    tolerance=st.floats(0.2, 0.6),
    values=st.sampled_from([(-1.0, 0.0), (0.0, 1.0), (0.0, 10.0)]),
)
def test_the_stored_rewards_come_back(
    layout: EntityLayout, joint: bool, tolerance: float, values: tuple[float, float]
) -> None:
    data = transitions(layout, joint, tolerance, *values)
    found = find_sparse_reward(data, layout)
    at, goal = data["next"], data
    if layout is FLAT:
        again = found(at["achieved_goal"], goal["desired_goal"])
    else:
        again = found(
            torch.cat([at["at", "cup"], at["at", "box"]], -1),
            torch.cat([goal["goal", "cup"], goal["goal", "box"]], -1),
        )
    assert torch.equal(again, data["next", "reward"].squeeze(-1))
    assert find_sparse_reward(data, layout, tolerance).tolerance == tolerance


def test_more_than_two_values() -> None:
    data = transitions(FLAT, False, 0.3, -1, 0)
    data["next", "reward"][0] = 5
    with pytest.raises(ValueError, match="have 3 values"):
        find_sparse_reward(data, FLAT)


def test_rewards_that_do_not_depend_on_the_goal() -> None:
    data = transitions(FLAT, False, 0.3, -1, 0)
    data["next", "reward"] = (torch.arange(500) % 2).float().unsqueeze(-1)
    with pytest.raises(ValueError, match="agrees with the stored rewards in"):
        find_sparse_reward(data, FLAT)


def test_a_goal_that_is_never_reached() -> None:
    data = transitions(FLAT, False, 0.3, -1, 0)
    data["next", "reward"].fill_(-1)
    data["desired_goal"] += 10
    with pytest.raises(ValueError, match="no tolerance can be found"):
        find_sparse_reward(data, FLAT)
    found = find_sparse_reward(data, FLAT, 0.3)
    assert (found.low, found.high) == (-1, 0)


def test_a_goal_that_is_always_reached() -> None:
    data = transitions(FLAT, False, 0.3, -1, 0)
    data["next", "reward"].fill_(0)
    data["desired_goal"] = data["next", "achieved_goal"].clone()
    found = find_sparse_reward(data, FLAT, 0.3)
    assert (found.low, found.high) == (-1, 0)


def test_no_rewards() -> None:
    data = transitions(FLAT, False, 0.3, -1, 0)
    del data["next", "reward"]
    with pytest.raises(KeyError, match="lack the reward"):
        find_sparse_reward(data, FLAT)
