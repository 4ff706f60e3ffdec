"""Files and folders are whole or not there, and have one writer."""

from __future__ import annotations

import json
import os
import stat

import pytest
from omegaconf import OmegaConf

from torchrl_caiac._files import (
    claim_folder,
    remove_leftovers,
    whole_file,
    whole_folder,
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

    def test_leftovers_of_interrupted_writes_are_removed(self, tmp_path):
        path = tmp_path / "table.txt"
        remove_leftovers(tmp_path / "missing" / "table.txt")
        writes = [whole_file(tmp_path / name) for name in ("table.txt", "other.txt")]
        for write in writes:
            write.__enter__().write_text("half")  # and never leaves
        assert len(list(tmp_path.iterdir())) == 2
        remove_leftovers(path)
        (left,) = tmp_path.iterdir()
        assert left.name.endswith("other.txt")


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


class TestWholeFolder:
    def test_what_raises_leaves_the_old_folder(self, tmp_path):
        path = tmp_path / "a" / "data"
        for text in ("old", "new"):
            with whole_folder(path) as partial:
                partial.mkdir()
                (partial / "x").write_text(text)
        with pytest.raises(RuntimeError), whole_folder(path) as partial:
            partial.mkdir()
            (partial / "x").write_text("half")
            raise RuntimeError
        with pytest.raises(FileNotFoundError), whole_folder(path):
            pass  # nothing was made: what is there stays
        assert (path / "x").read_text() == "new"
        assert list(path.parent.iterdir()) == [path]


def test_modes_follow_the_umask(tmp_path):
    previous = os.umask(0o022)
    try:
        write_json(tmp_path / "a.json", 1)
        with whole_folder(tmp_path / "folder") as partial:
            partial.mkdir()
    finally:
        os.umask(previous)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o644
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o755


def test_a_folder_is_claimed_once(tmp_path):
    folder = tmp_path / "new" / "folder"
    for _ in range(2):
        with claim_folder(folder):
            with (
                pytest.raises(RuntimeError, match=r"another process is using.*folder"),
                claim_folder(folder),
            ):
                pass
            with claim_folder(folder / "inner"):
                pass
    with pytest.raises(KeyError), claim_folder(folder):
        raise KeyError
    with claim_folder(folder):
        pass
