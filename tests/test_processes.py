from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import time
import traceback
from functools import partial

import pytest
import torch

from torchrl_caiac._files import claim_folder
from torchrl_caiac._processes import bar_position, run_in_processes

# What other processes import: they cannot import this file.
JOBS = '''
import os
import time
from pathlib import Path

import numpy as np
import torch

from torchrl_caiac import EntityLayout
from torchrl_caiac._files import claim_folder
from torchrl_caiac._processes import bar_position, run_in_processes
from torchrl_caiac.influence import true_influence


def calls(function, *args):
    return function(*args)


def looks_around(folder, number, after):
    """Finishes when another job has begun."""
    (folder / str(number)).touch()
    end = time.monotonic() + 600
    while not (folder / str(after)).exists():
        if time.monotonic() > end:
            raise TimeoutError(f"{after} has not begun")
        time.sleep(0.01)
    return os.getpid(), torch.get_num_threads(), bar_position()


def divides(folder, a, b):
    (folder / f"{a} by {b}").touch()
    return a / b


class Tool:
    """What each process makes once; tells on disk that it was closed."""

    def __init__(self, folder, works=True):
        if not works:
            raise FileNotFoundError("no tool")
        self.folder = folder
        self.used = 0

    def close(self):
        (self.folder / f"closed {os.getpid()}").touch()


def uses(tool, number):
    tool.used += 1
    return number, os.getpid(), tool.used


def makes_a_function():
    return lambda: 1


def dies():
    os._exit(7)


class TwoArguments(Exception):
    """Cannot be unpickled: pickle calls it with one argument."""

    def __init__(self, what, why):
        super().__init__(f"{what}: {why}")


def fails(kind, *args):
    raise kind(*args)


class Endless:
    """A simulator that never answers; its process claims a folder."""

    layout = EntityLayout({"cup": [0]})

    class action_space:
        low, high = np.array([-1.0]), np.array([1.0])

    def __init__(self):
        self.folder = Path(os.environ["CLAIMS"])
        self.claim = claim_folder(self.folder / str(os.getpid()))
        self.claim.__enter__()

    def outcomes(self, state, actions, *, horizon=1):
        (self.folder / "busy").touch()
        time.sleep(600)


def asks_endlessly():
    true_influence(Endless, [[0.0]], num_workers=1, progress=False)


if __name__ == "__main__":
    next(run_in_processes(asks_endlessly, [()], processes=1))
'''


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    (tmp_path / "jobs_of_test_processes.py").write_text(JOBS)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("jobs_of_test_processes")
    del sys.modules["jobs_of_test_processes"]


