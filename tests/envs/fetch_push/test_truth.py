"""The ground truth of influence in Fetch-Push."""

from __future__ import annotations

import functools
import pickle

import numpy as np
import pytest
import torch

from torchrl_caiac.envs.fetch_push import (
    FetchPushCubes,
    FetchPushExpert,
    FetchPushTruth,
    fetch_push_layout,
)
from torchrl_caiac.influence.truth import true_influence

QUERY = {"num_actions": 24, "threshold": 1e-3, "progress": False}


class Everything(FetchPushTruth):
    """Simulates every state."""

    def in_reach(self, state, *, horizon=1):
        return np.ones(len(self.layout), dtype=np.bool_)


class TestFetchPushTruth:
    def test_influence_is_contact(self, env, behind, pushed):
        env.reset(seed=0, options=pushed)
        away = env.simulator_state()
        behind(env)
        near = env.simulator_state()
        truth = true_influence(
            FetchPushTruth,
            np.stack([away, near]),
            num_actions=12,
            threshold=1e-3,
            progress=False,
        )
        assert truth.influenced.tolist() == [[True, False, False], [True, True, False]]
        # in metres: a step cannot move a cube farther than the gripper
        assert truth.displacement[:, 1:].max() < 0.08
        assert truth.displacement[0, 1:].max() < 1e-6
        assert truth.displacement[1, 2] < 1e-6

    @pytest.mark.parametrize("num_cubes", [1, 3])
    def test_layout(self, num_cubes):
        truth = FetchPushTruth(num_cubes)
        layout = fetch_push_layout(num_cubes)
        assert truth.layout.names == layout.names
        assert truth.layout.fixed == layout.fixed
        for name, columns in truth.layout.columns.items():
            assert tuple(columns) == tuple(layout.columns[name])[:3]
        assert truth.action_space.shape == (4,)
        assert pickle.loads(pickle.dumps(functools.partial(FetchPushTruth, num_cubes)))


class TestInReach:
    """States that ``in_reach`` excludes have no influence."""

    def test_cubes_that_are_nearly_reached(self):
        # The bound is tight: cubes that are just out of reach do not move although they
        # are near.
        env, states, distances = FetchPushCubes(2), [], []
        for seed in range(12):
            rng = np.random.default_rng(seed)
            expert = FetchPushExpert(2, action_noise=0.2, rng=rng)
            observation, _ = env.reset(seed=seed)
            for _ in range(60):
                states.append(env.simulator_state())
                achieved = observation["achieved_goal"].reshape(2, 3)
                gripper = observation["observation"][:3]
                distances.append(np.linalg.norm(achieved - gripper, axis=-1))
                action = expert(observation) if seed % 3 else rng.uniform(-1, 1, 4)
                observation, *_ = env.step(action)
        simulator = FetchPushTruth(2)
        reached = np.stack([simulator.in_reach(state) for state in states])
        assert reached[:, 0].all()
        reached = reached[:, 1:]
        assert 0.1 < reached.mean() < 0.7
        spared = np.where(reached, np.inf, distances)
        nearest = np.argsort(spared.min(1))[:80]
        assert spared[nearest].min() < 0.14
        truth = true_influence(
            Everything(), [states[i] for i in nearest], **QUERY
        ).displacement[:, 1:]
        assert truth[~torch.from_numpy(reached[nearest])].max() < 1e-4
        # In reach, many are influenced.
        nearest = np.argsort(np.min(distances, axis=1))[:20]
        influenced = true_influence(simulator, [states[i] for i in nearest], **QUERY)
        assert influenced.influenced[:, 1:].any(1).float().mean() > 0.8

    def test_cubes_that_push_cubes(self):
        env = FetchPushCubes(4)
        aside = [[x, 0.45] for x in (1.1, 1.2, 1.3, 1.4)]
        env.reset(seed=0, options={"cubes": aside})
        for _ in range(3):
            env.step(np.array([0.0, 0.0, -0.6, 0.0]))
        x, y, height = env.data.site("robot0:grip").xpos
        assert height < 0.45

        def moved(*places):
            state = env.simulator_state()
            for i, place in enumerate(places):
                at = env.model.joint(f"object{i}:joint").qposadr[0]
                state[at : at + 2] = place
            return state

        # A row in front of the gripper, with gaps of 3 mm; then its last cube alone.
        row = [[x, y + 0.043 + 0.053 * i] for i in range(4)]
        states = [moved(*row), moved(*aside[:3], row[3])]
        truth = true_influence(Everything(4), states, **QUERY).influenced
        assert truth.tolist() == [[True] * 5, [True, False, False, False, False]]
        simulator = FetchPushTruth(4)
        assert [simulator.in_reach(state).tolist() for state in states] == (
            truth.tolist()
        )

    def test_a_longer_horizon_reaches_farther(self):
        env = FetchPushCubes(1)
        env.reset(seed=0, options={"cubes": [[1.342, 0.85]]})
        simulator, state = FetchPushTruth(1), env.simulator_state()
        reached = [simulator.in_reach(state, horizon=h)[1] for h in (1, 4)]
        assert reached == [False, True]
        truth = true_influence(Everything(1), [state], horizon=1, **QUERY)
        assert not truth.influenced[0, 1]
