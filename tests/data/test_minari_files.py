from __future__ import annotations

import pytest

from torchrl_caiac.data.minari_files import (
    dataset_path,
    free_dataset_path,
    open_minari,
    work_folder,
)


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
