"""Tests of fitting a world model in two processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.test_fit import fit, make, world

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What two processes wrote."""
    path = tmp_path_factory.mktemp("ranks")
    command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [sys.executable, *command, "-m", "tests.fit_on_ranks", str(path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return path


def load(path: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = torch.load(path)
    return found


def test_all_processes_end_with_one_model_and_resume(folder: Path) -> None:
    first = load(folder / "whole-0.pt")
    for name in ("whole-1", "parts-0", "parts-1"):
        found = load(folder / f"{name}.pt")
        torch.testing.assert_close(found, first, rtol=0, atol=0, equal_nan=True)


def test_two_processes_learn_as_much_as_one(folder: Path) -> None:
    weights, _, table = load(folder / "whole-0.pt")
    alone = make()
    known = fit(alone, world(), steps=40, batch_size=32)["validation_nll"]
    assert abs(float(table["validation_nll"][-1]) - float(known[-1])) < 0.3
    assert float(table["validation_nll"][-1]) < float(known[0])
    own = dict(alone.named_parameters())
    assert any(not torch.equal(weights[name], own[name]) for name in own)


@pytest.mark.parametrize("what", ["data", "settings"])
def test_processes_that_differ_are_refused(folder: Path, what: str) -> None:
    for rank in range(2):
        message = (folder / f"{what}-{rank}.txt").read_text()
        assert "rank [1] have other settings or data than that of rank 0" in message


def test_without_a_group() -> None:
    with pytest.raises(RuntimeError, match="in no process group: call"):
        fit(make(), world(), distributed=True)
