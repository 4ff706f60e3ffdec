"""Tests of checkpoints: exact resume, whole files, refusals."""

from __future__ import annotations

import copy
import json
import os
import pickle
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tensordict
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

from tests.killing import run_killed
from tests.mutations import mutate_file
from torchrl_caiac._kernels import onednn_has_float32
from torchrl_caiac.checkpoint import TrainingCheckpoint
from torchrl_caiac.data import UnreadableFileError
from torchrl_caiac.modules import linear_kernel
from torchrl_caiac.modules.linear import linear


class Run:
    """A training that draws from all three generators."""

    def __init__(self, path: Path, seed: int, **kwargs) -> None:
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
            **kwargs,
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

    def everything(self) -> str:
        """All that a checkpoint may change, as a text to compare."""
        parts = (self.model, self.optimizer, self.scheduler)
        states = [copy.deepcopy(part.state_dict()) for part in parts]
        generators = (
            torch.get_rng_state().tolist(),
            np.random.get_state()[1].tolist(),
            random.getstate(),
        )
        return repr((states, generators))


class TestTrainingCheckpoint:
    def test_resumes_as_if_never_interrupted(self, tmp_path):
        path = tmp_path / "run" / "checkpoint.zip"
        run = Run(path, seed=1)
        assert run.checkpoint.load() == 0
        for step in range(1, 8):
            run.step()
            if step == 3:
                run.checkpoint.save(step)
        kept = path.read_bytes()
        for _ in range(2):  # a resumed run must not write into the file
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

    def test_leftovers_of_interrupted_writes_are_removed(self, tmp_path):
        run = Run(tmp_path / "checkpoint.zip", seed=1)
        run.checkpoint.save(1)

        def save(**_):
            checkpoint_save = Checkpoint.save

            def killed(self, *args, **kwargs):
                checkpoint_save(self, *args, **kwargs)
                os.kill(os.getpid(), 9)

            Checkpoint.save = killed
            run.checkpoint.save(2)
            yield

        run_killed(save)
        assert len(list(tmp_path.iterdir())) == 2
        others = {".partial-12-other-checkpoint.zip", "a.partial-12-checkpoint.zip"}
        for name in others:
            (tmp_path / name).touch()
        assert run.checkpoint.load() == 1
        assert {p.name for p in tmp_path.iterdir()} == {"checkpoint.zip", *others}

    def test_runs_that_do_the_same_write_the_same_bytes(self, tmp_path):
        for name in ("one.zip", "other.zip"):
            run = Run(tmp_path / name, seed=1, settings={"lr": 0.1})
            run.step()
            run.checkpoint.save(1)
        contents = [(tmp_path / n).read_bytes() for n in ("one.zip", "other.zip")]
        assert contents[0] == contents[1]
        with zipfile.ZipFile(tmp_path / "one.zip") as archive:
            assert {info.date_time[0] for info in archive.infolist()} == {1980}
        # It is an archive that TorchRL reads.
        assert Checkpoint.manifest(tmp_path / "one.zip")["metadata"]["step"] == 1

    def test_a_read_only_folder_is_read(self, tmp_path, read_only):
        path = tmp_path / "run" / "checkpoint.zip"
        Run(path, seed=1).checkpoint.save(3)
        read_only(path.parent)
        assert Run(path, seed=2).checkpoint.load() == 3

    def test_a_compressed_file_is_refused(self, tmp_path):
        path = tmp_path / "checkpoint.zip"
        run = Run(path, seed=1)
        run.checkpoint.save(1)
        with (
            zipfile.ZipFile(path) as source,
            zipfile.ZipFile(tmp_path / "bomb", "w", zipfile.ZIP_DEFLATED) as target,
        ):
            for info in source.infolist():
                target.writestr(info.filename, source.read(info))
        os.replace(tmp_path / "bomb", path)
        with pytest.raises(UnreadableFileError, match=r"manifest\.json.* compressed"):
            run.checkpoint.load()

    @settings(max_examples=150)
    @given(st.randoms(use_true_random=False))
    def test_a_damaged_file_changes_nothing(self, tmp_path_factory, rng):
        path = tmp_path_factory.mktemp("damaged") / "checkpoint.zip"
        saved = Run(path, seed=1)
        saved.step()
        saved.checkpoint.save(1)
        mutate_file(path, rng)
        run = Run(path, seed=2)
        before = run.everything()
        try:
            step = run.checkpoint.load()
        except UnreadableFileError as error:
            assert str(path) in str(error)
            assert run.everything() == before
        else:
            assert step == int(path.exists())

    def test_parts_are_restored_even_if_one_cannot_be(self, tmp_path, monkeypatch):
        path = tmp_path / "checkpoint.zip"
        saved = Run(path, seed=1)
        saved.step()
        saved.checkpoint.save(1)
        run = Run(path, seed=2)
        before = repr(copy.deepcopy(run.model.state_dict()))

        def refuse(state):
            raise RuntimeError("never again")

        monkeypatch.setattr(run.scheduler, "load_state_dict", refuse)
        with pytest.raises(UnreadableFileError, match="never again"):
            run.checkpoint.load()
        assert repr(run.model.state_dict()) == before
        assert not run.optimizer.state_dict()["state"]

    def test_without_generators(self, tmp_path):
        run = Run(tmp_path / "checkpoint.zip", seed=1, rng=False)
        run.checkpoint.save(1)
        torch.manual_seed(5)
        state = torch.get_rng_state()
        assert run.checkpoint.load() == 1
        assert torch.equal(torch.get_rng_state(), state)
        with pytest.raises(ValueError, match=r"expected the parts .*'rng'.*, got"):
            Run(tmp_path / "checkpoint.zip", seed=1).checkpoint.load()

    def test_settings_are_compared_first(self, tmp_path):
        path = tmp_path / "checkpoint.zip"
        settings = {"lr": 0.1, "model": {"sizes": (3, 4), "depth": 2}, "old": None}
        run = Run(path, seed=1, settings=settings)
        run.step()
        run.checkpoint.save(5)
        same = {**settings, "model": {"sizes": [3, 4], "depth": 2}}
        assert Run(path, seed=2, settings=same).checkpoint.load() == 5
        content = path.read_bytes()
        other = {"lr": 0.2, "model": {"sizes": [3], "depth": 2}, "new": 1}
        run = Run(path, seed=2, settings=other)
        before = run.everything()
        with pytest.raises(ValueError) as error:
            run.checkpoint.load()
        assert str(path) in str(error.value)
        assert (
            "other settings (lr: saved 0.1, given 0.2; model.sizes: saved [3, 4], "
            "given [3]; new is new; old is missing): repeat"
        ) in str(error.value)
        assert run.everything() == before and path.read_bytes() == content

    def test_more_steps_than_requested(self, tmp_path):
        run = Run(tmp_path / "checkpoint.zip", seed=1)
        run.checkpoint.save(5)
        run.step()
        before = run.everything()
        with pytest.raises(ValueError, match=r"\.zip has 5 steps.*requested 4"):
            run.checkpoint.load(max_step=4)
        assert run.everything() == before
        assert run.checkpoint.load(max_step=5) == 5

    @pytest.mark.parametrize("part", ["model", "optimizer", "scheduler"])
    def test_a_part_that_refuses_its_state_changes_nothing(
        self, part, tmp_path, monkeypatch
    ):
        path = tmp_path / "checkpoint.zip"
        saved = Run(path, seed=1)
        saved.step()
        saved.checkpoint.save(1)
        run = Run(path, seed=2)
        kind = type(getattr(run, part))
        load_state_dict, calls = kind.load_state_dict, []

        def refuse(self, state):
            load_state_dict(self, state)
            calls.append(state)
            if len(calls) == 1:
                raise RuntimeError("other sizes")

        before = run.everything()
        monkeypatch.setattr(kind, "load_state_dict", refuse)
        with pytest.raises(ValueError, match=r"not a readable checkpoint.*other sizes"):
            run.checkpoint.load()
        assert len(calls) == 2 and run.everything() == before

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
    def test_what_is_not_a_checkpoint_of_the_run(self, spoil, tmp_path):
        path = tmp_path / "checkpoint.zip"
        run = Run(path, seed=1)
        run.checkpoint.save(5)
        spoil(path)
        content, before = path.read_bytes(), run.everything()
        message = r"(?s)checkpoint\.zip is not a readable checkpoint.*delete it"
        with pytest.raises(ValueError, match=message):
            run.checkpoint.load()
        assert path.read_bytes() == content and run.everything() == before

    def test_a_folder_is_not_a_checkpoint(self, tmp_path):
        run = Run(tmp_path / "folder", seed=1)
        Checkpoint(model=run.model).save(tmp_path / "folder")
        with pytest.raises(ValueError, match=r"not a readable checkpoint.*not a file"):
            run.checkpoint.load()

    def test_flipped_bytes_are_noticed(self, tmp_path):
        path = tmp_path / "checkpoint.zip"
        run = Run(path, seed=1)
        run.checkpoint.save(5)
        content = bytearray(path.read_bytes())
        with zipfile.ZipFile(path) as archive:
            largest = max(archive.infolist(), key=lambda info: info.file_size)
        content[largest.header_offset + largest.file_size // 2] ^= 0xFF
        path.write_bytes(content)
        with pytest.raises(ValueError, match="not a readable checkpoint"):
            run.checkpoint.load()


class Malicious:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def plain_pickle(state: Path, evil: Malicious) -> None:
    (state / "state.pt").write_bytes(pickle.dumps(evil))


def torch_file(state: Path, evil: Malicious) -> None:
    torch.save({"weight": evil}, state / "state.pt")


def memory_mapped(state: Path, evil: Malicious) -> None:
    td = TensorDict({"weight": torch.ones(1)}, [])
    td.set_non_tensor("evil", evil)
    tensordict.save(td, state / "state")
    (state / "state.pt").unlink()
    (state / "state.json").write_text('{"kind": "dict", "items": []}')


@pytest.mark.parametrize("plant", [plain_pickle, torch_file, memory_mapped])
def test_loading_executes_no_code_from_the_file(plant, tmp_path, monkeypatch):
    marker, path = tmp_path / "marker", tmp_path / "checkpoint.zip"
    model = torch.nn.Linear(1, 1)
    checkpoint = TrainingCheckpoint(path, model=model)
    save = StateDictCheckpointAdapter.save

    def planting(self, component, path, **kwargs):
        save(self, component, path, **kwargs)
        if component is model:
            plant(path, Malicious(marker))

    with monkeypatch.context() as patch:
        patch.setattr(StateDictCheckpointAdapter, "save", planting)
        checkpoint.save(1)
    before = copy.deepcopy(model.state_dict())
    with pytest.raises(ValueError, match="not a readable checkpoint"):
        checkpoint.load()
    assert not marker.exists()
    assert all(map(torch.equal, model.state_dict().values(), before.values()))
    # The payload is live: it runs where pickles are trusted.
    theirs = Checkpoint(format="archive").register("model", torch.nn.Linear(1, 1))
    with pytest.raises(RuntimeError):
        theirs.load(path, tensor_load_kwargs={"weights_only": False})
    assert marker.is_dir()


def test_a_file_cannot_choose_another_adapter(tmp_path):
    path, other = tmp_path / "checkpoint.zip", tmp_path / "other.zip"
    checkpoint = TrainingCheckpoint(path, model=torch.nn.Linear(1, 1))
    checkpoint.save(1)
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(other, "w") as target:
        for info in source.infolist():
            content = source.read(info)
            if info.filename == "manifest.json":
                content = content.replace(b"torchrl.state_dict", b"torchrl.dump_load")
            target.writestr(info, content)
    os.replace(other, path)
    with pytest.raises(ValueError, match=r"manifest adapter is 'torchrl\.dump_load'"):
        checkpoint.load()


class Wide:
    """A training whose products depend on the kernel."""

    def __init__(self, path: Path) -> None:
        generator = torch.Generator().manual_seed(0)
        self.rows = torch.randn(64, 256, generator=generator)
        self.model = torch.nn.Linear(256, 256)
        with torch.no_grad():
            self.model.weight.normal_(generator=generator)
            self.model.bias.zero_()
        self.optimizer = torch.optim.SGD(self.model.parameters(), lr=0.01)
        self.checkpoint = TrainingCheckpoint(
            path, rng=False, model=self.model, optimizer=self.optimizer
        )

    def steps(self, first: int, last: int) -> torch.Tensor:
        for _ in range(first, last):
            out = linear(self.rows, self.model.weight, self.model.bias, relu=True)
            self.optimizer.zero_grad()
            out.square().mean().backward()
            self.optimizer.step()
        return self.model.weight.detach().clone()


@pytest.fixture
def of_kernels(tmp_path, new_process, monkeypatch) -> dict[str, torch.Tensor]:
    """The weights of whole runs with each kernel, which differ."""
    if not onednn_has_float32():  # bfloat16 then, which is another kernel too
        monkeypatch.setattr("torchrl_caiac._kernels.onednn_has_float32", lambda: True)
        monkeypatch.setattr(
            "torchrl_caiac.modules.linear.onednn_has_float32", lambda: True
        )
    found = {}
    for kernel in ("plain", "onednn"):
        new_process(kernel)
        found[kernel] = Wide(tmp_path / f"{kernel}.zip").steps(0, 6)
    assert not torch.equal(*found.values())
    return found


@pytest.mark.parametrize("first", ["plain", "onednn"])
def test_a_resumed_run_uses_the_kernels_of_the_first(
    tmp_path, new_process, of_kernels, first
):
    path = tmp_path / "checkpoint.zip"
    new_process(first)
    run = Wide(path)
    run.steps(0, 3)
    run.checkpoint.save(3)
    new_process("onednn" if first == "plain" else "plain")
    run = Wide(path)
    assert run.checkpoint.load() == 3
    assert torch.equal(run.steps(3, 6), of_kernels[first])
    run.checkpoint.save(6)
    saved = Checkpoint.manifest(path)["metadata"]["linear_kernels"]
    assert saved["kernel"] == "auto"
    assert set(saved["chosen"].values()) == {first}  # for the next one


def write_metadata(path: Path, **kernels: object) -> None:
    """Replaces the record of kernels in a checkpoint."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    manifest = json.loads(files["manifest.json"])
    manifest["metadata"].pop("linear_kernels", None)
    manifest["metadata"] |= kernels
    files["manifest.json"] = json.dumps(manifest).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)


def test_another_fixed_kernel_is_refused(tmp_path, new_process):
    path = tmp_path / "checkpoint.zip"
    new_process("plain")
    with linear_kernel("plain"):
        run = Wide(path)
        run.steps(0, 1)
        run.checkpoint.save(1)
        run.checkpoint.load()
    with pytest.raises(ValueError, match="linear_kernel: saved 'plain', given 'auto'"):
        Wide(path).checkpoint.load()
    write_metadata(path, linear_kernels={"kernel": "fast"})
    with pytest.raises(UnreadableFileError, match="fast"):
        Wide(path).checkpoint.load()


def test_a_checkpoint_without_kernels_is_read(tmp_path):
    path = tmp_path / "checkpoint.zip"
    Wide(path).checkpoint.save(1)
    write_metadata(path)  # as an earlier version has
    assert Wide(path).checkpoint.load() == 1
