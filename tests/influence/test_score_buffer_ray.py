"""Scores that tasks of Ray write together, one of which is killed."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
import ray
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_caiac import EntityLayout
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence import score_buffer, score_buffer_ray

pytestmark = pytest.mark.usefixtures("cluster")


class Fatal:
    """Kills the first process that uses it, if it has a place to note that."""

    layout = EntityLayout({"arm": [0], "cup": [1]})

    def __init__(self, note: Path | None = None, error: bool = False) -> None:
        self.note, self.error = note, error

    def __repr__(self) -> str:
        return "Fatal()"

    def __call__(self, td: TensorDictBase) -> torch.Tensor:
        if self.error:
            raise RuntimeError("these states cannot be scored")
        if self.note is not None:
            try:
                self.note.touch(exist_ok=False)
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        return (td["observation"] * 1.7).sin().abs()


def write(folder: Path, rows: int = 3000) -> Path:
    generator = torch.Generator().manual_seed(0)
    TensorDict(
        {
            "observation": torch.rand(rows, 2, generator=generator),
            "action": torch.rand(rows, 1, generator=generator),
            "episode": torch.arange(rows) // 30,
            "next": {
                "observation": torch.rand(rows, 2, generator=generator),
                "done": (torch.arange(rows) % 30 == 29).unsqueeze(-1),
            },
        },
        [rows],
    ).memmap(folder)
    return folder


def test_a_killed_task_starts_again_and_scores_are_those_of_one_process(
    tmp_path: Path,
) -> None:
    alone, together = write(tmp_path / "alone"), write(tmp_path / "together")
    settings = dict(batch_size=100, smoothing=3, check=False, progress=False)
    score_buffer(offline_buffer(load_transitions(alone)), Fatal(), **settings)
    note = tmp_path / "killed"
    score_buffer_ray(together, Fatal(note), num_workers=2, **settings)
    assert note.exists()
    one, other = load_transitions(alone), load_transitions(together)
    for key in one.keys(True, True):
        assert torch.equal(one[key], other[key]), key
    # All is scored: nothing is left for a call that scores alone.
    score_buffer(offline_buffer(other), Fatal(error=True), **settings)


def test_an_error_of_a_task_is_raised(tmp_path: Path) -> None:
    folder = write(tmp_path / "rows", 300)
    with pytest.raises(RuntimeError, match="these states cannot be scored"):
        score_buffer_ray(
            folder, Fatal(error=True), num_workers=1, check=False, progress=False
        )


def test_a_cluster_that_is_too_small_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wait(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ray, "wait", wait)
    needs = r"needs \{'CPU': 1, 'GPU': 7\}.*they have \[\{'CPU': 2.0, 'GPU': 0\}\]"
    with pytest.warns(UserWarning, match=needs), pytest.raises(KeyboardInterrupt):
        score_buffer_ray(
            write(tmp_path / "rows", 300),
            Fatal(),
            num_workers=1,
            resources={"num_gpus": 7},
            progress=False,
        )


def test_wrong_arguments_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="num_workers must be an int of at least 1"):
        score_buffer_ray(tmp_path, Fatal(), num_workers=0)
    with pytest.raises(TypeError, match="leave out shard"):
        score_buffer_ray(tmp_path, Fatal(), num_workers=1, shard=(0, 1))
    with pytest.raises(FileNotFoundError):
        score_buffer_ray(tmp_path / "missing", Fatal(), num_workers=1)
