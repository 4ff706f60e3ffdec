from __future__ import annotations

import pickle

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchrl_caiac.envs.fetch_push import (
    FetchPushCubes,
    fetch_push_distances,
    fetch_push_layout,
)
from torchrl_caiac.envs.rendering import RenderingUnavailable

CENTRE = np.array([1.342, 0.749])
SIDE = 0.05


def actions(steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 4)).astype(np.float32)


class TestSpaces:
    @pytest.mark.parametrize("num_cubes", [1, 2, 3])
    def test_observation_and_goal(self, num_cubes):
        env = FetchPushCubes(num_cubes)
        observation, info = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        for key, width in (
            ("observation", 10 + 12 * num_cubes),
            ("achieved_goal", 3 * num_cubes),
            ("desired_goal", 3 * num_cubes),
        ):
            assert observation[key].shape == (width,)
            assert observation[key].dtype == np.float32
        assert set(info) == {"success", "cube_success", "is_success"}
        assert info["cube_success"].shape == (num_cubes,)
        assert np.array_equal(observation["desired_goal"], env.goal.astype("f4"))

    @pytest.mark.parametrize("num_cubes", [1, 2, 5])
    def test_layout_fits_the_observation(self, num_cubes):
        layout = fetch_push_layout(num_cubes)
        cubes = tuple(f"cube{i}" for i in range(num_cubes))
        assert layout.names == ("gripper", *cubes)
        assert layout.fixed == ("gripper",)
        assert layout.goal_width == 3 * num_cubes
        owned = [c for columns in layout.columns.values() for c in columns]
        assert owned == list(range(10 + 12 * num_cubes))
        env = FetchPushCubes(num_cubes, cube_range=0.2, goal_range=0.2)
        assert env.layout == layout
        observation, _ = env.reset(seed=1)
        for name in cubes:
            assert np.array_equal(
                observation["observation"][list(layout.achieved[name])],
                observation["achieved_goal"][list(layout.goal[name])],
            )

    def test_observations_are_copies(self, env):
        observation, info = env.reset(seed=0)
        kept = {key: value.copy() for key, value in observation.items()}
        before = env.simulator_state()
        for _ in range(3):
            env.step(np.ones(4))
        for key, value in kept.items():
            assert np.array_equal(observation[key], value)
            assert not np.shares_memory(observation[key], env.data.qpos)
        assert not np.array_equal(env.simulator_state(), before)
        here = env.simulator_state()
        for value in (*observation.values(), info["cube_success"], env.goal):
            value[:] = 7
        env.simulator_state()[:] = 7.0
        assert np.array_equal(env.simulator_state(), here)
        assert np.array_equal(env.goal.astype("f4"), kept["desired_goal"])


