"""What sampling does to each row, in C or CUDA: compiled where it runs.

Each function gives the numbers of its reference, which computes them by operations of
torch, to the bit. Without a compiler the reference is used. The functions are in
``_sampling.c``, for tensors on the CPU, and in ``_sampling.cu``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache, partial
from typing import NamedTuple, TypeVar

import torch

from torchrl_caiac import _sampling_cuda as cuda
from torchrl_caiac._sampling_c import addresses, call, call_with_rows, library

__all__ = [
    "MOST_LEAVES",
    "Runs",
    "all_finite",
    "batch_donors",
    "buffer_donors",
    "chosen_windows",
    "hindsight_sources",
    "is_native",
    "look",
    "only_torch",
    "plain",
    "read_columns",
    "row_sums",
    "state_matches",
    "swap_rows",
]

_T = TypeVar("_T")

# Leaves of a state that are compared with fingerprints at once.
MOST_LEAVES = cuda.LEAVES
# Numbers of a batch from which torch, with several threads, may be faster.
_MOST = 1 << 22
_off: ContextVar[bool] = ContextVar("only_torch", default=False)


class Runs(NamedTuple):
    """Where the entities are in a row of a leaf.

    Attributes:
        entity (torch.Tensor): the entity of each run of bytes, int64 ``[R]``.
        start (torch.Tensor): its first byte in the row, int64 ``[R]``.
        length (torch.Tensor): its bytes, int64 ``[R]``.
        owners (tuple of int): the entity of each column, -1 for nobody; empty if runs
            are those of some columns.
    """

    entity: torch.Tensor
    start: torch.Tensor
    length: torch.Tensor
    owners: tuple[int, ...]

    @classmethod
    def of(cls, owners: Sequence[int], itemsize: int) -> Runs:
        """Returns the runs of columns with these owners; -1 is nobody.

        Examples:
            >>> from torchrl_caiac._sampling import Runs
            >>> Runs.of([0, 0, -1, 1], itemsize=4).start
            tensor([ 0, 12])
        """
        pairs = [(owner, c) for c, owner in enumerate(owners) if owner >= 0]
        return cls.of_columns(pairs, itemsize)._replace(owners=tuple(owners))

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
        return cls(entity, start, length, ())


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


def is_native(*tensors: torch.Tensor, sources: Sequence[torch.Tensor] = ()) -> bool:
    """Returns whether tensors are computed in C or CUDA: plain ones on one device.

    Args:
        *tensors (torch.Tensor): the tensors of a batch.

    Keyword Args:
        sources (sequence of torch.Tensor): tensors that rows are read from, which may
            be large.

    Returns:
        bool: whether they are, and the functions can be used here.
    """
    if _off.get() or torch.compiler.is_compiling():
        return False
    device = tensors[0].device if tensors else torch.device("cpu")
    if not all(map(partial(_is_plain, device=device), (*tensors, *sources))):
        return False
    if device.type != "cpu":
        return cuda.is_there(device)
    if torch.get_num_threads() > 1 and any(x.numel() > _MOST for x in tensors):
        return False
    return library() is not None


# Kinds of tensors whose numbers are at their addresses.
_PLAIN = {torch.Tensor}


def _is_plain(tensor: torch.Tensor, device: torch.device) -> bool:
    return (
        type(tensor) in _PLAIN
        and tensor.device == device
        and tensor.is_contiguous()
        and not (tensor.requires_grad or tensor.is_neg() or tensor.is_conj())
        and (tensor.data_ptr() != 0 or not tensor.numel())
    )


def plain(tensor: torch.Tensor) -> torch.Tensor:
    """Returns a view of a tensor, such as a memory-mapped one, without its class."""
    return tensor if type(tensor) in _PLAIN else tensor.as_subclass(torch.Tensor)


def row_sums(values: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Returns the sums of the bits of float32 numbers with weights, on the CPU.

    Args:
        values (torch.Tensor): float32 ``[B, L]``.
        weights (torch.Tensor): int64 ``[L]``.

    Returns:
        torch.Tensor: int64 ``[B]``.
    """
    sums = torch.empty(len(values), dtype=torch.int64)
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
            *_padded([leaf.data_ptr() for leaf in leaves]),
            *_padded(widths),
            *_padded([weight.data_ptr() for weight in weights]),
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
        (ctypes.c_int64 * len(leaves))(*(leaf.shape[1] for leaf in leaves)),
        addresses(weights),
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
    found = _empty_draw(free, drawn)
    if free.is_cuda:
        listed = torch.empty(2, entities, count, dtype=torch.int64, device=free.device)
        fields = [
            *(count, count - drawn, entities, window),
            *map(cuda.address, (free, chosen, chance)),
            swap_prob,
            *map(cuda.address, (share, *listed.unbind(), *found)),
        ]
        cuda.start("batch_donors", free.device, (entities, 1), fields)
        return found
    listed = torch.empty(count, dtype=torch.int64)
    call(
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
    found = _empty_draw(free, len(free))
    if free.is_cuda:
        fields = [
            *free.shape,
            *map(cuda.address, (free, chosen, chance)),
            swap_prob,
            *map(cuda.address, (share, offset, size)),
            len(starts),
            starts.dtype is torch.int32,
            *map(cuda.address, (starts, found[0], found[1], found[2].zero_())),
        ]
        blocks = cuda.blocks(free.numel())
        cuda.start("buffer_donors", free.device, (blocks, 1), fields)
        return found
    call(
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
    free: torch.Tensor, drawn: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    entities = free.shape[1]
    donors = free.new_empty(drawn, entities, dtype=torch.int64)
    swapped = free.new_empty(drawn, entities)
    return donors, swapped, free.new_empty(entities, dtype=torch.int64)


def chosen_windows(number: torch.Tensor, count: int) -> torch.Tensor:
    """Returns the windows that have the smallest numbers, on a CUDA device.

    Args:
        number (torch.Tensor): random numbers, float64 ``[B]``.
        count (int): how many windows are chosen.

    Returns:
        torch.Tensor: bool ``[B]``.
    """
    chosen = torch.empty_like(number, dtype=torch.bool)
    fields = len(number), count, number.data_ptr(), chosen.data_ptr()
    cuda.start("chosen_windows", number.device, (cuda.blocks(len(number)), 1), fields)
    return chosen


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
    found = flags.new_empty(2, len(flags), dtype=torch.int64)
    order, source = found.unbind()
    if flags.is_cuda:
        fields = [
            len(flags),
            *map(cuda.address, (flags, chance, pick)),
            *(future, random, counterfactual),
            *map(cuda.address, (order, source)),
        ]
        cuda.start("hindsight_sources", flags.device, (1, 1), fields)
        return source
    call(
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
    out = source.new_empty(count, len(columns))
    if source.is_cuda:
        where = _on_device(tuple(columns), source.device)
        fields = [
            *(count, len(source), cuda.address(rows), where.data_ptr()),
            *(len(columns), source.shape[1], source.element_size()),
            *map(cuda.address, (source, out)),
        ]
        blocks = cuda.blocks(out.numel())
        cuda.start("read_columns", source.device, (blocks, 1), fields)
        return out
    runs = _column_runs(tuple(columns), source.element_size())
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


@lru_cache(maxsize=256)
def _on_device(numbers: tuple[int, ...], device: torch.device) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.int64, device=device)


@lru_cache(maxsize=64)
def _column_runs(columns: tuple[int, ...], itemsize: int) -> Runs:
    return Runs.of_columns([(0, column) for column in columns], itemsize)


def swap_rows(
    own: Sequence[torch.Tensor],
    sources: Sequence[torch.Tensor],
    runs: Sequence[Runs],
    donors: torch.Tensor,
    swapped: torch.Tensor,
    window: int,
) -> list[torch.Tensor]:
    """Returns the rows of a batch, in which entities are those of their donors.

    Args:
        own (sequence of torch.Tensor): leaves of the batch, ``[B * window, ...]``.
        sources (sequence of torch.Tensor): for each leaf what donors are rows of,
            ``[T, ...]``.
        runs (sequence of Runs): for each leaf where the entities are in a row.
        donors (torch.Tensor): the first row of each donor, int64 ``[C, N]``.
        swapped (torch.Tensor): which entities of the last ``C`` windows are swapped,
            bool ``[C, N]``.
        window (int): rows in a window.

    Returns:
        list of torch.Tensor: for each leaf ``[B * window, ...]``.
    """
    drawn, entities = swapped.shape
    rows = len(own[0])
    outs = [torch.empty_like(leaf) for leaf in own]
    leaves = list(zip(own, sources, runs, outs, strict=True))
    if swapped.is_cuda:
        for some in _groups(leaves):
            fields = [rows - drawn * window, drawn, window, entities]
            fields += [donors.data_ptr(), swapped.data_ptr()]
            for column in zip(*(_leaf_fields(*leaf) for leaf in some), strict=True):
                fields += _padded(column)
            blocks = cuda.blocks(max(leaf.numel() for leaf, *_ in some))
            cuda.start("swap_rows", swapped.device, (blocks, len(some)), fields)
        return outs
    table = [
        number
        for leaf, source, where, out in leaves
        for number in (
            len(source),
            leaf.nbytes // rows,
            len(where.entity),
            *map(cuda.address, (*where[:3], leaf, source, out)),
        )
    ]
    call_with_rows(
        "swap_rows",
        donors,
        min(map(len, sources)),
        rows - drawn * window,
        drawn,
        window,
        entities,
        donors,
        swapped,
        len(leaves),
        (ctypes.c_int64 * len(table))(*table),
    )
    return outs


def _leaf_fields(
    own: torch.Tensor, source: torch.Tensor, runs: Runs, out: torch.Tensor
) -> list[int]:
    """Returns what the kernel ``swap_rows`` knows of a leaf."""
    owners, width = runs.owners, own.numel() // len(own)
    if len(owners) == 1:  # of all values
        owner, entity = 0, owners[0]
    else:
        owner, entity = _on_device(owners, own.device).data_ptr(), -1
    places = map(cuda.address, (own, source, out))
    return [*places, len(source), width, own.element_size(), owner, entity]


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
            value as in ``_sampling.cu``, and which values count, bool, if not all.
    """
    for some in _groups(values):
        fields = [found.data_ptr()]
        columns = zip(
            *(
                (cuda.address(x), cuda.address(where), x.numel(), kind, place)
                for place, x, kind, where in some
            ),
            strict=True,
        )
        for column in columns:
            fields += _padded(column)
        blocks = cuda.blocks(max(x.numel() for _, x, *_ in some))
        cuda.start("look", found.device, (blocks, len(some)), fields)


def _groups(items: Sequence[_T]) -> Iterator[Sequence[_T]]:
    """Yields as many items as one start of a kernel reads."""
    return (items[i : i + cuda.LEAVES] for i in range(0, len(items), cuda.LEAVES))


def _padded(numbers: Sequence[int]) -> list[int]:
    return [*numbers, *[0] * (cuda.LEAVES - len(numbers))]
