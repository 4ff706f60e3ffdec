"""What all writers of the package have in common."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from minari.data_collector import EpisodeBuffer
from tensordict import TensorDict

from tests.killing import run_killed
from torchrl_caiac import EntityLayout
from torchrl_caiac._files import whole_file, whole_folder, write_json
from torchrl_caiac.checkpoint import TrainingCheckpoint
from torchrl_caiac.data import collect_episodes, load_minari, mix_trajectories
from torchrl_caiac.data.digests import write_digests
from torchrl_caiac.data.minari_files import (
    free_dataset_path,
    open_minari,
    publish_dataset,
)
from torchrl_caiac.data.write_transitions import write_transitions


def rows() -> TensorDict:
    return TensorDict(
        {
            "action": torch.zeros(4, 2),
            "episode": torch.arange(4) // 2,
            "next": {"done": torch.ones(4, 1, dtype=torch.bool)},
        },
        [4],
    )


def dataset(path: Path):
    episode = EpisodeBuffer(
        observations=np.zeros((3, 4), np.float32),
        actions=np.zeros(2, int),
        rewards=np.zeros(2),
        terminations=np.zeros(2, bool),
        truncations=np.array([False, True]),
    )
    publish_dataset(
        f"pole/{path.name}",
        [episode],
        free_dataset_path(f"pole/{path.name}", path.parent / "pole", True),
        lambda: gymnasium.make("CartPole-v1"),
        code="",
        requirements=[],
        progress=False,
        description="A pole at rest.",
        algorithm_name="none",
    )


def minari_rows(path: Path) -> None:
    dataset(path.with_name("rest-v0"))
    opened = open_minari("pole/rest-v0", path.parent / "pole")
    load_minari(opened, path, progress=False)


def episodes(path: Path) -> None:
    arrays = {"a": np.zeros(2)}
    collect_episodes(lambda: lambda *_: arrays, [{}], path, workers=1, progress=False)


def digests(path: Path) -> None:
    rows().memmap(path)
    write_digests(path)


WRITERS = {
    "table.json": lambda path: write_json(path, {}),
    "layout.json": EntityLayout({"arm": [0]}).save,
    "checkpoint.zip": lambda path: TrainingCheckpoint(path).save(1),
    "rows": lambda path: write_transitions(
        rows(), path, overwrite=True, action_bounds=([0, 0], [1, 1])
    ),
    "mixed": lambda path: mix_trajectories([rows()], path=path, overwrite=True),
    "digests": digests,
    "minari_rows": minari_rows,
    "episodes": episodes,
    "rest-v0": dataset,
}


@pytest.fixture
def umask():
    previous = os.umask(0o027)
    yield
    os.umask(previous)


@pytest.mark.parametrize("name", WRITERS)
def test_modes_follow_the_umask(name, tmp_path, umask):
    folder = tmp_path / "new"
    WRITERS[name](folder / name)
    written = list(folder.rglob("*"))
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in written}
    assert len(written) > 0
    assert {m for p, m in modes.items() if p.is_dir()} <= {0o750}, modes
    assert {m for p, m in modes.items() if p.is_file()} == {0o640}, modes


@pytest.mark.parametrize("name", [n for n in WRITERS if n not in ("digests",)])
def test_what_killed_calls_left_is_removed(name, tmp_path):
    inner = {"episodes": "episodes/x", "rest-v0": "pole/pole/rest-v0"}.get(name, name)
    place = tmp_path / inner

    def half(write):
        with write(place) as partial:
            partial.mkdir() if write is whole_folder else partial.touch()
            yield

    for write in (whole_file, whole_folder):
        run_killed(half, write)
    assert len(list(place.parent.glob(".partial-*"))) >= 1
    WRITERS[name](tmp_path / name)
    assert not list(tmp_path.rglob(".partial-*"))
