from __future__ import annotations

import numpy as np
import pytest

from torchrl_caiac.data import mix_trajectories
from torchrl_caiac.envs import random_transitions
from torchrl_caiac.envs.kitchen import RestorableKitchen, kitchen_transitions


@pytest.fixture(scope="module")
def kitchen():
    kitchen = RestorableKitchen()
    kitchen.seed(0)
    yield kitchen
    kitchen.close()


def test_recorded_actions_lead_to_the_recorded_states(random_actions, kitchen):
    for episode in list(random_actions.iterate_episodes())[:5]:
        infos = episode.infos
        start = np.concatenate([infos["qpos"][0], infos["qvel"][0]])
        observation = kitchen.restore(start)
        assert np.abs(observation - infos["qpos"][0])[9:].max() < 0.02
        for action, expected in zip(episode.actions, infos["qpos"][1:], strict=True):
            kitchen.step(action)
            # The controller starts from the observed joints, which have noise.
            assert np.allclose(kitchen.record()["qpos"], expected, atol=0.02)


def test_random_rows_mix_with_kitchen_transitions(demonstrations):
    data = kitchen_transitions(demonstrations, progress=False)
    states = np.concatenate([data["sim", "qpos"], data["sim", "qvel"]], 1)
    random = random_transitions(
        RestorableKitchen,
        states[::20],
        steps=2,
        info_key="sim",
        num_workers=1,
        progress=False,
    )
    mixed = mix_trajectories([data.exclude("task"), random])
    assert len(mixed) == len(data) + len(random)
    assert np.array_equal(random["sim", "qpos"][::2], data["sim", "qpos"][::20])
