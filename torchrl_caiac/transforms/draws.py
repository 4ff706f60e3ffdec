"""Random draws: which entities are swapped, and which donors they get.

Every function is pure. A *window* is ``window`` consecutive rows of a flat batch, ``B``
is the number of windows, ``C`` the number of windows that donors are drawn for (all of
them, or the last ones), ``N`` the number of entities.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch

from torchrl_caiac._random import draw_below, draw_numbers
from torchrl_caiac._sampling import (
    batch_donors,
    buffer_donors,
    chosen_windows,
    free_windows,
    is_native,
)
from torchrl_caiac.transforms.indexing import pick_rows, window_max, window_starts

__all__ = [
    "DonorBits",
    "DonorIndex",
    "SwapDraw",
    "donor_numbers",
    "draw_batch_donors",
    "draw_buffer_donors",
    "draw_windows",
    "uninfluenced",
    "window_numbers",
]


class SwapDraw(NamedTuple):
    """The draw for one batch: the entities to swap, and their donors.

    Attributes:
        donors (torch.Tensor): int64 ``[C, N]``, the first row of each entity's donor
            window, a row of the batch or of the donor storage. Meaningless where
            nothing is swapped.
        swapped (torch.Tensor): bool ``[C, N]``.
        no_donor (torch.Tensor): int64 ``[N]``, the number of windows in which the
            entity was to be swapped but had no donor.
        goal_rows (torch.Tensor, optional): int64 ``[C, N]``, the row of the donor
            storage whose next state is the goal of the donor window.
        chosen (torch.Tensor, optional): bool ``[C]``, which of the windows become
            counterfactual; all of them by default.
    """

    donors: torch.Tensor
    swapped: torch.Tensor
    no_donor: torch.Tensor
    goal_rows: torch.Tensor | None = None
    chosen: torch.Tensor | None = None


class DonorIndex(NamedTuple):
    """The rows of a storage at which donor windows may start, entity by entity.

    Attributes:
        starts (torch.Tensor): integer ``[M]``, the rows for the first entity, then
            for the second, and so on.
        offset (torch.Tensor): int64 ``[N]``, where an entity's rows begin.
        size (torch.Tensor): int64 ``[N]``, the number of its rows.
    """

    starts: torch.Tensor
    offset: torch.Tensor
    size: torch.Tensor

    def rows(self, place: torch.Tensor) -> torch.Tensor:
        """Returns the rows at places in ``starts``, integer ``[*]``."""
        return pick_rows(self.starts, place.clamp(0, len(self.starts) - 1))


class DonorBits(NamedTuple):
    """The same as :class:`DonorIndex`, in a tenth of the memory.

    A row is one bit, and each word of 16 bits has the number of rows before it: 0.375
    bytes for each row and entity, whether it is eligible or not. The order of the rows
    of an entity is that of the storage.

    Attributes:
        words (torch.Tensor): int16 ``[N * W]``, the words of the first entity, then of
            the second, and so on.
        before (torch.Tensor): integer ``[N * W]``, the rows in all words before.
        offset (torch.Tensor): int64 ``[N]``, the number of rows of earlier entities.
        size (torch.Tensor): int64 ``[N]``, the number of the entity's rows.
    """

    words: torch.Tensor
    before: torch.Tensor
    offset: torch.Tensor
    size: torch.Tensor

    @classmethod
    def of_words(cls, words: torch.Tensor) -> DonorBits:
        """Counts the rows in words, int16 ``[N, W]``."""
        width = words.shape[1]
        counts, _ = _word_tables(words.device)
        dtype = torch.int32 if 16 * words.numel() < 1 << 31 else torch.int64
        before = torch.empty(words.numel(), dtype=dtype, device=words.device)
        total = torch.zeros((), dtype=torch.int64, device=words.device)
        for start in range(0, words.numel(), _WORDS):
            part = words.view(-1)[start : start + _WORDS]
            count = counts[part.int() & 0xFFFF].long()
            ahead = count.cumsum(0)
            before[start : start + _WORDS] = ahead - count + total
            total = total + ahead[-1]
        offset = before[::width].long() if width else torch.zeros_like(before).long()
        size = torch.cat([offset, total.view(1)]).diff()
        return cls(words.reshape(-1), before, offset, size)

    def listed(self) -> DonorIndex:
        """Returns the rows as numbers, 4 bytes each, which are faster to look up."""
        width = len(self.words) // len(self.size)
        dtype = torch.int32 if 16 * width < 1 << 31 else torch.int64
        # At least one row, so that an index without any can be read.
        total = max(1, int(self.size.sum()))
        starts = torch.zeros(total, dtype=dtype, device=self.words.device)
        counts, bits = _word_tables(self.words.device)
        end = 0
        for start in range(0, len(self.words), _WORDS):
            word = self.words[start : start + _WORDS].int() & 0xFFFF
            first = torch.arange(start, start + len(word), device=word.device)
            first = first % width * 16
            is_set = torch.arange(16, device=word.device) < counts[word][:, None]
            rows = (first[:, None] + bits[word])[is_set]
            starts[end : end + len(rows)] = rows.to(dtype)
            end += len(rows)
        return DonorIndex(starts, self.offset, self.size)

    def rows(self, place: torch.Tensor) -> torch.Tensor:
        """Returns the rows at places among all rows, int64 ``[*]``."""
        place = place.to(self.before).contiguous()
        word = torch.searchsorted(self.before, place, right=True) - 1
        word.clamp_min_(0)
        _, bits = _word_tables(self.words.device)
        rank = (place - pick_rows(self.before, word)).clamp(0, 15)
        value = pick_rows(self.words, word).int() & 0xFFFF
        bit = pick_rows(bits.view(-1), value * 16 + rank)
        return word % (len(self.words) // len(self.size)) * 16 + bit


# Words whose rows are counted together.
_WORDS = 1 << 17


@lru_cache(maxsize=8)
def _word_tables(device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the number of bits of each word, and the place of each set one.

    uint8 ``[65536]`` and ``[65536, 16]``, 0 after the last one.
    """
    words = torch.arange(1 << 16)
    counts = torch.zeros(1 << 16, dtype=torch.int64)
    places = torch.zeros(1 << 16, 16, dtype=torch.uint8)
    for bit in range(16):
        having = words[(words >> bit) & 1 == 1]
        places[having, counts[having]] = bit
        counts[having] += 1
    return counts.to(device, torch.uint8), places.to(device)


