from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import (
    OBS_ELEMENT_GOALS,
    OBS_ELEMENT_INDICES,
)
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import (
    KitchenEnv as UpstreamKitchen,
)

from torchrl_caiac.envs.kitchen import KITCHEN_TASKS, KitchenEnv


def actions(steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 9)).astype(np.float32)


def solve(env: KitchenEnv, task: str) -> None:
    """Puts the simulator where the task is done, within the episode."""
    state = env.qpos
    state[list(env.layout.columns[task])] = env.solved(task)
    env.set_simulator(state)


class TestSpaces:
    def test_observation_and_goal(self, env):
        observation, info = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        for key, width in (
            ("observation", 30),
            ("achieved_goal", 21),
            ("desired_goal", 21),
        ):
            assert observation[key].shape == (width,)
            assert observation[key].dtype == np.float32
        assert set(info) == {"success", "task_success", "wrong_tasks", "task"}
        assert np.array_equal(
            observation["achieved_goal"], observation["observation"][9:]
        )

    def test_observations_are_copies(self, env):
        observation, _ = env.reset(seed=0)
        kept = {key: value.copy() for key, value in observation.items()}
        before = env.qpos
        for key in kept:
            env.step(np.ones(9))
            assert np.array_equal(observation[key], kept[key])
            assert not np.shares_memory(observation[key], env.data.qpos)
        observation["achieved_goal"][:] = 7.0
        env.qpos[:] = 7.0
        env.full_observation[:] = 7.0
        env.goal[:] = 7.0
        env.default_state()[:] = 7.0
        env.solved("microwave")[:] = 7.0
        assert not np.array_equal(env.qpos, before)
        for value in (env.qpos, env.full_observation, env.goal, env.default_state()):
            assert (value < 6).all()
        assert env.solved("microwave")[0] == -0.75


class TestDynamics:
    def test_equal_upstream_step_by_step(self, env):
        upstream = UpstreamKitchen(
            terminate_on_tasks_completed=False, remove_task_when_completed=False
        )
        theirs, _ = upstream.reset(seed=3)
        ours, _ = env.reset(seed=3)
        columns = np.r_[0:9, 18:39]
        for action in actions(40):
            assert np.array_equal(env.full_observation, theirs["observation"])
            assert np.array_equal(
                ours["observation"], theirs["observation"][columns].astype(np.float32)
            )
            theirs = upstream.step(action)[0]
            ours = env.step(action)[0]
        assert np.array_equal(env.qpos, upstream.data.qpos)
        assert np.array_equal(env.qvel, upstream.data.qvel)

    def test_noise_ratios(self):
        silent = KitchenEnv(robot_noise_ratio=0.0, object_noise_ratio=0.0)
        observation, _ = silent.reset(seed=0)
        assert np.array_equal(observation["observation"], silent.qpos.astype("f4"))
        loud = KitchenEnv(robot_noise_ratio=1.0, object_noise_ratio=0.0)
        observation, _ = loud.reset(seed=0)
        error = np.abs(observation["observation"] - loud.qpos.astype("f4"))
        assert error[:9].max() > 0.01
        assert error[9:].max() == 0

    def test_reset_leaves_no_velocity(self, env):
        env.reset(seed=0)
        for action in actions(10):
            env.step(10 * action)
        assert np.abs(env.qvel).max() > 0.1
        for start in ("default", "random"):
            env.reset(options={"start": start})
            assert not env.qvel.any()
            assert not env.data.qacc_warmstart[9:].any() or env.data.time == 0

    def test_same_seed_same_episode(self, env):
        runs = []
        for _ in range(2):
            rows = [env.reset(seed=11, options={"start": "random"})[0]]
            rows += [env.step(action)[0] for action in actions(5)]
            # the second episode continues the generator
            rows += [env.reset(options={"start": "random"})[0]]
            runs.append(np.stack([row["observation"] for row in rows]))
        assert np.array_equal(runs[0], runs[1])
        other = env.reset(seed=12, options={"start": "random"})[0]["observation"]
        assert not np.array_equal(other, runs[0][0])

    def test_snapshot_restores_exactly(self, env):
        env.reset(seed=5, options={"start": "random", "task": "kettle"})
        for action in actions(6):
            env.step(action)
        snapshot = pickle.loads(pickle.dumps(env.get_state()))

        def play(kitchen: KitchenEnv) -> list:
            rows = []
            for action in actions(8, seed=1):
                observation, reward, terminated, truncated, info = kitchen.step(action)
                rows.append((*observation.values(), reward, terminated, truncated))
                rows.append((kitchen.qpos, kitchen.qvel, *info.values()))
            options = {"start": "random", "task": "kettle"}
            rows.append(tuple(kitchen.reset(options=options)[0].values()))
            return rows

        first = play(env)
        env.reset(seed=99)
        env.set_state(snapshot)
        assert env.task == "kettle"
        second = play(env)
        another = KitchenEnv("hinge_cabinet")
        another.set_state(snapshot)
        third = play(another)
        for a, b, c in zip(first, second, third, strict=True):
            for x, y, z in zip(a, b, c, strict=True):
                assert np.array_equal(x, y) and np.array_equal(x, z)

    def test_set_simulator_agrees_with_the_recording(self, env):
        env.reset(seed=5)
        for action in actions(6):
            env.step(action)
        qpos, qvel, noise = env.qpos, env.qvel, env.get_state()
        after = env.step(np.zeros(9))[0]["observation"]
        env.reset(seed=0)
        env.set_simulator(qpos, qvel)
        assert np.array_equal(env.qpos, qpos)
        assert np.array_equal(env.qvel, qvel)
        env.robot_env._last_robot_qpos = noise.last_robot_qpos.copy()
        again = env.step(np.zeros(9))[0]["observation"]
        assert np.abs(again[9:] - after[9:]).max() < 3e-4


