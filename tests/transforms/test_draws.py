"""Draws of donors against plain Python."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.transforms.donors import eligible_starts
from torchrl_caiac.transforms.draws import (
    draw_batch_donors,
    draw_buffer_donors,
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
)
def test_batch_donors(seed, windows, window, share, swap_prob) -> None:
    generator = torch.Generator().manual_seed(seed)
    free = torch.rand(windows, 3, generator=generator) < 0.5
    count = round(share * windows)
    draw = draw_batch_donors(
        free, count, window=window, swap_prob=swap_prob, generator=generator
    )
    assert draw.donors.shape == draw.swapped.shape == (count, 3)
    for c in range(count):
        for n in range(3):
            own = windows - count + c
            options = [b for b in range(windows) if free[b, n] and b != own]
            if draw.swapped[c, n]:
                assert free[own, n] and int(draw.donors[c, n]) % window == 0
                assert int(draw.donors[c, n]) // window in options
            elif swap_prob == 1.0:
                assert not (free[own, n] and options)
            assert 0 <= int(draw.donors[c, n]) < windows * window
    if swap_prob == 1.0:
        alone = free[windows - count :].sum(0) * (free.sum(0) == 1)
        assert draw.no_donor.tolist() == alone.tolist()


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
