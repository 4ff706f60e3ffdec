"""Reads NumPy archives, after checking that their content fits their size."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_caiac._files import UnreadableFileError, check_archive

__all__ = ["read_npz"]


def read_npz(
    file: str | os.PathLike[str],
    what: str,
    remedy: str,
    *,
    names: Collection[str] | None = None,
) -> dict[str, NDArray[Any]]:
    """Reads the arrays of a file that ``numpy.savez`` wrote.

    NumPy allocates what the header of an array says, before it reads the array. This
    function compares all headers with the size of the file first. Nothing is unpickled.

    Args:
        file (path): the file.
        what (str): what the file is, for the error message.
        remedy (str): the end of the message, which says what to do.

    Keyword Args:
        names (collection of str, optional): the arrays to read. Defaults to ``None``:
            all.

    Returns:
        dict of str to numpy.ndarray: the arrays.

    Raises:
        FileNotFoundError: there is no such file.
        UnreadableFileError: the file is damaged, compressed, or has Python objects.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data.npz import read_npz
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(f"{folder}/a.npz", steps=np.arange(3))
        ...     read_npz(f"{folder}/a.npz", "episode", "delete it")
        {'steps': array([0, 1, 2])}
    """
    path = Path(file)
    check_archive(path, what, remedy)
    try:
        with zipfile.ZipFile(path) as archive:
            for part in archive.infolist():
                _check_header(archive, part)
        with np.load(path, allow_pickle=False) as stored:
            wanted = [n for n in stored.files if names is None or n in names]
            return {name: stored[name] for name in wanted}
    except Exception as error:  # zipfile and NumPy raise many kinds for damaged files
        raise UnreadableFileError(
            f"{path} is not a readable {what}, it may be truncated or damaged "
            f"({error}): {remedy}"
        ) from error


def _check_header(archive: zipfile.ZipFile, part: zipfile.ZipInfo) -> None:
    with archive.open(part) as stream:
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            raise ValueError(f"{part.filename} has an array of version {version}")
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
        if dtype.hasobject:
            # They could be a pickle, which could execute anything.
            raise ValueError(f"{part.filename} has Python objects")
        expected = stream.tell() + math.prod(shape) * dtype.itemsize
        if expected != part.file_size:
            raise ValueError(
                f"{part.filename} has {part.file_size} bytes, but an array {shape} of "
                f"{dtype} needs {expected}"
            )