class TestObservation:
    def test_equals_mujoco(self, env, behind):
        behind(env)
        model = env.model
        moving = 0
        for step in range(8):
            observation = env.step([1.0, 0.15, 0.0, 0.0])[0]["observation"]
            fresh = mujoco.MjData(model)
            fresh.qpos[:] = env.data.qpos
            fresh.qvel[:] = env.data.qvel
            mujoco.mj_forward(model, fresh)
            site = fresh.site("robot0:grip")
            assert observation[:3] == pytest.approx(site.xpos, abs=1e-6)
            velocity = np.empty(6)
            mujoco.mj_objectVelocity(
                model, fresh, mujoco.mjtObj.mjOBJ_SITE.value, site.id, velocity, 0
            )
            assert observation[5:8] == pytest.approx(velocity[3:] * 0.04, abs=1e-6)
            for k, side in enumerate("rl"):
                joint = fresh.joint(f"robot0:{side}_gripper_finger_joint")
                assert observation[3 + k] == joint.qpos[0] == 0.0
                assert observation[8 + k] == pytest.approx(joint.qvel[0] * 0.04)
            for i in range(2):
                cube = observation[10 + 12 * i : 22 + 12 * i]
                body = fresh.body(f"object{i}")
                assert cube[:3] == pytest.approx(body.xpos, abs=1e-6)
                turned = Rotation.from_euler("XYZ", cube[3:6]).as_matrix()
                assert turned.flatten() == pytest.approx(body.xmat, abs=1e-5)
                mujoco.mj_objectVelocity(
                    model, fresh, mujoco.mjtObj.mjOBJ_BODY.value, body.id, velocity, 0
                )
                assert cube[6:9] == pytest.approx(velocity[3:] * 0.04, abs=1e-6)
                assert cube[9:] == pytest.approx(velocity[:3] * 0.04, abs=1e-5)
            moving += np.abs(observation[16:22]).min() > 1e-6 and step > 0
        assert moving >= 3  # it was pushed and turned while we looked

    def test_cubes_are_alike(self):
        model = FetchPushCubes(3).model
        geoms = [model.geom(f"object{i}").id for i in range(3)]
        bodies = [model.body(f"object{i}").id for i in range(3)]
        for of_geom in ("size", "friction", "solref", "solimp", "condim", "margin"):
            values = getattr(model, f"geom_{of_geom}")[geoms]
            assert (values == values[0]).all(), of_geom
        for of_body in ("mass", "inertia"):
            values = getattr(model, f"body_{of_body}")[bodies]
            assert (values == values[0]).all(), of_body
        assert (model.dof_damping[-18:] == 0.01).all()
        assert (model.dof_armature[-18:] == model.dof_armature[-1]).all()

    def test_moves_like_upstream(self):
        gymnasium.register_envs(gymnasium_robotics)
        upstream = gymnasium.make("FetchPush-v4", disable_env_checker=True).unwrapped
        upstream.reset(seed=0)
        ours = FetchPushCubes(1, gripper_noise=0.0)
        cube = [1.3, CENTRE[1]]
        ours.reset(seed=0, options={"cubes": [cube]})
        upstream.data.qpos[:] = ours.data.qpos
        upstream.data.qvel[:] = 0.0
        mujoco.mj_forward(upstream.model, upstream.data)
        down = [[-1, 0, 0, 0]] * 4 + [[0, 0, -1, 0]] * 3
        for action in [*down, *[[0.8, 0, 0, 0]] * 6]:
            action = np.array(action, dtype=np.float32)
            upstream.step(action)
            ours.step(action)
            # The base's contact with the floor, which only upstream has, moves the arm
            # by a few mrad.
            place, expected = (
                env.data.site("robot0:grip").xpos for env in (ours, upstream)
            )
            assert place == pytest.approx(expected, abs=1.5e-3)
        moved = ours.data.qpos[15:17] - cube
        assert moved[0] > 0.05
        assert upstream.data.qpos[15:17] - cube == pytest.approx(moved, abs=2e-3)


