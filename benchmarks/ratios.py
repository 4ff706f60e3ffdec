"""Times calls in turns, and compares their ratios with targets."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch


def seconds(
    calls: Mapping[str, Callable[[], Any]],
    *,
    rounds: int,
    warmup: int = 2,
    clock: Callable[[], float] = time.perf_counter,
    statistic: Callable[[list[float]], float] = median,
) -> dict[str, float]:
    """The median seconds of each call.

    All calls of a round follow each other, so that other load affects them equally.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(warmup + rounds):
        for name, call in calls.items():
            begin = clock()
            call()
            if torch.cuda.is_initialized():
                torch.cuda.synchronize()
            if number >= warmup:
                times[name].append(clock() - begin)
    return {name: statistic(values) for name, values in times.items()}


@dataclass(frozen=True)
class Judged:
    """A ratio and its target."""

    name: str
    value: float
    target: float
    at_least: bool

    @property
    def holds(self) -> bool:
        """Whether the ratio is on the right side of its target."""
        if self.at_least:
            return self.value >= self.target
        return self.value <= self.target

    def __str__(self) -> str:
        sign = "≥" if self.at_least else "≤"
        verdict = "holds" if self.holds else "missed"
        return f"{self.name:<72}{self.value:>8.3g}   {sign} {self.target:<6g} {verdict}"
