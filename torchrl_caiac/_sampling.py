"""What sampling does to each row, in C: compiled where it runs, by the C compiler.

Each function gives the numbers of its reference, which computes them by operations of
torch, to the bit. Without a compiler the reference is used.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchrl_caiac._kernels import cache_folder, machine, processor_slug
from torchrl_caiac._whole_files import whole_file

__all__ = [
    "Runs",
    "all_finite",
    "batch_donors",
    "buffer_donors",
    "hindsight_sources",
    "is_native",
    "is_native_source",
    "only_torch",
    "read_columns",
    "row_sums",
    "state_matches",
    "swap_rows",
]

_logger = logging.getLogger("torchrl_caiac")

_SOURCE = Path(__file__).with_suffix(".c")
_FLAGS = ("-O3", "-march=native", "-std=c99", "-shared", "-fPIC")
_SECONDS = 60  # for compiling
# Numbers of a batch from which torch, with several threads, may be faster.
_MOST = 1 << 22
_GOOD = -1  # what functions in C return if no row is out of range
_off: ContextVar[bool] = ContextVar("only_torch", default=False)


class Runs(NamedTuple):
    """Where the entities are in a row of a leaf.

    Attributes:
        entity (torch.Tensor): the entity of each run of bytes, int64 ``[R]``.
        start (torch.Tensor): its first byte in the row, int64 ``[R]``.
        length (torch.Tensor): its bytes, int64 ``[R]``.
        last (int): the highest entity, -1 if there is none.
    """

    entity: torch.Tensor
    start: torch.Tensor
    length: torch.Tensor
    last: int

    @classmethod
    def of(cls, owners: Sequence[int], itemsize: int) -> Runs:
        """Returns the runs of columns with these owners; -1 is nobody.

        Examples:
            >>> from torchrl_caiac._sampling import Runs
            >>> Runs.of([0, 0, -1, 1], itemsize=4).start
            tensor([ 0, 12])
        """
        pairs = [(owner, c) for c, owner in enumerate(owners) if owner >= 0]
        return cls.of_columns(pairs, itemsize)

    @classmethod
    def of_columns(cls, pairs: Sequence[tuple[int, int]], itemsize: int) -> Runs:
        """Returns the runs of pairs of an entity and one of its columns."""
        runs: list[list[int]] = []
        for owner, column in pairs:
            if runs and runs[-1][0] == owner and sum(runs[-1][1:]) == column * itemsize:
                runs[-1][2] += itemsize
            else:
                runs.append([owner, column * itemsize, itemsize])
        table = torch.tensor(runs, dtype=torch.int64).reshape(-1, 3)
        entity, start, length = table.t().contiguous().unbind()
        return cls(entity, start, length, max((n for n, _ in pairs), default=-1))


@contextmanager
def only_torch() -> Iterator[None]:
    """Uses the reference inside of the block.

    Examples:
        >>> from torchrl_caiac._sampling import is_native, only_torch
        >>> with only_torch():
        ...     is_native()
        False
    """
    token = _off.set(True)
    try:
        yield
    finally:
        _off.reset(token)


def is_native(*tensors: torch.Tensor) -> bool:
    """Returns whether tensors are computed in C: plain, contiguous, on the CPU.

    Args:
        *tensors (torch.Tensor): the tensors.

    Returns:
        bool: whether they are, and C can be used here.
    """
    if not is_native_source(*tensors):
        return False
    if any(x.numel() > _MOST for x in tensors) and torch.get_num_threads() > 1:
        return False
    if _off.get() or torch.compiler.is_compiling():
        return False
    return _library() is not None


def is_native_source(*tensors: torch.Tensor) -> bool:
    """Returns whether tensors of any size can be read in C."""
    return all(
        type(x) is torch.Tensor
        and x.device.type == "cpu"
        and x.is_contiguous()
        and not (x.requires_grad or x.is_neg() or x.is_conj())
        and (x.data_ptr() != 0 or not x.numel())
        for x in tensors
    )


def row_sums(values: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Returns the sums of the bits of float32 numbers with weights.

    Args:
        values (torch.Tensor): float32 ``[B, L]``.
        weights (torch.Tensor): int64 ``[L]``.

    Returns:
        torch.Tensor: int64 ``[B]``.
    """
    sums = torch.empty(len(values), dtype=torch.int64)
    _call(
        "row_sums",
        *values.shape,
        values,
        weights,
        sums,
    )
    return sums