class TestReset:
    @settings(max_examples=40)
    @given(seed=st.integers(0, 2**31), num_cubes=st.integers(1, 3))
    def test_starts(self, seed, num_cubes):
        env = FetchPushCubes(num_cubes)
        observation, info = env.reset(seed=seed)
        state = observation["observation"].astype(np.float64)
        cubes = state[10:].reshape(-1, 12)
        goals = observation["desired_goal"].reshape(-1, 3).astype(np.float64)
        gripper = state[:3]
        assert np.abs(gripper[:2] - CENTRE).max() < 0.06
        assert gripper[2] > 0.48
        for i in range(num_cubes):
            assert np.linalg.norm(cubes[i, :2] - gripper[:2]) > 0.09
            assert np.linalg.norm(cubes[i, :3] - goals[i]) > 0.05
            for j in range(i):
                apart = np.abs(cubes[i, :2] - cubes[j, :2]).max()
                assert apart > SIDE
                assert np.linalg.norm(goals[i] - goals[j]) > SIDE
        for place in (cubes[:, :2], goals[:, :2]):
            assert np.abs(place - CENTRE).max() <= 0.15 + 1e-6
        assert np.abs(cubes[:, 2] - 0.425).max() < 5e-4
        assert not state[5:10].any() and not cubes[:, 3:].any()
        assert not info["success"] and not info["cube_success"].any()
        # nothing touches but the cubes and the table, which hold still
        before = observation["achieved_goal"]
        after = env.step(np.zeros(4))[0]["achieved_goal"]
        assert after == pytest.approx(before, abs=1e-4)

    def test_starts_fill_the_regions(self, env):
        drawn = [env.reset(seed=seed)[0] for seed in range(60)]
        for key in ("achieved_goal", "desired_goal"):
            places = np.stack([o[key].reshape(2, 3)[:, :2] for o in drawn]) - CENTRE
            assert places.min() < -0.13 and places.max() > 0.13
        grippers = np.stack([o["observation"][:3] for o in drawn])
        assert (np.ptp(grippers, axis=0) > [0.08, 0.08, 0.02]).all()

    def test_seeds(self):
        first, second = FetchPushCubes(2), FetchPushCubes(2)
        second.reset(seed=9)
        for env in (first, second):
            env.reset(seed=4)
        for action in actions(30):
            for a, b in zip(first.step(action), second.step(action), strict=True):
                assert _equal(a, b)
        assert np.array_equal(first.simulator_state(), second.simulator_state())
        assert _equal(first.reset()[0], second.reset()[0])
        other, _ = second.reset(seed=5)
        assert not np.array_equal(
            other["achieved_goal"], first.reset(seed=4)[0]["achieved_goal"]
        )

    def test_regions_and_noise(self):
        env = FetchPushCubes(1, cube_range=0.2, goal_range=0.02, gripper_noise=0.0)
        starts = [env.reset(seed=seed)[0] for seed in range(30)]
        cubes = np.stack([o["achieved_goal"][:2] for o in starts]) - CENTRE
        goals = np.stack([o["desired_goal"][:2] for o in starts]) - CENTRE
        grippers = np.stack([o["observation"][:3] for o in starts])
        assert np.abs(cubes).max() > 0.16
        assert np.abs(goals).max() <= 0.02 + 1e-6
        assert np.ptp(grippers, axis=0).max() < 1e-6

    @pytest.mark.parametrize("width", [2, 3])
    def test_given_positions(self, env, width):
        cubes = np.array([[1.3, 0.7, 0.425], [1.4, 0.8, 0.425]])
        goals = np.array([[1.2, 0.9, 0.425], [1.25, 0.8, 0.44]])
        options = {"cubes": cubes[:, :width], "goals": goals[:, :width]}
        observation, _ = env.reset(seed=0, options=options)
        achieved = observation["achieved_goal"].reshape(2, 3)
        desired = observation["desired_goal"].reshape(2, 3)
        assert achieved[:, :2] == pytest.approx(cubes[:, :2])
        assert desired[:, :width] == pytest.approx(goals[:, :width])
        for key, given_places, drawn in (
            ("cubes", cubes, desired),
            ("goals", goals, achieved),
        ):
            o, info = env.reset(seed=1, options={key: given_places[:, :2]})
            kept = "achieved_goal" if key == "cubes" else "desired_goal"
            assert o[kept].reshape(2, 3)[:, :2] == pytest.approx(given_places[:, :2])
            other = "desired_goal" if key == "cubes" else "achieved_goal"
            assert not np.allclose(o[other].reshape(2, 3), drawn)
            assert not info["cube_success"].any()

    def test_given_goals_may_be_reached(self, env):
        cubes = [[1.3, 0.7], [1.4, 0.8]]
        options = {"cubes": cubes, "goals": [[1.3, 0.72], [1.2, 0.6]]}
        info = env.reset(seed=0, options=options)[1]
        assert info["cube_success"].tolist() == [True, False]
        assert not info["success"] and info["is_success"] == 0.0
        options["goals"] = cubes
        assert env.reset(seed=0, options=options)[1]["success"]

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"cubes": [[1.3, 0.7]]}, r"cubes.*\(1, 2\).*\(2, 2\) or \(2, 3\)"),
            ({"goals": np.full((2, 2), np.nan)}, "finite"),
            ({"cubes": [[0.9, 0.7], [1.3, 0.7]]}, r"cubes\[0\].*off the table"),
            ({"goals": [[1.3, 0.7], [1.3, 1.4]]}, r"goals\[1\].*off the table"),
            ({"cubes": [[1.6, 1.1], [1.3, 0.7]]}, r"cubes\[0\].*out of reach"),
            ({"goals": [[1.3, 0.7], [1.06, 0.75]]}, r"goals\[1\].*out of reach"),
            ({"cubes": [[1.3, 0.7, 0.6], [1.4, 0.8, 0.425]]}, r"cubes\[0\].*height"),
            ({"goals": [[1.3, 0.7, 0.6], [1.4, 0.8, 0.425]]}, r"goals\[0\].*height"),
            ({"cubes": [[1.3, 0.7], [1.34, 0.72]]}, "cubes overlap"),
            ({"goals": [[1.3, 0.7], [1.34, 0.72]]}, "goals overlap"),
            ({"start": [[1.3, 0.7]]}, "'start'"),
        ],
    )
    def test_bad_options(self, env, options, message):
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)

    @pytest.mark.parametrize(
        "arguments",
        [
            {"num_cubes": 0},
            {"render_mode": "human"},
            {"max_episode_steps": 0},
            {"distance_threshold": 0.0},
            {"distance_threshold": float("nan")},
            {"cube_range": -0.1},
            {"cube_range": float("nan")},
            {"goal_range": 0.3},
            {"gripper_noise": 0.2},
        ],
    )
    def test_bad_arguments(self, arguments):
        with pytest.raises(ValueError, match="expected"):
            FetchPushCubes(**arguments)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"cube_range": 0.05}, "2 cubes do not fit.*larger cube_range"),
            ({"goal_range": 0.0}, "2 goals do not fit.*larger goal_range"),
            ({"distance_threshold": 0.5}, "2 goals do not fit"),
            ({"num_cubes": 30}, "30 cubes do not fit"),
        ],
    )
    def test_regions_too_small(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            FetchPushCubes(**arguments)

    def test_before_reset(self):
        env = FetchPushCubes(1)
        for call in (
            lambda: env.step(np.zeros(4)),
            env.simulator_state,
            env.get_state,
        ):
            with pytest.raises(RuntimeError, match="reset"):
                call()


class TestStep:
    def test_action(self, env):
        env.reset(seed=0)
        start = env.data.site("robot0:grip").xpos.copy()
        for _ in range(4):
            env.step([5.0, -1.0, 0.0, 0.0])  # clipped
        moved = env.data.site("robot0:grip").xpos - start
        assert moved[:2] == pytest.approx([0.13, -0.13], abs=0.02)
        assert abs(moved[2]) < 0.01

    def test_the_fingers_stay_closed(self, env):
        results = []
        for opening in (-1.0, 1.0):
            env.reset(seed=0)
            for _ in range(5):
                observation = env.step([0.1, 0.1, 0.1, opening])[0]["observation"]
            results.append(observation)
        assert np.array_equal(*results)
        assert not results[0][3:5].any()

    def test_bad_actions(self, env):
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"shape \(3,\)"):
            env.step(np.zeros(3))
        with pytest.raises(ValueError, match="non-finite"):
            env.step([0.0, np.nan, 0.0, 0.0])

    def test_ends(self):
        env = FetchPushCubes(1, max_episode_steps=3)
        env.reset(seed=0)
        ends = [env.step(np.zeros(4))[2:4] for _ in range(3)]
        assert ends == [(False, False), (False, False), (False, True)]

    @pytest.mark.parametrize("terminate", [False, True])
    def test_terminates_on_success_if_requested(self, terminate):
        env = FetchPushCubes(1, terminate_on_success=terminate)
        options = {"cubes": [[1.2, 0.7]], "goals": [[1.2, 0.72]]}
        env.reset(seed=0, options=options)
        _, reward, terminated, truncated, info = env.step(np.zeros(4))
        assert reward == 0.0 and info["success"] and info["is_success"] == 1.0
        assert terminated is terminate and truncated is False

    def test_divergence_raises(self):
        env = FetchPushCubes(1)
        env.reset(seed=0)
        env.data.qvel[:] = 1e11
        with pytest.raises(RuntimeError, match="diverged"):
            env.step(np.zeros(4))
        with pytest.raises(RuntimeError, match="reset"):
            env.step(np.zeros(4))
        env.reset(seed=0)
        env.step(np.zeros(4))

    def test_environments_share_a_model_and_nothing_else(self):
        environments = [FetchPushCubes(2) for _ in range(20)]
        assert len({id(env.model) for env in environments}) == 1
        first, *others = environments
        for env in environments:
            env.reset(seed=1)
        alone = FetchPushCubes(2)
        alone.reset(seed=1)
        for step, action in enumerate(actions(10)):
            for env in others:
                env.step(-action)
            assert _equal(first.step(action)[0], alone.step(action)[0]), step


