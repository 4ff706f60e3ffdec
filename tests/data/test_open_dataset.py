"""Recognising formats."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import ModuleType

import h5py
import numpy as np
import pytest
import torch

from torchrl_caiac.data import (
    FORMATS,
    UnreadableFileError,
    episode_transitions,
    from_arrays,
    load_lerobot,
    open_dataset,
    to_minari,
    write_transitions,
)

LEROBOT = Path(__file__).parent / "lerobot" / "v3.0"
STATES = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
ACTIONS = STATES[:, :2]
ENDS = np.array([0, 0, 1, 0, 0, 1], bool)


def transitions():
    rows = episode_transitions(
        np.concatenate([STATES, STATES[:1]]), ACTIONS, rewards=np.ones(6), where="one"
    )
    rows["episode"] = torch.zeros(6, dtype=torch.int64)
    return rows


@pytest.fixture
def sources(tmp_path, monkeypatch):
    """One source of each format, by its name."""
    write_transitions(transitions(), tmp_path / "rows")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    to_minari(transitions(), "push/play-v0", progress=False)
    shutil.copytree(LEROBOT, tmp_path / "lerobot")
    arrays = {"observations": STATES, "actions": ACTIONS}
    np.savez_compressed(tmp_path / "pointmaze-v0.npz", **arrays, terminals=ENDS)
    np.savez(tmp_path / "plain.npz", **arrays, timeouts=ENDS)
    with h5py.File(tmp_path / "lift.hdf5", "w") as file:
        file["data/demo_0/obs/object"], file["data/demo_0/actions"] = STATES, ACTIONS
    with h5py.File(tmp_path / "plain.h5", "w") as file:
        for name, array in {**arrays, "timeouts": ENDS}.items():
            file[name] = array
    return {
        "transitions": tmp_path / "rows",
        "minari": "push/play-v0",
        "lerobot": tmp_path / "lerobot",
        "ogbench": tmp_path / "pointmaze-v0.npz",
        "npz": tmp_path / "plain.npz",
        "robomimic": tmp_path / "lift.hdf5",
        "hdf5": tmp_path / "plain.h5",
    }


ROWS = {"transitions": 6, "minari": 6, "lerobot": 18, "robomimic": 5}
NAMES = [known.name for known in FORMATS]


@pytest.mark.parametrize("name", NAMES)
def test_every_format_is_recognised_and_read_twice(sources, name, tmp_path, caplog):
    path = tmp_path / "out"
    with caplog.at_level("INFO", "torchrl_caiac"):
        first = open_dataset(sources[name], path, progress=False)
    assert f"is read as {name}" in caplog.text
    assert len(first) == ROWS.get(name, 4)
    assert path.exists() == (name != "transitions")
    assert (open_dataset(str(sources[name]), path, progress=False) == first).all()
    forced = open_dataset(
        sources[name], tmp_path / "forced", format=name, progress=False
    )
    assert (forced == first).all()


def test_minari_datasets_are_found_by_their_files_too(sources, tmp_path):
    first = open_dataset("minari://push/play-v0", tmp_path / "a", progress=False)
    root = tmp_path / "minari/push/play-v0"
    for part in (root, root / "data", root / "data/main_data.hdf5"):
        assert (open_dataset(part, tmp_path / "a", progress=False) == first).all()


def test_names_are_downloaded(sources, tmp_path, monkeypatch):
    hub = ModuleType("huggingface_hub")
    hub.snapshot_download = lambda name, **options: str(LEROBOT)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    data = open_dataset("lerobot://someone/push", tmp_path / "a", progress=False)
    assert (data == load_lerobot(LEROBOT, tmp_path / "b", progress=False)).all()
    # One that is here already is not.
    data = open_dataset(
        "ogbench://pointmaze-v0", tmp_path / "c", root=tmp_path, progress=False
    )
    assert len(data) == 4
    with pytest.raises(FileNotFoundError, match=r"'cup-v0' is not at"):
        open_dataset("ogbench://cup-v0", tmp_path / "d", root=tmp_path, download=False)


def test_options_are_those_of_the_loader(sources, tmp_path):
    data = open_dataset(sources["robomimic"], tmp_path / "a", keys=["object"])
    assert data["observation"].shape == (5, 3)
    with pytest.raises(
        TypeError, match=r"'robomimic' has no options \['columns'\], it"
    ):
        open_dataset(sources["robomimic"], tmp_path / "a", columns=[0])
    with pytest.raises(TypeError, match=r"'minari' has no options \['key'\].*'infos'"):
        open_dataset(sources["minari"], tmp_path / "b", key=[0])
    with pytest.raises(FileExistsError, match=r"overwrite=True"):
        open_dataset(sources["robomimic"], tmp_path / "a")
    nested = open_dataset(sources["robomimic"], tmp_path / "a", overwrite=True)
    assert nested["observation", "object"].shape == (5, 3)


def test_terminals_alone_are_not_those_of_ogbench(tmp_path, caplog):
    arrays = {"next_observations": STATES, "terminals": ENDS}
    for name, more in (("a", {}), ("b", {"qpos": STATES}), ("cube-single-v0", {})):
        file = tmp_path / f"{name}.npz"
        np.savez(file, observations=STATES, actions=ACTIONS, **arrays, **more)
        caplog.clear()
        with caplog.at_level("INFO", "torchrl_caiac"):
            data = open_dataset(file, tmp_path / name, progress=False)
        assert data["next", "terminated"].any() == (name == "a")
        assert ("terminals end episodes as truncated" in caplog.text) == (name != "a")
        assert "(--format)" in caplog.text


def test_rewards_without_masks_are_not_those_of_ogbench(tmp_path):
    np.savez(
        tmp_path / "a.npz",
        observations=STATES,
        actions=ACTIONS,
        next_observations=STATES,
        rewards=np.ones(6),
        terminals=ENDS,
    )
    data = open_dataset(tmp_path / "a.npz", tmp_path / "rows", progress=False)
    assert data["next", "terminated"].squeeze(1).tolist() == ENDS.tolist()
    arrays = {"next_observations": STATES, "rewards": np.ones(6), "terminals": ENDS}
    expected = from_arrays(STATES, ACTIONS, tmp_path / "b", **arrays)
    assert (data == expected).all()


@pytest.mark.parametrize(
    "source", ["nothing", "a/b-v0", "s3://bucket", "folder", "note.txt"]
)
def test_unknown_formats_list_the_known_ones(tmp_path, monkeypatch, source):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/demo.txt").touch()
    (tmp_path / "note.txt").touch()
    with pytest.raises(ValueError) as error:
        open_dataset(source, tmp_path / "rows")
    assert source.split("://")[0] in str(error.value)
    for known in FORMATS:
        assert f"{known.name}: {known.looks}" in str(error.value)
    assert not (tmp_path / "rows").exists()
    with pytest.raises(ValueError, match=r"'csv' of .* is unknown. The known formats"):
        open_dataset(source, tmp_path / "rows", format="csv")


def test_a_contradicting_format_is_refused(sources, tmp_path):
    with pytest.raises(ValueError, match=r"ogbench://x .* 'lerobot'.*lerobot://NAME"):
        open_dataset("ogbench://x", tmp_path / "a", format="lerobot")
    with pytest.raises(ValueError, match=r"'npz': leave out format=, or give a path"):
        open_dataset("ogbench://x", tmp_path / "a", format="npz")
    with pytest.raises(KeyError, match=r"plain.h5 has no data/demo_\*"):
        open_dataset(sources["hdf5"], tmp_path / "a", format="robomimic")


@pytest.mark.parametrize("name", ["ogbench", "npz", "robomimic", "hdf5"])
def test_damaged_and_missing_files_are_named(sources, tmp_path, name):
    file = sources[name]
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(UnreadableFileError, match=rf"{file.name} is not a readable"):
        open_dataset(file, tmp_path / "a")
    file.unlink()
    with pytest.raises(FileNotFoundError, match=rf"no file .*{file.name}"):
        open_dataset(file, tmp_path / "a")


def test_missing_packages_are_named(sources, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ImportError, match=r"package minari.*torchrl-caiac\[envs\]"):
        open_dataset("minari://push/play-v0", tmp_path / "a")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"lift.hdf5 needs the package h5py"):
        open_dataset(sources["robomimic"], tmp_path / "a")
