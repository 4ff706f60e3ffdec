"""The expert in the real simulator."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.envs.fetch_push import FetchPushCubes, FetchPushExpert, expert

HIGH = 0.5


@pytest.fixture(scope="module")
def env():
    env = FetchPushCubes(2)
    yield env
    env.close()


def play(env, expert, steps=100, **reset):
    """Observations, actions and infos of an episode."""
    observation, info = env.reset(**reset)
    observations, actions, infos = [observation], [], [info]
    for _ in range(steps):
        actions.append(expert(observation))
        observation, *_, info = env.step(actions[-1])
        observations.append(observation)
        infos.append(info)
    return observations, np.stack(actions), infos


def scene(gripper, cubes, goals):
    """An observation of things at rest, at places on the table."""
    rows = np.zeros((len(cubes), 12), dtype=np.float32)
    rows[:, :3] = [[*place, 0.425] for place in cubes]
    return {
        "observation": np.concatenate(
            (np.array([*gripper, 0, 0, 0, 0, 0, 0, 0], dtype=np.float32), rows.ravel())
        ),
        "desired_goal": np.array([[*place, 0.425] for place in goals]).ravel(),
    }


class TestSuccess:
    @pytest.mark.parametrize(("noise", "least"), [(0.0, 20), (0.2, 18)])
    def test_two_cubes(self, env, noise, least):
        done = 0
        for seed in range(20):
            expert = FetchPushExpert(2, action_noise=noise, rng=seed)
            _, actions, infos = play(env, expert, seed=seed)
            assert np.abs(actions).max() <= 1 and actions.dtype == np.float32
            done += any(info["success"] for info in infos)
        assert done >= least

    @pytest.mark.parametrize(("num_cubes", "least"), [(1, 5), (3, 4)])
    def test_other_numbers_of_cubes(self, num_cubes, least):
        env = FetchPushCubes(num_cubes)
        expert = FetchPushExpert(num_cubes)
        done = 0
        for seed in range(5):
            observations, _, infos = play(env, expert, seed=seed)
            if infos[-1]["success"]:
                done += 1
                last = observations[-1]
                errors = last["achieved_goal"] - last["desired_goal"]
                # It brakes: cubes do not slide to the edge of the tolerance.
                assert np.linalg.norm(errors.reshape(-1, 3), axis=-1).max() < 0.045
        assert done >= least

    def test_leaves_a_finished_cube_alone(self, env):
        options = {
            "cubes": [[1.4, 0.7], [1.3, 0.85]],
            "goals": [[1.4, 0.7], [1.2, 0.85]],
        }
        observations, _, infos = play(
            env, FetchPushExpert(2), steps=50, seed=0, options=options
        )
        assert infos[-1]["success"]
        moved = observations[-1]["achieved_goal"] - observations[0]["achieved_goal"]
        assert np.abs(moved[:3]).max() < 1e-3
        assert np.abs(moved[3:]).max() > 0.05

    def test_waits_above_after_success(self, env):
        places = [[1.4, 0.7], [1.3, 0.85]]
        observations, actions, infos = play(
            env,
            FetchPushExpert(2),
            steps=20,
            seed=0,
            options={"cubes": places, "goals": places},
        )
        assert all(info["success"] for info in infos)
        assert observations[-1]["observation"][2] == pytest.approx(HIGH, abs=5e-3)
        assert not actions[:, [0, 1, 3]].any()


class TestChoice:
    def test_takes_the_cube_that_stands_in_the_way_first(self):
        # The second cube is farther from its goal, and on the way of the first.
        cubes, goals = [[1.25, 0.75], [1.34, 0.75]], [[1.42, 0.75], [1.34, 0.95]]
        action = FetchPushExpert(2).act(scene([1.34, 0.75, HIGH], cubes, goals))
        assert action[1] < -0.9  # behind the second one, seen from its goal
        goals[0] = [1.25, 0.60]  # another way: now the first is nearer to its goal
        action = FetchPushExpert(2).act(scene([1.34, 0.75, HIGH], cubes, goals))
        assert action[0] < -0.5 and action[1] > 0.2

    def test_makes_room_in_the_right_order(self):
        # The first cube's goal lies on the way of the second.
        cubes, goals = [[1.30, 0.65], [1.20, 0.80]], [[1.30, 0.80], [1.45, 0.80]]
        action = FetchPushExpert(2).act(scene([1.35, 0.80, HIGH], cubes, goals))
        assert action[0] < -0.9

    def test_stays_with_the_cube_that_it_pushes(self):
        cubes, goals = [[1.30, 0.65], [1.25, 0.85]], [[1.30, 0.70], [1.45, 0.85]]
        pushing = scene([1.205, 0.85, 0.425], cubes, goals)
        assert FetchPushExpert(2).act(pushing)[0] > 0.9
        above = scene([1.205, 0.85, HIGH], cubes, goals)
        assert FetchPushExpert(2).act(above)[1] < -0.9  # the other one is nearer

    def test_slows_down_before_the_goal(self):
        speeds = [
            FetchPushExpert(1).act(
                scene([1.26, 0.75, 0.425], [[1.3, 0.75]], [[1.3 + left, 0.75]])
            )[0]
            for left in (0.2, 0.03, 0.017)
        ]
        assert speeds[0] == 1.0
        assert speeds[0] > speeds[1] > speeds[2] > 0.1

    def test_corrects_sideways_and_gives_up_a_lost_line(self):
        cube, goal = [[1.3, 0.75]], [[1.45, 0.75]]
        near = FetchPushExpert(1).act(scene([1.26, 0.76, 0.425], cube, goal))
        assert near[0] > 0.9 and near[1] < -0.1
        lost = FetchPushExpert(1).act(scene([1.28, 0.79, 0.425], cube, goal))
        assert lost[2] == 1.0 and np.abs(lost[:2]).max() < 0.1  # straight up first


class TestFunctionOfTheObservation:
    def test_has_no_memory(self, env):
        observations, actions, _ = play(env, FetchPushExpert(2), seed=5, steps=60)
        expert = FetchPushExpert(2)
        for i in np.random.default_rng(0).permutation(60):
            assert np.array_equal(expert(observations[i]), actions[i])

    def test_reads_state_and_goal_only(self, env):
        observation, _ = env.reset(seed=1)
        action = FetchPushExpert(2).act(observation)
        kept = {k: observation[k].copy() for k in ("observation", "desired_goal")}
        assert np.array_equal(FetchPushExpert(2).act(kept), action)
        assert np.array_equal(kept["observation"], observation["observation"])

    @settings(max_examples=30)
    @given(
        seed=st.integers(0, 10**6),
        num_cubes=st.integers(1, 3),
        batch=st.sampled_from([(0,), (4,), (2, 3), (1, 2, 2)]),
    )
    def test_batches_equal_single_rows(self, seed, num_cubes, batch):
        rng = np.random.default_rng(seed)
        state = rng.uniform(0.4, 1.4, (*batch, 10 + 12 * num_cubes))
        state[..., 10:] = rng.uniform(-0.02, 0.02, state[..., 10:].shape)
        for first in range(10, state.shape[-1], 12):
            state[..., first : first + 2] += [1.3, 0.75]
        goal = rng.uniform(0.4, 1.4, (*batch, 3 * num_cubes))
        expert = FetchPushExpert(num_cubes)
        actions = expert.act({"observation": state, "desired_goal": goal})
        assert actions.shape == (*batch, 4)
        assert np.abs(actions).max(initial=0.0) <= 1
        for place in np.ndindex(*batch):
            row = {"observation": state[place], "desired_goal": goal[place]}
            assert np.array_equal(expert.act(row), actions[place])

    def test_takes_tensors(self, env):
        observation, _ = env.reset(seed=1)
        tensors = {key: torch.from_numpy(value) for key, value in observation.items()}
        expert = FetchPushExpert(2)
        assert np.array_equal(expert.act(tensors), expert.act(observation))


class TestNoise:
    def test_scale_and_clipping(self, env):
        observation, _ = env.reset(seed=2)
        many = {key: np.tile(value, (4000, 1)) for key, value in observation.items()}
        exact = FetchPushExpert(2).act(observation)
        drawn = FetchPushExpert(2, action_noise=0.2, rng=0)(many)
        assert drawn.shape == (4000, 4)
        assert np.abs(drawn).max() <= 1
        error = drawn - exact
        free = np.abs(exact) < 0.2
        assert free.any()
        assert error[:, free].std(0) == pytest.approx(0.2, abs=0.02)
        assert error[:, free].mean(0) == pytest.approx(0.0, abs=0.02)

    def test_seeds(self, env):
        observation, _ = env.reset(seed=2)
        first, second = (FetchPushExpert(2, action_noise=0.2, rng=7) for _ in range(2))
        drawn = first(observation)
        assert np.array_equal(drawn, second(observation))
        assert not np.array_equal(drawn, first(observation))
        quiet = FetchPushExpert(2)
        assert np.array_equal(
            quiet(observation), quiet.act(observation).astype(np.float32)
        )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_cubes": 0}, "num_cubes is 0"),
        ({"action_noise": -0.1}, "action_noise is -0.1"),
        ({"action_noise": float("nan")}, "action_noise is nan"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        FetchPushExpert(**arguments)


def test_bad_observations(env):
    observation, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match=r"'observation'.*\(34,\).*\[\*B, 22\]"):
        FetchPushExpert(1)(observation)
    with pytest.raises(ValueError, match=r"'desired_goal'.*\(3,\)"):
        FetchPushExpert(2)({**observation, "desired_goal": np.zeros(3)})


def test_main_logs_the_success(caplog):
    with caplog.at_level(logging.INFO, logger=expert.__name__):
        assert expert.main(["--cubes", "1", "--episodes", "2"]) == 0
    text = caplog.text
    assert "50 steps" in text and "100 steps" in text
    assert "in 1.000 and at the last step" in text
