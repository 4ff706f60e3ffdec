"""Files of arrays, as D4RL and others write them."""

from __future__ import annotations

import logging
import os
import sys

import h5py
import numpy as np
import pytest

from torchrl_caiac.augment import export_hdf5, export_npz
from torchrl_caiac.data import (
    UnreadableFileError,
    action_bounds,
    from_arrays,
    open_dataset,
)
from torchrl_caiac.data.load_array_file import load_array_file

ENDS = np.array([0, 0, 0, 1, 0, 1, 0, 0, 1], bool)


def arrays():
    random = np.random.default_rng(0)
    return {
        "observations": random.normal(size=(9, 3)).astype(np.float32),
        "actions": random.uniform(-1, 1, (9, 2)).astype(np.float32),
        "next_observations": random.normal(size=(9, 3)).astype(np.float32),
        "rewards": random.normal(size=9).astype(np.float32),
        "terminals": ENDS & (np.arange(9) == 5),
        "timeouts": ENDS & (np.arange(9) != 5),
    }


def write(path, content, **more):
    content = {**content, **more}
    if path.suffix == ".npz":
        np.savez_compressed(path, **content)
    else:
        with h5py.File(path, "w") as file:
            for name, array in content.items():
                file[name] = array
    return path


@pytest.fixture(params=["a.npz", "a.hdf5", "a.h5"])
def name(request):
    return request.param


def load(file, **options):
    return load_array_file(file, file.with_name("rows"), progress=False, **options)


def expected(path, **changes):
    content = {**arrays(), **changes}
    return from_arrays(
        content.pop("observations"), content.pop("actions"), path, **content
    )


def test_the_result_is_that_of_from_arrays(tmp_path, name):
    data = load(write(tmp_path / name, arrays()))
    assert (data == expected(tmp_path / "b")).all()
    assert data["next", "terminated"].sum() == 1
    again = load(tmp_path / name)
    assert (data == again).all()
    with pytest.raises(FileExistsError, match=r"overwrite=True"):
        load(write(tmp_path / name, arrays(), rewards=np.zeros(9)))


def test_other_names_of_the_ends_are_known(tmp_path, name):
    content = arrays()
    content["terminations"] = content.pop("terminals")
    content["truncations"] = content.pop("timeouts")
    file = write(tmp_path / name, content)
    assert (load(file) == expected(tmp_path / "b")).all()
    write(file, content, timeouts=ENDS)
    with pytest.raises(ValueError, match=r"two mean the same: .*exclude="):
        load(file, overwrite=True)


def test_infos_are_kept_by_name(tmp_path, name, caplog):
    qpos = np.arange(18.0).reshape(9, 2)
    file = write(tmp_path / name, arrays(), **{"infos/qpos": qpos, "extra": qpos})
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        data = load(file, infos=["infos/qpos"], action_bounds=([-1, -1], [1, 1]))
    assert np.array_equal(data["info", "infos/qpos"], qpos)
    assert f"['extra'] of {file} are left out" in caplog.text
    assert action_bounds(file.with_name("rows"))[1].tolist() == [1, 1]


def test_groups_become_nested_observations(tmp_path, name):
    content = arrays()
    states, after = content.pop("observations"), content.pop("next_observations")
    for prefix, array in (("observations", states), ("next_observations", after)):
        content |= {f"{prefix}/arm": array[:, :1], f"{prefix}/cup": array[:, 1:]}
    data = load(write(tmp_path / name, content))
    assert np.array_equal(data["next", "observation", "cup"], after[:, 1:])


@pytest.mark.parametrize("export", [export_npz, export_hdf5])
@pytest.mark.parametrize("is_nested", [False, True])
def test_exported_transitions_are_read_back(tmp_path, export, is_nested):
    first = expected(tmp_path / "b")
    if is_nested:
        first = first.clone()
        for td in (first, first["next"]):
            td["achieved_goal"] = td["observation"][:, :1]
    file = export(first, tmp_path / f"a.{export.__name__.removeprefix('export_')}")
    again = open_dataset(file, tmp_path / "rows", progress=False)
    assert (again == first).all()


@pytest.mark.parametrize(
    ("changes", "options", "error", "message"),
    [
        ({"actions": None}, {}, KeyError, r"a\.\w+ lacks \['actions'\], it has \["),
        ({}, {"infos": ["cup"]}, KeyError, r"lacks \['cup'\]"),
        ({}, {"exclude": ["cup"]}, KeyError, r"lacks \['cup'\]"),
        ({"terminals": None, "timeouts": None}, {}, ValueError, r"a\.\w+: .* end"),
        ({"rewards": np.full(9, np.nan)}, {}, ValueError, r"a\.\w+: 'reward'.*NaN"),
    ],
)
def test_errors_leave_nothing(tmp_path, name, changes, options, error, message):
    content = {**arrays(), **changes}
    file = write(tmp_path / name, {k: v for k, v in content.items() if v is not None})
    with pytest.raises(error, match=message):
        load(file, **options)
    assert os.listdir(tmp_path) == [name]


def test_files_cut_short_are_refused(tmp_path, name):
    file = write(tmp_path / name, arrays())
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(UnreadableFileError, match=rf"{name} is not a readable"):
        load(file)
    with pytest.raises(FileNotFoundError, match=r"no file .*other"):
        load(file.with_name("other.npz"))


def test_damaged_parts_are_refused(tmp_path):
    states = np.random.default_rng(0).normal(size=(9, 3))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for key, array in arrays().items():
            file[key] = array
        del file["observations"]
        stored = file.create_dataset("observations", data=states, compression="gzip")
        place = stored.id.get_chunk_info(0).byte_offset
    content = bytearray((tmp_path / "a.h5").read_bytes())
    content[place : place + 20] = bytes(20)
    (tmp_path / "a.h5").write_bytes(content)
    with pytest.raises(UnreadableFileError, match=r"a.h5 cannot be read"):
        load(tmp_path / "a.h5")
    assert os.listdir(tmp_path) == ["a.h5"]


def test_without_h5py_the_package_is_named(tmp_path, monkeypatch):
    file = write(tmp_path / "a.h5", arrays())
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"package h5py"):
        load(file)


def test_an_array_beside_a_group_of_its_name(tmp_path):
    names = {"observations": np.zeros((4, 2)), "observations/cup": np.zeros((4, 1))}
    np.savez(tmp_path / "a.npz", actions=np.zeros((4, 1)), **names)
    with pytest.raises(ValueError, match="has the array 'observations' and arrays"):
        load_array_file(tmp_path / "a.npz", tmp_path / "data", progress=False)


@pytest.mark.parametrize("first", ["observations/cup", "observations/cup/vel"])
def test_arrays_below_an_array_are_refused(tmp_path, first):
    arrays = {"observations/cup": np.zeros((4, 2)), "observations/cup/vel": np.ones(4)}
    arrays = {first: arrays.pop(first), **arrays}
    np.savez(tmp_path / "a.npz", actions=np.zeros((4, 1)), **arrays)
    with pytest.raises(ValueError, match="'observations/cup' and arrays below it"):
        load_array_file(tmp_path / "a.npz", tmp_path / "rows", progress=False)
