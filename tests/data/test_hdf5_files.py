"""Damaged HDF5 files are read or refused, always by name."""

from __future__ import annotations

import os

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.data import UnreadableFileError, open_dataset


def write(path, kind):
    """Writes a file of demonstrations, or one of flat arrays."""
    states = np.arange(24, dtype=np.float32).reshape(8, 3)
    prefix = "data/demo_0/" if kind == "robomimic" else ""
    names = ("obs/object", "next_obs/object") if prefix else ("observations",)
    with h5py.File(path, "w", libver="latest" if kind == "new" else None) as file:
        for name in (*names, "actions"):
            file.create_dataset(prefix + name, data=states, compression="gzip")
        if prefix:
            file["data"].attrs["env_args"] = "{}"
        else:
            file["timeouts"] = np.arange(8) % 4 == 3
    return path.read_bytes()


@given(
    kind=st.sampled_from(["robomimic", "flat", "new"]),
    changes=st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)),
        min_size=1,
        max_size=3,
    ),
)
@settings(max_examples=100, deadline=None)
def test_changed_bytes_are_read_or_refused_by_name(tmp_path_factory, kind, changes):
    folder = tmp_path_factory.mktemp("hdf5")
    content = bytearray(write(folder / "a.hdf5", kind))
    for place, value in changes:
        content[int(place * len(content))] = value
    (folder / "a.hdf5").write_bytes(content)
    try:
        open_dataset(folder / "a.hdf5", folder / "rows", progress=False)
    except (ValueError, KeyError) as error:  # it may look like other data
        assert "a.hdf5" in str(error)
        assert os.listdir(folder) == ["a.hdf5"]


@pytest.mark.parametrize("size", [0, 8, 100, 0.5, 0.9])
def test_files_cut_short_are_refused(tmp_path, size):
    content = write(tmp_path / "a.hdf5", "robomimic")
    size = int(size * len(content)) if size < 1 else int(size)
    (tmp_path / "a.hdf5").write_bytes(content[:size])
    with pytest.raises(UnreadableFileError, match=r"a.hdf5 is not a readable HDF5"):
        open_dataset(tmp_path / "a.hdf5", tmp_path / "rows")
