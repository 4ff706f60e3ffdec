from __future__ import annotations

import functools
import os
import shutil

import gymnasium
import minari
import numpy as np
import pytest
import torch
from minari.data_collector import EpisodeBuffer
from tensordict import TensorDict

from torchrl_caiac.envs.kitchen import KITCHEN_TASKS, kitchen_transitions


def test_transitions(demonstrations, random_actions, tmp_path):
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


def check_foreign(rows, episodes):
    assert len(rows) == 9
    assert set(rows.keys(True, True)) == {
        "observation",
        "action",
        "episode",
        "task",
        *(
            ("next", name)
            for name in ("observation", "reward", "done", "terminated", "truncated")
        ),
    }
    row = 0
    for number, episode in enumerate(episodes):
        full = episode["observations"]["observation"].astype(np.float32)
        for step in range(len(episode["actions"])):
            now, after = (
                np.concatenate([full[t, :9], full[t, 18:39]]) for t in (step, step + 1)
            )
            np.testing.assert_array_equal(rows["observation"][row], now)
            np.testing.assert_array_equal(rows["next", "observation"][row], after)
            np.testing.assert_array_equal(rows["action"][row], episode["actions"][step])
            assert rows["next", "reward"][row] == episode["rewards"][step]
            assert rows["next", "terminated"][row] == (step == 4)
            last = step + 1 == len(episode["actions"])
            assert rows["next", "truncated"][row] == (last and step != 4)
            assert rows["next", "done"][row] == last
            assert (rows["episode"][row], rows["task"][row]) == (number, -1)
            row += 1


def test_a_kitchen_of_minari_loads_as_ours(foreign, tmp_path):
    root, episodes = foreign
    rows = kitchen_transitions("D4RL/kitchen/mixed-v2", root=root, progress=False)
    check_foreign(rows, episodes)
    stored = kitchen_transitions(
        "D4RL/kitchen/mixed-v2", tmp_path / "rows", root=root, progress=False
    )
    assert stored.is_memmap()
    assert (stored == rows).all()


@pytest.mark.parametrize("named", [True, False])
def test_a_missing_dataset_is_downloaded(named, foreign, tmp_path, monkeypatch):
    source, episodes = foreign
    requested = []

    def download(dataset_id):
        requested.append(dataset_id)
        shutil.copytree(source, os.environ["MINARI_DATASETS_PATH"], dirs_exist_ok=True)

    monkeypatch.setattr(minari, "download_dataset", download)
    before = tmp_path / ("other" if named else "target")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(before))
    root = tmp_path / "target" if named else None
    load = functools.partial(
        kitchen_transitions, "D4RL/kitchen/mixed-v2", root=root, progress=False
    )
    with pytest.raises(FileNotFoundError, match="download=True"):
        load()
    assert not requested
    for _ in range(2):
        check_foreign(load(download=True), episodes)
    assert requested == ["D4RL/kitchen/mixed-v2"]
    assert os.environ["MINARI_DATASETS_PATH"] == str(before)
    assert (tmp_path / "target" / "D4RL/kitchen/mixed-v2/data").exists()


def test_bad_datasets(demonstrations, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def store(name, observation, width=59):
        box = gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float64)
        space = gymnasium.spaces.Dict({"observation": box})
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
            observation_space=space,
            action_space=demonstrations.action_space,
        )

    narrow = store("narrow", np.zeros((4, 12)), 12)
    with pytest.raises(ValueError, match=r"shape \[12\], expected \[59\]"):
        kitchen_transitions(narrow, progress=False)
    values = np.zeros((4, 59))
    values[2, 5] = np.inf
    with pytest.raises(ValueError, match="finite"):
        kitchen_transitions(store("infinite", values), progress=False)
    # A file that does not mark its end: the last transition is the end.
    rows = kitchen_transitions(store("open", np.zeros((4, 59))), progress=False)
    assert rows["next", "truncated"].flatten().tolist() == [False, False, True]
    assert "sim" not in rows
