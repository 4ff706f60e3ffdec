"""Functions of goals in the forms that users have them."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest
import torch
from torch import nn

from torchrl_caiac.transforms.goal_function import GoalFunction

ACHIEVED = torch.tensor([[0.0, 3.0], [1.0, 1.0], [2.0, 5.0]])
DESIRED = torch.tensor([[4.0, 0.0], [1.0, 1.0], [2.0, 6.0]])
ACTION = torch.tensor([[1.0], [2.0], [3.0]])
DISTANCE = [-5.0, 0.0, -1.0]


def tensors(achieved: Any, desired: Any) -> Any:
    assert isinstance(achieved, torch.Tensor) and isinstance(desired, torch.Tensor)
    return -(achieved - desired).norm(dim=-1)


def arrays(achieved: Any, desired: Any, info: Any) -> Any:
    assert isinstance(achieved, np.ndarray) and isinstance(desired, np.ndarray)
    assert info == {}
    return -np.linalg.norm(achieved - desired, axis=-1)


class Env:
    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return arrays(achieved_goal, desired_goal, info)


class Module(nn.Module):
    def forward(self, achieved: Any, desired: Any) -> Any:
        return tensors(achieved, desired)


def in_place(achieved: Any, desired: Any, info: Any) -> Any:
    achieved -= desired
    return -np.linalg.norm(achieved, axis=-1)


def column(achieved: Any, desired: Any, info: Any) -> Any:
    return torch.as_tensor(arrays(achieved, desired, info))[:, None]


@pytest.mark.parametrize(
    "function",
    [
        tensors,
        arrays,
        Env().compute_reward,
        Module(),
        in_place,
        column,
        functools.partial(lambda a, d, power: tensors(a, d) ** power, power=1),
        lambda a, d, /: tensors(a, d),
        lambda a, d, power=1: tensors(a, d) ** power,
        lambda a, d, *rest, **more: tensors(a, d),
        lambda a, d, _info: arrays(a, d, _info),
        lambda a, d, info=None, p=0.5: arrays(a, d, info),
        lambda a, d, *, info: arrays(a, d, info),
    ],
)
def test_the_signature_decides_what_a_function_gets(function: Any) -> None:
    achieved, desired = ACHIEVED.clone(), DESIRED.clone()
    called = GoalFunction(function)
    assert called.function is function and not called.needs_action
    found = called(achieved, desired)
    assert found.tolist() == DISTANCE and found.dtype == torch.float32
    assert torch.equal(achieved, ACHIEVED)  # functions write to copies


def test_a_parameter_named_action_gets_the_actions() -> None:
    def with_action(achieved: Any, desired: Any, action: Any) -> Any:
        return tensors(achieved, desired) + action[:, 0]

    def with_both(achieved: Any, desired: Any, info: Any, action: Any) -> Any:
        return arrays(achieved, desired, info) + np.sum(action, -1)

    for function in (
        with_action,
        with_both,
        lambda a, d, action, info: with_both(a, d, info, action),
    ):
        called = GoalFunction(function)
        assert called.needs_action
        assert called(ACHIEVED, DESIRED, ACTION).tolist() == [-4.0, 2.0, 2.0]


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int8, torch.int64, torch.bool])
def test_goals_of_integers_do_not_wrap_around(dtype: torch.dtype) -> None:
    achieved, desired = (
        torch.tensor([[0, 1]]).to(dtype),
        torch.tensor([[1, 0]]).to(dtype),
    )
    for function in (tensors, arrays):
        found = GoalFunction(function)(achieved, desired)
        assert found.tolist() == pytest.approx([-(2**0.5)])


def test_goals_in_bfloat16_become_arrays() -> None:
    found = GoalFunction(arrays)(ACHIEVED.bfloat16(), DESIRED.bfloat16())
    assert found.tolist() == DISTANCE


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda a, d, radius: a, r"reward_fn needs the parameters \['radius'\]"),
        (lambda a, d, *, radius, info: a, r"needs the parameters \['radius'\]"),
        (lambda a, d, info, /: a, r"needs the parameters \['info'\]"),
        (lambda a: a, r"has the parameters \['a'\], without two positional"),
        (lambda *args: args[0], r"has the parameters \['\*args'\]"),
        (lambda *, achieved, desired: achieved, "without two positional"),
        (lambda desired, achieved: achieved, "the achieved goals come first"),
        (min, "the parameters of reward_fn, <built-in function min>, cannot be read"),
    ],
)
def test_other_functions_are_refused(function: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        GoalFunction(function)
    assert "compute_reward(achieved_goal, desired_goal, info)" in str(caught.value)


def test_what_is_no_function_is_refused() -> None:
    with pytest.raises(TypeError, match="terminated_fn must be a function of the next"):
        GoalFunction("sparse", "terminated_fn")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.float64(1.0), r"returned \[\] for goals \[3, 2\], expected \[3\]"),
        (np.zeros((3, 2)), r"returned \[3, 2\]"),
        (np.array(["a"] * 3), "returned ndarray"),
        ([0.0] * 3, "returned list"),
        (None, "returned NoneType"),
        (torch.zeros(3, dtype=torch.complex64), r"returned torch\.complex64"),
    ],
)
def test_results_of_another_kind_are_refused(value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GoalFunction(lambda a, d: value)(ACHIEVED, DESIRED)


def test_the_reward_of_a_gymnasium_robotics_environment() -> None:
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FetchReach-v4")
    reward_fn = GoalFunction(env.unwrapped.compute_reward)  # type: ignore[attr-defined]
    goals = torch.tensor([[1.0, 0.5, 0.5], [1.0, 0.5, 0.5]])
    reached = goals + torch.tensor([[0.01], [0.1]])
    assert reward_fn(reached, goals).tolist() == [0.0, -1.0]
    env.close()
