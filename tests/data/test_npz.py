"""NumPy archives are compared with their size before anything is allocated."""

from __future__ import annotations

import io
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.mutations import mutate_file
from torchrl_caiac.data import UnreadableFileError
from torchrl_caiac.data.npz import read_npz

ARRAYS = {
    "a/b": np.arange(6.0).reshape(2, 3),
    "text": np.array("x"),
    "none": np.zeros((0, 3), np.int8),
    "t": np.asfortranarray(np.eye(3)),
}


def read(path):
    return read_npz(path, "episode", "delete it")


def test_what_numpy_wrote_is_read(tmp_path):
    np.savez(tmp_path / "a.npz", **ARRAYS)
    found = read(tmp_path / "a.npz")
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def write_array(path, content: bytes) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", content)


def header(**changes) -> bytes:
    values = {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)} | changes
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, values)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (header() + bytes(64), "needs 87960930"),
        (header(shape=(2,)) + bytes(15), "needs"),
        (header(shape=(2,)) + bytes(17), "needs"),
        (header(shape=(1,), descr="|O") + bytes(8), "Python objects"),
        (b"\x93NUMPY\x03\x00" + bytes(80), r"version \(3, 0\)"),
        (b"", "a.npz"),
    ],
)
def test_a_header_that_does_not_fit_is_refused_before_it_is_followed(
    content, match, tmp_path
):
    path = tmp_path / "a.npz"
    write_array(path, content)
    tracemalloc.start()
    try:
        with pytest.raises(UnreadableFileError, match=match):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_compressed_files_are_refused(tmp_path):
    np.savez_compressed(tmp_path / "bomb.npz", a=np.zeros(1 << 20))
    with pytest.raises(UnreadableFileError, match=r"'a\.npy'.* are compressed"):
        read(tmp_path / "bomb.npz")


@settings(max_examples=300)
@given(st.randoms(use_true_random=False))
def test_a_damaged_file_is_read_or_refused_by_name(tmp_path_factory, rng):
    path = tmp_path_factory.mktemp("damaged") / "a.npz"
    np.savez(path, **ARRAYS)
    mutate_file(path, rng)
    try:
        read(path)
    except (UnreadableFileError, FileNotFoundError) as error:
        assert str(path) in str(error)
