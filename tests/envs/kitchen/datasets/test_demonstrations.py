from __future__ import annotations

import json

import minari
import numpy as np
import pytest

from torchrl_caiac.data.minari_files import open_minari
from torchrl_caiac.envs.kitchen import (
    DEMONSTRATIONS_ID,
    RANDOM_ID,
    Demonstrations,
    create_kitchen_demonstrations,
)


def test_minari_itself_finds_the_datasets(
    demonstrations, random_actions, root, monkeypatch
):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    assert set(minari.list_local_datasets()) == {DEMONSTRATIONS_ID, RANDOM_ID}
    dataset = minari.load_dataset(DEMONSTRATIONS_ID)
    assert dataset.total_episodes == 3
    env = dataset.recover_environment()
    observation, _ = env.reset(seed=0)
    assert dataset.observation_space.contains(observation)
    env.close()
    assert open_minari(RANDOM_ID).total_episodes == random_actions.total_episodes


def test_demonstrations_end_in_success_and_keep_exact_states(demonstrations):
    goals = {"microwave": -0.75, "kettle": 0.75}
    metadata = demonstrations.storage.get_episode_metadata(range(3))
    for episode, known in zip(demonstrations.iterate_episodes(), metadata, strict=True):
        task = known["options"]["task"]
        start = json.loads(known["options"]["start"])
        length = len(episode.actions)
        observation = episode.observations["observation"]
        assert observation.shape == (length + 1, 59)
        assert episode.actions.shape == (length, 9)
        assert episode.truncations.tolist() == [False] * (length - 1) + [True]
        assert not episode.terminations.any()
        for kind in ("achieved_goal", "desired_goal"):
            goal = episode.observations[kind]
            assert goal["microwave"].shape == (length + 1, 1)
            assert goal["kettle"].shape == (length + 1, 7)
        distance = np.linalg.norm(
            episode.observations["achieved_goal"][task][-1]
            - episode.observations["desired_goal"][task][-1]
        )
        assert distance < 0.3
        assert episode.rewards[-1] == 1.0
        assert episode.rewards[0] == 0.0
        qpos = episode.infos["qpos"]
        assert qpos.shape == (length + 1, 30)
        assert episode.infos["qvel"].shape == (length + 1, 29)
        seen = observation[:, [*range(9), *range(18, 39)]]
        np.testing.assert_allclose(seen, qpos, atol=2e-3)
        assert np.abs(seen - qpos).max() > 0
        np.testing.assert_allclose(
            qpos[:, 19], start.get("slide_cabinet", 0.0), atol=0.01
        )
        moved = {"microwave": qpos[-1, 22], "kettle": qpos[-1, 24]}
        assert abs(moved[task] - goals[task]) < 0.3


def test_a_dataset_is_replaced_on_request_only(demonstrations, groups, root, work):
    with pytest.raises(FileExistsError, match="overwrite=True"):
        create_kitchen_demonstrations(root=root)
    again, report = create_kitchen_demonstrations(
        demonstrations=groups,
        root=root,
        work=work,
        workers=1,
        overwrite=True,
        progress=False,
    )
    assert (report.collected, report.reused) == (0, 3)
    assert again.total_steps == demonstrations.total_steps
    for left, right in zip(
        again.iterate_episodes(), demonstrations.iterate_episodes(), strict=True
    ):
        np.testing.assert_array_equal(left.actions, right.actions)


@pytest.mark.slow
def test_two_workers_collect_the_same(demonstrations, groups, tmp_path):
    dataset, _ = create_kitchen_demonstrations(
        demonstrations=groups, root=tmp_path, workers=2, progress=False
    )
    for left, right in zip(
        dataset.iterate_episodes(), demonstrations.iterate_episodes(), strict=True
    ):
        np.testing.assert_array_equal(left.actions, right.actions)
        np.testing.assert_array_equal(left.infos["qpos"], right.infos["qpos"])


def test_bad_input(root, tmp_path):
    with pytest.raises(FileNotFoundError, match="no Minari dataset"):
        open_minari("kitchen/none-v0", root)
    with pytest.raises(KeyError, match="toaster"):
        create_kitchen_demonstrations(
            demonstrations=[Demonstrations("toaster")], root=tmp_path
        )
    with pytest.raises(ValueError, match="no demonstrations"):
        create_kitchen_demonstrations(demonstrations=[], root=tmp_path)
