"""CoDATransform against CAIACTransform, and attention against a plain forward pass.

Run with ``pytest benchmarks/bench_coda.py`` (``make bench``). The batches are those of
``bench_sampling.py``: 512 transitions of Fetch-Push (3 entities) and 500 windows of 20
rows of the kitchen (10 entities), donors from the batch or from 100 k stored rows; the
transforms are timed alone, without sampling, on the same batch. With ``--device=cuda``
batches and donors are on the GPU. For scoring, the rate is that of the attention
against the model's plain forward pass, in chunks of the same size.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import TensorStorage

from benchmarks.bench_sampling import CHUNK, EPISODE, FETCH, KITCHEN, chunk
from benchmarks.ratios import seconds
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


def drawn(data: TensorDictBase, window: int, windows: int) -> TensorDictBase:
    """A batch of windows, each of one episode."""
    generator = torch.Generator().manual_seed(2)
    episode = torch.randint(len(data) // EPISODE, (windows, 1), generator=generator)
    start = torch.randint(EPISODE - window + 1, (windows, 1), generator=generator)
    return data[(episode * EPISODE + start + torch.arange(window)).flatten()]


@pytest.mark.parametrize("donors", ["batch", "buffer"])
@pytest.mark.parametrize("name", BATCHES)
def bench_transform(
    benchmark: Any, judge: Any, name: str, donors: str, device: torch.device
) -> None:
    """Either transform on the same batch."""
    layout, width, action, goals, window, windows = BATCHES[name]
    part = chunk(layout, width, action, goals)
    part["coda", "graph"] = graphs(layout, CHUNK)
    stored = torch.cat([part] * (DONOR_ROWS // CHUNK))
    stored["episode"] = torch.arange(DONOR_ROWS) // EPISODE
    batch = drawn(stored, window, windows).to(device)
    storage = None
    if donors == "buffer":
        storage = TensorStorage(stored.to(device), device=device)
    calls = {
        made.__name__: partial(made(layout, window=window, donors=storage), batch)
        for made in (CAIACTransform, CoDATransform)
    }
    times = seconds(calls, rounds=200, warmup=10)
    judge(
        f"CoDA / CAIAC, {name}, donors from the {donors}",
        times["CoDATransform"] / times["CAIACTransform"],
        at_most=3,
    )
    benchmark.pedantic(calls["CoDATransform"], rounds=50)


@pytest.mark.parametrize("name", MODELS)
def bench_attention(
    benchmark: Any, judge: Any, name: str, device: torch.device
) -> None:
    """Scoring with attention, and the same rows through the model alone."""
    layout, action_dim, layers = MODELS[name]
    model = TransformerWorldModel(layout, action_dim, layers).to(device).eval()
    model.fitted = True  # its weights do not matter for the time
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

    score = partial(estimator, td)
    times = seconds({"plain": forward, "score": score}, rounds=15)
    judge(
        f"attention, rate / plain forward, {name}",
        times["plain"] / times["score"],
        at_least=0.5,
    )
    benchmark.extra_info["states_per_s"] = rows / times["score"]
    benchmark.pedantic(score, rounds=3)
