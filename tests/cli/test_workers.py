"""``caiac score`` in several processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import Caiac
from tests.cli.test_score import SCORE, contents


def test_workers_write_what_one_process_writes(caiac: Caiac, scored: Path) -> None:
    result = caiac(*SCORE[:-1], "two", "--workers", "2")
    assert result.code == 0, result.err
    assert contents(Path("two")) == contents(scored)
    assert caiac(*SCORE[:-1], "two").code == 0  # and nothing is left to do


def torchrun(*arguments: str, ranks: int) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).parents[2]
    return subprocess.run(
        [
            *(sys.executable, "-m", "torch.distributed.run", "--standalone"),
            *(f"--nproc-per-node={ranks}", "-m", "torchrl_caiac", *arguments),
        ],
        env={**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_torchrun_writes_what_one_process_writes(caiac: Caiac, scored: Path) -> None:
    result = torchrun(*SCORE[:-1], "two", ranks=2)
    assert result.returncode == 0, result.stderr
    assert contents(Path("two")) == contents(scored)
    assert result.stdout.count("written to two") == 1


def test_a_failure_of_rank_0_ends_all_ranks(caiac: Caiac, scored: Path) -> None:
    before = contents(scored)
    result = torchrun(*SCORE, "--lookahead", "5", ranks=2)
    assert result.returncode != 0
    assert "lookahead was 1, is 5" in result.stderr
    assert contents(scored) == before


@pytest.mark.parametrize("workers", ["0", "-1"])
def test_rejects_bad_numbers(caiac: Caiac, pushes: Path, workers: str) -> None:
    result = caiac(*SCORE, "--workers", workers)
    assert result.code == 2 and "--workers must be at least 1" in result.error


def test_torchrun_has_its_own_processes(
    caiac: Caiac, pushes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    variables = {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0"}
    address = {"MASTER_ADDR": "localhost", "MASTER_PORT": "29500"}
    for name, value in {**variables, **address}.items():
        monkeypatch.setenv(name, value)
    result = caiac(*SCORE, "--workers", "2")
    assert result.code == 2 and "leave it out" in result.error
    monkeypatch.setenv("RANK", "first")
    result = caiac(*SCORE)
    assert result.code == 2 and "expected the integers of torchrun" in result.error
