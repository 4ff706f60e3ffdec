"""The expert in the real simulator."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from torchrl_caiac.envs.kitchen import KitchenEnv, KitchenExpert, set_kitchen_start
from torchrl_caiac.envs.kitchen.rotations import rotation_vector
from torchrl_caiac.envs.kitchen.waypoints import TASKS, Waypoint, tool_rotation


def play(franka_kitchen, expert, seed, cabinet=0.0, steps=80):
    franka_kitchen.reset(seed=seed)
    set_kitchen_start(franka_kitchen, {"slide_cabinet": cabinet})
    expert.rng = np.random.default_rng(seed)
    expert.reset()
    begin = expert.data.qpos.copy()
    actions = []
    for _ in range(steps):
        actions.append(expert())
        franka_kitchen.step(actions[-1])
        if expert.goal_distance < 0.25:
            break
    return np.stack(actions), begin, expert.data.qpos.copy()


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("cabinet", [0.0, 0.37])
def test_solves_its_task_and_touches_nothing_else(franka_kitchen, task, cabinet):
    if task == "slide cabinet":
        cabinet /= 10  # it starts ajar: more would be solved
    expert = KitchenExpert(franka_kitchen, task)
    for seed in (1, 2):
        actions, begin, end = play(franka_kitchen, expert, seed, cabinet)
        assert expert.success
        assert np.abs(actions).max() <= 1
        others = np.setdiff1d(np.arange(9, 30), expert.task.columns)
        assert np.abs(end - begin)[others].max() < 0.02
        if task != "slide cabinet":
            assert end[19] == pytest.approx(cabinet, abs=0.01)


@pytest.mark.parametrize("speed", [0.35, 1.4])
@pytest.mark.parametrize("task", TASKS)
def test_succeeds_at_other_speeds(franka_kitchen, task, speed):
    expert = KitchenExpert(franka_kitchen, task, speed=speed, speed_range=0.1)
    play(franka_kitchen, expert, 5, steps=150)
    assert expert.success


def test_a_grasp_turns_with_its_knob(franka_kitchen):
    franka_kitchen.reset(seed=0)
    set_kitchen_start(franka_kitchen, {"knob_Joint_2": -0.4})
    expert = KitchenExpert(
        franka_kitchen, "bottom burner", waypoint_noise=0, action_noise=0, rng=0
    )
    expert.reset()
    axis = expert.data.joint("knob_Joint_2").xaxis.copy()
    grasp = expert.task.waypoints[1]
    straight = tool_rotation(grasp.yaw, grasp.pitch)
    turned = None
    for _ in range(60):
        action = expert()
        if expert.stage == 2 and turned is None:
            turned = expert.ik.pose(expert.data.qpos)[1]
        franka_kitchen.step(action)
        if expert.success:
            break
    assert expert.success
    turn = rotation_vector(turned @ straight.T)
    np.testing.assert_allclose(turn, -0.4 * axis, atol=0.1)


def test_equal_seeds_give_equal_actions_and_slower_is_longer(franka_kitchen):
    expert = KitchenExpert(franka_kitchen, "kettle", speed=1.0)
    first, _, _ = play(franka_kitchen, expert, 3)
    again, _, _ = play(franka_kitchen, expert, 3)
    np.testing.assert_array_equal(first, again)
    other, _, _ = play(franka_kitchen, expert, 4)
    assert not np.array_equal(first[0], other[0])
    expert.speed = 0.4
    slow, _, _ = play(franka_kitchen, expert, 3)
    assert len(slow) > 1.3 * len(first)


def test_works_in_kitchen_env_and_only_reads_the_simulator():
    env = KitchenEnv("kettle", terminate_on_success=False)
    try:
        env.reset(seed=0, options={"open": "slide_cabinet"})
        expert = KitchenExpert(env, "kettle", rng=0)
        expert.reset()
        for _ in range(40):
            before = (env.qpos, env.qvel, env.data.time)
            action = expert()
            np.testing.assert_array_equal(before[0], env.qpos)
            np.testing.assert_array_equal(before[1], env.qvel)
            assert before[2] == env.data.time
            *_, info = env.step(action)
        assert expert.success
        assert expert.finished
        assert info["task_success"]
    finally:
        env.close()


def test_another_task_is_another_table(franka_kitchen):
    table = dataclasses.replace(
        TASKS["kettle"],
        name="wave",
        posture=None,
        waypoints=(
            Waypoint("reach", (-0.35, 0.35, 2.0), gripper=0.04, tolerance=0.03),
            Waypoint("line", (-0.25, 0.4, 2.0), speed=0.5, tolerance=0.01, noisy=False),
            Waypoint("hold", (-0.25, 0.4, 2.0), steps=12, noisy=False),
        ),
    )
    franka_kitchen.reset(seed=0)
    set_kitchen_start(franka_kitchen)
    expert = KitchenExpert(
        franka_kitchen, table, action_noise=0, waypoint_noise=0, rng=0
    )
    expert.reset()
    stages = []
    for _ in range(60):
        action = expert()
        stages.append(expert.stage)
        if expert.finished:
            break
        franka_kitchen.step(action)
    assert stages == sorted(stages)
    assert set(stages) == {0, 1, 2, 3}
    point, rotation = expert.ik.pose(expert.data.qpos)
    np.testing.assert_allclose(point, (-0.25, 0.4, 2.0), atol=0.01)
    np.testing.assert_allclose(rotation, tool_rotation(), atol=0.1)
    assert expert.data.qpos[7:9].max() < 0.01


def test_bad_input(franka_kitchen):
    env = franka_kitchen
    with pytest.raises(KeyError, match="no expert for task 'toaster'"):
        KitchenExpert(env, "toaster")
    with pytest.raises(ValueError, match="speed is 0"):
        KitchenExpert(env, "kettle", speed=0)
    with pytest.raises(ValueError, match="speed_range is 1"):
        KitchenExpert(env, "kettle", speed_range=1)
    with pytest.raises(ValueError, match="at least 0"):
        KitchenExpert(env, "kettle", action_noise=-1)
    with pytest.raises(ValueError, match="clearance is -1"):
        KitchenExpert(env, "kettle", clearance=-1)
    with pytest.raises(TypeError, match="has no simulator"):
        KitchenExpert(object(), "kettle")
    with pytest.raises(RuntimeError, match="reset"):
        KitchenExpert(env, "kettle")()
