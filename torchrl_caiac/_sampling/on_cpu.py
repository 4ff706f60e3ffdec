"""The functions of ``sampling.c``, compiled where they run by the C compiler."""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch

from torchrl_caiac._kernels import cache_folder, machine, processor_slug
from torchrl_caiac._whole_files import whole_file

__all__ = [
    "GOOD",
    "addresses",
    "call",
    "call_with_rows",
    "check_rows",
    "int64_array",
    "library",
]

_logger = logging.getLogger("torchrl_caiac")

_SOURCE = Path(__file__).with_name("sampling.c")
_FLAGS = ("-O3", "-march=native", "-std=c99", "-shared", "-fPIC")
_SECONDS = 60  # for compiling
GOOD = -1  # what functions in C return if no row is out of range


def addresses(tensors: Sequence[torch.Tensor]) -> Any:
    """Returns the addresses of the numbers of tensors, an array in C."""
    return (ctypes.c_void_p * len(tensors))(*(x.data_ptr() for x in tensors))


def int64_array(numbers: Sequence[int]) -> Any:
    """Returns an array in C."""
    return _array_type(len(numbers))(*numbers)


@lru_cache(maxsize=64)
def _array_type(length: int) -> Any:  # ctypes would create some of them again and again
    return ctypes.c_int64 * length


def call(name: str, *args: Any) -> Any:
    """Calls a function; tensors are passed as the addresses of their numbers."""
    functions = library()
    assert functions is not None  # is_native() is true
    return functions[name](
        *(x.data_ptr() if isinstance(x, torch.Tensor) else x for x in args)
    )


def call_with_rows(
    name: str, rows: torch.Tensor | None, length: int, *args: Any
) -> None:
    """Calls a function that reads rows of tensors.

    Args:
        name (str): the function.
        rows (torch.Tensor, optional): the rows, in their order.
        length (int): how many there are.
        *args (Any): the arguments.

    Raises:
        IndexError: a row is out of range.
    """
    check_rows(call(name, *args), rows, length)


def check_rows(place: int, rows: torch.Tensor | None, length: int) -> None:
    """Raises if a function returned the place of a row that is out of range.

    Args:
        place (int): what it returned.
        rows (torch.Tensor, optional): the rows, in their order.
        length (int): how many there are.

    Raises:
        IndexError: a row is out of range.
    """
    if place != GOOD:
        bad = place if rows is None else int(rows.flatten()[place])
        raise IndexError(f"row {bad} is out of range: there are {length} rows")


_P, _I = ctypes.c_void_p, ctypes.c_int64
_ARGUMENTS: dict[str, list[Any]] = {
    "row_sums": [_I, _I, _P, _P, _P],
    "state_matches": [_I, _I, _P, _I, _P, _P, _P, _P, _I, _P],
    "batch_donors": [*[_I] * 4, *[_P] * 3, ctypes.c_float, *[_P] * 5],
    "buffer_donors": [_I, _I, *[_P] * 3, ctypes.c_float, *[_P] * 3, _I, _I, *[_P] * 4],
    "hindsight_sources": [_I, *[_P] * 3, *[ctypes.c_double] * 3, _P, _P],
    "relabel_batch": [_P, _P],
    "relabel_rows": [*[_I] * 3, *[_P] * 4, _I, _I, *[_P] * 5],
    "gather_rows": [_I, _I, _P, _I, _P],
    "rows_equal": [_I, _I, _P, _I, _P, _P],
    "read_ahead": [_I, _I, _P, _P, _I, _P, _I, _I, *[_P] * 5],
    "read_columns": [_I, _I, _P, _I, _I, *[_P] * 4],
    "swap_rows": [*[_I] * 4, _P, _P, _I, _P],
    "all_finite": [_I, _P],
    "uninfluenced": [_I, _I, _I, _P, _P, _I, _P],
    "batch_fits": [_P],
    "swap_batch": [_P, ctypes.c_float, _P],
    "window_goals": [_P, _P],
}


@cache
def library() -> dict[str, Callable[..., Any]] | None:
    """Returns the functions in C, ``None`` if they cannot be compiled."""
    if os.environ.get("TORCHRL_CAIAC_NATIVE") == "0":
        return None
    try:
        library = _load()
    except (OSError, subprocess.SubprocessError) as error:
        _logger.warning(
            "sampling is slower, as its functions in C are not compiled: %s. Install a "
            "C compiler (apt-get install gcc), or name one in the environment "
            "variable CC",
            error,
        )
        return None
    functions = {}
    for name, arguments in _ARGUMENTS.items():
        function = getattr(library, name)
        function.argtypes = arguments
        function.restype = ctypes.c_int32 if name == "all_finite" else ctypes.c_int64
        functions[name] = function
    return functions


def _load() -> ctypes.CDLL:
    """Loads the library of this processor, which is compiled once."""
    names = (os.environ.get("CC"), "cc", "gcc", "clang")
    compiler = next((found for n in names if n and (found := shutil.which(n))), None)
    if compiler is None:
        raise FileNotFoundError("there is no C compiler")
    own = {**machine(), "flags": _FLAGS, "compiler": compiler}
    del own["threads"]
    key = _SOURCE.read_bytes() + json.dumps(own).encode()
    slug = processor_slug(str(own["processor"]))
    name = f"sampling-{slug}-{hashlib.sha256(key).hexdigest()[:12]}.so"
    folder = cache_folder()
    file = None if folder is None else folder / name
    if file is not None and _is_mine(file):
        try:
            return ctypes.CDLL(str(file))
        except OSError as error:  # damaged
            _logger.debug("%s is compiled again: %s", file, error)
    with tempfile.TemporaryDirectory() as work:
        made = Path(work, name)
        subprocess.run(
            [compiler, *_FLAGS, str(_SOURCE), "-o", str(made)],
            check=True,
            capture_output=True,
            timeout=_SECONDS,
        )
        # It stays loaded without its file.
        return ctypes.CDLL(str(made if file is None else _kept(made, file)))


def _is_mine(file: Path) -> bool:
    """Returns whether this user alone can have written a file."""
    if not file.is_file():
        return False
    status = file.stat()
    return status.st_uid == os.geteuid() and not status.st_mode & 0o022


def _kept(made: Path, file: Path) -> Path:
    """Copies a file for the next process; returns the one to load."""
    try:
        with whole_file(file) as partial:
            shutil.copyfile(made, partial)
            partial.chmod(0o700)
    except OSError as error:
        _logger.debug("%s is not kept: %s", file, error)
        return made
    return file
