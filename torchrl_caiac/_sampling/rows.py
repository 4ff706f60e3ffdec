"""Reading and checking rows, in C or CUDA."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch

from torchrl_caiac._sampling import on_cuda as cuda
from torchrl_caiac._sampling.on_cpu import (
    GOOD,
    addresses,
    call,
    call_with_rows,
    int64_array,
)
from torchrl_caiac._sampling.runs import Runs

__all__ = [
    "all_finite",
    "batch_fits",
    "column_runs",
    "device_numbers",
    "free_windows",
    "gather_rows",
    "look",
    "read_ahead",
    "read_columns",
    "row_sums",
    "rows_equal",
    "rows_fit",
    "state_matches",
]


def row_sums(values: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Returns the sums of the bits of float32 numbers with weights, on the CPU.

    Args:
        values (torch.Tensor): float32 ``[B, L]``.
        weights (torch.Tensor): int64 ``[L]``.

    Returns:
        torch.Tensor: int64 ``[B]``.
    """
    sums = weights.new_empty(len(values))
    call(
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
    valid = torch.empty(count, dtype=torch.bool, device=known.device)
    if known.is_cuda:
        widths = [leaf.shape[1] for leaf in leaves]
        fields = [
            *(count, len(known), cuda.address(rows), len(leaves)),
            *(cuda.address(known), upper, cuda.address(valid)),
            *cuda.padded([leaf.data_ptr() for leaf in leaves]),
            *cuda.padded(widths),
            *cuda.padded([weight.data_ptr() for weight in weights]),
        ]
        cuda.start("state_matches", known.device, (cuda.blocks(count), 1), fields)
        return valid
    call_with_rows(
        "state_matches",
        rows,
        len(known),
        count,
        len(known),
        rows,
        len(leaves),
        addresses(leaves),
        int64_array([leaf.shape[1] for leaf in leaves]),
        addresses(weights),
        known,
        upper,
        valid,
    )
    return valid


def gather_rows(
    sources: Sequence[torch.Tensor], rows: torch.Tensor
) -> list[torch.Tensor]:
    """Returns rows of several tensors on the CPU.

    Args:
        sources (sequence of torch.Tensor): ``[T, ...]`` each.
        rows (torch.Tensor): int64 ``[B]``.

    Returns:
        list of torch.Tensor: ``[B, ...]`` each.

    Raises:
        IndexError: a row is out of range.
    """
    count, length = rows.shape[0], sources[0].shape[0]
    table, found = [], []
    for source in sources:
        out = source.new_empty((count, *source.shape[1:]))
        found.append(out)
        table += [source.data_ptr(), out.data_ptr(), source.nbytes // length]
    call_with_rows(
        *("gather_rows", rows, length, count, length, rows),
        *(len(found), int64_array(table)),
    )
    return found


def rows_equal(own: torch.Tensor, source: torch.Tensor, rows: torch.Tensor) -> bool:
    """Returns whether rows are those of a source to the bit, on the CPU.

    Args:
        own (torch.Tensor): ``[B, ...]``.
        source (torch.Tensor): ``[T, ...]``.
        rows (torch.Tensor): int64 ``[B]``.

    Returns:
        bool: whether they are.
    """
    size = own.nbytes // max(1, len(own))
    count = len(own)
    return call("rows_equal", count, len(source), rows, size, own, source) == GOOD


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
    out = source.new_empty(count, len(columns))
    if source.is_cuda:
        where = device_numbers(tuple(columns), source.device)
        fields = [
            *(count, len(source), cuda.address(rows), where.data_ptr()),
            *(len(columns), source.shape[1], source.element_size()),
            *map(cuda.address, (source, out)),
        ]
        blocks = cuda.blocks(out.numel())
        cuda.start("read_columns", source.device, (blocks, 1), fields)
        return out
    runs = column_runs(tuple(columns), source.element_size())
    call_with_rows(
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


def read_ahead(
    source: torch.Tensor,
    columns: tuple[int, ...],
    rows: torch.Tensor,
    steps: torch.Tensor,
    left: torch.Tensor,
) -> torch.Tensor:
    """Returns some columns of rows that are some steps after others, on the CPU.

    Args:
        source (torch.Tensor): ``[T, D]``, a ring.
        columns (tuple of int): the columns, at least one.
        rows (torch.Tensor): int64 ``[M]``.
        steps (torch.Tensor): int64 ``[M]``, at least 0.
        left (torch.Tensor): int32 or int64 ``[T]``, the most steps from each row.

    Returns:
        torch.Tensor: ``[M, len(columns)]``.

    Raises:
        IndexError: a row is out of range, or its steps are negative.
    """
    count, length = rows.shape[0], left.shape[0]
    out = source.new_empty(count, len(columns))
    size = source.element_size()
    runs = column_runs(columns, size)
    places = torch.empty_like(rows)
    call_with_rows(
        "read_ahead",
        rows,
        length,
        *(count, length, rows, steps, left.dtype is torch.int32, left),
        *(source.shape[1] * size, runs.start.shape[0], runs.start, runs.length),
        *(source, places, out),
    )
    return out


@lru_cache(maxsize=256)
def device_numbers(numbers: tuple[int, ...], device: torch.device) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.int64, device=device)


@lru_cache(maxsize=64)
def column_runs(columns: tuple[int, ...], itemsize: int) -> Runs:
    """Returns where columns are in a row."""
    return Runs.of_columns([(0, column) for column in columns], itemsize)


def free_windows(
    scores: torch.Tensor, limits: torch.Tensor, window: int
) -> torch.Tensor:
    """Returns which entities have scores of at most the limits in all of a window.

    Args:
        scores (torch.Tensor): float32 ``[B * window, N]``.
        limits (torch.Tensor): float32 ``[N]``, or ``[]`` for all entities.
        window (int): rows in a window.

    Returns:
        torch.Tensor: bool ``[B, N]``.
    """
    rows, entities = scores.shape
    windows = rows // window
    free = scores.new_empty(windows, entities, dtype=torch.bool)
    sizes = windows, window, entities
    step = limits.ndim
    if scores.is_cuda:
        places = map(cuda.address, (scores, limits))
        fields = [*sizes, *places, step, free.data_ptr()]
        blocks = cuda.blocks(free.numel())
        cuda.start("uninfluenced", scores.device, (blocks, 1), fields)
    else:
        call("uninfluenced", *sizes, scores, limits, step, free)
    return free


def all_finite(leaves: Sequence[torch.Tensor]) -> bool:
    """Returns whether all numbers of float32 tensors on the CPU are finite."""
    return all(call("all_finite", leaf.numel(), leaf) for leaf in leaves)


def look(
    found: torch.Tensor,
    values: Sequence[tuple[int, torch.Tensor, int, torch.Tensor | None]],
) -> None:
    """Marks the tensors of a CUDA device that have bad values.

    Args:
        found (torch.Tensor): float64 ``[V]``, gets NaN where something is bad.
        values (sequence of tuple): the place in ``found``, a tensor, the kind of bad
            value as in ``sampling.cu``, and which values count, bool, if not all.
    """
    for some in cuda.groups(values):
        fields = [found.data_ptr()]
        columns = zip(
            *(
                (cuda.address(x), cuda.address(where), x.numel(), kind, place)
                for place, x, kind, where in some
            ),
            strict=True,
        )
        for column in columns:
            fields += cuda.padded(column)
        blocks = cuda.blocks(max(x.numel() for _, x, *_ in some))
        cuda.start("look", found.device, (blocks, len(some)), fields)


def batch_fits(
    states: Sequence[tuple[torch.Tensor, torch.Tensor, torch.Tensor]],
    scores: torch.Tensor,
    known: torch.Tensor | None,
    upper: int,
    ids: torch.Tensor | None,
    flags: Sequence[torch.Tensor],
    window: int,
) -> bool:
    """Returns whether a batch may be swapped, on the CPU.

    Its scores are those of its states, or finite if they have no fingerprints, and the
    rows of each window follow each other: every state is the next state of the row
    before, to the bit, and the trajectory is the same and has not ended.

    Args:
        states (sequence of tuple): for each leaf of a state the values, those of the
            next state, float32 ``[B * window, L]``, and the weights of its hash.
        scores (torch.Tensor): float32 ``[B * window, N]``.
        known (torch.Tensor, optional): the fingerprints, int64 ``[B * window]``.
        upper (int): the upper half of a fingerprint, less the hash of the states.
        ids (torch.Tensor, optional): trajectory ids, int64, one for each row.
        flags (sequence of torch.Tensor): end flags, bool, one for each row.
        window (int): rows in a window.

    Returns:
        bool: whether it may. If not, it can still be right, such as a window of noisy
        recordings.
    """
    numbers = [
        *(len(scores), window, cuda.address(known), upper, cuda.address(ids)),
        *(scores.data_ptr(), scores.numel(), len(states), len(flags)),
    ]
    for here, there, weights in states:
        numbers += [here.data_ptr(), there.data_ptr(), weights.data_ptr()]
        numbers.append(here.shape[1])
    numbers += [flag.data_ptr() for flag in flags]
    return bool(call("batch_fits", int64_array(numbers)))


def rows_fit(
    states: Sequence[tuple[torch.Tensor, torch.Tensor, torch.Tensor]],
    known: torch.Tensor | None,
    upper: int,
    ids: torch.Tensor | None,
    flags: Sequence[torch.Tensor],
    window: int,
) -> torch.Tensor:
    """Returns which rows may be swapped, on a CUDA device.

    Args:
        states (sequence of tuple): as of :func:`batch_fits`.
        known (torch.Tensor, optional): as of :func:`batch_fits`.
        upper (int): as of :func:`batch_fits`.
        ids (torch.Tensor, optional): as of :func:`batch_fits`.
        flags (sequence of torch.Tensor): as of :func:`batch_fits`.
        window (int): rows in a window.

    Returns:
        torch.Tensor: bool ``[B * window]``.
    """
    here, there, weights = zip(*states, strict=True)
    rows, device = len(here[0]), here[0].device
    valid = torch.empty(rows, dtype=torch.bool, device=device)
    fields = [
        *(rows, window, cuda.address(known), upper, cuda.address(ids)),
        *(len(states), len(flags), valid.data_ptr()),
    ]
    for tensors in (here, there, weights):
        fields += cuda.padded([x.data_ptr() for x in tensors])
    fields += cuda.padded([x.shape[1] for x in here])
    fields += cuda.padded([x.data_ptr() for x in flags])
    cuda.start("rows_fit", device, (cuda.blocks(rows), 1), fields)
    return valid
