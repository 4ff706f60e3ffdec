"""The kitchen's datasets: schema, restored states, rows, refusals."""

from __future__ import annotations

import json
import os

import minari
import numpy as np
import pytest
import torch
from minari.data_collector import EpisodeBuffer
from tensordict import TensorDict

from torchrl_caiac.data.kitchen_datasets import (
    DEMONSTRATIONS_ID,
    RANDOM_ID,
    Demonstrations,
    create_kitchen_demonstrations,
    create_kitchen_random,
    kitchen_transitions,
)
from torchrl_caiac.data.minari_files import open_minari
from torchrl_caiac.envs.kitchen import KITCHEN_TASKS

GROUPS = (
    Demonstrations("microwave", 1, {"slide_cabinet": 0.37}),
    Demonstrations("kettle", 2),
)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("minari")


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def demonstrations(root, work):
    before = os.environ.get("MINARI_DATASETS_PATH")
    dataset, report = create_kitchen_demonstrations(
        demonstrations=GROUPS, root=root, work=work, workers=1, progress=False
    )
    assert os.environ.get("MINARI_DATASETS_PATH") == before
    assert report.collected == 3
    assert not list(root.glob(".partial-*"))
    return dataset


@pytest.fixture(scope="module")
def random_actions(demonstrations, root, work):
    return create_kitchen_random(
        demonstrations,
        ratio=0.5,
        steps=4,
        simulator_states=True,
        starts_per_file=8,
        root=root,
        work=work,
        workers=1,
        progress=False,
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
    assert open_minari(RANDOM_ID).total_episodes == (
        random_actions.total_episodes
    )


def test_demonstrations_end_in_success_and_keep_the_truth(demonstrations):
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


def test_rows(demonstrations, random_actions, tmp_path):
    rows = kitchen_transitions(demonstrations, progress=False)
    total = demonstrations.total_steps
    assert rows.batch_size == (total,)
    assert rows["observation"].shape == (total, 30)
    assert rows["observation"].dtype == torch.float32
    assert rows["action"].shape == (total, 9)
    assert rows["next", "reward"].shape == (total, 1)
    assert rows["episode"].dtype == torch.int64
    episodes = list(demonstrations.iterate_episodes())
    lengths = torch.tensor([len(e.actions) for e in episodes])
    assert rows["episode"].bincount().tolist() == lengths.tolist()
    ends = torch.zeros(total, 1, dtype=torch.bool)
    ends[lengths.cumsum(0) - 1] = True
    assert torch.equal(rows["next", "done"], ends)
    assert torch.equal(rows["next", "truncated"], ends)
    assert not rows["next", "terminated"].any()
    same = rows["episode"][1:] == rows["episode"][:-1]
    assert torch.equal(
        rows["next", "observation"][:-1][same], rows["observation"][1:][same]
    )
    first = episodes[0].observations["observation"]
    np.testing.assert_array_equal(
        rows["observation"][0, :9], first[0, :9].astype(np.float32)
    )
    np.testing.assert_array_equal(
        rows["observation"][0, 9:], first[0, 18:39].astype(np.float32)
    )
    np.testing.assert_array_equal(
        rows["next", "observation"][lengths[0] - 1, 9:], first[-1, 18:39].astype("f4")
    )
    assert {KITCHEN_TASKS[t] for t in rows["task"].unique()} == {"microwave", "kettle"}
    opened = rows["observation"][:, 19] > 0.2
    assert torch.equal(opened, rows["task"] == KITCHEN_TASKS.index("microwave"))
    np.testing.assert_array_equal(rows["sim", "qpos"][0], episodes[0].infos["qpos"][0])

    path = tmp_path / "rows"
    stored = kitchen_transitions(demonstrations, path, progress=False)
    assert stored.is_memmap()
    assert (stored == rows).all()
    assert (TensorDict.load_memmap(path) == rows).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["rows"]
    with pytest.raises(FileExistsError, match="overwrite=True"):
        kitchen_transitions(demonstrations, path, progress=False)
    other = kitchen_transitions(random_actions, path, overwrite=True, progress=False)
    assert len(other) == random_actions.total_steps
    assert (other["task"] == -1).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["rows"]


def test_a_dataset_is_not_replaced_unasked(demonstrations, root, work):
    with pytest.raises(FileExistsError, match="overwrite=True"):
        create_kitchen_demonstrations(root=root)
    again, report = create_kitchen_demonstrations(
        demonstrations=GROUPS,
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


def test_nothing_is_left_behind_by_an_error(demonstrations, root, monkeypatch):
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


def test_bad_input(demonstrations, root, tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="no Minari dataset"):
        open_minari("kitchen/none-v0", root)
    with pytest.raises(KeyError, match="toaster"):
        create_kitchen_demonstrations(
            demonstrations=[Demonstrations("toaster")], root=tmp_path
        )
    with pytest.raises(ValueError, match="no demonstrations"):
        create_kitchen_demonstrations(demonstrations=[], root=tmp_path)
    for wrong in ({"ratio": 0}, {"ratio": np.nan}, {"steps": 0}):
        with pytest.raises(ValueError, match="wanted"):
            create_kitchen_random(demonstrations, root=tmp_path, **wrong)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def foreign(name, observation, width=59):
        return minari.create_dataset_from_buffers(
            f"kitchen/{name}-v0",
            [
                EpisodeBuffer(
                    observations={"observation": observation},
                    actions=np.zeros((3, 9)),
                    rewards=np.zeros(3),
                    terminations=np.zeros(3, bool),
                    truncations=np.zeros(3, bool),
                )
            ],
            observation_space=_space(width),
            action_space=demonstrations.action_space,
        )

    narrow = foreign("narrow", np.zeros((4, 12)), 12)
    with pytest.raises(ValueError, match=r"shape \(4, 12\)"):
        kitchen_transitions(narrow, progress=False)
    with pytest.raises(KeyError, match="qpos"):
        create_kitchen_random(narrow, root=tmp_path, progress=False)
    values = np.zeros((4, 59))
    values[2, 5] = np.inf
    with pytest.raises(ValueError, match="finite"):
        kitchen_transitions(foreign("infinite", values), progress=False)
    # A file that does not say where its trajectory ends: the last row is the end.
    rows = kitchen_transitions(foreign("open", np.zeros((4, 59))), progress=False)
    assert rows["next", "truncated"].flatten().tolist() == [False, False, True]
    assert "sim" not in rows


def _space(width):
    import gymnasium

    box = gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float64)
    return gymnasium.spaces.Dict({"observation": box})