class TestReward:
    def test_the_environments_rewards_are_those_of_its_goals(self, env, behind):
        behind(env)
        seen = []
        for step in range(40):
            observation, reward, *_, info = env.step([float(step < 4), 0, 0, 0])
            goals = observation["achieved_goal"], observation["desired_goal"]
            assert env.compute_reward(*goals, info) == reward
            assert reward == float(info["success"]) - 1
            assert np.array_equal(
                info["cube_success"], fetch_push_distances(*goals) < 0.05
            )
            seen.append(info["cube_success"].copy())
        assert np.any(seen, axis=0).tolist() == [True, False]
        wide = FetchPushCubes(2, distance_threshold=0.1)
        achieved, desired = np.zeros(6), np.full(6, 0.05)
        assert wide.compute_reward(achieved, desired) == 0.0
        assert env.compute_reward(achieved, desired) == -1.0

    def test_goals_of_other_numbers_of_cubes(self, env):
        with pytest.raises(ValueError, match=r"achieved.*\[\*B, 6\]"):
            env.compute_reward(np.zeros(9), np.zeros(9))


class TestSnapshots:
    def test_the_same_actions_give_the_same(self, env, behind):
        behind(env)
        snapshot = pickle.loads(pickle.dumps(env.get_state()))
        assert snapshot.simulator.shape == (83,)
        assert snapshot.simulator.dtype == np.float64
        script = np.concatenate((np.tile([1.0, 0, 0, 0], (5, 1)), actions(15)))
        first = [env.step(action) for action in script]
        after = env.reset()[0]
        for other in (env, FetchPushCubes(2)):
            other.reset(seed=77)
            other.set_state(snapshot)
            for action, expected in zip(script, first, strict=True):
                for a, b in zip(other.step(action), expected, strict=True):
                    assert _equal(a, b)
            assert _equal(other.reset()[0], after)  # the generator is part of it
        assert first[-1][0]["achieved_goal"][0] > 1.34  # the cube was pushed

    def test_steps_are_part_of_a_snapshot(self):
        env = FetchPushCubes(1, max_episode_steps=2)
        env.reset(seed=0)
        snapshot = env.get_state()
        env.step(np.zeros(4))
        assert env.step(np.zeros(4))[3]
        env.set_state(snapshot)
        assert not env.step(np.zeros(4))[3]

    def test_recorded_simulator_states(self, env, behind):
        behind(env)
        states, observations = [], []
        for action in np.tile([1.0, 0.1, 0, 0], (8, 1)):
            observations.append(env.step(action)[0])
            states.append(env.simulator_state())
        other = FetchPushCubes(2)
        goal = np.array([1.3, 0.7, 0.425, 1.2, 0.6, 0.425])
        for state, observation in zip(states, observations, strict=True):
            found = other.set_simulator_state(state, goal=goal)
            for key in ("observation", "achieved_goal"):
                assert np.array_equal(found[key], observation[key])
            assert np.array_equal(other.simulator_state(), state)
            assert np.array_equal(found["desired_goal"], goal.astype("f4"))
        # the goal stays where none is given
        assert np.array_equal(
            other.set_simulator_state(states[0])["desired_goal"], goal.astype("f4")
        )

    def test_bad_states(self, env):
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"\(83,\).*number of cubes"):
            env.set_simulator_state(np.zeros(60))
        with pytest.raises(ValueError, match="non-finite"):
            env.set_simulator_state(np.full(83, np.nan))
        with pytest.raises(ValueError, match=r"goal has shape \(3,\)"):
            env.set_simulator_state(env.simulator_state(), goal=np.zeros(3))


