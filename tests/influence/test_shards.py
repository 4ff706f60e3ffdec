"""Scores of a folder that several processes write together."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
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
from torchrl_caiac.influence.score_parts import ScoreParts, new_plan

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


def interrupted(folder: Path) -> Path:
    """Scores a part of the rows, and returns the folder of the parts."""
    episodes((30, 20, 50)).memmap(folder)
    with pytest.raises(KeyboardInterrupt):
        score(folder, 6)
    return folder / PARTS


def score(folder: Path, calls: int = -1) -> None:
    settings = {"shard": (0, 2), "check": False, "progress": False}
    score_buffer(opened(folder), Failing(calls), 4, **settings)


@pytest.mark.parametrize(
    "change",
    [
        {"rows": [1]},
        {"rows": "x"},
        {"rows": [4] * 24 + ["4"]},
        {"rows": [4] * 26},
        {"chunks": 0},
        {"chunks": "1"},
        {"chunks": 2},
        {"feature_shape": "ab"},
        {"geometry": {}},
        {"settings": None},
        {"name": "../x"},
    ],
    ids=str,
)
def test_a_damaged_plan_is_refused(change: dict[str, Any], tmp_path: Path) -> None:
    plan = interrupted(tmp_path / "rows") / "plan.json"
    plan.write_text(json.dumps({**json.loads(plan.read_text()), **change}))
    with pytest.raises(ValueError, match=r"is not a plan of scoring: delete .*parts"):
        score(tmp_path / "rows")


@pytest.mark.parametrize("seconds", [-3600, 3600])
def test_clocks_that_are_wrong_stop_nobody(seconds: int, tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    episodes((30, 20, 50)).memmap(whole)
    score(whole)
    parts = interrupted(tmp_path / "rows")
    name = "deadbeef-77-aaaaaaaa"  # of another machine
    for claim in parts.glob("*.claim"):
        claim.write_text(name)
    member = parts / f"{name}.member"
    member.write_text("{}")
    os.utime(member, (time.time() + seconds,) * 2)
    plan = json.loads((parts / "plan.json").read_text())["name"]
    (parts / f"{plan}-abc.npz").touch()  # of another program
    score(tmp_path / "rows")
    assert leaf_bytes(tmp_path / "rows") == leaf_bytes(whole)


@pytest.mark.parametrize("row", range(20, 30))
def test_rows_that_change_between_two_calls_are_found(row: int, tmp_path: Path) -> None:
    for name, calls in (("rows", 6), ("whole", -1)):
        folder = tmp_path / name
        episodes((30, 20, 50)).memmap(folder)
        settings = {"smoothing": 5, "shard": (0, 2), "check": False, "progress": False}
        if calls > 0:  # the rows up to 23 are scored
            with pytest.raises(KeyboardInterrupt):
                score_buffer(opened(folder), Failing(calls), 4, **settings)
        data = load_transitions(folder)
        data["observation"][row] += 3.0
        score_buffer(opened(folder), Failing(-1), 4, **settings)
    assert leaf_bytes(tmp_path / "rows") == leaf_bytes(tmp_path / "whole")


@pytest.mark.parametrize("content", [b"\0\0", b"\xff\xfe", b"a/../../b"], ids=repr)
def test_a_claim_that_a_crash_damaged_is_taken_over(
    content: bytes, tmp_path: Path
) -> None:
    parts = ScoreParts.of(tmp_path, "score")
    plan = new_plan({}, {"batch_size": 4, "rows": 4}, (2,), None, 1)
    parts.write(plan, None)
    with parts.taking_part():
        parts.enter()
        assert parts.claim(plan, 0) == 0
        (claim,) = parts.root.glob("*.claim")
        claim.write_bytes(content)
        os.utime(claim, (time.time() - 3600,) * 2)
        assert parts.take_over(plan) == 0
        assert claim.read_text() == parts.member


def test_scored_folders_may_be_read_only(
    tmp_path: Path, read_only: Callable[[Path], None]
) -> None:
    for name in ("scored", "other"):
        episodes((30, 20)).memmap(tmp_path / name)
    score(tmp_path / "scored")
    for name in ("scored", "other"):
        read_only(tmp_path / name)
    score(tmp_path / "scored")
    with pytest.raises(OSError, match=str(tmp_path / "other")):
        score(tmp_path / "other")


def test_a_full_disk_is_named_and_the_call_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "rows"
    parts = interrupted(folder)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, limits[1]))
    try:
        with pytest.raises(OSError, match="repeat the call") as caught:
            score(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert caught.value.errno == errno.ENOSPC
    assert not list(parts.glob(".part-*"))
    score(folder)
    assert not parts.exists()
