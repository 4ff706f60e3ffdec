"""Archives of NumPy, read a few rows at a time."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from torchrl_caiac.data import UnreadableFileError
from torchrl_caiac.data.npz_streams import NpzStreams


def opened(file):
    return NpzStreams(file, "archive", "make it again")


@given(
    array=arrays.arrays(
        st.sampled_from(["f4", ">f8", "i8", "u1", "?"]),
        arrays.array_shapes(max_dims=3, max_side=6),
    ),
    sizes=st.lists(st.integers(0, 3), max_size=4),
    save=st.sampled_from([np.savez, np.savez_compressed]),
    in_columns=st.booleans(),
)
@settings(max_examples=50, deadline=None)
def test_rows_are_those_that_numpy_reads(
    tmp_path_factory, array, sizes, save, in_columns
):
    file = tmp_path_factory.mktemp("npz") / "a.npz"
    array = np.asfortranarray(array) if in_columns else array
    save(file, a=array, b=array[::-1])
    with opened(file) as streams:
        assert streams.kinds["a"] == (array.dtype, array.shape)
        first = 0
        for size in [*sizes, len(array)]:
            size = min(size, len(array) - first)
            # In turn, from two arrays of one file.
            for name, whole in (("a", array), ("b", array[::-1])):
                expected = whole[first : first + size]
                assert np.array_equal(
                    streams.take(name, size),
                    expected,
                    equal_nan=array.dtype.kind == "f",
                )
            first += size
        with pytest.raises(ValueError, match=r"'a' of .*1 more cannot be"):
            streams.take("a", 1)


def test_the_memory_is_that_of_the_rows(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros((1000, 1000)))
    most = []
    read = zipfile.ZipExtFile.read

    def counted(self, size=-1):
        content = read(self, size)
        most.append(len(content))
        return content

    monkeypatch.setattr(zipfile.ZipExtFile, "read", counted)
    with opened(tmp_path / "a.npz") as streams:
        for _ in range(100):
            streams.take("a", 10)
    assert max(most) == 10 * 1000 * 8


def edited(file, edit):
    """Changes the content of the one array of a file."""
    with zipfile.ZipFile(file) as archive:
        content = archive.read("a.npy")
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", edit(content))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda content: content[:-8], "'a' has .* bytes, but an array"),
        (lambda content: content + b"more", "'a' has .* bytes, but an array"),
        (lambda content: content.replace(b"(10,", b"(99,"), "needs"),
        (lambda content: b"\x93NUMPY\x03\x00" + content[8:], "version"),
        (lambda content: b"no array", "magic"),
    ],
)
def test_headers_that_do_not_fit_are_refused(tmp_path, edit, message):
    np.savez(tmp_path / "a.npz", a=np.zeros(10))
    edited(tmp_path / "a.npz", edit)
    with pytest.raises(
        UnreadableFileError, match=rf"a.npz is .*{message}.*make it again"
    ):
        opened(tmp_path / "a.npz")


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.npz").write_text("no archive")
    with pytest.raises(UnreadableFileError, match=r"a.npz is not a readable archive"):
        opened(tmp_path / "a.npz")
    with pytest.raises(UnreadableFileError, match=r"it is not a file"):
        opened(tmp_path)
    with pytest.raises(FileNotFoundError):
        opened(tmp_path / "b.npz")
    np.savez(tmp_path / "a.npz", a=np.array([{}]))
    with pytest.raises(UnreadableFileError, match=r"'a' has Python objects"):
        opened(tmp_path / "a.npz")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("note.txt", "no array")
    with pytest.raises(UnreadableFileError, match=r"note.txt is not an array"):
        opened(tmp_path / "a.npz")