class TestOutcomes:
    @pytest.mark.parametrize("horizon", [1, 3])
    def test_equal_stepping(self, env, horizon, behind):
        behind(env)
        env.step([0.5, 0, 0, 0])
        snapshot = env.get_state()
        asked = np.concatenate(([[1.0, 0, 0, 0], [3.0, 0, 0, 0]], actions(6)))
        found = env.outcomes(snapshot.simulator, asked, horizon=horizon)
        assert found.shape == (8, 34) and found.dtype == np.float64
        # the running episode is left alone
        assert np.array_equal(env.simulator_state(), snapshot.simulator)
        for action, outcome in zip(asked, found, strict=True):
            env.set_state(snapshot)
            for _ in range(horizon):
                observation = env.step(action)[0]["observation"]
            assert np.array_equal(observation, outcome.astype(np.float32))
        assert np.array_equal(found[0], found[1])

    def test_bad_arguments(self, env):
        env.reset(seed=0)
        state = env.simulator_state()
        with pytest.raises(ValueError, match=r"\[K, 4\]"):
            env.outcomes(state, np.zeros(4))
        with pytest.raises(ValueError, match="non-finite"):
            env.outcomes(state, np.full((1, 4), np.inf))
        with pytest.raises(ValueError, match="horizon"):
            env.outcomes(state, np.zeros((1, 4)), horizon=0)
        with pytest.raises(ValueError, match=r"\(83,\)"):
            env.outcomes(state[:-1], np.zeros((1, 4)))


