from __future__ import annotations

import importlib
import json
import os
import random
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from torchrl.checkpoint import Checkpoint

from torchrl_caiac.experiments import (
    TrainingCheckpoint,
    bar_position,
    claim_folder,
    keep_settings,
    run_side_by_side,
    whole_file,
    write_json,
)


class TestWholeFile:
    def test_takes_its_place_at_the_end(self, tmp_path):
        path = tmp_path / "new" / "folder" / "figure.png"
        with whole_file(path) as partial:
            assert partial.suffix == ".png"
            partial.write_text("first")
            assert not path.exists()
        assert path.read_text() == "first"
        with whole_file(str(path)) as partial:
            partial.write_text("second")
            assert path.read_text() == "first"
        assert path.read_text() == "second"
        assert list(path.parent.iterdir()) == [path]

    def test_errors_leave_the_old_file(self, tmp_path):
        path = tmp_path / "table.txt"
        path.write_text("old")
        with pytest.raises(KeyboardInterrupt), whole_file(path) as partial:
            partial.write_text("ne")
            raise KeyboardInterrupt
        with pytest.raises(FileNotFoundError), whole_file(path):
            pass  # nothing is written
        assert path.read_text() == "old"
        assert list(tmp_path.iterdir()) == [path]


class TestWriteJson:
    def test_what_settings_are_made_of(self, tmp_path):
        value = {
            "hydra": OmegaConf.create({"a": [1, {"b": None}], "c": "${hydra.c}"}),
            "pair": (1.5, "x"),
            3: True,
        }
        value["hydra"].c = "text"
        write_json(tmp_path / "a.json", value)
        assert json.loads((tmp_path / "a.json").read_text()) == {
            "hydra": {"a": [1, {"b": None}], "c": "text"},
            "pair": [1.5, "x"],
            "3": True,
        }

    def test_errors_leave_the_old_file(self, tmp_path):
        write_json(tmp_path / "a.json", [1])
        with pytest.raises(TypeError, match="not JSON serializable"):
            write_json(tmp_path / "a.json", {"a": object()})
        assert json.loads((tmp_path / "a.json").read_text()) == [1]
        assert len(list(tmp_path.iterdir())) == 1


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.sampled_from([0.5, 1.0, "a", ""]),
    lambda x: st.lists(x, max_size=2) | st.dictionaries(st.sampled_from("ab"), x),
    max_leaves=4,
)
mappings = st.dictionaries(st.sampled_from("abc"), values, max_size=3)


class TestKeepSettings:
    @settings(max_examples=60, deadline=None)
    @given(mappings, mappings)
    def test_only_the_same_again(self, first, second):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "settings.json"
            keep_settings(first, path)
            keep_settings(OmegaConf.create(first), path)
            kept = path.read_bytes()
            if first == second:
                keep_settings(second, path)
            else:
                names = [
                    k
                    for k in sorted({*first, *second})
                    if k not in first or k not in second or first[k] != second[k]
                ]
                with pytest.raises(ValueError) as error:
                    keep_settings(second, path)
                assert f"({names} differ)" in str(error.value)
            assert path.read_bytes() == kept

    def test_tuples_are_lists(self, tmp_path):
        keep_settings({"sizes": (3, 4)}, tmp_path / "new" / "a.json")
        keep_settings({"sizes": [3, 4]}, tmp_path / "new" / "a.json")
        with pytest.raises(ValueError, match=r"new holds results of other settings"):
            keep_settings({"sizes": [4, 3]}, tmp_path / "new" / "a.json")

    def test_foreign_files(self, tmp_path):
        path = tmp_path / "a.json"
        path.write_text("[1, 2]")
        with pytest.raises(ValueError, match=r"\(all differ\)"):
            keep_settings({"a": 1}, path)
        write_json(path, {"a": 1})
        for content in (path.read_bytes()[:-4], b"", b"\xff\xfe"):
            path.write_bytes(content)
            with pytest.raises(ValueError, match=r"a\.json holds no settings"):
                keep_settings({"a": 1}, path)
            assert path.read_bytes() == content


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


def test_a_folder_is_claimed_once(tmp_path):
    folder = tmp_path / "new" / "folder"
    for _ in range(2):
        with claim_folder(folder):
            with (
                pytest.raises(RuntimeError, match=r"another process works in.*folder"),
                claim_folder(folder),
            ):
                pass
            with claim_folder(folder / "inner"):
                pass
    with pytest.raises(KeyError), claim_folder(folder):
        raise KeyError
    with claim_folder(folder):
        pass


# What other processes import: they cannot import this file.
JOBS = '''
import os
import time
from pathlib import Path

import numpy as np
import torch

from torchrl_caiac import EntityLayout
from torchrl_caiac.experiments import bar_position, claim_folder, run_side_by_side
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
    next(run_side_by_side(asks_endlessly, [()], processes=1))
'''


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    (tmp_path / "jobs_of_test_experiments.py").write_text(JOBS)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("jobs_of_test_experiments")
    del sys.modules["jobs_of_test_experiments"]


class TestSideBySide:
    def test_a_job_leaves_its_threads_to_no_other(self, jobs, monkeypatch):
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
        # A worker that is given four threads by one job has one in the next.
        calls = [(torch.set_num_threads, 4), (torch.get_num_threads,)]
        found = dict(run_side_by_side(jobs.calls, calls, processes=1))
        assert found[1] == 1

    def test_in_order_of_finishing_one_thread_each(self, jobs, tmp_path, monkeypatch):
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
        folder = tmp_path / "finished"
        folder.mkdir()
        afters = [2, 0, 1]  # job 2 begins where job 1 has finished
        results = list(
            run_side_by_side(
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
        runs = run_side_by_side(
            jobs.divides, [(tmp_path, *pair) for pair in pairs], processes=1
        )
        assert next(runs) == (0, 2.0)
        with pytest.raises(ZeroDivisionError):
            next(runs)
        begun = {path.name for path in tmp_path.glob("* by *")}
        assert begun == {"4 by 2", "1 by 0"}

    def test_bad_input(self):
        with pytest.raises(ValueError, match="at least 1"):
            next(run_side_by_side(print, [()], processes=0))
        assert list(run_side_by_side(print, [])) == []

    @pytest.mark.slow
    def test_processes_end_with_a_killed_parent(self, jobs, tmp_path):
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
            parent.kill()
            parent.wait()
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
