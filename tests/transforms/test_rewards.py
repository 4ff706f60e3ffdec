from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import HERReplayBuffer, LazyTensorStorage

from tests.pretend_cuda import nothing_waits
from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac.transforms import HindsightGoal, TransformKeys
from torchrl_caiac.transforms.rewards import call_reward

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


# --- rewards in every path -----------------------------------------------------------


def transitions(reward_dtype: torch.dtype = torch.float32) -> TensorDict:
    """Eight transitions of one trajectory, the last of which ends it."""
    td = whole_numbers()
    ends = torch.zeros(8, 1, dtype=torch.bool)
    ends[7] = True
    td["desired_goal"] = td["desired_goal"].float()
    td["episode"] = torch.zeros(8, dtype=torch.int64)
    td["action"] = torch.arange(16.0).view(8, 2)
    td["next", "reward"] = td["next", "reward"].to(reward_dtype)
    td["next"].update({"terminated": ends.clone(), "truncated": ~ends & ends})
    td["next", "done"] = ends
    return td


def augmented(path: str, td: TensorDict, reward_fn: Any, **kwargs: Any) -> TensorDict:
    """The batch after one of the transforms; the last four rows are recomputed."""
    if path == "caiac":
        return CAIACTransform(LAYOUT, reward_fn=reward_fn, rows="last", **kwargs)(td)
    if path == "coda":
        td = td.clone().set(("coda", "graph"), torch.zeros(8, 2, 1))
        kwargs.update(reward_fn=reward_fn, rows="last")
        return CoDATransform(LAYOUT, 0.2, **kwargs)(td)
    keys = kwargs.get("keys", TransformKeys())
    flags = (torch.arange(8) >= 4).unsqueeze(-1)
    td = td.clone().set(keys.counterfactual, flags)
    return HindsightGoal(LAYOUT, reward_fn, future=0.0, **kwargs)(td)


PATHS = ["caiac", "coda", "hindsight"]


@pytest.mark.parametrize("path", PATHS)
def test_rewards_in_the_form_of_gymnasium(path: str) -> None:
    def compute_reward(achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)

    out = augmented(path, transitions(), compute_reward)
    gap = (out["next", "observation"] - out["desired_goal"]).abs()
    assert out["next", "reward"].dtype == torch.float32
    torch.testing.assert_close(out["next", "reward"][4:], -gap[4:])
    assert (out["next", "reward"][:4] == -1.0).all()


@pytest.mark.parametrize("path", PATHS)
def test_rewards_that_depend_on_the_action(path: str) -> None:
    def effort(achieved: Any, desired: Any, action: Any) -> Any:
        return -action.sum(-1)

    td = transitions()
    out = augmented(path, td, effort)
    assert torch.equal(out["next", "reward"][4:, 0], -td["action"][4:].sum(-1))
    td.rename_key_("action", "force")
    with pytest.raises(KeyError, match=r"no 'action'.*TransformKeys\(action="):
        augmented(path, td, effort)
    out = augmented(path, td, effort, keys=TransformKeys(action="force"))
    assert torch.equal(out["next", "reward"][4:, 0], -td["force"][4:].sum(-1))
    keys = TransformKeys(action="force")
    made = CAIACTransform(LAYOUT, reward_fn=effort, keys=keys)
    assert "force" in made.in_keys and "force" not in made.out_keys


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    ("stored", "returned", "expected"),
    [
        (torch.int64, torch.float32, torch.float32),
        (torch.int64, torch.float64, torch.float32),  # not of double precision
        (torch.int64, torch.bool, torch.int64),
        (torch.int64, torch.int8, torch.int64),
        (torch.int8, torch.int64, torch.float32),
        (torch.uint8, torch.int8, torch.float32),
        (torch.bool, torch.int64, torch.float32),
        (torch.bool, torch.bool, torch.bool),
        (torch.float32, torch.float64, torch.float32),
        (torch.float64, torch.float32, torch.float64),
        (torch.float32, torch.int64, torch.float32),
        (torch.float32, torch.bool, torch.float32),
    ],
)
def test_no_dtype_changes_a_reward(
    path: str, stored: torch.dtype, returned: torch.dtype, expected: torch.dtype
) -> None:
    value = torch.tensor(-1.0 if returned.is_signed else 1.0)
    value = value - 0.3 if returned.is_floating_point else value
    td = transitions()
    td["next", "reward"] = torch.tensor([[0], [1]] * 4).to(stored)
    out = augmented(path, td, lambda a, d: value.to(returned).expand(len(a)))
    assert out["next", "reward"].dtype == expected
    assert out["next", "reward"].flatten().tolist() == pytest.approx(
        [0.0, 1.0, 0.0, 1.0, *[value.item()] * 4]
    )


