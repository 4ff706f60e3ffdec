"""``caiac score`` in several processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import Caiac
from tests.cli.test_score import SCORE, contents
from tests.pushes import LAYOUT, push_transitions
from torchrl_caiac.data import write_transitions

# The command line, whose first process kills itself when there are scores.
FATAL = """
import os
import signal
import sys
import time
from pathlib import Path

from torchrl_caiac.cli import main
from torchrl_caiac.influence import MotionInfluence

original, note = MotionInfluence.forward, Path(os.environ["NOTE"])


def fatal(self, td):
    if any(Path("two").rglob("*.npz")):
        if os.environ.get("RANK", "0") != "0":
            time.sleep(600)  # until it is ended
        try:
            note.touch(exist_ok=False)
        except FileExistsError:
            pass
        else:
            os.kill(os.getpid(), signal.SIGKILL)
    return original(self, td)


MotionInfluence.forward = fatal
if __name__ == "__main__":
    sys.exit(main())
"""
MODULE = ("-m", "torchrl_caiac")


def test_workers_write_what_one_process_writes(caiac: Caiac, scored: Path) -> None:
    result = caiac(*SCORE[:-1], "two", "--workers", "2")
    assert result.code == 0, result.err
    assert contents(Path("two")) == contents(scored)
    assert caiac(*SCORE[:-1], "two").code == 0  # and nothing is left to do


def python(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    paths = {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, **paths, **variables},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def torchrun(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    options = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")
    return python(*options, *arguments, **variables)


def test_torchrun_writes_what_one_process_writes(caiac: Caiac, scored: Path) -> None:
    result = torchrun(*MODULE, *SCORE[:-1], "two")
    assert result.returncode == 0, result.stderr
    assert contents(Path("two")) == contents(scored)
    assert result.stdout.count("written to two") == 1


def test_a_failure_of_rank_0_ends_all_ranks(caiac: Caiac, scored: Path) -> None:
    before = contents(scored)
    result = torchrun(*MODULE, *SCORE, "--lookahead", "5")
    assert result.returncode != 0
    assert "lookahead was 1, is 5" in result.stderr
    assert contents(scored) == before


@pytest.mark.slow
def test_a_repeated_call_goes_on_after_processes_were_killed(caiac: Caiac) -> None:
    rows = push_transitions((40, 30, 50) * 120)  # several ranges of 4096
    write_transitions(rows, "pushes", action_bounds=([-1], [1]))
    LAYOUT.save("layout.json")
    Path("fatal.py").write_text(FATAL)
    assert caiac(*SCORE[:-1], "one").code == 0
    command = ("fatal.py", *SCORE[:-1], "two")
    record = Path("two/data/caiac.score.json")

    result = torchrun(*command, NOTE="rank")
    assert result.returncode and Path("rank").exists(), result.stderr
    assert json.loads(record.read_text())["state"] == "scoring"
    assert [*Path("two").rglob("*.npz")]

    result = python(*command, "--workers", "2", NOTE="worker")
    assert Path("worker").exists()
    assert result.returncode == 1 and not result.stdout
    assert "two/data was killed" in result.stderr
    assert "repeat the same call" in result.stderr
    assert "Traceback" not in result.stderr

    # The other process may have scored the rest by now, or not.
    assert caiac(*SCORE[:-1], "two").code == 0
    assert contents(Path("two")) == contents(Path("one"))


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
