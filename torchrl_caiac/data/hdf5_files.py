"""Opens HDF5 files, and names them in the errors of h5py."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl_caiac._extras import extra
from torchrl_caiac._files import UnreadableFileError

__all__ = ["open_hdf5", "reading_hdf5"]

_AGAIN = "download or create the file again"


def open_hdf5(file: Path) -> Any:
    """Opens an HDF5 file to read it.

    Args:
        file (Path): the file.

    Returns:
        h5py.File: the file, a context manager that closes it.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: the package ``h5py`` is missing.
        UnreadableFileError: it is not an HDF5 file, or truncated.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_caiac.data.hdf5_files import open_hdf5
        >>> open_hdf5(Path("missing.hdf5"))
        Traceback (most recent call last):
        ...
        FileNotFoundError: there is no file missing.hdf5: give another one
    """
    if not file.exists():
        raise FileNotFoundError(f"there is no file {file}: give another one")
    with extra("robomimic", str(file)):
        import h5py
    with reading_hdf5(file):
        return h5py.File(file, "r")


@contextmanager
def reading_hdf5(file: Path) -> Iterator[None]:
    """Context manager for a block that only reads an HDF5 file.

    h5py raises errors of many kinds for damaged files, also ``KeyError``, and does not
    name the file. Those of this package name it, and pass.

    Args:
        file (Path): the file.

    Raises:
        UnreadableFileError: h5py raised an error.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_caiac.data.hdf5_files import reading_hdf5
        >>> with reading_hdf5(Path("a.hdf5")):
        ...     raise KeyError("Unable to synchronously open object")
        Traceback (most recent call last):
        ...
        torchrl_caiac._files.UnreadableFileError: a.hdf5 is not a readable HDF5 file...
    """
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        # KeyError shows its message as a literal, with quotes that are escaped.
        text = str(error.args[0]) if error.args else str(error)
        if isinstance(error, UnreadableFileError) or f"{file}" in text:
            raise
        raise UnreadableFileError(
            f"{file} is not a readable HDF5 file, it may be truncated or damaged "
            f"({error}): {_AGAIN}"
        ) from error