def test_no_dtype_wraps_goals_around() -> None:
    td = transitions()
    td["next", "observation"] = -torch.arange(8, dtype=torch.int64).unsqueeze(-1)
    td["desired_goal"] = torch.zeros(8, 1, dtype=torch.uint8)
    out = HindsightGoal(LAYOUT, distance, future=0.0, random=1.0)(td)
    assert out["desired_goal"].min() < 0 and out["hindsight", "relabeled"].all()


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_rewards_that_are_not_finite_name_the_row(path: str, value: float) -> None:
    def broken(achieved: Any, desired: Any) -> Any:
        found = torch.zeros(len(achieved))
        found[-2:] = value
        return found

    row = 7 - 1
    with pytest.raises(
        ValueError,
        match=rf"reward_fn returned -?(nan|inf) for row {row} of the batch \(2 of "
        r".*the next achieved goal \[.*\] and the desired goal \[1\.0\]",
    ):
        td = transitions()
        augmented(
            path, td, broken, **({"counterfactual": 0.0} if path == PATHS[2] else {})
        )
    # Rows that keep their reward do not matter.
    relabel = HindsightGoal(LAYOUT, broken, future=0.0, counterfactual=0.0)
    assert relabel(transitions())["next", "reward"].isfinite().all()


@pytest.mark.gpu
@pytest.mark.parametrize("path", PATHS)
def test_on_an_accelerator_nothing_waits_for_rewards_and_end_flags(path: str) -> None:
    value = [0.0]

    def reward(achieved: Any, desired: Any) -> Any:
        return torch.full_like(achieved[:, 0], value[0])

    def reached(achieved: Any, desired: Any) -> Any:
        return (achieved > desired)[:, 0]

    td = transitions().to("cuda")
    flags = (torch.arange(8) >= 4).unsqueeze(-1).to("cuda")
    td["caiac", "counterfactual"] = flags
    td["coda", "graph"] = torch.zeros(8, 2, 1, device="cuda")
    kwargs = {"reward_fn": reward, "terminated_fn": reached}
    made: Any = {
        "caiac": lambda: CAIACTransform(LAYOUT, **kwargs),
        "coda": lambda: CoDATransform(LAYOUT, 0.2, **kwargs),
        "hindsight": lambda: HindsightGoal(LAYOUT, future=0.0, **kwargs),
    }[path]()
    quiet: Any = HindsightGoal(LAYOUT, reward, future=0.0)
    made(td), quiet(td)  # caches
    with nothing_waits():
        made(td)
        for _ in range(2):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                quiet(td)
    value[0] = math.nan
    made(td)
    torch.cuda.synchronize()
    with pytest.raises(ValueError, match="NaN or infinite rewards in an earlier batch"):
        made(td)


# --- tasks that end at their goal ----------------------------------------------------


