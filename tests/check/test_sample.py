"""Tests of the rows that a check reads, against their definition."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_caiac.check.sample import take_sample
from torchrl_caiac.trajectories import trajectory_index


@given(
    lengths=st.lists(st.integers(1, 40), min_size=1, max_size=12),
    max_rows=st.integers(1, 200),
)
def test_pieces_are_rows_that_follow_each_other(
    lengths: list[int], max_rows: int
) -> None:
    ids = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    data = TensorDict({"episode": ids, "row": torch.arange(len(ids))}, [len(ids)])
    index = trajectory_index(data)
    sample = take_sample(data, index, max_rows)
    size = len(sample)
    assert 1 <= size <= max(max_rows, max(2, max_rows // 2))
    if sum(lengths) <= max_rows:
        assert sample.rows.tolist() == list(range(len(ids)))
    assert torch.equal(sample.raw("row"), sample.rows)
    assert len(sample.rows.unique()) == size
    assert torch.equal(sample.last, index.is_last(sample.rows))
    for piece in sample.piece.unique():
        rows = sample.rows[sample.piece == piece]
        assert len(ids[rows].unique()) == 1
        assert torch.equal(rows, torch.arange(rows[0], rows[0] + len(rows)))
    here, there = sample.following(torch.ones(size, dtype=torch.long))
    assert torch.equal(sample.rows[there], sample.rows[here] + 1)
    assert len(here) == size - len(sample.piece.unique())
    again = take_sample(data, index, max_rows)
    assert torch.equal(again.rows, sample.rows)


def test_rows_are_spread_over_the_data() -> None:
    ids = torch.arange(100_000) // 100
    data = TensorDict({"episode": ids}, [100_000])
    rows = take_sample(data, trajectory_index(data), 5_000).rows
    share = torch.histc(rows.float(), bins=10, min=0, max=100_000) / 5_000
    assert (share - 0.1).abs().max() < 0.01
    alone = take_sample(data, None, 1_000)
    assert len(alone) == 1_000 and not alone.last.any()
    assert not len(alone.following(torch.ones(1_000, dtype=torch.long))[0])