class TestRendering:
    def test_frames_or_a_clear_error(self, pushed):
        env = FetchPushCubes(2, render_mode="rgb_array", render_size=(96, 64))
        env.reset(seed=0, options=pushed)
        state = env.simulator_state()
        try:
            frame = env.render()
        except RenderingUnavailable as error:
            # A machine without OpenGL: the message is all there is to see.
            assert "apt-get install" in str(error)
            return
        assert frame.shape == (64, 96, 3) and frame.dtype == np.uint8
        assert frame.std() > 10
        env.step([0, 0, 1.0, 0])
        later = env.simulator_state()
        elsewhere = np.add(env.goal, [0, 0.1, 0, 0, 0, 0])
        frames = env.render_states(
            [state, state, later], [env.goal, elsewhere, env.goal]
        )
        assert np.array_equal(frames[0], frame)
        assert not np.array_equal(frames[1], frame)  # the goals are to be seen
        assert not np.array_equal(frames[2], frame)
        assert np.array_equal(env.render_states(state)[0], frame)
        assert np.array_equal(frames[2], env.render())
        assert np.array_equal(env.simulator_state(), later)
        with pytest.raises(ValueError, match=r"\(83,\)"):
            env.render_states(np.zeros((2, 5)))
        env.close()
        env.close()

    def test_no_render_mode_no_frame(self, env):
        env.reset(seed=0)
        assert env.render() is None


def _equal(a, b) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_equal(a[key], b[key]) for key in a)
    return np.array_equal(a, b)


def test_cubes_slide_by_themselves_with_low_friction() -> None:
    def way(**options: float) -> np.ndarray:
        env = FetchPushCubes(2, **options)
        first, _ = env.reset(seed=0)
        for _ in range(10):
            last, *_ = env.step(np.zeros(4))
        moved = last["achieved_goal"] - first["achieved_goal"]
        return np.linalg.norm(moved.reshape(2, 3)[:, :2], axis=1)

    # 0.2 m/s for 0.4 s, and g * 0.02 / 2 * 0.4^2 less of it.
    np.testing.assert_allclose(
        way(cube_friction=0.02, cube_speed=0.2), 0.065, atol=4e-3
    )
    assert (way(cube_speed=0.2) < 0.01).all()
    assert (way() < 1e-4).all()


def test_sliding_cubes_do_not_change_the_draws() -> None:
    plain, _ = FetchPushCubes(2).reset(seed=3)
    slippery, _ = FetchPushCubes(2, cube_friction=0.02).reset(seed=3)
    np.testing.assert_allclose(
        plain["observation"][10:13], slippery["observation"][10:13], atol=1e-6
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cube_friction": 0.0}, "cube_friction is 0.0, expected None or a positive"),
        ({"cube_speed": -1.0}, "cube_speed is -1.0, expected between 0 and 0.5"),
    ],
)
def test_impossible_cubes_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FetchPushCubes(2, **options)
