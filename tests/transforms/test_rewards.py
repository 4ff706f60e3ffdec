from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.transforms import HindsightGoal
from torchrl_caiac.transforms.rewards import call_reward, recompute_reward

LAYOUT = EntityLayout({"cup": [0]}, goal={"cup": [0]}, achieved={"cup": [0]})


def whole_numbers() -> TensorDict:
    """Transitions whose rewards and goals are stored as integers."""
    state = torch.linspace(0.0, 1.0, 8).unsqueeze(-1)
    return TensorDict(
        {
            "observation": state,
            "desired_goal": torch.ones(8, 1, dtype=torch.int64),
            "next": {
                "observation": state + 0.3,
                "reward": -torch.ones(8, 1, dtype=torch.int64),
            },
            ("caiac", "score"): torch.zeros(8, 1),
        },
        [8],
    )


def distance(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return -(achieved - desired).abs().sum(-1)


def test_rewards_of_stored_integers_are_not_cut() -> None:
    td = whole_numbers()
    out = CAIACTransform(LAYOUT, reward_fn=distance, rows="last")(td)
    gap = (out["next", "observation"] - out["desired_goal"]).abs()
    assert out["next", "reward"].dtype == torch.float32
    torch.testing.assert_close(out["next", "reward"][4:], -gap[4:])
    assert (out["next", "reward"][:4] == -1.0).all()


@given(
    chosen=st.sets(st.integers(0, 7)),
    wide=st.booleans(),
    dtype=st.sampled_from([torch.float32, torch.float64, torch.int64]),
)
def test_rewards_of_any_rows(chosen: set[int], wide: bool, dtype: torch.dtype) -> None:
    td = whole_numbers()
    stored = torch.arange(-8, 0).to(dtype)
    td["next", "reward"] = stored.unsqueeze(-1) if wide else stored
    rows = torch.tensor(sorted(chosen), dtype=torch.int64)
    new = recompute_reward(td, LAYOUT, distance, rows)
    assert new.shape == td["next", "reward"].shape
    assert new.dtype == (dtype if dtype.is_floating_point else torch.float32)
    for row in range(8):
        wanted = float(stored[row])
        if row in chosen:
            wanted = -abs(float(td["next", "observation"][row]) - 1.0)
        assert float(new[row]) == pytest.approx(wanted)


def test_goals_between_integers_are_not_cut() -> None:
    goals = HindsightGoal(LAYOUT, distance, future=0.0, random=1.0)
    out = goals(whole_numbers())
    assert out["hindsight", "relabeled"].all()
    reached = out["next", "observation"]
    assert all((reached == goal).any() for goal in out["desired_goal"])
    torch.testing.assert_close(
        out["next", "reward"], -(reached - out["desired_goal"]).abs()
    )
    with pytest.raises(ValueError, match="store rewards in floating point"):
        goals.her_reward(whole_numbers())


@pytest.mark.parametrize("shape", [(4,), (4, 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64])
def test_call_reward(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    like = torch.zeros(shape, dtype=dtype)
    goals = torch.arange(8.0).view(4, 2)
    for out in (goals[:, 1], goals[:, 1:], goals[:, 1] > 3):
        found = call_reward(lambda a, d, out=out: out, goals, goals, like)
        # Rewards between two integers are never cut.
        cuts = out.is_floating_point() and not like.is_floating_point()
        assert found.shape == like.shape
        assert found.dtype == (out.dtype if cuts else dtype)
        assert found.flatten().tolist() == out.flatten().tolist()
    for wrong in (goals, goals[:2], 1.0):
        with pytest.raises(ValueError, match=r"reward_fn returned .*expected \[4\]"):
            call_reward(lambda a, d, wrong=wrong: wrong, goals, goals, like)
