"""Tests of checkpoints: exact resume, whole files, refusals."""

from __future__ import annotations

import os
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.checkpoint import Checkpoint

from torchrl_caiac.checkpoint import TrainingCheckpoint


class Run:
    """A training that draws from all three generators."""

    def __init__(self, path: Path, seed: int) -> None:
        torch.manual_seed(seed)
        np.random.seed(seed)
        random.seed(seed)
        self.model = torch.nn.Sequential(
            torch.nn.Linear(3, 8), torch.nn.BatchNorm1d(8), torch.nn.Linear(8, 1)
        )
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=0.1)
        self.scheduler = torch.optim.lr_scheduler.StepLR(self.optimizer, 2, gamma=0.5)
        self.checkpoint = TrainingCheckpoint(
            path,
            model=self.model,
            optimizer=self.optimizer,
            scheduler=self.scheduler,
        )

    def step(self) -> None:
        noise = np.random.standard_normal(1).astype(np.float32)
        loss = self.model(torch.randn(4, 3) + torch.from_numpy(noise))
        self.optimizer.zero_grad()
        (random.random() * loss.square().mean()).backward()
        self.optimizer.step()
        self.scheduler.step()

    def parameters(self) -> list[torch.Tensor]:
        return [value.clone() for value in self.model.state_dict().values()]


class TestTrainingCheckpoint:
    def test_goes_on_as_if_never_stopped(self, tmp_path):
        path = tmp_path / "run" / "checkpoint.zip"
        run = Run(path, seed=1)
        assert run.checkpoint.load() == 0
        for step in range(1, 8):
            run.step()
            if step == 3:
                run.checkpoint.save(step)
        kept = path.read_bytes()
        for _ in range(2):  # going on must not write into the file
            other = Run(path, seed=2)
            assert other.checkpoint.load() == 3
            for _ in range(3, 7):
                other.step()
            for mine, expected in zip(
                other.parameters(), run.parameters(), strict=True
            ):
                assert torch.equal(mine, expected)
            assert other.scheduler.get_last_lr() == run.scheduler.get_last_lr()
            assert path.read_bytes() == kept

    def test_without_a_file_nothing_changes(self, tmp_path):
        run = Run(tmp_path / "checkpoint.zip", seed=1)
        before, state = run.parameters(), torch.get_rng_state()
        assert run.checkpoint.load() == 0
        assert torch.equal(torch.get_rng_state(), state)
        assert all(map(torch.equal, before, run.parameters()))

    def test_there_is_a_whole_file_at_any_time(self, tmp_path, monkeypatch):
        path = tmp_path / "checkpoint.zip"
        run = Run(path, seed=1)
        run.checkpoint.save(1)
        replace, seen = os.replace, []

        def watched(*args, **kwargs):
            replace(*args, **kwargs)
            seen.append(zipfile.is_zipfile(path))

        monkeypatch.setattr(os, "replace", watched)
        run.checkpoint.save(2)
        assert len(seen) >= 1 and all(seen)
        assert run.checkpoint.load() == 2
        monkeypatch.setattr(run.model, "state_dict", lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run.checkpoint.save(3)
        monkeypatch.undo()
        assert run.checkpoint.load() == 2
        assert list(tmp_path.iterdir()) == [path]

    @pytest.mark.parametrize(
        "spoil",
        [
            lambda path: path.write_bytes(b""),
            lambda path: path.write_bytes(b"something else"),
            lambda path: path.write_bytes(path.read_bytes()[:-30]),
            lambda path: torch.save({"step": 1}, path),
            lambda path: Checkpoint(format="archive", step=1).save(path),
            lambda path: TrainingCheckpoint(path, other=torch.nn.Linear(1, 1)).save(1),
            lambda path: TrainingCheckpoint(
                path,
                model=torch.nn.Linear(1, 1),
                optimizer=torch.optim.Adam([torch.zeros(1)]),
                scheduler=torch.nn.Linear(1, 1),
            ).save(1),
        ],
        ids=["empty", "text", "truncated", "torch", "archive", "parts", "sizes"],
    )
    def test_what_is_no_checkpoint_of_it(self, spoil, tmp_path):
        path = tmp_path / "checkpoint.zip"
        run = Run(path, seed=1)
        run.checkpoint.save(5)
        spoil(path)
        content = path.read_bytes()
        with pytest.raises(ValueError, match=r"(?s)no readable checkpoint.*delete it"):
            run.checkpoint.load()
        assert path.read_bytes() == content

    def test_flipped_bytes_are_noticed(self, tmp_path):
        path = tmp_path / "checkpoint.zip"
        run = Run(path, seed=1)
        run.checkpoint.save(5)
        content = bytearray(path.read_bytes())
        with zipfile.ZipFile(path) as archive:
            largest = max(archive.infolist(), key=lambda info: info.file_size)
        content[largest.header_offset + largest.file_size // 2] ^= 0xFF
        path.write_bytes(content)
        with pytest.raises(ValueError, match="no readable checkpoint"):
            run.checkpoint.load()