def reached(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return (achieved - desired).abs().sum(-1) < 0.4


@pytest.mark.parametrize("path", PATHS)
def test_end_flags_follow_the_goal(path: str) -> None:
    torch.manual_seed(4)
    td = transitions()
    td["desired_goal"][::2] = 9.0  # far from all states
    td["next", "truncated"][5] = td["next", "done"][5] = True
    out = augmented(path, td, distance, terminated_fn=reached)
    expected = reached(out["next", "observation"], out["desired_goal"])
    terminated = out["next", "terminated"].flatten()
    assert torch.equal(terminated[4:], expected[4:])
    assert torch.equal(terminated[:4], td["next", "terminated"].flatten()[:4])
    assert torch.equal(
        out["next", "done"], out["next", "terminated"] | out["next", "truncated"]
    )
    assert expected[4:].any() and not expected[4:].all()
    assert out["next", "terminated"].shape == (8, 1)
    # The storage's rows stay as they are.
    assert td["next", "terminated"].sum() == 1


def test_rewards_over_several_steps_are_refused() -> None:
    td = whole_numbers()
    td["steps_to_next_obs"] = torch.full((8, 1), 3)
    message = r"'steps_to_next_obs'.*leave out MultiStepTransform"
    with pytest.raises(ValueError, match=message):
        CAIACTransform(LAYOUT, reward_fn=distance)(td)
    with pytest.raises(ValueError, match=message):
        HindsightGoal(LAYOUT, distance, future=0.0)(td)
    assert CAIACTransform(LAYOUT)(td)["caiac", "swapped"].any()


@pytest.mark.parametrize("path", PATHS)
def test_end_flags_under_other_keys(path: str) -> None:
    td = transitions()
    keys = TransformKeys(terminated="ends", truncated="cut", done="over")
    for old, new in (("terminated", "ends"), ("truncated", "cut"), ("done", "over")):
        td[new] = td["next", old].flatten().to(torch.uint8)
    before = td["next"].clone()
    out = augmented(path, td, distance, terminated_fn=reached, keys=keys)
    expected = reached(out["next", "observation"], out["desired_goal"])
    for key in ("ends", "over"):
        assert out[key].dtype == torch.uint8 and out[key].shape == (8,)
        assert torch.equal(out[key][4:].bool(), expected[4:])
    for key in ("terminated", "truncated", "done"):
        assert torch.equal(out["next", key], before[key])
    # Without flags of truncation, what ended without ending the task still ends.
    td["over"][4:] = 1
    out = augmented(path, td.exclude("cut"), distance, terminated_fn=reached, keys=keys)
    assert out["over"][4:7].all()
    keys = TransformKeys(terminated="ends", done=None)
    out = augmented(path, td, distance, terminated_fn=reached, keys=keys)
    assert torch.equal(out["over"], td["over"])
    expected = reached(out["next", "observation"], out["desired_goal"])
    assert torch.equal(out["ends"][4:].bool(), expected[4:])


@pytest.mark.parametrize("path", PATHS)
def test_end_flags_have_to_be_there_and_to_be_flags(path: str) -> None:
    with pytest.raises(ValueError, match=r"terminated_fn returned torch\.float32"):
        augmented(path, transitions(), distance, terminated_fn=distance)
    td = transitions()
    del td["next", "terminated"]
    with pytest.raises(KeyError, match=r"no \('next', 'terminated'\).*TransformKeys"):
        augmented(path, td, distance, terminated_fn=reached)
    with pytest.raises(ValueError, match=r"terminated_fn needs the parameters"):
        augmented(path, td, distance, terminated_fn=lambda a, d, radius: a)


def test_windows_are_checked_by_the_stored_end_flags() -> None:
    """Flags that a swap sets within a window do not make it cross an end."""
    td = transitions()
    td["next", "observation"][:-1] = td["observation"][1:]
    augment = CAIACTransform(
        LAYOUT,
        counterfactual_ratio=1.0,
        window=4,
        reward_fn=distance,
        terminated_fn=lambda a, d: torch.ones(len(a), dtype=torch.bool),
    )
    out = augment(td)
    assert out["next", "done"].all() and not td["next", "done"][:7].any()


@pytest.mark.parametrize("path", PATHS)
def test_kept_end_flags_are_mentioned_once(path: str) -> None:
    td = transitions()
    td["caiac", "counterfactual"] = (torch.arange(8) >= 4).unsqueeze(-1)
    td["coda", "graph"] = torch.zeros(8, 2, 1)

    def make(**kwargs: Any) -> Any:
        if path == "hindsight":
            return HindsightGoal(LAYOUT, distance, future=0.0, **kwargs)
        kind = CAIACTransform if path == "caiac" else CoDATransform
        return kind(LAYOUT, 0.2, reward_fn=distance, **kwargs)

    made = make()
    with pytest.warns(UserWarning, match=r"'terminated'\) is true .* terminated_fn"):
        made(td)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made(td)
        make(terminated_fn=reached)(td)
        td["next", "terminated"] = torch.zeros(8, 1, dtype=torch.bool)
        make()(td)


def test_her_reward_sets_the_flags_of_the_rows_that_the_buffer_relabelled() -> None:
    td = transitions()
    goals = HindsightGoal(LAYOUT, distance, terminated_fn=reached, future=0.0)
    td["achieved_goal"] = td["observation"]
    td["next", "achieved_goal"] = td["next", "observation"]
    rb = HERReplayBuffer(
        goals.her_reward,
        her_ratio=0.5,
        batch_size=8,
        achieved_goal_key=("next", "achieved_goal"),
        storage=LazyTensorStorage(8),
    )
    rb.extend(td)
    rb.append_transform(goals)
    stored = rb.storage[:].clone()
    for _ in range(5):
        batch = rb.sample()
        expected = reached(batch["next", "achieved_goal"], batch["desired_goal"])
        assert torch.equal(batch["next", "terminated"][:4, 0], expected[:4])
        assert torch.equal(batch["next", "done"][:4, 0], expected[:4])
    assert (rb.storage[:] == stored).all()


@pytest.mark.parametrize("path", ["swap", "her"])
def test_goals_that_are_reached_equal_their_rounded_copies(path: str) -> None:
    state = torch.linspace(0.1, 0.8, 8, dtype=torch.float64).unsqueeze(-1)
    td = TensorDict(
        {
            "observation": state,
            "desired_goal": (state + 0.3).float(),
            "next": {"observation": state + 0.3, "reward": -torch.ones(8, 1)},
            ("caiac", "score"): torch.ones(8, 1),  # nothing is swapped
        },
        [8],
    )

    def exact(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
        return (achieved == desired).all(-1).float() - 1

    if path == "swap":
        transform = CAIACTransform(LAYOUT, 0.5, reward_fn=exact, rows="last")
        reward = transform(td)["next", "reward"][4:]
    else:
        reward = HindsightGoal(LAYOUT, exact, future=0.0).her_reward(td)
    assert (reward == 0).all()
