"""Fetch-Push episodes per second with one and two processes, and their busy share.

Run with ``pytest benchmarks/bench_collect.py`` (``make bench``). What is timed is
``create_fetch_push_expert`` as ``examples/environments/fetch_push.py`` calls it:
episodes of 100 steps with simulator states, from the start of the processes (some
seconds each, for imports) to the Minari dataset. The busy share is the processor time
of all processes over twice the time that passed; jobs next to it lower it.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from torchrl_caiac.envs import create_fetch_push_expert

EPISODES = 300


def processor_time() -> float:
    """Returns the processor time of this process and of those it waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@pytest.mark.parametrize("workers", [1, 2])
def bench_expert(benchmark, judge, tmp_path: Path, workers: int):
    """Collects a dataset from scratch, once."""
    busy = []

    def collect() -> None:
        before, start = processor_time(), time.perf_counter()
        create_fetch_push_expert(
            episodes=EPISODES, root=tmp_path, workers=workers, progress=False
        )
        passed = time.perf_counter() - start
        busy.append((processor_time() - before) / passed)
        benchmark.extra_info["episodes_per_s"] = round(EPISODES / passed, 1)

    benchmark.pedantic(collect, rounds=1)
    share = busy[0] / workers
    if workers == 2:
        judge(
            "collecting with 2 processes, busy share of 2 cores", share, at_least=0.85
        )
    benchmark.extra_info["busy_share"] = round(share, 3)
