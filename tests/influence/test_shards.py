"""Scores of a folder that several processes write together."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.data import ReplayBuffer

from tests.influence.scoring import (
    Failing,
    definition,
    episodes,
    scores,
    square,
)
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence import score_buffer

PARTS = "caiac.score.parts"


def opened(folder: Path) -> ReplayBuffer:
    return offline_buffer(load_transitions(folder))


def leaf_bytes(folder: Path) -> list[bytes]:
    names = ("caiac/score.memmap", "caiac/score_fingerprint.memmap", "caiac.score.json")
    return [(folder / name).read_bytes() for name in names]


@settings(max_examples=25, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 30), min_size=1, max_size=6),
    smoothing=st.integers(1, 4),
    lookahead=st.integers(0, 3),
    every=st.integers(1, 3),
    batch_size=st.integers(1, 9),
    calls=st.lists(
        st.tuples(st.integers(0, 4), st.integers(1, 5), st.integers(1, 12)), max_size=4
    ),
    alone=st.booleans(),
)
def test_any_split_and_interruption_gives_the_bytes_of_one_process(
    lengths, smoothing, lookahead, every, batch_size, calls, alone
):
    rows = episodes(lengths)
    options = {"lookahead": lookahead, "every": every, "progress": False}
    with tempfile.TemporaryDirectory() as name:
        whole, shared = Path(name, "whole"), Path(name, "shared")
        for folder in (whole, shared):
            rows.memmap(folder)
        score_buffer(opened(whole), Failing(-1), batch_size, smoothing, **options)
        for i, n, count in calls:  # processes that end after a few calls
            # An interrupted call is repeated without shard, if n is 5.
            shard = None if n == 5 else (i % n, n)
            estimator = Failing(count)
            try:
                score_buffer(
                    opened(shared),
                    estimator,
                    batch_size,
                    smoothing,
                    shard=shard,
                    **options,
                )
            except KeyboardInterrupt:
                record = shared / "caiac.score.json"
                if record.exists():
                    assert json.loads(record.read_text())["state"] != "scored"
        rb = opened(shared)
        shard = None if alone else (0, 1)
        estimator = Failing(-1)
        score_buffer(rb, estimator, batch_size, smoothing, shard=shard, **options)
        assert not (shared / PARTS).exists()
        assert leaf_bytes(shared) == leaf_bytes(whole)
        if every == 1:
            expected = definition(rows, square, smoothing, lookahead)
            torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-6)
