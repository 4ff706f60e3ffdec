"""From random numbers to donors, in C or CUDA."""

from __future__ import annotations

import torch

from torchrl_caiac._sampling import on_cuda as cuda
from torchrl_caiac._sampling.on_cpu import call

__all__ = ["batch_donors", "buffer_donors", "chosen_windows"]


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
    listed = free.new_empty(count, dtype=torch.int64)
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
