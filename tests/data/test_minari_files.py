"""Folders that are whole or not there; trees of arrays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.data import load_transitions
from torchrl_caiac.data.minari_files import (
    dataset_path,
    free_dataset_path,
    index_tree,
    open_minari,
    stack_trees,
    whole_folder,
    work_folder,
    write_rows,
)


def make_rows(value, length=3):
    return TensorDict(
        {
            "action": torch.full((length, 2), value),
            "episode": torch.zeros(length, dtype=torch.int64),
            "next": {"done": torch.ones(length, 1, dtype=torch.bool)},
        },
        [length],
    )


def test_rows_replace_what_was_there(tmp_path):
    place = tmp_path / "deep" / "rows"
    for value in (1.0, 2.0):
        rows = write_rows(make_rows(value), place)
        assert rows.is_memmap()
        assert (rows == make_rows(value)).all()
    assert [entry.name for entry in place.parent.iterdir()] == ["rows"]
    # As text too.
    assert len(write_rows(make_rows(3.0, 5), str(place))) == 5


def test_an_error_leaves_what_was_there(tmp_path):
    write_rows(make_rows(1.0), tmp_path / "rows")
    for name in ("rows", "other"):
        with (
            pytest.raises(OSError, match="disk full"),
            whole_folder(tmp_path / name) as folder,
        ):
            make_rows(2.0).memmap(folder)
            raise OSError("disk full")
    assert [entry.name for entry in tmp_path.iterdir()] == ["rows"]
    assert (load_transitions(tmp_path / "rows") == make_rows(1.0)).all()


def test_a_block_that_makes_nothing(tmp_path):
    write_rows(make_rows(1.0), tmp_path / "rows")
    with pytest.raises(FileNotFoundError), whole_folder(tmp_path / "rows"):
        pass
    assert (load_transitions(tmp_path / "rows") == make_rows(1.0)).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["rows"]


def test_places_of_datasets(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert dataset_path("a/b-v0") == tmp_path / "a" / "b-v0"
    monkeypatch.chdir(tmp_path)
    assert dataset_path("a/b-v0", "here") == tmp_path / "here" / "a" / "b-v0"
    assert not free_dataset_path("a/b-v0", None, False).exists()
    (tmp_path / "a" / "b-v0").mkdir(parents=True)
    with pytest.raises(FileExistsError, match=r"'a/b-v0'.*overwrite=True"):
        free_dataset_path("a/b-v0", None, False)
    assert free_dataset_path("a/b-v0", None, True) == tmp_path / "a" / "b-v0"
    with pytest.raises(FileNotFoundError, match=r"no Minari dataset 'a/b-v0'"):
        open_minari("a/b-v0")


def test_work_folders(tmp_path):
    with work_folder(tmp_path, "a/b-v0") as folder:
        assert folder == tmp_path / "a-b-v0"
    with work_folder(None, "a/b-v0") as folder:
        (folder / "file").touch()
    assert not folder.exists()


def test_trees():
    trees = [{"a": np.arange(3) + i, "b": {"c": np.float32(i)}} for i in range(4)]
    stacked = stack_trees(trees)
    assert stacked["a"].shape == (4, 3)
    assert stacked["b"]["c"].dtype == np.float32
    for index, tree in enumerate(trees):
        back = index_tree(stacked, index)
        np.testing.assert_array_equal(back["a"], tree["a"])
        assert back["b"]["c"] == tree["b"]["c"]
