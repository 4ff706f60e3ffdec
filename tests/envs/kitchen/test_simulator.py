"""The simulation of the environment, and positions in its states."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_caiac.envs.kitchen import KITCHEN_TASKS
from torchrl_caiac.envs.kitchen.simulator import KitchenRobot, default_state


def test_a_handle_moves_with_its_object(env):
    names = env.layout.names
    assert tuple(env.handles) == names
    states = np.stack([env.default_state()] * len(KITCHEN_TASKS))
    for state, task in zip(states, KITCHEN_TASKS, strict=True):
        state[list(env.layout.columns[task])] = env.solved(task)
    moved = np.linalg.norm(
        env.handle_positions(states) - env.handle_positions(env.default_state()),
        axis=-1,
    )
    for i, task in enumerate(KITCHEN_TASKS):
        others = [n for n, name in enumerate(names) if name != task]
        assert moved[i, others].max() < 1e-9
        # A knob turns around its own site.
        turns = "burner" in task
        assert (moved[i, names.index(task)] < 1e-3) == turns


def test_handle_positions_leave_the_episode_unchanged(env):
    env.reset(seed=0)
    before = env.get_state().physics
    env.handle_positions(np.zeros((2, 30)))
    assert np.array_equal(env.get_state().physics, before)


@pytest.mark.parametrize("function", ["handle_positions", "render_states"])
def test_other_shapes_are_refused(env, function):
    with pytest.raises(ValueError, match=r"shape \(1, 29\), expected \[S, 30\]"):
        getattr(env, function)(np.zeros(29))


def test_each_simulation_has_its_own_model():
    first, second = KitchenRobot(), KitchenRobot()
    first.model.opt.timestep = 0.1
    assert second.model.opt.timestep == 0.002
    assert KitchenRobot().model.opt.timestep == 0.002


def test_physics_are_restored_exactly():
    robot = KitchenRobot()
    robot.restart(default_state(), seed=0)
    for _ in range(3):
        robot.step(np.full(9, 0.5))
    physics = robot.read_physics()
    other = KitchenRobot()
    other.write_physics(physics)
    assert np.array_equal(other.read_physics(), physics)
    assert np.array_equal(other.data.qpos, robot.data.qpos)
    with pytest.raises(ValueError, match="use a snapshot of this environment"):
        other.write_physics(physics[:-1])


def test_a_diverged_simulation_is_noticed_until_the_next_start():
    robot = KitchenRobot()
    robot.restart(default_state(), seed=0)
    assert not robot.diverged
    robot.data.qvel[:] = 1e30
    robot.step(np.zeros(9))
    assert robot.diverged
    robot.restart(default_state())
    assert not robot.diverged
