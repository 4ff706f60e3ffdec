"""The share of a training step that sampling, swapping and goals take.

Run with ``pytest benchmarks/bench_share.py --benchmark-only --ratios=<folder>``, in
``make bench`` too. A TD3 step is that of ``bench_td3`` (half of two critic updates, one
of the policy and one of the targets) on transitions of Fetch-Push from 1 M rows; the
examples sample four batches at once, which is measured too. Both buffers have the
storage of ``offline_buffer``, as the examples have. A step of LMP is that of
``bench_lmp``, on windows of the kitchen from 6,000 rows. The share is the time of
``rb.sample()`` with swaps and goals, in that of sample and step together. The second
ratio leaves out what the sample of a buffer without transforms takes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.data import ReplayBuffer

from benchmarks.bench_lmp import SIZES, make_buffer, make_step, slices
from benchmarks.bench_sampling import TRANSITIONS, Setting, made
from benchmarks.bench_td3 import DTYPE, Learner
from benchmarks.ratios import seconds


@pytest.fixture(scope="module")
def transitions(request: pytest.FixtureRequest, tmp_path_factory: Any) -> Setting:
    """Transitions of Fetch-Push from a storage of 1 M rows on the device."""
    device = torch.device(request.config.getoption("--device"))
    kind = "memory" if device.type == "cpu" else "cuda"
    folder = Path(tmp_path_factory.getbasetemp())
    return made(TRANSITIONS, 512, "1M", kind, folder, device).offline()


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Larger batches on a GPU."""
    if "rows" in metafunc.fixturenames:
        on_gpu = metafunc.config.getoption("--device") == "cuda"
        metafunc.parametrize("rows", [256, 512, *[4096] * on_gpu])


@DTYPE
def bench_td3_share(
    benchmark: Any,
    judge: Any,
    transitions: Setting,
    rows: int,
    dtype: torch.dtype | None,
) -> None:
    """One batch in a sample, and four, which are split."""
    buffer, plain = transitions.with_goals(), transitions.buffer()
    learner = Learner(dtype, transitions.device)
    batch = buffer.sample(rows)
    times = seconds(
        {
            "plain": lambda: plain.sample(rows),
            "one": lambda: buffer.sample(rows),
            "plain of four": lambda: plain.sample(4 * rows),
            "of four": lambda: buffer.sample(4 * rows),
            "two steps": lambda: learner.two_steps(batch),
        },
        rounds=60,
        warmup=25,
    )
    name = "float32" if dtype is None else "bfloat16"
    for what, number in (("one", 1), ("of four", 4)):
        label = f"TD3, {rows} rows, {name}, {what}"
        before = times["plain" if number == 1 else "plain of four"] / number
        step, most = times["two steps"] / 2, 0.15 if rows == 4096 else 0.05
        shares(judge, label, before, times[what] / number, step, most)
    benchmark.pedantic(lambda: buffer.sample(rows), rounds=20)


@SIZES
def bench_lmp_share(
    benchmark: Any, judge: Any, device: torch.device, windows: int, window: int
) -> None:
    """Windows with goals: one batch in a sample, and four, which are split."""
    buffer, size = make_buffer(windows, window, device, swap=True), windows * window
    plain = ReplayBuffer(
        storage=buffer.storage, sampler=slices(window), batch_size=size
    )
    step, batch = make_step(window, device), buffer.sample()
    times = seconds(
        {
            "plain": plain.sample,
            "one": buffer.sample,
            "plain of four": lambda: plain.sample(4 * size),
            "of four": lambda: buffer.sample(4 * size),
            "step": lambda: step(batch),
        },
        rounds=30,
        warmup=25,
    )
    for what, number in (("one", 1), ("of four", 4)):
        label = f"LMP, {windows} windows of {window}, {what}"
        before = times["plain" if number == 1 else "plain of four"] / number
        shares(judge, label, before, times[what] / number, times["step"], 0.1)
    benchmark.pedantic(buffer.sample, rounds=20)


def shares(
    judge: Any, label: str, plain: float, sample: float, step: float, target: float
) -> None:
    """Judges the share of a whole sample, and of what swaps and goals add to it."""
    whole = sample + step
    judge(f"{label}: sample / sample and step", sample / whole, at_most=target)
    judge(
        f"{label}: swap and goals / the same", (sample - plain) / whole, at_most=target
    )
