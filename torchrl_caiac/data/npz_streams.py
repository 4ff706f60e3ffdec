"""Reads the arrays of a NumPy archive row by row, compressed or not."""

from __future__ import annotations

import math
import os
import zipfile
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_caiac._files import UnreadableFileError

__all__ = ["ArrayKind", "NpzStreams"]

# The most that deflate compresses; more means that a file was made to fill the memory.
_MOST_COMPRESSION = 1100
_MOST_AT_ONCE = 1 << 30  # bytes of an array that is not stored row by row


class ArrayKind(NamedTuple):
    """What the header of an array says.

    Attributes:
        dtype (numpy.dtype): the type of the numbers.
        shape (tuple of int): the shape.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.npz_streams import ArrayKind
        >>> ArrayKind(np.dtype("float32"), (3, 2)).shape
        (3, 2)
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]


class NpzStreams:
    """Context manager that reads the arrays of an ``.npz`` file a few rows at a time.

    ``numpy.load`` reads a compressed array at once. This class needs the memory of the
    rows that are asked for. Nothing is unpickled.

    Args:
        file (path): the file, as ``numpy.savez`` or ``numpy.savez_compressed`` writes
            it.
        what (str): what the file is, for error messages.
        remedy (str): the end of the messages, which says what to do.

    Attributes:
        kinds (dict of str to ArrayKind): types and shapes by the names of the arrays.

    Raises:
        FileNotFoundError: there is no such file.
        UnreadableFileError: the file is damaged, or has Python objects.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data.npz_streams import NpzStreams
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez_compressed(f"{folder}/a.npz", steps=np.arange(5))
        ...     with NpzStreams(f"{folder}/a.npz", "dataset", "delete it") as arrays:
        ...         arrays.take("steps", 2), arrays.take("steps", 3)
        (array([0, 1]), array([2, 3, 4]))
    """

    def __init__(self, file: str | os.PathLike[str], what: str, remedy: str) -> None:
        self.path, self._what, self._remedy = Path(file), what, remedy
        self.kinds: dict[str, ArrayKind] = {}
        self._streams: dict[str, IO[bytes]] = {}
        self._whole: dict[str, NDArray[Any]] = {}  # in Fortran's order
        self._next: dict[str, int] = {}
        with ExitStack() as stack:
            try:
                if not self.path.is_file():
                    self.path.stat()  # FileNotFoundError
                    raise ValueError("it is not a file")
                archive = stack.enter_context(zipfile.ZipFile(self.path))
                for part in archive.infolist():
                    self._open(archive, part, stack)
            except FileNotFoundError:
                raise
            except Exception as error:  # zipfile and NumPy raise many kinds
                raise self._unreadable(error) from error
            self._stack = stack.pop_all()

    def __enter__(self) -> NpzStreams:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    def take(self, name: str, rows: int) -> NDArray[Any]:
        """Returns the next rows of an array.

        Args:
            name (str): the array.
            rows (int): how many.

        Returns:
            numpy.ndarray: the rows, ``[rows, ...]``.

        Raises:
            UnreadableFileError: the file is damaged.
            ValueError: the array has fewer rows left.
        """
        dtype, shape = self.kinds[name]
        first = self._next[name]
        if not shape or first + rows > shape[0]:
            raise ValueError(
                f"{name!r} of {self.path} has shape {shape}, and {first} rows were "
                f"taken: {rows} more cannot be"
            )
        self._next[name] = first + rows
        if name in self._whole:
            return self._whole[name][first : first + rows]
        return self._read(name, (rows, *shape[1:]), dtype)

    def _read(
        self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> NDArray[Any]:
        expected = math.prod(shape) * dtype.itemsize
        try:
            content = self._streams[name].read(expected)
            if len(content) != expected:
                raise ValueError(f"{name} ends early")
        except Exception as error:  # zipfile and zlib raise many kinds
            raise self._unreadable(error) from error
        return np.frombuffer(content, dtype).reshape(shape)

    def _open(
        self, archive: zipfile.ZipFile, part: zipfile.ZipInfo, stack: ExitStack
    ) -> None:
        name = part.filename.removesuffix(".npy")
        if name in self.kinds or name == part.filename:
            raise ValueError(f"{part.filename} is not an array, or is there twice")
        stream = stack.enter_context(archive.open(part))
        shape, in_columns, dtype = _header(stream)
        if dtype.hasobject:
            # They are a pickle, which could execute anything.
            raise ValueError(
                f"{name!r} has Python objects, which are not read: save numbers"
            )
        expected = stream.tell() + math.prod(shape) * dtype.itemsize
        if expected != part.file_size:
            raise ValueError(
                f"{name!r} has {part.file_size} bytes, but an array {shape} of {dtype} "
                f"needs {expected}"
            )
        if part.file_size > _MOST_COMPRESSION * max(part.compress_size, 1):
            raise ValueError(
                f"{name!r} has {part.compress_size} bytes, too few for {shape} of "
                f"{dtype}"
            )
        self.kinds[name], self._streams[name] = ArrayKind(dtype, shape), stream
        self._next[name] = 0
        if in_columns and len(shape) > 1:
            if part.file_size > _MOST_AT_ONCE:
                raise ValueError(
                    f"{name!r} is stored column by column, and too large to read at "
                    "once: save numpy.ascontiguousarray of it"
                )
            whole = self._read(name, shape[::-1], dtype)
            self._whole[name] = whole.T

    def _unreadable(self, error: Exception) -> UnreadableFileError:
        if isinstance(error, UnreadableFileError):
            return error
        return UnreadableFileError(
            f"{self.path} is not a readable {self._what}, it may be truncated or "
            f"damaged ({error}): {self._remedy}"
        )


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(stream)
    raise ValueError(f"it has an array of version {version}")
