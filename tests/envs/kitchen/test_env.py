from __future__ import annotations

import functools
import pickle

import gymnasium
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
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs import SerialEnv, check_env_specs

from torchrl_caiac.envs.kitchen.env import (
    KITCHEN_ENV_ID,
    KITCHEN_TASKS,
    KitchenEnv,
    kitchen_distances,
    kitchen_reward,
    make_kitchen_env,
    register_kitchen,
)

OBJECTS = KitchenEnv.layout.names[1:]


def actions(steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 9)).astype(np.float32)


@pytest.fixture(scope="module")
def env():
    env = KitchenEnv("microwave")
    yield env
    env.close()


def solve(env: KitchenEnv, task: str) -> None:
    """Put the simulator where the task is done, the episode going on."""
    state = env.qpos
    state[list(env.layout.columns[task])] = env.solved(task)
    env.set_simulator(state)


class TestHandles:
    def test_a_handle_moves_with_its_object(self, env):
        names = env.layout.names
        assert set(env.handles) == set(names)
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

    def test_the_episode_goes_on(self, env):
        env.reset(seed=0)
        before = env.get_state().physics
        env.handle_positions(np.zeros((2, 30)))
        assert np.array_equal(env.get_state().physics, before)

    @pytest.mark.parametrize("function", ["handle_positions", "render_states"])
    def test_other_shapes_are_refused(self, env, function):
        with pytest.raises(ValueError, match=r"shape \(1, 29\), wanted \[S, 30\]"):
            getattr(env, function)(np.zeros(29))


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

    def test_layout_fits_the_observation(self, env):
        layout = env.layout
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
            # a second episode goes on from the seed
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

    def test_model_is_its_own(self):
        first, second = KitchenEnv(), KitchenEnv()
        first.model.opt.timestep = 0.1
        assert second.model.opt.timestep == 0.002
        assert KitchenEnv().model.opt.timestep == 0.002

    def test_outcomes_touch_nothing(self, env):
        env.reset(seed=0)
        for action in actions(5):
            env.step(action)
        snapshot = env.get_state()
        state = np.concatenate((env.qpos, env.qvel))
        several = env.outcomes(state, actions(3))
        assert several.shape == (3, 30)
        assert np.array_equal(env.outcomes(state, actions(3)), several)
        assert np.array_equal(env.outcomes(state, actions(3)[1:2])[0], several[1])
        assert not np.array_equal(env.outcomes(state, actions(3), horizon=2), several)
        close = env.outcomes(snapshot, actions(3))
        assert np.abs(close - several).max() < 1e-3
        assert np.array_equal(env.get_state().physics, snapshot.physics)
        # noise aside, a step leads where the outcomes say
        env.robot_env._last_robot_qpos = env.qpos[:9]
        env.step(actions(3)[1])
        assert np.array_equal(env.qpos, close[1])


class TestStarts:
    def test_default_is_upstreams(self, env):
        env.reset(seed=0)
        upstream = UpstreamKitchen()
        upstream.reset(seed=0)
        assert np.array_equal(env.qpos, upstream.data.qpos)

    def test_given_and_mapping_and_open(self, env):
        state = env.default_state()
        state[22] = -0.3
        env.reset(options={"start": state})
        assert np.array_equal(env.qpos, state)
        env.reset(options={"start": torch.from_numpy(state)})
        assert np.array_equal(env.qpos, state)
        env.reset(options={"start": {"microwave": -0.3}})
        assert np.array_equal(env.qpos, state)
        env.reset(options={"open": "slide_cabinet"})
        assert env.qpos[19] == 0.37
        env.reset(options={"start": {"slide_cabinet": [0.1]}, "open": ["microwave"]})
        assert env.qpos[19] == 0.1 and env.qpos[22] == -0.75
        env.reset()
        assert env.qpos[19] == env.default_state()[19]

    def test_constructor_options_last(self):
        env = KitchenEnv("kettle", open=("slide_cabinet",), start={"microwave": -0.2})
        for _ in range(2):
            env.reset()
            assert env.qpos[19] == 0.37 and env.qpos[22] == -0.2
            assert env.task == "kettle"

    @pytest.mark.parametrize("task", KITCHEN_TASKS)
    def test_random_starts(self, env, task):
        rng = np.random.default_rng(0)
        default = env.default_state()
        starts = np.stack([env.random_start(task, rng=rng) for _ in range(60)])
        moved = {
            name: (starts != default)[:, list(env.layout.columns[name])].any(-1)
            for name in env.layout.names
        }
        assert not moved["robot"].any()
        assert not moved[task].any()
        for name in OBJECTS:
            if name != task:
                assert 0.25 < moved[name].mean() < 0.75
        for name in OBJECTS:
            own = starts[moved[name]][:, list(env.layout.columns[name])]
            if name.endswith("burner"):
                assert np.allclose(own[:, 0] / 174, own[:, 1])
            elif name == "light_switch":
                assert np.allclose(own[:, 0] / 14, own[:, 1])
        # the kettle stands upright on the hob
        kettle = starts[:, 23:30]
        assert np.array_equal(kettle[:, 2:], np.tile(default[25:], (60, 1)))
        # all within the joints' ranges
        for joint in range(9, 23):
            low, high = env.model.jnt_range[joint]
            assert (starts[:, joint] > low - 1e-2).all()
            assert (starts[:, joint] < high + 1e-2).all()

    def test_random_start_probability(self, env):
        rng = np.random.default_rng(0)
        never = env.random_start("kettle", p=0.0, rng=rng)
        assert np.array_equal(never, env.default_state())
        always = env.random_start("kettle", p=1.0, rng=rng)
        changed = always != env.default_state()
        assert changed[9:20].all() and changed[21:23].all()
        assert not changed[20] and not changed[23:].any()

    def test_random_starts_stay_where_they_are(self, env):
        for seed, task in enumerate(KITCHEN_TASKS * 2):
            env.reset(seed=seed, options={"start": "random", "task": task})
            start = env.qpos
            for _ in range(4):
                info = env.step(np.zeros(9))[-1]
            # the default start itself settles by 7e-3
            assert np.abs(env.qpos - start)[9:].max() < 1e-2
            assert not info["wrong_tasks"].any()
            assert not info["success"]

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"start": "weird"}, "'default', 'random'"),
            ({"start": np.zeros(29)}, r"shape \(29,\)"),
            ({"start": np.full(30, np.nan)}, "non-finite"),
            ({"start": {"toaster": 1.0}}, "'toaster'"),
            ({"start": {"kettle": [1.0]}}, r"'kettle'.*\(7,\)"),
            ({"open": "robot"}, "'robot'"),
            ({"task": "wash up"}, "'wash up'"),
            ({"goal": "done"}, "'start', 'default'"),
            ({"goal": np.zeros(20)}, r"shape \(20,\)"),
            ({"tasks": "kettle"}, "'tasks'"),
        ],
    )
    def test_bad_options(self, env, options, message):
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)

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
    def test_bad_arguments(self, arguments):
        with pytest.raises(ValueError, match="wanted"):
            KitchenEnv(**arguments)

    def test_random_start_arguments(self, env):
        with pytest.raises(ValueError, match="probability"):
            env.random_start("kettle", p=1.5)
        with pytest.raises(ValueError, match="needs the task"):
            env.start_state("random")


