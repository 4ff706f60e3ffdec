"""The first sample after each write to a full ring, with lookahead.

Run with ``pytest benchmarks/bench_writes.py``. The ring has 1 M rows, and 1,000 are
written between samples, whose trajectories alone are read again.
"""

from __future__ import annotations

import time
from statistics import median
from typing import Any

import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer

from benchmarks.bench_sampling import CHUNK, EPISODE, FETCH, chunk
from torchrl_caiac.transforms import CAIACTransform

ROWS, WRITTEN, ROUNDS = 1_000_000, 1_000, 10


def bench_first_sample_after_a_write(benchmark: Any, judge: Any) -> None:
    """What a write adds to the next sample, in ns for each row of the ring."""
    part = chunk(FETCH, 34, 4, True)
    rb = ReplayBuffer(storage=LazyTensorStorage(ROWS), batch_size=512)
    written = 0

    def write(rows: int) -> None:
        nonlocal written
        new = part[:rows].clone()
        new["episode"] = torch.arange(written, written + rows) // EPISODE
        written += rows
        rb.extend(new)

    for _ in range(ROWS // CHUNK):
        write(CHUNK)
    rb.append_transform(CAIACTransform(FETCH, lookahead="next"))
    rb.sample()
    times: list[tuple[float, float]] = []
    for _ in range(ROUNDS):
        write(WRITTEN)
        begin = time.perf_counter()
        rb.sample()
        first = time.perf_counter()
        rb.sample()
        times.append((first - begin, time.perf_counter() - first))
    first, later = (median(found) for found in zip(*times, strict=True))
    label = "lookahead, first sample after a write to 1M rows, added ns a row"
    judge(label, (first - later) / ROWS * 1e9, at_most=20)
    benchmark.pedantic(rb.sample, setup=lambda: write(WRITTEN), rounds=ROUNDS)
