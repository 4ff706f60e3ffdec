"""Goals of rows, in C or CUDA."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import NamedTuple

import torch

from torchrl_caiac._sampling import on_cuda as cuda
from torchrl_caiac._sampling.on_cpu import (
    call,
    call_with_rows,
    check_rows,
    int64_array,
)
from torchrl_caiac._sampling.rows import column_runs, device_numbers

__all__ = [
    "RelabeledBatch",
    "hindsight_sources",
    "relabel_batch",
    "relabel_rows",
    "window_goals",
]

_NO_WINDOWS = -3


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


def relabel_rows(
    desired: torch.Tensor,
    values: torch.Tensor,
    columns: Sequence[int],
    future: torch.Tensor | None,
    source: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns the goals of rows by their sources.

    Args:
        desired (torch.Tensor): the desired goals, ``[B, G]``.
        values (torch.Tensor): what goals are achieved in, ``[B, D]``.
        columns (sequence of int): its columns that are the achieved goals, ``G``.
        future (torch.Tensor, optional): future goals, ``[B, G]``.
        source (torch.Tensor): the row that each goal is of desired, achieved and
            future goals concatenated, int64 ``[B]``.

    Returns:
        tuple of torch.Tensor: the goals and the achieved goals, ``[B, G]``, and which
        rows have another goal than their desired one, bool ``[B, 1]``.
    """
    rows, width = desired.shape
    goals, achieved = torch.empty_like(desired), torch.empty_like(desired)
    relabeled = desired.new_empty(rows, 1, dtype=torch.bool)
    size = desired.element_size()
    given = source, desired, future, values
    if desired.is_cuda:
        column = device_numbers(tuple(columns), desired.device)
        fields = [
            *(rows, width, size, *map(cuda.address, given), values.shape[1]),
            *map(cuda.address, (column, goals, achieved, relabeled)),
        ]
        blocks = cuda.blocks(desired.numel())
        cuda.start("relabel_rows", desired.device, (blocks, 1), fields)
        return goals, achieved, relabeled
    runs = column_runs(tuple(columns), size)
    call_with_rows(
        "relabel_rows",
        source,
        (2 if future is None else 3) * rows,
        *(rows, width, size, *given, values.shape[1] * size, len(runs.start)),
        *(runs.start, runs.length, goals, achieved, relabeled),
    )
    return goals, achieved, relabeled


class RelabeledBatch(NamedTuple):
    """What :func:`relabel_batch` returns.

    Attributes:
        goals (torch.Tensor): the desired goals, ``[B, G]``.
        achieved (torch.Tensor): the achieved goals, ``[B, G]``.
        relabeled (torch.Tensor): which rows have another goal than their desired one,
            bool ``[B, 1]``.
        changed (torch.Tensor): which rows are relabelled or counterfactual, bool
            ``[B]``.
        source (torch.Tensor): where each goal comes from, int64 ``[B]``, as of
            :func:`hindsight_sources`.
    """

    goals: torch.Tensor
    achieved: torch.Tensor
    relabeled: torch.Tensor
    changed: torch.Tensor
    source: torch.Tensor


def relabel_batch(
    flags: torch.Tensor,
    numbers: torch.Tensor,
    shares: tuple[float, float, float],
    desired: torch.Tensor,
    values: torch.Tensor,
    columns: tuple[int, ...],
    future: torch.Tensor | None,
) -> RelabeledBatch:
    """Relabels the goals of a batch, from random numbers.

    The same as :func:`hindsight_sources` and :func:`relabel_rows`.

    Args:
        flags (torch.Tensor): which rows are counterfactual, bool ``[B, 1]``.
        numbers (torch.Tensor): ``chance`` and ``pick``, float64 ``[2, B]``.
        shares (tuple of float): ``future``, ``random`` and ``counterfactual``.
        desired (torch.Tensor): the desired goals, ``[B, G]``.
        values (torch.Tensor): what goals are achieved in, ``[B, D]``.
        columns (tuple of int): its columns that are the achieved goals, ``G``.
        future (torch.Tensor, optional): future goals, ``[B, G]``.

    Returns:
        RelabeledBatch: the goals.

    Raises:
        IndexError: a goal comes from the future, and there are no future goals.
    """
    if flags.is_cuda:
        flags = flags.view(-1)
        chance, pick = numbers.unbind()
        source = hindsight_sources(flags, chance, pick, *shares)
        found = relabel_rows(desired, values, columns, future, source)
        return RelabeledBatch(*found, found[2].view(-1) | flags, source)
    rows, width = desired.shape
    goals, achieved = torch.empty_like(desired), torch.empty_like(desired)
    memory = numbers.new_empty(2, rows, dtype=torch.int64)
    relabeled, changed = torch.empty_like(flags), flags.new_empty(rows)
    size = desired.element_size()
    runs = column_runs(columns, size)
    places = flags, numbers, desired, future, values
    table = [
        *(rows, width, size, values.shape[1] * size, runs.start.shape[0]),
        *map(cuda.address, (*places, runs.start, runs.length, memory)),
        *map(cuda.address, (goals, achieved, relabeled, changed)),
    ]
    call_with_rows(
        *("relabel_batch", memory[1], (2 if future is None else 3) * rows),
        *(int64_array(table), (ctypes.c_double * 3)(*shares)),
    )
    return RelabeledBatch(goals, achieved, relabeled, changed, memory[1])


def window_goals(
    rows: torch.Tensor,
    window: int,
    left: torch.Tensor,
    bounds: Sequence[tuple[int, float]],
    numbers: Sequence[torch.Tensor | None],
    source: torch.Tensor,
    columns: tuple[int, ...],
) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Returns the goals of the rows of windows, on the CPU.

    Args:
        rows (torch.Tensor): int64 ``[W * window]``, window by window.
        window (int): rows in a window.
        left (torch.Tensor): int32 or int64 ``[T]``, the number of later rows in the
            trajectory of each row.
        bounds (sequence of tuple): strategies, 0, 1 or 2, with the least ``chance`` for
            which they are taken, ascending from 0.
        numbers (sequence of torch.Tensor): ``chance``, ``share`` and ``steps`` of
            ``GoalNumbers``, ``[W]`` each; ``None`` where no strategy needs them.
        source (torch.Tensor): what goals are read from, ``[T, D]``, a ring.
        columns (tuple of int): its columns that are goals, ``G``.

    Returns:
        tuple of torch.Tensor, optional: the goals ``[W * window, G]``, and the steps
        from each row to its goal, int64 ``[W * window, 1]``; ``None`` if the rows are
        not windows within trajectories.

    Raises:
        IndexError: the first row of a window is out of range.
    """
    count, length = rows.shape[0], left.shape[0]
    goals = source.new_empty(count, len(columns))
    steps = rows.new_empty(count, 1)
    places = rows.new_empty(count // window)
    size = source.element_size()
    runs = column_runs(columns, size)
    given = rows, left, *numbers, source, runs.start, runs.length, places, goals, steps
    table = [
        *(count // window, window, length, left.dtype is torch.int32, len(bounds)),
        *(source.shape[1] * size, len(columns) * size, runs.start.shape[0]),
        *map(cuda.address, given),
        *(kind for kind, _ in bounds),
    ]
    least = (ctypes.c_float * len(bounds))(*(least for _, least in bounds))
    place = call("window_goals", int64_array(table), least)
    if place == _NO_WINDOWS:
        return None
    check_rows(place, rows, length)
    return goals, steps