class TestGoalsAndSuccess:
    @pytest.mark.parametrize("task", KITCHEN_TASKS)
    def test_goal_is_start_but_for_the_task(self, env, task):
        observation, info = env.reset(seed=1, options={"task": task, "start": "random"})
        goal = env.start_state("default")
        goal[:] = env._start
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
        wanted = np.arange(21.0)
        observation, _ = env.reset(options={"goal": wanted})
        assert np.array_equal(observation["desired_goal"], wanted.astype("f4"))

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


def slow_success(achieved: np.ndarray, desired: np.ndarray) -> float:
    """The criterion in plain Python."""
    for name in OBJECTS:
        columns = KitchenEnv.layout.goal[name]
        total = sum((float(achieved[c]) - float(desired[c])) ** 2 for c in columns)
        if not total**0.5 < 0.3:
            return 0.0
    return 1.0


class TestReward:
    @settings(max_examples=40, deadline=None)
    @given(
        seed=st.integers(0, 2**31),
        batch=st.lists(st.integers(0, 3), max_size=3),
        double=st.booleans(),
    )
    def test_any_batch_equals_plain_python(self, seed, batch, double):
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

    def test_gradient_free_dtype_and_shape_errors(self):
        with pytest.raises(ValueError, match=r"achieved goal has shape \(2, 20\)"):
            kitchen_reward(torch.zeros(2, 20), torch.zeros(21))
        with pytest.raises(ValueError, match="desired goal"):
            kitchen_distances(np.zeros(21), np.zeros(30))

    def test_threshold(self):
        achieved, desired = np.zeros(21), np.zeros(21)
        achieved[13] = 0.25
        assert kitchen_reward(achieved, desired) == 1
        assert kitchen_reward(achieved, desired, threshold=0.2) == 0


class TestLibraries:
    def test_gymnasium_make(self):
        register_kitchen()
        env = gymnasium.make(KITCHEN_ENV_ID, task="kettle")
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        assert env.unwrapped.task == "kettle"
        env.step(env.action_space.sample())
        env.close()

    def test_torchrl(self):
        env = make_kitchen_env("kettle", max_episode_steps=4, open=("slide_cabinet",))
        check_env_specs(env)
        env.set_seed(0)
        rollout = env.rollout(10)
        assert rollout.shape == (4,)
        for key in ("observation", "achieved_goal", "desired_goal"):
            assert rollout[key].dtype == torch.float32
        assert rollout["observation"].shape == (4, 30)
        assert torch.equal(
            KitchenEnv.layout.achieved_goal(rollout), rollout["achieved_goal"]
        )
        for key in ("success", "task_success"):
            assert rollout["next", key].shape == (4, 1)
            assert rollout["next", key].dtype == torch.bool
        assert rollout["next", "wrong_tasks"].shape == (4, 7)
        assert (rollout["next", "task"] == KITCHEN_TASKS.index("kettle")).all()
        assert rollout["is_init"].flatten().tolist() == [True, False, False, False]
        assert rollout["next", "truncated"].flatten().tolist() == [False] * 3 + [True]
        assert not rollout["next", "terminated"].any()
        assert abs(rollout["observation"][0, 19] - 0.37) < 1e-3
        env.close()

    def test_torchrl_batched(self):
        env = SerialEnv(2, functools.partial(make_kitchen_env, "kettle"))
        rollout = env.rollout(3)
        assert rollout["next", "wrong_tasks"].shape == (2, 3, 7)
        assert rollout["is_init"][..., 0].tolist() == [[True, False, False]] * 2
        env.close()

    def test_torchrl_reports_success(self):
        env = make_kitchen_env("microwave")
        # already done at the start: pays on the first step
        td = env.reset(options={"open": "microwave"})
        assert td["task_success"].item()
        td = env.rand_step(td)
        assert td["next", "success"].item() and td["next", "reward"].item() == 1
        assert td["next", "terminated"].item()
        env.close()