def uninfluenced(
    scores: torch.Tensor, threshold: float | torch.Tensor, window: int = 1
) -> torch.Tensor:
    """Returns the entities that are uninfluenced in each window (section 3.3, eq. 1).

    Args:
        scores (torch.Tensor): ``[B * window, N]``; a row that was not scored (NaN) is
            not uninfluenced.
        threshold (float or torch.Tensor): the largest score of an uninfluenced entity,
            θ; one number, or ``[N]`` with the dtype of the scores.
        window (int): rows in a window. Defaults to 1.

    Returns:
        torch.Tensor: bool ``[B, N]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.draws import uninfluenced
        >>> uninfluenced(torch.tensor([[0.0], [0.01], [0.0], [0.2]]), 0.05, window=2)
        tensor([[ True],
                [False]])
    """
    if (
        scores.ndim == 2
        and scores.dtype is torch.float32
        and not len(scores) % window
        and is_native(scores)
    ):
        limits = _limits(threshold, scores.device)
        if (
            limits.dtype is torch.float32
            and limits.shape in ((), scores.shape[1:])
            and is_native(limits)
        ):
            return free_windows(scores, limits, window)
    return window_max(scores, window) <= threshold


def _limits(threshold: float | torch.Tensor, device: torch.device) -> torch.Tensor:
    if isinstance(threshold, torch.Tensor):
        return threshold
    return _number(float(threshold), device)


@lru_cache(maxsize=64)
def _number(number: float, device: torch.device) -> torch.Tensor:
    given = torch.tensor(number, dtype=torch.float64, device="cpu")
    return given.to(device, torch.float32)


def window_numbers(
    windows: int, *, device: torch.device, generator: torch.Generator | None = None
) -> torch.Tensor:
    """Draws what decides which windows of a batch become counterfactual.

    Args:
        windows (int): the number of windows in the batch, ``B``.

    Keyword Args:
        device (torch.device): the device of the result.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        torch.Tensor: a permutation, int64 ``[B]``; or, if they are drawn on a CUDA
        device, where this takes fewer operations, numbers below 1, float64 ``[B]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.draws import window_numbers
        >>> sorted(window_numbers(3, device=torch.device("cpu")).tolist())
        [0, 1, 2]
    """
    if device.type == "cuda" and (generator is None or generator.device == device):
        return draw_numbers(
            torch.rand,
            (windows,),
            device=device,
            generator=generator,
            dtype=torch.float64,
        )
    return draw_numbers(torch.randperm, windows, device=device, generator=generator)


