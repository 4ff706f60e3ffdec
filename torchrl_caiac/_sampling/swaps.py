"""Swapping entities in rows, in C or CUDA."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch

from torchrl_caiac._sampling import on_cuda as cuda
from torchrl_caiac._sampling.draws import batch_donors
from torchrl_caiac._sampling.on_cpu import (
    GOOD,
    addresses,
    call,
    call_with_rows,
    int64_array,
)
from torchrl_caiac._sampling.rows import device_numbers
from torchrl_caiac._sampling.runs import Runs

__all__ = ["DonorRows", "SwappedBatch", "swap_batch", "swap_rows"]


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
        for some in cuda.groups(leaves):
            fields = [rows - drawn * window, drawn, window, entities]
            fields += [donors.data_ptr(), swapped.data_ptr()]
            for column in zip(*(_leaf_fields(*leaf) for leaf in some), strict=True):
                fields += cuda.padded(column)
            blocks = cuda.blocks(max(leaf.numel() for leaf, *_ in some))
            cuda.start("swap_rows", swapped.device, (blocks, len(some)), fields)
        return outs
    table = [number for leaf in leaves for number in _table_row(*leaf)]
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
        int64_array(table),
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
        owner, entity = device_numbers(owners, own.device).data_ptr(), -1
    places = map(cuda.address, (own, source, out))
    return [*places, len(source), width, own.element_size(), owner, entity]


class DonorRows(NamedTuple):
    """The rows of a storage that donors are drawn from, on the CPU.

    Attributes:
        starts (torch.Tensor): eligible rows, int32 or int64 ``[M]``, entity by entity.
        offset (torch.Tensor): where those of an entity begin, int64 ``[N]``.
        size (torch.Tensor): how many it has, int64 ``[N]``.
        sources (sequence of torch.Tensor): for each leaf that is swapped the rows of
            the storage, ``[T, ...]``.
        known (torch.Tensor, optional): their fingerprints, int64 ``[T]``; ``None`` if
            they are not compared.
        states (sequence of tuple): for each leaf of states and next states the rows,
            float32 ``[T, L]``, and the weights of its hash, int64 ``[L]``.
        upper (int): the upper half of a fingerprint, less the hash of the states.
    """

    starts: torch.Tensor
    offset: torch.Tensor
    size: torch.Tensor
    sources: Sequence[torch.Tensor]
    known: torch.Tensor | None
    states: Sequence[tuple[torch.Tensor, torch.Tensor]]
    upper: int


class SwappedBatch(NamedTuple):
    """What :func:`swap_batch` returns.

    Attributes:
        leaves (list of torch.Tensor): the new leaves, ``[B * window, ...]``.
        counterfactual (torch.Tensor): which rows are counterfactual, bool
            ``[B * window, 1]``.
        swapped (torch.Tensor): which entities are swapped, bool ``[B * window, N]``.
        is_finite (bool): whether all states are finite.
        is_stale (bool): whether swaps were taken back, as their donors have other
            states than those of their fingerprints.
    """

    leaves: list[torch.Tensor]
    counterfactual: torch.Tensor
    swapped: torch.Tensor
    is_finite: bool
    is_stale: bool


def swap_batch(
    free: torch.Tensor,
    order: torch.Tensor | None,
    chance: torch.Tensor | None,
    share: torch.Tensor,
    count: int,
    window: int,
    swap_prob: float,
    leaves: Sequence[tuple[torch.Tensor, Runs]],
    states: Sequence[int | torch.Tensor],
    no_donor: torch.Tensor,
    donors: DonorRows | None = None,
) -> SwappedBatch:
    """Swaps entities between the windows of a batch, or with those of a storage.

    The same as :func:`batch_donors` or :func:`buffer_donors` and :func:`swap_rows`, and
    the flags of the rows.

    Args:
        free (torch.Tensor): bool ``[B, N]``, the entities that may be swapped.
        order (torch.Tensor, optional): a permutation of the windows: those that have a
            number below ``count`` become counterfactual; on a CUDA device which ones
            do, bool. The last ``count`` windows do if it is ``None``.
        chance (torch.Tensor, optional): float32 ``[N, C]``, below 1.
        share (torch.Tensor): float64 ``[N, C]``, below 1: which donor it is. With
            ``donors`` the same memory is read as ``[C, N]``.
        count (int): the number of windows that become counterfactual.
        window (int): rows in a window.
        swap_prob (float): the chance below which a free entity is swapped.
        leaves (sequence of tuple): what is swapped, ``[B * window, ...]``, and where
            the entities are in a row.
        states (sequence of int or torch.Tensor): what has to be finite after the swap,
            float32: places in ``leaves``, or other tensors. Only on the CPU.
        no_donor (torch.Tensor): int64 ``[N]``, to which the windows are added in which
            an entity had no donor.
        donors (DonorRows, optional): the storage that donors are from; ``None`` for the
            batch. Only on the CPU.

    Returns:
        SwappedBatch: the leaves and flags.

    Raises:
        IndexError: a donor is not a row of the storage.
    """
    windows, entities = free.shape
    drawn = share.shape[1]
    rows = windows * window
    if free.is_cuda:
        return _swap_cuda_batch(
            free, order, chance, share, window, swap_prob, leaves, no_donor
        )
    outs = [torch.empty_like(own) for own, _ in leaves]
    numbers = free.new_empty(windows + (drawn + 1) * entities, dtype=torch.int64)
    flags = free.new_empty(drawn * (entities + 1))
    chosen = free.new_empty(rows, 1)
    swapped = free.new_empty(rows, entities)
    storage = None if donors is None else _storage_numbers(donors)
    table = [
        *(windows, windows - drawn, entities, window),
        *map(cuda.address, (free, order, chance, share)),
        count,
        *map(cuda.address, (numbers, flags, no_donor, chosen, swapped)),
        *(len(leaves), len(states)),
        0 if storage is None else ctypes.addressof(storage[0]),
    ]
    sources = [own for own, _ in leaves] if donors is None else donors.sources
    for (own, runs), source, out in zip(leaves, sources, outs, strict=True):
        table += _table_row(own, source, runs, out)
    for state in states:
        tensor = outs[state] if isinstance(state, int) else state
        table += [tensor.data_ptr(), tensor.numel()]
    given, lost = int64_array(table), ctypes.c_int64()
    found = call("swap_batch", given, swap_prob, ctypes.byref(lost))
    if found >= 0:
        row = int(numbers[windows + found])
        raise IndexError(
            f"row {row} is out of range: there are {min(map(len, sources))} rows"
        )
    return SwappedBatch(outs, chosen, swapped, found == GOOD, lost.value > 0)


def _storage_numbers(donors: DonorRows) -> tuple[Any, ...]:
    """Returns what ``swap_batch`` in C knows of a storage, and what has to be kept."""
    values = [leaf for leaf, _ in donors.states]
    weights = [weight for _, weight in donors.states]
    kept = (
        addresses(values),
        int64_array([leaf.shape[1] for leaf in values]),
        addresses(weights),
    )
    known, starts = donors.known, donors.starts
    numbers = [
        *(donors.offset.data_ptr(), donors.size.data_ptr(), starts.shape[0]),
        *(starts.dtype is torch.int32, starts.data_ptr(), cuda.address(known)),
        *(0 if known is None else known.shape[0], donors.upper, len(values)),
        *map(ctypes.addressof, kept),
    ]
    return int64_array(numbers), kept


def _swap_cuda_batch(
    free: torch.Tensor,
    chosen: torch.Tensor | None,
    chance: torch.Tensor | None,
    share: torch.Tensor,
    window: int,
    swap_prob: float,
    leaves: Sequence[tuple[torch.Tensor, Runs]],
    no_donor: torch.Tensor,
) -> SwappedBatch:
    first = len(free) - share.shape[1]
    donors, swapped, missing = batch_donors(
        free, len(free) - first, window, swap_prob, chosen, chance, share
    )
    own, runs = zip(*leaves, strict=True)
    outs = swap_rows(own, own, runs, donors, swapped, window)
    no_donor.add_(missing)
    flags = swapped.new_ones(len(swapped), 1) if chosen is None else chosen[:, None]
    if window > 1:
        flags, swapped = (
            x.unsqueeze(1).expand(-1, window, -1).flatten(0, 1)
            for x in (flags, swapped)
        )
    if first:
        flags, swapped = (
            torch.cat([x.new_zeros(first * window, x.shape[1]), x])
            for x in (flags, swapped)
        )
    return SwappedBatch(outs, flags, swapped, is_finite=True, is_stale=False)


def _table_row(
    own: torch.Tensor, source: torch.Tensor, runs: Runs, out: torch.Tensor
) -> list[int]:
    """Returns what ``swap_rows`` in C knows of a leaf."""
    entity, begin, length, _ = runs
    return [
        *(source.shape[0], own.nbytes // own.shape[0], entity.shape[0]),
        *(entity.data_ptr(), begin.data_ptr(), length.data_ptr()),
        *(own.data_ptr(), source.data_ptr(), out.data_ptr()),
    ]
