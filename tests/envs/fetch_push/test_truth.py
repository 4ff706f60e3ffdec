"""The ground truth of Fetch-Push; see also tests/influence/test_truth.py."""

from __future__ import annotations

import functools
import pickle

import numpy as np
import pytest

from torchrl_caiac.envs.fetch_push import FetchPushTruth, fetch_push_layout
from torchrl_caiac.influence.truth import true_influence


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