def state_matches(
    leaves: Sequence[torch.Tensor],
    weights: Sequence[torch.Tensor],
    known: torch.Tensor,
    upper: int,
    rows: torch.Tensor | None,
) -> torch.Tensor:
    """Returns which rows have the states of their fingerprints.

    Args:
        leaves (sequence of torch.Tensor): states and next states, float32 or int32
            ``[T, L]`` each.
        weights (sequence of torch.Tensor): for each leaf int64 ``[L]``.
        known (torch.Tensor): the fingerprints, int64 ``[T]``.
        upper (int): the upper half of a fingerprint, less the hash of the states.
        rows (torch.Tensor, optional): int64 ``[B]``, the rows to compare; all of them
            if it is ``None``.

    Returns:
        torch.Tensor: bool ``[B]``.
    """
    count = len(known) if rows is None else len(rows)
    valid = torch.empty(count, dtype=torch.bool)
    _call_with_rows(
        "state_matches",
        rows,
        len(known),
        count,
        len(known),
        rows,
        len(leaves),
        _array(leaves),
        (ctypes.c_int64 * len(leaves))(*(leaf.shape[1] for leaf in leaves)),
        _array(weights),
        known,
        upper,
        valid,
    )
    return valid


def batch_donors(
    free: torch.Tensor,
    drawn: int,
    window: int,
    swap_prob: float,
    chosen: torch.Tensor | None,
    chance: torch.Tensor | None,
    share: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns donors among the windows of a batch, from random numbers.

    Args:
        free (torch.Tensor): bool ``[B, N]``, the entities that may be swapped.
        drawn (int): the number of windows that donors are drawn for, ``C``: the last
            ones of the batch.
        window (int): rows in a window.
        swap_prob (float): the chance below which a free entity is swapped.
        chosen (torch.Tensor, optional): bool ``[C]``, which windows become
            counterfactual.
        chance (torch.Tensor, optional): float32 ``[N, C]``, below 1.
        share (torch.Tensor): float64 ``[N, C]``, below 1: which donor it is.

    Returns:
        tuple of torch.Tensor: donors int64 ``[C, N]``, swapped bool ``[C, N]``, and
        without a donor int64 ``[N]``.
    """
    count, entities = free.shape
    found = _empty_draw(drawn, entities)
    listed = torch.empty(count, dtype=torch.int64)
    _call(
        "batch_donors",
        count,
        count - drawn,
        entities,
        window,
        free,
        chosen,
        chance,
        swap_prob,
        share,
        listed,
        *found,
    )
    return found


def buffer_donors(
    free: torch.Tensor,
    starts: torch.Tensor,
    offset: torch.Tensor,
    size: torch.Tensor,
    swap_prob: float,
    chosen: torch.Tensor | None,
    chance: torch.Tensor | None,
    share: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns donors among the eligible windows of a storage, from random numbers.

    Args:
        free (torch.Tensor): bool ``[C, N]``, the entities that may be swapped.
        starts (torch.Tensor): eligible rows, int32 or int64 ``[M]``, entity by entity.
        offset (torch.Tensor): where those of an entity begin, int64 ``[N]``.
        size (torch.Tensor): how many it has, int64 ``[N]``.
        swap_prob (float): the chance below which a free entity is swapped.
        chosen (torch.Tensor, optional): bool ``[C]``, which windows become
            counterfactual.
        chance (torch.Tensor, optional): float32 ``[N, C]``, below 1.
        share (torch.Tensor): float64 ``[C, N]``, below 1: which donor it is.

    Returns:
        tuple of torch.Tensor: as of :func:`batch_donors`.
    """
    found = _empty_draw(*free.shape)
    _call(
        "buffer_donors",
        *free.shape,
        free,
        chosen,
        chance,
        swap_prob,
        share,
        offset,
        size,
        len(starts),
        starts.dtype is torch.int32,
        starts,
        *found,
    )
    return found


def _empty_draw(
    drawn: int, entities: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    donors = torch.empty(drawn, entities, dtype=torch.int64)
    swapped = torch.empty(drawn, entities, dtype=torch.bool)
    return donors, swapped, torch.empty(entities, dtype=torch.int64)


def hindsight_sources(
    flags: torch.Tensor,
    chance: torch.Tensor,
    pick: torch.Tensor,
    future: float,
    random: float,
    counterfactual: float,
) -> torch.Tensor:
    """Returns where the goals of rows come from, from random numbers.

    Args:
        flags (torch.Tensor): which rows are counterfactual, bool ``[B]``.
        chance (torch.Tensor): float64 ``[B]``, below 1: whether a row is relabelled.
        pick (torch.Tensor): float64 ``[B]``, below 1: whose goal it gets.
        future (float): the share of real rows that get a future goal.
        random (float): the share of real rows that get that of another one.
        counterfactual (float): the share of counterfactual rows that are relabelled.

    Returns:
        torch.Tensor: int64 ``[B]``, below ``3 B``, see ``HindsightDraw``.
    """
    order, source = torch.empty(2, len(flags), dtype=torch.int64).unbind()
    _call(
        "hindsight_sources",
        len(flags),
        flags,
        chance,
        pick,
        future,
        random,
        counterfactual,
        order,
        source,
    )
    return source


def read_columns(
    source: torch.Tensor, columns: Sequence[int], rows: torch.Tensor | None
) -> torch.Tensor:
    """Returns some columns of some rows.

    Args:
        source (torch.Tensor): ``[T, D]``.
        columns (sequence of int): the columns, at least one.
        rows (torch.Tensor, optional): int64 ``[M]``; all rows if it is ``None``.

    Returns:
        torch.Tensor: ``[M, len(columns)]``.
    """
    count = len(source) if rows is None else len(rows)
    out = torch.empty(count, len(columns), dtype=source.dtype)
    runs = _column_runs(tuple(columns), source.element_size())
    _call_with_rows(
        "read_columns",
        rows,
        len(source),
        count,
        len(source),
        rows,
        source.shape[1] * source.element_size(),
        len(runs.start),
        runs.start,
        runs.length,
        source,
        out,
    )
    return out


@lru_cache(maxsize=64)
def _column_runs(columns: tuple[int, ...], itemsize: int) -> Runs:
    return Runs.of_columns([(0, column) for column in columns], itemsize)


def swap_rows(
    own: torch.Tensor,
    source: torch.Tensor,
    runs: Runs,
    donors: torch.Tensor,
    swapped: torch.Tensor,
    window: int,
) -> torch.Tensor:
    """Returns the rows of a batch, in which entities are those of their donors.

    Args:
        own (torch.Tensor): the rows, ``[B * window, ...]``.
        source (torch.Tensor): what donors are rows of, ``[T, ...]``.
        runs (Runs): where the entities are in a row.
        donors (torch.Tensor): the first row of each donor, int64 ``[C, N]``.
        swapped (torch.Tensor): which entities of the last ``C`` windows are swapped,
            bool ``[C, N]``.
        window (int): rows in a window.

    Returns:
        torch.Tensor: ``[B * window, ...]``.
    """
    out = torch.empty_like(own)
    drawn, entities = swapped.shape
    _call_with_rows(
        "swap_rows",
        donors,
        len(source),
        len(own) - drawn * window,
        drawn,
        window,
        entities,
        len(source),
        donors,
        swapped,
        own.nbytes // len(own),
        len(runs.entity),
        runs.entity,
        runs.start,
        runs.length,
        own,
        source,
        out,
    )
    return out


def all_finite(values: torch.Tensor) -> bool:
    """Returns whether all numbers of a float32 tensor are finite."""
    return bool(_call("all_finite", values.numel(), values))


# --- the library ---------------------------------------------------------------------


def _array(tensors: Sequence[torch.Tensor]) -> Any:
    return (ctypes.c_void_p * len(tensors))(*(x.data_ptr() for x in tensors))


def _call(name: str, *args: Any) -> Any:
    """Calls a function; tensors are passed as the addresses of their numbers."""
    functions = _library()
    assert functions is not None  # is_native() is true
    return functions[name](
        *(x.data_ptr() if isinstance(x, torch.Tensor) else x for x in args)
    )


def _call_with_rows(
    name: str, rows: torch.Tensor | None, length: int, *args: Any
) -> None:
    place = _call(name, *args)
    if place != _GOOD:
        bad = place if rows is None else int(rows.flatten()[place])
        raise IndexError(f"row {bad} is out of range: there are {length} rows")


_P, _I = ctypes.c_void_p, ctypes.c_int64
_ARGUMENTS: dict[str, list[Any]] = {
    "row_sums": [_I, _I, _P, _P, _P],
    "state_matches": [_I, _I, _P, _I, _P, _P, _P, _P, _I, _P],
    "batch_donors": [*[_I] * 4, *[_P] * 3, ctypes.c_float, *[_P] * 5],
    "buffer_donors": [_I, _I, *[_P] * 3, ctypes.c_float, *[_P] * 3, _I, _I, *[_P] * 4],
    "hindsight_sources": [_I, *[_P] * 3, *[ctypes.c_double] * 3, _P, _P],
    "read_columns": [_I, _I, _P, _I, _I, *[_P] * 4],
    "swap_rows": [*[_I] * 5, _P, _P, _I, _I, *[_P] * 6],
    "all_finite": [_I, _P],
}


@cache
def _library() -> dict[str, Callable[..., Any]] | None:
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
