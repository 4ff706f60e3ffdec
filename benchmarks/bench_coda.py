"""CoDATransform against CAIACTransform, and attention against a plain forward pass.

Run with ``pytest benchmarks/bench_coda.py`` (``make bench``). The batches are those of
``bench_sampling.py``: 512 transitions of Fetch-Push (3 entities) and 500 windows of 20
rows of the kitchen (10 entities), donors from the batch or from 100 k stored rows; the
transforms are timed alone, without sampling. ``extra_info["ratio"]`` is CoDA's time
against CAIAC's on the same batch, both at their fastest, so that what else the machine
does hardly counts; the target is at most 3.

For scoring, ``states_per_s`` is that of the attention or of the model's plain forward
pass, in chunks of the same size, and ``share`` the former against the latter, at least
0.5.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import TensorStorage

from benchmarks.bench_sampling import CHUNK, EPISODE, FETCH, KITCHEN, chunk
from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac.influence import AttentionInfluence
from torchrl_caiac.modules import TransformerWorldModel

DONOR_ROWS = 100_000
BATCHES = {
    "transitions": (FETCH, 34, 4, True, 1, 512),
    "windows": (KITCHEN, 30, 9, False, 20, 500),
}
MODELS = {"fetch": (FETCH, 4, 3), "kitchen": (KITCHEN, 9, 5)}
STATES = {"cpu": 512, "cuda": 65_536}


def graphs(layout: EntityLayout, rows: int) -> torch.Tensor:
    """Graphs that stay the same for an episode, with a twentieth of all links."""
    generator = torch.Generator().manual_seed(1)
    shape = (rows // EPISODE, len(layout) + 1, len(layout))
    graph = torch.rand(shape, generator=generator) * 0.1
    graph[torch.rand(shape, generator=generator) < 0.05] = 1.0
    return graph.repeat_interleave(EPISODE, 0)


def synchronised(call: Callable[[], Any], device: torch.device) -> Callable[[], None]:
    def run() -> None:
        call()
        if device.type == "cuda":
            torch.cuda.synchronize()

    return run


def ratio(one: Callable[[], Any], other: Callable[[], Any], rounds: int) -> float:
    """The time of one call in that of the other, each at its fastest."""
    best = [math.inf, math.inf]
    for _ in range(rounds):
        for i, call in enumerate((one, other)):
            begin = time.perf_counter()
            call()
            best[i] = min(best[i], time.perf_counter() - begin)
    return best[0] / best[1]


def drawn(data: TensorDictBase, window: int, windows: int) -> TensorDictBase:
    """A batch of windows, each of one episode."""
    generator = torch.Generator().manual_seed(2)
    episode = torch.randint(len(data) // EPISODE, (windows, 1), generator=generator)
    start = torch.randint(EPISODE - window + 1, (windows, 1), generator=generator)
    return data[(episode * EPISODE + start + torch.arange(window)).flatten()]


@pytest.mark.parametrize("kind", ["caiac", "coda"])
@pytest.mark.parametrize("donors", ["batch", "buffer"])
@pytest.mark.parametrize("name", BATCHES)
def bench_transform(
    benchmark: Any, name: str, donors: str, kind: str, device: torch.device
) -> None:
    """Either transform on the same batch."""
    layout, width, action, goals, window, windows = BATCHES[name]
    part = chunk(layout, width, action, goals)
    part["coda", "graph"] = graphs(layout, CHUNK)
    stored = torch.cat([part] * (DONOR_ROWS // CHUNK))
    stored["episode"] = torch.arange(DONOR_ROWS) // EPISODE
    storage = None if donors == "batch" else TensorStorage(stored)
    batch = drawn(stored, window, windows).to(device)
    caiac, coda = (
        synchronised(
            partial(made(layout, window=window, donors=storage), batch), device
        )
        for made in (CAIACTransform, CoDATransform)
    )
    benchmark.group = f"{name}, donors from the {donors}"
    benchmark.extra_info["target"] = 3.0
    benchmark.extra_info["ratio"] = round(ratio(coda, caiac, 200), 2)
    benchmark.pedantic(caiac if kind == "caiac" else coda, rounds=200, warmup_rounds=5)


@pytest.mark.parametrize("name", MODELS)
def bench_attention(benchmark: Any, name: str, device: torch.device) -> None:
    """Scoring with attention, and the same rows through the model alone."""
    layout, action_dim, layers = MODELS[name]
    model = TransformerWorldModel(layout, action_dim, layers).to(device).eval()
    estimator = AttentionInfluence(model)
    rows = STATES[device.type]
    width = model.state_dim
    td = TensorDict(
        {
            "observation": torch.randn(rows, width, device=device),
            "action": torch.randn(rows, action_dim, device=device),
        },
        [rows],
        device=device,
    )

    @torch.no_grad()
    def forward() -> None:
        for part in td.split(estimator.chunk_rows):
            model.forward_tensors(layout.read(part), part["action"])

    plain = synchronised(forward, device)
    score = synchronised(lambda: estimator(td), device)
    benchmark.group = "scoring"
    benchmark.extra_info["target"] = 0.5
    benchmark.extra_info["share"] = round(ratio(plain, score, 10), 2)
    benchmark.pedantic(score, rounds=5)
    if benchmark.stats is not None:  # None where benchmarks are disabled
        benchmark.extra_info["states_per_s"] = rows / benchmark.stats.stats.median