class TestGoalsAndSuccess:
    @pytest.mark.parametrize("task", KITCHEN_TASKS)
    def test_goal_is_start_but_for_the_task(self, env, task):
        observation, info = env.reset(seed=1, options={"task": task, "start": "random"})
        goal = env.start_state("default")
        goal[:] = env.get_state().start
        goal[OBS_ELEMENT_INDICES[task.replace("_", " ")]] = OBS_ELEMENT_GOALS[
            task.replace("_", " ")
        ]
        assert np.array_equal(observation["desired_goal"], goal[9:].astype("f4"))
        assert info["task"] == KITCHEN_TASKS.index(task)
        assert not info["success"] and not info["task_success"]

    @pytest.mark.parametrize("task", KITCHEN_TASKS)
    def test_doing_the_task_succeeds(self, env, task):
        env.reset(seed=1, options={"task": task})
        solve(env, task)
        _, reward, terminated, truncated, info = env.step(np.zeros(9))
        assert info["success"] and info["task_success"]
        assert reward == 1.0 and terminated and not truncated
        assert not info["wrong_tasks"].any()

    def test_success_needs_all_objects(self, env):
        env.reset(seed=1, options={"task": "microwave"})
        solve(env, "microwave")
        solve(env, "kettle")
        _, reward, terminated, _, info = env.step(np.zeros(9))
        assert info["task_success"] and not info["success"]
        assert reward == 0.0 and not terminated
        assert info["wrong_tasks"].tolist() == [t == "kettle" for t in KITCHEN_TASKS]

    def test_wrong_tasks_are_remembered_and_fresh_ones_only(self, env):
        env.reset(options={"task": "microwave", "open": "slide_cabinet"})
        before = env.qpos
        solve(env, "kettle")
        assert env.step(np.zeros(9))[-1]["wrong_tasks"][KITCHEN_TASKS.index("kettle")]
        env.set_simulator(before)
        info = env.step(np.zeros(9))[-1]
        # the kettle was pushed once; the cabinet was open from the start
        assert info["wrong_tasks"].tolist() == [t == "kettle" for t in KITCHEN_TASKS]
        assert not env.reset()[1]["wrong_tasks"].any()

    def test_goal_options(self, env):
        env.reset(options={"open": "slide_cabinet", "goal": "default"})
        assert env.goal[10] == env.default_state()[19]
        assert env.goal[13] == -0.75
        goal = np.arange(21.0)
        observation, _ = env.reset(options={"goal": goal})
        assert np.array_equal(observation["desired_goal"], goal.astype("f4"))

    def test_task_drawn_when_none(self):
        env = KitchenEnv(None)
        env.reset(seed=0)
        drawn = set()
        for _ in range(40):
            drawn.add(KITCHEN_TASKS[env.reset()[1]["task"]])
        assert drawn == set(KITCHEN_TASKS)

    def test_episode_ends(self):
        env = KitchenEnv(max_episode_steps=3, terminate_on_success=False)
        env.reset(seed=0)
        solve(env, "microwave")
        ends = [env.step(np.zeros(9))[1:4] for _ in range(3)]
        assert ends == [(1.0, False, False), (1.0, False, False), (1.0, False, True)]
        assert KitchenEnv().max_episode_steps == 280

    @pytest.mark.parametrize(
        "action", [np.zeros(8), np.full(9, np.nan), np.zeros((1, 9))]
    )
    def test_bad_action(self, env, action):
        env.reset(seed=0)
        with pytest.raises(ValueError, match="action"):
            env.step(action)

    def test_actions_are_clipped(self, env):
        env.reset(seed=0)
        first = env.step(np.full(9, 5.0))[0]["observation"]
        env.reset(seed=0)
        assert np.array_equal(env.step(np.ones(9))[0]["observation"], first)

    def test_no_episode_yet(self):
        env = KitchenEnv()
        with pytest.raises(RuntimeError, match="reset"):
            env.step(np.zeros(9))
        with pytest.raises(RuntimeError, match="reset"):
            env.get_state()

    def test_divergence_is_reported(self):
        env = KitchenEnv()
        env.reset(seed=0)
        env.data.qvel[:] = 1e30
        with pytest.raises(RuntimeError, match="diverged"):
            env.step(np.zeros(9))
        with pytest.raises(RuntimeError, match="reset"):
            env.step(np.zeros(9))
        env.reset(seed=0)
        env.step(np.zeros(9))

    def test_one_goal_for_many(self, env):
        achieved = torch.zeros(4, 5, 21)
        achieved[1, 2, 13] = -0.75
        goal = torch.zeros(21)
        goal[13] = -0.75
        reward = env.compute_reward(achieved, goal, None)
        assert reward.shape == (4, 5)
        assert reward.nonzero().tolist() == [[1, 2]]

    def test_agrees_with_the_episode(self, env):
        env.reset(seed=0)
        solve(env, "microwave")
        observation, reward, *_ = env.step(np.zeros(9))
        again = env.compute_reward(
            observation["achieved_goal"], observation["desired_goal"], {}
        )
        assert again == reward == 1.0


@pytest.mark.parametrize(
    "arguments",
    [
        {"task": "wash up"},
        {"start": np.zeros(3)},
        {"render_mode": "human"},
        {"max_episode_steps": 0},
        {"robot_noise_ratio": -1.0},
        {"object_noise_ratio": float("nan")},
    ],
)
def test_bad_arguments(arguments):
    with pytest.raises(ValueError, match="expected"):
        KitchenEnv(**arguments)
