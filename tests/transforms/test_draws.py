"""Draws of donors against plain Python."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.transforms.donors import eligible_starts
from torchrl_caiac.transforms.draws import (
    DonorBits,
    DonorIndex,
    draw_batch_donors,
    draw_buffer_donors,
    draw_windows,
    uninfluenced,
)


@given(
    rows=st.lists(
        st.lists(
            st.sampled_from([0.0, 0.5, 0.50001, math.nan]), min_size=2, max_size=2
        ),
        min_size=1,
        max_size=24,
    ),
    window=st.integers(1, 4),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
@settings(deadline=None)
def test_uninfluenced(rows, window: int, dtype: torch.dtype) -> None:
    rows = (rows * window)[: len(rows) // window * window] or rows * window
    found = uninfluenced(torch.tensor(rows, dtype=dtype), 0.5, window)
    wanted = [
        [all(row[n] <= 0.5 for row in rows[b : b + window]) for n in range(2)]
        for b in range(0, len(rows), window)
    ]
    assert found.tolist() == wanted


@settings(deadline=None)
@given(
    seed=st.integers(0, 1000),
    windows=st.integers(1, 12),
    window=st.integers(1, 3),
    share=st.floats(0, 1),
    swap_prob=st.sampled_from([0.0, 0.4, 1.0]),
    rows=st.sampled_from(["random", "last"]),
)
def test_batch_donors(seed, windows, window, share, swap_prob, rows) -> None:
    generator = torch.Generator().manual_seed(seed)
    free = torch.rand(windows, 3, generator=generator) < 0.5
    count, chosen = round(share * windows), None
    last = [True] * count
    if rows == "random":
        chosen = draw_windows(windows, count, device=free.device, generator=generator)
        assert chosen.dtype == torch.bool and chosen.shape == (windows,)
        last, count = chosen.tolist(), windows
        assert sum(last) == round(share * windows)
    draw = draw_batch_donors(
        free,
        count,
        window=window,
        swap_prob=swap_prob,
        chosen=chosen,
        generator=generator,
    )
    assert draw.chosen is chosen
    assert draw.donors.shape == draw.swapped.shape == (count, 3)
    for c in range(count):
        own = windows - count + c
        for n in range(3):
            assert last[c] or not draw.swapped[c, n]
            options = [b for b in range(windows) if free[b, n] and b != own]
            if draw.swapped[c, n]:
                assert free[own, n] and int(draw.donors[c, n]) % window == 0
                assert int(draw.donors[c, n]) // window in options
            elif swap_prob == 1.0:
                assert not (last[c] and free[own, n] and options)
            assert 0 <= int(draw.donors[c, n]) < windows * window
    if swap_prob == 1.0:
        own_rows = free[windows - count :][torch.tensor(last, dtype=torch.bool)]
        alone = own_rows.sum(0) * (free.sum(0) == 1)
        assert draw.no_donor.tolist() == alone.tolist()


def test_donors_of_chosen_windows_are_the_other_ones() -> None:
    free = torch.ones(5, 1, dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    chosen = torch.tensor([True, False, False, True, False])
    counts = torch.zeros(2, 5)
    for _ in range(4000):
        draw = draw_batch_donors(free, 5, chosen=chosen, generator=generator)
        assert torch.equal(draw.swapped[:, 0], chosen)
        counts[[0, 1], draw.donors[chosen, 0]] += 1
    assert counts[0, 0] == counts[1, 3] == 0
    assert (counts[counts > 0] - 1000).abs().max() < 5 * 750**0.5


def test_drawn_windows_are_all_or_none() -> None:
    device = torch.device("cpu")
    assert draw_windows(5, 5, device=device).tolist() == [True] * 5
    assert draw_windows(5, 0, device=device).tolist() == [False] * 5
    draws = {
        tuple(
            draw_windows(
                20, 5, device=device, generator=torch.Generator().manual_seed(seed)
            ).tolist()
        )
        for seed in (0, 0, 1)
    }
    assert len(draws) == 2


def test_buffer_donors_are_uniform() -> None:
    scores = torch.ones(50, 2)
    scores[10:30, 0] = 0.0
    scores[5:8, 1] = 0.0
    index = eligible_starts(scores, 0.1, torch.tensor([True, True]))
    draw = draw_buffer_donors(
        torch.ones(40_000, 2, dtype=torch.bool),
        index,
        generator=torch.Generator().manual_seed(0),
    )
    for entity, begin, end in ((0, 10, 30), (1, 5, 8)):
        share = torch.bincount(draw.donors[:, entity], minlength=50) / 40_000
        assert share[begin:end].sum() == pytest.approx(1.0)
        assert (share[begin:end] - 1 / (end - begin)).abs().max() < 0.01
    assert draw.swapped.all() and not draw.no_donor.any()


def _bits(free: torch.Tensor) -> DonorBits:
    """Sets the bits of free rows, bool ``[T, N]``, one by one."""
    words = torch.zeros(free.shape[1], -(-len(free) // 16), dtype=torch.int32)
    for row, entity in free.nonzero().tolist():
        words[entity, row // 16] |= 1 << row % 16
    return DonorBits.of_words(words.to(torch.int16))


@settings(deadline=None, max_examples=50)
@given(
    rows=st.integers(1, 70),
    share=st.sampled_from([0.0, 0.05, 0.5, 1.0]),
    seed=st.integers(0, 1000),
)
def test_bits_draw_what_lists_draw(rows: int, share: float, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    free = torch.rand(rows, 3, generator=generator) < share
    bits = _bits(free)
    lists = [column.nonzero()[:, 0] for column in free.unbind(1)]
    size = torch.tensor([len(found) for found in lists])
    starts = torch.cat(lists)
    index = DonorIndex(
        starts if len(starts) else torch.zeros(1).long(), size.cumsum(0) - size, size
    )
    assert bits.listed().starts[: len(starts)].tolist() == starts.tolist()
    wanted, found = (
        draw_buffer_donors(
            torch.ones(200, 3, dtype=torch.bool),
            donors,
            generator=torch.Generator().manual_seed(seed),
        )
        for donors in (index, bits)
    )
    assert torch.equal(found.swapped, wanted.swapped)
    assert torch.equal(found.donors[found.swapped], wanted.donors[wanted.swapped])


def test_bits_need_less_than_half_a_byte_for_a_row() -> None:
    rows = 200_000
    words = torch.full((1, rows // 16), -1, dtype=torch.int16)  # all bits
    bits = DonorBits.of_words(words)
    size = sum(leaf.numel() * leaf.element_size() for leaf in bits)
    assert size <= 0.38 * rows
    assert bits.rows(torch.tensor([0, 17, rows - 1])).tolist() == [0, 17, rows - 1]
