from __future__ import annotations

import minari
import numpy as np
import pytest

from torchrl_caiac.envs.kitchen import create_kitchen_random


def test_random_episodes_begin_in_states_of_demonstrations(
    demonstrations, random_actions
):
    states = np.concatenate(
        [
            np.concatenate([e.infos["qpos"], e.infos["qvel"]], 1)
            for e in demonstrations.iterate_episodes()
        ]
    )
    rows = demonstrations.total_steps
    assert random_actions.total_episodes == round(rows * 0.5 / 4)
    assert random_actions.total_steps == 4 * random_actions.total_episodes
    actions, starts = [], []
    for episode in random_actions.iterate_episodes():
        start = np.concatenate([episode.infos["qpos"][0], episode.infos["qvel"][0]])
        hits = np.flatnonzero((states == start).all(1))
        # Demonstrations of one task share their first state.
        assert len(hits)
        starts.append(int(hits[0]))
        actions.append(episode.actions)
        assert episode.truncations.tolist() == [False, False, False, True]
    assert len(set(starts)) == len(starts)
    drawn = np.concatenate(actions)
    assert drawn.min() > -1 and drawn.max() < 1
    assert np.abs(drawn.mean(0)).max() < 0.25
    assert np.abs(drawn.std(0) - 1 / np.sqrt(3)).max() < 0.15


def test_an_error_leaves_nothing_behind(demonstrations, root, monkeypatch):
    def broken(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(minari, "create_dataset_from_buffers", broken)
    before = sorted(root.rglob("*"))
    with pytest.raises(OSError, match="disk full"):
        create_kitchen_random(
            demonstrations,
            "kitchen/other-v0",
            ratio=0.05,
            root=root,
            workers=1,
            progress=False,
        )
    assert sorted(root.rglob("*")) == before


@pytest.mark.parametrize(
    "wrong", [{"ratio": 0}, {"ratio": np.nan}, {"steps": 0}, {"starts_per_file": 0}]
)
def test_bad_input(wrong, demonstrations, tmp_path):
    with pytest.raises(ValueError, match="expected"):
        create_kitchen_random(demonstrations, root=tmp_path, **wrong)


def test_demonstrations_without_simulator_states(foreign, tmp_path):
    with pytest.raises(KeyError, match="qpos"):
        create_kitchen_random(
            minari.MinariDataset(foreign[0] / "D4RL/kitchen/mixed-v2/data"),
            root=tmp_path,
            progress=False,
        )
