"""The expert in the real simulator."""

from __future__ import annotations

import dataclasses

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest

from torchrl_caiac.envs import kitchen_expert
from torchrl_caiac.envs.kitchen import KitchenEnv
from torchrl_caiac.envs.kitchen_expert import (
    TASKS,
    KitchenExpert,
    Waypoint,
    set_kitchen_start,
    tool_rotation,
)


@pytest.fixture(scope="module")
def env():
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(
        "FrankaKitchen-v1",
        tasks_to_complete=["microwave", "kettle"],
        terminate_on_tasks_completed=False,
        disable_env_checker=True,
    )
    yield env
    env.close()


def play(env, expert, seed, cabinet=0.0, steps=80):
    env.reset(seed=seed)
    set_kitchen_start(env, {"slide_cabinet": cabinet})
    expert.rng = np.random.default_rng(seed)
    expert.reset()
    begin = expert.data.qpos.copy()
    actions = []
    for _ in range(steps):
        actions.append(expert())
        env.step(actions[-1])
        if expert.goal_distance < 0.25:
            break
    return np.stack(actions), begin, expert.data.qpos.copy()


@pytest.mark.parametrize("task", ["microwave", "kettle"])
@pytest.mark.parametrize("cabinet", [0.0, 0.37])
def test_solves_its_task_and_touches_nothing_else(env, task, cabinet):
    expert = KitchenExpert(env, task)
    for seed in (1, 2):
        actions, begin, end = play(env, expert, seed, cabinet)
        assert expert.success
        assert np.abs(actions).max() <= 1
        others = np.setdiff1d(np.arange(9, 30), expert.task.columns)
        assert np.abs(end - begin)[others].max() < 0.02
        assert end[19] == pytest.approx(cabinet, abs=0.01)


def test_equal_seeds_give_equal_actions_and_slower_is_longer(env):
    expert = KitchenExpert(env, "kettle", speed=1.0)
    first, _, _ = play(env, expert, 3)
    again, _, _ = play(env, expert, 3)
    np.testing.assert_array_equal(first, again)
    other, _, _ = play(env, expert, 4)
    assert not np.array_equal(first[0], other[0])
    expert.speed = 0.4
    slow, _, _ = play(env, expert, 3)
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


def test_another_task_is_another_table(env):
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
    env.reset(seed=0)
    set_kitchen_start(env)
    expert = KitchenExpert(env, table, action_noise=0, waypoint_noise=0, rng=0)
    expert.reset()
    stages = []
    for _ in range(60):
        action = expert()
        stages.append(expert.stage)
        if expert.finished:
            break
        env.step(action)
    assert stages == sorted(stages)
    assert set(stages) == {0, 1, 2, 3}
    point, rotation = expert.ik.pose(expert.data.qpos)
    np.testing.assert_allclose(point, (-0.25, 0.4, 2.0), atol=0.01)
    np.testing.assert_allclose(rotation, tool_rotation(), atol=0.1)
    assert expert.data.qpos[7:9].max() < 0.01


def test_tool_rotation_points_where_the_angles_say():
    right = tool_rotation(yaw=0.4)[:, 2]
    assert right[0] == pytest.approx(np.sin(0.4))
    down = tool_rotation(pitch=-0.4)[:, 2]
    assert down[2] == pytest.approx(-np.sin(0.4))
    rolled = tool_rotation(0.2, -0.3, 0.5)
    np.testing.assert_allclose(rolled @ rolled.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rolled[:, 2], tool_rotation(0.2, -0.3)[:, 2])


def test_set_kitchen_start(env):
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.full(9, 0.5))
    observation = set_kitchen_start(
        env, {"knob_Joint_2": -0.87, "light_switch": -0.69, "slide_cabinet": 0.3}
    )
    data = env.unwrapped.robot_env.data
    assert data.qpos[11] == -0.87
    assert data.qpos[12] == pytest.approx(-0.005)
    assert data.qpos[18] == pytest.approx(-0.05)
    assert (data.qvel == 0).all()
    np.testing.assert_allclose(
        env.unwrapped.robot_env._last_robot_qpos, data.qpos[:9], atol=2e-3
    )
    np.testing.assert_allclose(
        observation["observation"][18:39], data.qpos[9:], atol=1e-3
    )
    qpos, qvel = data.qpos.copy(), np.linspace(0, 0.1, 29)
    set_kitchen_start(env, qpos=qpos, qvel=qvel)
    np.testing.assert_array_equal(data.qpos, qpos)
    np.testing.assert_array_equal(data.qvel, qvel)


def test_bad_input(env):
    env.reset(seed=0)
    with pytest.raises(KeyError, match="no expert for task 'toaster'"):
        KitchenExpert(env, "toaster")
    with pytest.raises(ValueError, match="speed is 0"):
        KitchenExpert(env, "kettle", speed=0)
    with pytest.raises(ValueError, match="speed_range is 1"):
        KitchenExpert(env, "kettle", speed_range=1)
    with pytest.raises(ValueError, match="at least 0"):
        KitchenExpert(env, "kettle", action_noise=-1)
    with pytest.raises(TypeError, match="has no simulator"):
        KitchenExpert(object(), "kettle")
    with pytest.raises(RuntimeError, match="reset"):
        KitchenExpert(env, "kettle")()
    with pytest.raises(ValueError, match="needs joint, anchor and until"):
        Waypoint("follow")
    with pytest.raises(ValueError, match="no joint 'toaster'"):
        set_kitchen_start(env, {"toaster": 1.0})
    with pytest.raises(ValueError, match=r"qpos has shape \(3,\)"):
        set_kitchen_start(env, qpos=np.zeros(3))
    with pytest.raises(ValueError, match=r"not finite at positions \[19\]"):
        set_kitchen_start(env, {"slide_cabinet": np.nan})
    with pytest.raises(TypeError, match="KitchenEnv"):
        set_kitchen_start(gymnasium.Env())


def test_main_measures(caplog):
    with caplog.at_level("INFO"):
        code = kitchen_expert.main(["--task", "kettle", "--episodes", "1"])
    assert code == 0
    assert "kettle: 1 of 1 episodes" in caplog.text
