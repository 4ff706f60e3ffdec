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


@pytest.mark.parametrize("tolerance", [None, 0.3])
@pytest.mark.parametrize("value", [-1, 0])
def test_only_one_reward(value: float, tolerance: float | None) -> None:
    data = transitions(FLAT, False, 0.3, -1, 0)
    data["next", "reward"].fill_(value)
    with pytest.raises(ValueError, match=f"all 500 stored rewards are {value}, "):
        find_sparse_reward(data, FLAT, tolerance)


def rare(successes: int) -> TensorDict:
    """Few rows reach their goals by 0.05; as many are at a distance of 0.2."""
    data = transitions(FLAT, False, 0.3, 0, 1).expand(40, 500).reshape(-1).clone()
    data["desired_goal"] = data["next", "achieved_goal"] + 10
    data["next", "reward"].zero_()
    for rows, gap in ((slice(successes), 0.03), (slice(100, 100 + successes), 0.2)):
        data["desired_goal"][rows] = data["next", "achieved_goal"][rows]
        data["desired_goal"][rows, 2] += gap
    data["next", "reward"][:successes] = 1
    return data


def test_few_successes() -> None:
    data = rare(10)
    assert 0.03 < find_sparse_reward(data, FLAT).tolerance < 0.2
    assert find_sparse_reward(data, FLAT, 0.05).tolerance == 0.05
    # Wrong in 10 of 20000 rows only, but in all that reach their goals.
    with pytest.raises(ValueError, match=r"0\.00% of the 10 with the reward 1 and"):
        find_sparse_reward(data, FLAT, 0.001)


def test_few_successes_that_do_not_depend_on_the_goal() -> None:
    data = rare(10)
    data["next", "reward"].zero_()
    data["next", "reward"][500:515] = 1
    with pytest.raises(ValueError, match="of the 15 with the reward 1"):
        find_sparse_reward(data, FLAT)


def test_too_few_successes() -> None:
    with pytest.raises(ValueError, match="4 stored rewards are 1 and 19996 are 0"):
        find_sparse_reward(rare(4), FLAT, 0.05)


def test_no_rewards() -> None:
    data = transitions(FLAT, False, 0.3, -1, 0)
    del data["next", "reward"]
    with pytest.raises(KeyError, match="lack the reward"):
        find_sparse_reward(data, FLAT)
