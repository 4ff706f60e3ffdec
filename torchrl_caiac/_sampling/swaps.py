"""Swapping entities in rows, in C or CUDA."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch

from torchrl_caiac._sampling import on_cuda as cuda
from torchrl_caiac._sampling.draws import batch_donors
from torchrl_caiac._sampling.on_cpu import GOOD, call, call_with_rows
from torchrl_caiac._sampling.rows import device_numbers
from torchrl_caiac._sampling.runs import Runs

__all__ = ["swap_batch", "swap_rows"]


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
        owner, entity = device_numbers(owners, own.device).data_ptr(), -1
    places = map(cuda.address, (own, source, out))
    return [*places, len(source), width, own.element_size(), owner, entity]


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
) -> tuple[list[torch.Tensor], torch.Tensor, torch.Tensor, bool]:
    """Swaps entities between the windows of a batch.

    The same as :func:`batch_donors` and :func:`swap_rows`, and the flags of the rows.

    Args:
        free (torch.Tensor): bool ``[B, N]``, the entities that may be swapped.
        order (torch.Tensor, optional): a permutation of the windows: those that have a
            number below ``count`` become counterfactual; on a CUDA device which ones
            do, bool. The last ``count`` windows do if it is ``None``.
        chance (torch.Tensor, optional): float32 ``[N, C]``, below 1.
        share (torch.Tensor): float64 ``[N, C]``, below 1: which donor it is.
        count (int): the number of windows that become counterfactual.
        window (int): rows in a window.
        swap_prob (float): the chance below which a free entity is swapped.
        leaves (sequence of tuple): what is swapped, ``[B * window, ...]``, and where
            the entities are in a row.
        states (sequence of int or torch.Tensor): what has to be finite after the swap,
            float32: places in ``leaves``, or other tensors. Only on the CPU.
        no_donor (torch.Tensor): int64 ``[N]``, to which the windows are added in which
            an entity had no donor.

    Returns:
        tuple: the new leaves; which rows are counterfactual, bool ``[B * window, 1]``;
        which entities are swapped, bool ``[B * window, N]``; and whether all states are
        finite.
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
    table = [
        *(windows, windows - drawn, entities, window),
        *map(cuda.address, (free, order, chance, share)),
        count,
        *map(cuda.address, (numbers, flags, no_donor, chosen, swapped)),
        *(len(leaves), len(states)),
    ]
    for (own, runs), out in zip(leaves, outs, strict=True):
        table += _table_row(own, own, runs, out)
    for state in states:
        tensor = outs[state] if isinstance(state, int) else state
        table += [tensor.data_ptr(), tensor.numel()]
    found = call("swap_batch", (ctypes.c_int64 * len(table))(*table), swap_prob)
    return outs, chosen, swapped, found == GOOD


def _swap_cuda_batch(
    free: torch.Tensor,
    chosen: torch.Tensor | None,
    chance: torch.Tensor | None,
    share: torch.Tensor,
    window: int,
    swap_prob: float,
    leaves: Sequence[tuple[torch.Tensor, Runs]],
    no_donor: torch.Tensor,
) -> tuple[list[torch.Tensor], torch.Tensor, torch.Tensor, bool]:
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
    return outs, flags, swapped, True


def _table_row(
    own: torch.Tensor, source: torch.Tensor, runs: Runs, out: torch.Tensor
) -> list[int]:
    """Returns what ``swap_rows`` in C knows of a leaf."""
    tensors = (*runs[:3], own, source, out)
    return [
        *(len(source), own.nbytes // len(own), len(runs.entity)),
        *map(cuda.address, tensors),
    ]
