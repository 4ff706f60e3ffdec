"""Files are checked when they are read, have their space, and one writer."""

from __future__ import annotations

import errno
import json
import os
from itertools import product
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from tests.killing import run_killed, running
from torchrl_caiac._files import (
    UnreadableFileError,
    claim_folder,
    recover_meta,
    reserve,
    safe_meta,
    write_json,
)
from torchrl_caiac._torchrl import mark_memmap
from torchrl_caiac.data.load_transitions import load_transitions


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


def test_a_folder_is_claimed_once(tmp_path):
    folder = tmp_path / "new" / "folder"
    for _ in range(2):
        with claim_folder(folder):
            with (
                pytest.raises(
                    RuntimeError, match=rf"process {os.getpid()} on .*is using.*folder"
                ),
                claim_folder(folder),
            ):
                pass
            with claim_folder(folder / "inner"):
                pass
    with pytest.raises(KeyError), claim_folder(folder):
        raise KeyError
    with claim_folder(folder):
        pass


def stored(folder: Path) -> TensorDict:
    rows = TensorDict({"action": torch.ones(3, 2), "next": {"x": torch.ones(3)}}, [3])
    return rows.memmap(folder)


class TestReserve:
    def test_files_get_their_blocks_and_keep_their_content(self, tmp_path):
        file = tmp_path / "leaf.memmap"
        file.write_bytes(b"abc")
        reserve(file, 1 << 20)
        assert file.stat().st_blocks * 512 >= file.stat().st_size == 1 << 20
        assert file.read_bytes()[:4] == b"abc\0"
        reserve(file, 2)
        assert file.read_bytes() == b"ab"

    def test_all_sparse_files_of_a_folder(self, tmp_path):
        rows = TensorDict({"a": torch.zeros(1), "b": {"c": torch.zeros(1)}}, [1])
        rows.expand(1 << 18).memmap_like(tmp_path)
        files = sorted(tmp_path.rglob("*.memmap"))
        assert all(f.stat().st_blocks * 512 < f.stat().st_size for f in files)
        reserve(tmp_path)
        assert all(f.stat().st_blocks * 512 >= f.stat().st_size > 0 for f in files)

    def test_a_full_disk_is_an_error_that_names_file_and_sizes(self, small_disk):
        old, new = small_disk / "old.memmap", small_disk / "new.memmap"
        old.write_bytes(b"abc")
        for file in (old, new):
            with pytest.raises(OSError, match=r"(?s)8388608 bytes, \d+ are free") as e:
                reserve(file, 8 << 20)
            assert e.value.errno == errno.ENOSPC and str(file) in str(e.value)
        assert old.read_bytes() == b"abc" and not new.exists()

    def test_where_space_cannot_be_reserved_the_free_space_decides(
        self, small_disk, monkeypatch
    ):
        monkeypatch.delattr(os, "posix_fallocate")
        reserve(small_disk / "fits.memmap", 1 << 20)
        with pytest.raises(OSError, match="the disk is full"):
            reserve(small_disk / "large.memmap", 8 << 20)

    def test_other_errors_are_not_hidden(self, tmp_path):
        with pytest.raises(FileNotFoundError):
            reserve(tmp_path / "missing" / "leaf.memmap", 1)