class TestRunInProcesses:
    def test_a_job_leaves_its_threads_to_no_other(self, jobs, monkeypatch):
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
        # A worker that is given four threads by one job has one in the next.
        calls = [(torch.set_num_threads, 4), (torch.get_num_threads,)]
        found = dict(run_in_processes(jobs.calls, calls, processes=1))
        assert found[1] == 1

    def test_in_order_of_finishing_one_thread_each(self, jobs, tmp_path, monkeypatch):
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
        folder = tmp_path / "finished"
        folder.mkdir()
        afters = [2, 0, 1]  # job 2 begins where job 1 has finished
        results = list(
            run_in_processes(
                jobs.looks_around,
                ((folder, number, after) for number, after in enumerate(afters)),
            )
        )
        assert results[0][0] == 1
        assert sorted(number for number, _ in results) == [0, 1, 2]
        pids, threads, positions = zip(*(found for _, found in results), strict=True)
        assert threads == (1, 1, 1)
        assert os.getpid() not in pids
        assert len(set(pids)) == 2
        assert len(set(zip(pids, positions, strict=True))) == 2
        assert set(positions) == {0, 1}
        assert bar_position() == 0

    def test_an_error_stops_what_has_not_begun(self, jobs, tmp_path):
        pairs = [(4, 2), (1, 0), (3, 1), (5, 1)]
        runs = run_in_processes(
            jobs.divides, [(tmp_path, *pair) for pair in pairs], processes=1
        )
        assert next(runs) == (0, 2.0)
        with pytest.raises(ZeroDivisionError) as caught:
            next(runs)
        # With the traceback of the process.
        assert "in divides" in "".join(traceback.format_exception(caught.value))
        begun = {path.name for path in tmp_path.glob("* by *")}
        assert begun == {"4 by 2", "1 by 0"}

    @pytest.mark.parametrize("processes", [0, 2])
    def test_each_process_is_set_up_once_and_closes_what_it_made(
        self, jobs, tmp_path, processes
    ):
        setup = partial(jobs.Tool, tmp_path)
        done = dict(
            run_in_processes(
                jobs.uses, [(n,) for n in range(6)], processes=processes, setup=setup
            )
        )
        assert [done[n][0] for n in range(6)] == list(range(6))
        pids = {pid for _, pid, _ in done.values()}
        for pid in pids:
            counts = sorted(used for _, p, used in done.values() if p == pid)
            assert counts == list(range(1, len(counts) + 1))
        assert {p.name for p in tmp_path.glob("closed *")} >= {
            f"closed {pid}" for pid in pids
        }
        assert (os.getpid() in pids) == (processes == 0)

    def test_without_jobs_nothing_is_set_up(self, jobs):
        setup = partial(jobs.fails, ValueError)
        assert list(run_in_processes(jobs.uses, [], processes=0, setup=setup)) == []

    def test_errors_that_cannot_be_pickled_are_described(self, jobs):
        runs = run_in_processes(
            jobs.fails, [(jobs.TwoArguments, "sand", "wet")], processes=1
        )
        with pytest.raises(RuntimeError, match="TwoArguments: sand: wet") as caught:
            next(runs)
        assert "in fails" in "".join(traceback.format_exception(caught.value))

    @pytest.mark.parametrize("processes", [0, 1])
    def test_a_job_that_exits_ends_nothing_but_itself(self, jobs, processes):
        calls = [(sorted, "ba"), (sys.exit, 3)]
        runs = run_in_processes(jobs.calls, calls, processes=processes)
        assert next(runs) == (0, ["a", "b"])
        with pytest.raises(RuntimeError, match=r"job 1 called sys\.exit\(3\)"):
            next(runs)
        setup = partial(sys.exit, "no licence")
        with pytest.raises(
            RuntimeError, match=r"setup called sys\.exit\('no licence'\)"
        ):
            list(run_in_processes(jobs.uses, [(0,)], processes=processes, setup=setup))

    def test_what_cannot_be_pickled_names_the_job(self, jobs):
        calls = [(sorted, "ba"), (jobs.makes_a_function,)]
        runs = run_in_processes(jobs.calls, calls, processes=1)
        assert next(runs) == (0, ["a", "b"])
        with pytest.raises(
            RuntimeError, match=r"job 1 returned a function that cannot"
        ):
            next(runs)
        calls[1] = (lambda: 1,)
        with pytest.raises(TypeError, match=r"job 1 cannot be sent to a process"):
            list(run_in_processes(jobs.calls, calls, processes=1))

    def test_tensors_come_back(self, jobs):
        values = dict(run_in_processes(jobs.calls, [(torch.arange, 5)], processes=1))
        assert values[0].tolist() == [0, 1, 2, 3, 4]

    @pytest.mark.parametrize("processes", [0, 1])
    def test_errors_of_set_up_are_raised(self, jobs, tmp_path, processes):
        setup = partial(jobs.Tool, tmp_path, works=False)
        with pytest.raises(FileNotFoundError, match="no tool") as caught:
            list(run_in_processes(jobs.uses, [(0,)], processes=processes, setup=setup))
        assert "in __init__" in "".join(traceback.format_exception(caught.value))

    def test_a_process_that_dies_is_noticed(self, jobs):
        with pytest.raises(RuntimeError, match="ended in the middle of a job"):
            list(run_in_processes(jobs.dies, [()], processes=1))

    def test_bad_input(self):
        with pytest.raises(ValueError, match="at least 0"):
            next(run_in_processes(print, [()], processes=-1))
        assert list(run_in_processes(print, [])) == []

    @pytest.mark.slow
    @pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
    def test_processes_end_with_a_killed_parent(self, number, jobs, tmp_path):
        claims = tmp_path / "claims"
        claims.mkdir()
        parent = subprocess.Popen(
            [sys.executable, jobs.__file__], env={**os.environ, "CLAIMS": str(claims)}
        )
        end = time.monotonic() + 600
        try:
            while not (claims / "busy").exists():
                assert parent.poll() is None and time.monotonic() < end
                time.sleep(0.05)
        finally:
            parent.send_signal(number)  # a job would take 600 s
            assert parent.wait(300)
        # Of the process that asks, and of the one that it has started in turn.
        folders = [path for path in claims.iterdir() if path.is_dir()]
        assert len(folders) == 2
        while folders:
            try:
                with claim_folder(folders[-1]):
                    folders.pop()
            except RuntimeError:
                assert time.monotonic() < end
                time.sleep(0.05)