def draw_windows(
    windows: int,
    count: int,
    *,
    device: torch.device,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draws which windows of a batch become counterfactual.

    Args:
        windows (int): the number of windows in the batch, ``B``.
        count (int): the number of windows to choose.

    Keyword Args:
        device (torch.device): the device of the result.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        torch.Tensor: bool ``[B]``, true for exactly ``count`` windows.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.draws import draw_windows
        >>> draw_windows(9, 4, device=torch.device("cpu")).sum()
        tensor(4)
    """
    number = window_numbers(windows, device=device, generator=generator)
    if number.dtype is torch.int64:
        return number < count
    if windows <= _MOST_RANKED and is_native(number):
        return chosen_windows(number, count)
    return number.argsort(stable=True).argsort() < count


# Windows that are compared with each other by a kernel, at most.
_MOST_RANKED = 8192


def _drawn(
    free: torch.Tensor,
    swap_prob: float,
    chosen: torch.Tensor | None,
    generator: torch.Generator | None,
) -> torch.Tensor:
    """Returns which of the free entities are swapped, bool ``[N, C]``."""
    if chosen is not None:
        free = free & chosen
    if swap_prob >= 1.0:
        return free
    return free & (_chance(free, generator) < swap_prob)


def _is_native_draw(
    free: torch.Tensor,
    chosen: torch.Tensor | None,
    drawn: int,
    index: Sequence[torch.Tensor] = (),
) -> bool:
    """Returns whether a draw is computed in C or CUDA."""
    if free.dtype is not torch.bool:
        return False
    if chosen is None:
        return is_native(free, sources=index)
    is_fit = (chosen.dtype, chosen.shape) == (torch.bool, (drawn,))
    return is_fit and is_native(free, chosen, sources=index)


def is_native_index(index: DonorIndex, entities: int) -> bool:
    """Returns whether functions in C or CUDA can draw from an index.

    Args:
        index (DonorIndex): the eligible windows.
        entities (int): the number of entities, ``N``.

    Returns:
        bool: whether they are in memory as :func:`draw_buffer_donors` expects.
    """
    return (
        len(index.starts) > 0
        and index.starts.dtype in (torch.int32, torch.int64)
        and index.offset.dtype == index.size.dtype == torch.int64
        and len(index.offset) == len(index.size) == entities
        and is_native(index.size, sources=index)
    )


def _chance(free: torch.Tensor, generator: torch.Generator | None) -> torch.Tensor:
    return draw_numbers(
        torch.rand,
        free.shape,
        device=free.device,
        generator=generator,
        dtype=torch.float32,
    )


def donor_numbers(
    entities: int,
    windows: int,
    swap_prob: float,
    *,
    device: torch.device,
    generator: torch.Generator | None = None,
) -> tuple[torch.Tensor | None, torch.Tensor]:
    """Draws what decides which entities of windows are swapped, and their donors.

    Args:
        entities (int): the number of entities, ``N``.
        windows (int): the number of windows, ``C``.
        swap_prob (float): probability of swapping a free entity.

    Keyword Args:
        device (torch.device): the device of the results.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        tuple of torch.Tensor: below 1, float32 ``[N, C]``: whether they are swapped,
        ``None`` if all are; and float64 ``[N, C]``: which donor it is.
    """
    shape = entities, windows
    chance = None
    if not swap_prob >= 1.0:
        chance = draw_numbers(
            torch.rand, shape, device=device, generator=generator, dtype=torch.float32
        )
    share = draw_numbers(
        torch.rand, shape, device=device, generator=generator, dtype=torch.float64
    )
    return chance, share


def draw_batch_donors(
    free: torch.Tensor,
    num_windows: int,
    *,
    window: int = 1,
    swap_prob: float = 1.0,
    chosen: torch.Tensor | None = None,
    generator: torch.Generator | None = None,
) -> SwapDraw:
    """Draws donors among the windows of the batch itself.

    Each entity of each chosen window draws one of the *other* windows in which
    it is free too, all with the same probability and independently of the other
    entities.

    Args:
        free (torch.Tensor): bool ``[B, N]``, the entities that may be swapped.
        num_windows (int): the number of windows that donors are drawn for, ``C``: the
            last ones of the batch.

    Keyword Args:
        window (int): rows in a window. Defaults to 1.
        swap_prob (float): probability of swapping a free entity. Defaults to 1.
        chosen (torch.Tensor, optional): bool ``[C]``, which of these windows become
            counterfactual. Defaults to all of them.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        SwapDraw: the donors as rows of the batch.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.draws import draw_batch_donors
        >>> free = torch.tensor([[True, False], [False, True], [True, True]])
        >>> draw = draw_batch_donors(free, 1)
        >>> draw.donors, draw.swapped
        (tensor([[0, 1]]), tensor([[True, True]]))
    """
    count, entities = free.shape
    first = count - num_windows
    if num_windows and _is_native_draw(free, chosen, num_windows):
        chance, share = donor_numbers(
            entities, num_windows, swap_prob, device=free.device, generator=generator
        )
        drawn = batch_donors(
            free, num_windows, window, swap_prob, chosen, chance, share
        )
        return SwapDraw(*drawn, chosen=chosen)
    free = free.t().contiguous()
    tail = free[:, first:] if first else free
    is_chosen = _drawn(tail, swap_prob, chosen, generator)
    # rank[n, b]: the number of free windows of entity n up to and including window b.
    rank = free.cumsum(1)
    others, own = rank[:, -1:] - 1, rank[:, first:] if first else rank
    place = draw_below(others.expand_as(own), generator=generator).add_(1)
    place = place + (place >= own)  # not the window itself
    # listed[n, r]: the free window of rank r, from 1; those that are not free end up
    # at 0.
    starts = window_starts(count, window, free.device).expand(entities, -1)
    listed = rank.new_zeros(entities, count + 2)
    listed.scatter_(1, rank * free, starts)
    swapped = is_chosen & (others > 0)
    return SwapDraw(
        listed.gather(1, place).t(),
        swapped.t(),
        (is_chosen ^ swapped).sum(1),
        chosen=chosen,
    )


def draw_buffer_donors(
    free: torch.Tensor,
    index: DonorIndex | DonorBits,
    *,
    swap_prob: float = 1.0,
    chosen: torch.Tensor | None = None,
    generator: torch.Generator | None = None,
) -> SwapDraw:
    """Draws donors among the eligible windows of a donor storage.

    Args:
        free (torch.Tensor): bool ``[C, N]``, the entities that may be swapped.
        index (DonorIndex or DonorBits): the eligible windows.

    Keyword Args:
        swap_prob (float): probability of swapping a free entity. Defaults to 1.
        chosen (torch.Tensor, optional): bool ``[C]``, which of these windows become
            counterfactual. Defaults to all of them.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        SwapDraw: the donors as rows of the storage.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.draws import DonorIndex, draw_buffer_donors
        >>> index = DonorIndex(
        ...     torch.tensor([7]), torch.tensor([0, 1]), torch.tensor([1, 0])
        ... )
        >>> draw_buffer_donors(torch.ones(1, 2, dtype=torch.bool), index).swapped
        tensor([[ True, False]])
    """
    device = free.device
    if (
        isinstance(index, DonorIndex)
        and is_native_index(index, free.shape[1])
        and _is_native_draw(free, chosen, len(free), index)
    ):
        windows, entities = free.shape
        chance, share = donor_numbers(
            entities, windows, swap_prob, device=device, generator=generator
        )
        share = share.view(free.shape)
        drawn = buffer_donors(free, *index, swap_prob, chosen, chance, share)
        return SwapDraw(*drawn, chosen=chosen)
    is_chosen = _drawn(free.t(), swap_prob, chosen, generator).t()
    size = index.size.to(device)
    pick = draw_below(size.expand_as(free), generator=generator)
    pick = pick + index.offset.to(device)
    found = size > 0
    swapped = is_chosen & found
    home = index.offset.device
    if isinstance(index, DonorBits) and {device.type, home.type} == {"cpu"}:
        # Only what is needed: rows are searched for.
        donors = torch.zeros(free.shape, dtype=torch.int64)
        donors[swapped] = index.rows(pick[swapped])
    else:
        donors = index.rows(pick.to(home)).to(device, torch.int64)
    return SwapDraw(donors, swapped, (is_chosen ^ swapped).sum(0), chosen=chosen)