class TestSafeMeta:
    def test_leaves_no_copies(self, tmp_path):
        rows = stored(tmp_path)
        before = sorted(tmp_path.rglob("*"))
        with safe_meta(tmp_path):
            assert len(list(tmp_path.rglob("*.bak"))) == 2
        assert sorted(tmp_path.rglob("*")) == before
        with safe_meta(tmp_path):
            rows.make_memmap(("next", "y"), shape=torch.Size([3]))
        loaded = TensorDict.load_memmap(tmp_path)
        assert ("next", "y") in loaded.keys(True)

    @pytest.mark.parametrize(
        ("key", "emptied"),
        [
            *product(["y", ("next", "y"), ("new", "y")], ["meta.json"]),
            *product(["y", ("next", "y"), ("new", "y")], ["next/meta.json"]),
            (("new", "y"), "new/meta.json"),
        ],
    )
    def test_a_killed_addition_is_undone(self, tmp_path, key, emptied):
        stored(tmp_path)
        kept = {f: f.read_bytes() for f in tmp_path.rglob("meta.json")}
        run_killed(half_an_addition, tmp_path, key, emptied)
        assert len(list(tmp_path.rglob("*.bak"))) == 2
        assert recover_meta(tmp_path)
        assert {f: f.read_bytes() for f in kept} == kept
        assert set(TensorDict.load_memmap(tmp_path).keys()) == {"action", "next"}
        assert not recover_meta(tmp_path)
        rows = TensorDict.load_memmap(tmp_path)
        mark_memmap(rows)
        with safe_meta(tmp_path):
            rows.make_memmap(key, shape=torch.Size([3]))
        assert key in TensorDict.load_memmap(tmp_path).keys(True)
        assert not list(tmp_path.rglob("*.bak"))

    def test_what_a_running_process_writes_is_not_undone(self, tmp_path, monkeypatch):
        stored(tmp_path)
        monkeypatch.setattr("torchrl_caiac._files._SECONDS_BETWEEN_TRIES", 0.0)
        match = rf"another process is adding a leaf to {tmp_path}.*try again"
        with running(half_an_addition, tmp_path, "y", "meta.json"):
            with pytest.raises(UnreadableFileError, match=match):
                recover_meta(tmp_path)
            with pytest.raises(UnreadableFileError, match=match):
                load_transitions(tmp_path, keys=["action"])
            assert (tmp_path / "meta.json").read_text() == ""
        monkeypatch.setattr("platform.node", lambda: "elsewhere")
        with pytest.raises(UnreadableFileError, match=match):
            recover_meta(tmp_path)
        for copy in tmp_path.rglob("*.bak"):
            os.utime(copy, (0, 0))
        assert recover_meta(tmp_path)

    def test_a_running_process_restores_after_a_killed_one(self, tmp_path, monkeypatch):
        stored(tmp_path)
        monkeypatch.setattr("torchrl_caiac._files._SECONDS_BETWEEN_TRIES", 0.0)
        with running(half_an_addition, tmp_path, "y", None):
            run_killed(half_an_addition, tmp_path, "z", "meta.json")
            with pytest.raises(UnreadableFileError, match="try again"):
                recover_meta(tmp_path)
            assert (tmp_path / "meta.json").read_text() == ""
        assert recover_meta(tmp_path)
        assert "z" not in TensorDict.load_memmap(tmp_path)

    def test_copies_of_a_finished_addition_are_not_used(self, tmp_path):
        stored(tmp_path)
        run_killed(half_an_addition, tmp_path, "y", None)
        assert not recover_meta(tmp_path)
        assert "y" in TensorDict.load_memmap(tmp_path)
        run_killed(half_an_addition, tmp_path, "z", "meta.json")
        assert recover_meta(tmp_path)
        assert set(TensorDict.load_memmap(tmp_path).keys()) == {"action", "next", "y"}

    def test_blocks_may_be_nested(self, tmp_path):
        stored(tmp_path)
        kept = (tmp_path / "meta.json").read_text()
        with pytest.raises(OSError, match="full"), safe_meta(tmp_path):
            with safe_meta(tmp_path):
                pass
            (tmp_path / "meta.json").write_text("")
            raise OSError("full")
        assert (tmp_path / "meta.json").read_text() == kept

    def test_an_error_restores_at_once(self, tmp_path):
        stored(tmp_path)
        kept = (tmp_path / "meta.json").read_text()
        with pytest.raises(OSError, match="full"), safe_meta(tmp_path):
            (tmp_path / "meta.json").write_text("")
            raise OSError("full")
        assert (tmp_path / "meta.json").read_text() == kept
        assert not list(tmp_path.rglob("*.bak"))

    def test_damage_without_a_copy_is_an_error(self, tmp_path):
        stored(tmp_path)
        (tmp_path / "next" / "meta.json").write_text("{")
        assert not recover_meta(tmp_path)
        with (
            pytest.raises(UnreadableFileError, match=r"next/meta\.json is damaged"),
            safe_meta(tmp_path),
        ):
            pass
        assert not list(tmp_path.rglob("*.bak"))


def half_an_addition(folder: Path, key, emptied: str | None):
    rows = TensorDict.load_memmap(folder)
    mark_memmap(rows)
    with safe_meta(folder):
        rows.make_memmap(key, shape=torch.Size([3]))
        if emptied is not None:
            (folder / emptied).write_text("")
        yield
