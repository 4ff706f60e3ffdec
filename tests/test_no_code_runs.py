"""No file that the package or an example reads can run code."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import TensorStorage

from torchrl_caiac import EntityLayout
from torchrl_caiac.checkpoint import TrainingCheckpoint
from torchrl_caiac.data import (
    action_bounds,
    load_episode,
    load_transitions,
    open_dataset,
)
from torchrl_caiac.data.digests import verify_digests, write_digests
from torchrl_caiac.data.minari_files import open_minari
from torchrl_caiac.envs import load_d4rl_kitchen
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence.score_record import read_record, score_file
from torchrl_caiac.modules import GaussianWorldModel

ROOT = Path(__file__).parents[1]
LAYOUT = EntityLayout({"arm": [0], "cup": [1]})


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self.folder,)


def rows() -> TensorDict:
    return TensorDict(
        {
            "observation": torch.randn(20, 2),
            "action": torch.randn(20, 1),
            "episode": torch.arange(20) // 10,
            "next": {"observation": torch.randn(20, 2), "done": torch.ones(20, 1) > 0},
        },
        [20],
    )


def replace_in_zip(path: Path, suffix: str, content: bytes) -> None:
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, content if name.endswith(suffix) else part)


def transitions(folder: Path, evil: Payload) -> Callable[[], Any]:
    data = rows()
    data.set_non_tensor("note", evil)
    data.memmap(folder)
    return lambda: load_transitions(folder)


def meta_json(folder: Path, evil: Payload) -> Callable[[], Any]:
    rows().memmap(folder)
    (folder / "meta.json").write_bytes(pickle.dumps(evil))
    return lambda: load_transitions(folder)


def leaf(folder: Path, evil: Payload) -> Callable[[], Any]:
    rows().memmap(folder)
    (folder / "action.memmap").write_bytes(pickle.dumps(evil))
    return lambda: load_transitions(folder)


def digests(folder: Path, evil: Payload) -> Callable[[], Any]:
    rows().memmap(folder)
    write_digests(folder)
    (folder / "digests.json").write_bytes(pickle.dumps(evil))
    return lambda: verify_digests(folder)


def bounds(folder: Path, evil: Payload) -> Callable[[], Any]:
    (folder / "action_space.json").write_bytes(pickle.dumps(evil))
    return lambda: action_bounds(folder)


def episode(folder: Path, evil: Payload) -> Callable[[], Any]:
    meta = np.array('{"spec": {}, "seed": 1, "attempts": 1}')
    np.savez(folder / "a.npz", meta=meta, a=np.array([evil], dtype=object))
    return lambda: load_episode(folder / "a.npz")


def episode_as_pickle(folder: Path, evil: Payload) -> Callable[[], Any]:
    (folder / "a.npz").write_bytes(pickle.dumps(evil))
    return lambda: load_episode(folder / "a.npz")


def layout(folder: Path, evil: Payload) -> Callable[[], Any]:
    (folder / "layout.json").write_bytes(pickle.dumps(evil))
    return lambda: EntityLayout.load(folder / "layout.json")


def score_record(folder: Path, evil: Payload) -> Callable[[], Any]:
    rows().memmap(folder)
    data, key = load_transitions(folder), ("caiac", "score")
    score_file(folder, key).write_bytes(pickle.dumps(evil))
    return lambda: read_record(TensorStorage(data), data, key)


def checkpoint(folder: Path, evil: Payload) -> Callable[[], Any]:
    run = TrainingCheckpoint(folder / "a.zip", model=torch.nn.Linear(1, 1))
    run.save(1)
    replace_in_zip(run.path, "model/state.pt", pickle.dumps(evil))
    return run.load


def checkpoint_as_pickle(folder: Path, evil: Payload) -> Callable[[], Any]:
    run = TrainingCheckpoint(folder / "a.zip", model=torch.nn.Linear(1, 1))
    run.path.write_bytes(pickle.dumps(evil))
    return run.load


def fitted_model(folder: Path, evil: Payload) -> Callable[[], Any]:
    path, model = folder / "fit.zip", GaussianWorldModel(LAYOUT, 1, (4,))

    def fit() -> None:
        options = {"steps": 1, "batch_size": 4, "eval_every": 1, "progress": False}
        fit_world_model(model, rows(), checkpoint=path, **options)

    fit()
    torch.save({"weight": evil}, folder / "state.pt")
    replace_in_zip(path, "state.pt", (folder / "state.pt").read_bytes())
    return fit


def minari_metadata(folder: Path, evil: Payload) -> Callable[[], Any]:
    data = folder / "a" / "b-v0" / "data"
    data.mkdir(parents=True)
    spec = {"id": "Evil-v0", "entry_point": "os:mkdir", "additional_wrappers": []}
    spec["kwargs"] = {"path": evil.folder}
    content = {"env_spec": json.dumps(spec), "data_format": "hdf5"}
    (data / "metadata.json").write_text(json.dumps(content))
    (data / "main_data.hdf5").touch()
    return lambda: open_minari("a/b-v0", folder)


def minari_as_pickle(folder: Path, evil: Payload) -> Callable[[], Any]:
    read = minari_metadata(folder, evil)
    (metadata,) = folder.rglob("metadata.json")
    metadata.write_bytes(pickle.dumps(evil))
    return read


def d4rl(folder: Path, evil: Payload) -> Callable[[], Any]:
    content = np.void(pickle.dumps(evil))
    names = ("observations", "actions", "rewards", "terminals", "timeouts")
    with h5py.File(folder / "kitchen.hdf5", "w") as stored:
        for name in names:
            stored[name] = content
    return lambda: load_d4rl_kitchen(folder / "kitchen.hdf5")


def ogbench(folder: Path, evil: Payload) -> Callable[[], Any]:
    file, rows = folder / "cube-single-play-v0.npz", np.zeros((3, 5))
    evils = np.array([evil] * 3, dtype=object)
    np.savez(file, observations=rows, actions=rows, terminals=[0, 0, 1], qpos=evils)
    return lambda: open_dataset(file, folder / "rows")


def array_file(folder: Path, evil: Payload) -> Callable[[], Any]:
    file, rows = folder / "rows.npz", np.zeros((3, 5))
    np.savez(file, observations=rows, actions=rows, timeouts=np.array(evil))
    return lambda: open_dataset(file, folder / "rows")


def robomimic(folder: Path, evil: Payload) -> Callable[[], Any]:
    with h5py.File(folder / "lift.hdf5", "w") as stored:
        stored["data/demo_0/obs/object"] = np.zeros((3, 5))
        stored["data/demo_0/actions"] = np.void(pickle.dumps(evil))
    return lambda: open_dataset(folder / "lift.hdf5", folder / "rows")


def lerobot(folder: Path, evil: Payload) -> Callable[[], Any]:
    shutil.copytree(ROOT / "tests/data/lerobot/v2.1", folder / "push")
    for file in folder.rglob("episode_000001.parquet"):
        file.write_bytes(pickle.dumps(evil))
    return lambda: open_dataset(folder / "push", folder / "rows", progress=False)


def lerobot_description(folder: Path, evil: Payload) -> Callable[[], Any]:
    shutil.copytree(ROOT / "tests/data/lerobot/v2.1", folder / "push")
    (folder / "push/meta/info.json").write_bytes(pickle.dumps(evil))
    return lambda: open_dataset(folder / "push", folder / "rows")


READERS = [
    transitions, meta_json, leaf, digests, bounds, episode, episode_as_pickle,
    layout, score_record, checkpoint, checkpoint_as_pickle,
    fitted_model, minari_metadata, minari_as_pickle, d4rl,
    ogbench, array_file, robomimic, lerobot, lerobot_description,
]  # fmt: skip


@pytest.mark.parametrize("plant", READERS, ids=lambda plant: plant.__name__)
def test_a_payload_does_not_run(plant, tmp_path):
    marker, folder = tmp_path / "marker", tmp_path / "files"
    folder.mkdir()
    read = plant(folder, Payload(marker))
    with pytest.raises((ValueError, OSError)):
        read()
    assert not marker.exists()
    pickle.loads(pickle.dumps(Payload(marker)))  # the payload is live
    assert marker.is_dir()


def test_every_reader_of_pickles_is_told_to_read_none():
    """Also those that no test above reaches, in the examples for instance."""
    for path in [*ROOT.glob("torchrl_caiac/**/*.py"), *ROOT.glob("examples/**/*.py")]:
        text = path.read_text()
        for call, option in (
            ("torch.load(", "weights_only=True"),
            ("np.load(", "allow_pickle=False"),
            ("load_memmap(", "allow_pickle=False"),
        ):
            for place in text.split(call)[1:]:
                assert option in place[:200] or place.startswith("``"), (
                    path,
                    place[:80],
                )
