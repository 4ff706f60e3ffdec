"""States scored a second by CAI, and the milliseconds of a world model's step.

Run with ``pytest benchmarks/bench_scoring.py`` (``make bench``); ``extra_info`` holds
``states_per_s``. The shapes are those of Fetch-Push with two cubes (34 columns and 4
actions, 3 x 256, 11 predicted columns of 3 entities) and of the kitchen (30 and 9,
5 x 256, all columns of 10 entities), both with 64 actions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.cai import CAI, causal_action_influence
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
from torchrl_caiac.objectives.entity_dynamics import gaussian_nll

ROWS = {"cpu": 256, "cuda": 65_536}


def fetch() -> GaussianWorldModel:
    """Fetch-Push with two cubes, positions predicted."""
    layout = EntityLayout(
        {"gripper": range(10), "cube0": range(10, 22), "cube1": range(22, 34)}
    )
    predict = {"gripper": range(5), "cube0": range(10, 13), "cube1": range(22, 25)}
    return GaussianWorldModel(layout, 4, (256,) * 3, predict)


def kitchen() -> GaussianWorldModel:
    """The kitchen, everything predicted."""
    ends = [0, 9, 11, 13, 15, 17, 19, 20, 22, 23, 30]
    names = ["robot", *(f"object{i}" for i in range(9))]
    layout = EntityLayout({n: range(ends[i], ends[i + 1]) for i, n in enumerate(names)})
    return GaussianWorldModel(layout, 9, (256,) * 5)


SHAPES = pytest.mark.parametrize("make", [fetch, kitchen])


def _synchronised(
    function: Callable[[], Any], device: torch.device
) -> Callable[[], Any]:
    def call() -> Any:
        result = function()
        if device.type == "cuda":
            torch.cuda.synchronize()
        return result

    return call


def _report(benchmark: Any, rows: int) -> None:
    if benchmark.stats is not None:  # None where benchmarks are disabled
        benchmark.extra_info["states_per_s"] = rows / benchmark.stats.stats.median


@SHAPES
def bench_estimator(
    benchmark: Any, make: Callable[[], GaussianWorldModel], device: torch.device
) -> None:
    """CAI as a whole: network and divergences."""
    rows = ROWS[device.type]
    estimator = CAI(make().to(device))
    td = TensorDict(
        {"observation": torch.randn(rows, 34, device=device)}, [rows], device=device
    )
    scores = benchmark(_synchronised(lambda: estimator(td), device))
    assert scores.shape == (rows, estimator.model.layout.num_entities)
    _report(benchmark, rows)


@SHAPES
def bench_divergences(
    benchmark: Any, make: Callable[[], GaussianWorldModel], device: torch.device
) -> None:
    """Equation 3 alone, for all entities of given Gaussians."""
    rows = ROWS[device.type] // 16
    model = make()
    loc = torch.randn(rows, 64, model.predict_dim, device=device)
    var = torch.rand(rows, 64, model.predict_dim, device=device) + 0.1

    def score() -> list[torch.Tensor]:
        return [
            causal_action_influence(loc[..., where], var[..., where])
            for where in model.predicted.values()
        ]

    benchmark(_synchronised(score, device))
    _report(benchmark, rows)


@SHAPES
def bench_gradient_step(
    benchmark: Any, make: Callable[[], GaussianWorldModel], device: torch.device
) -> None:
    """One step of fitting on 500 rows."""
    model = make().to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=8e-4)
    state = torch.randn(500, model.state_dim, device=device)
    action = torch.randn(500, model.action_dim, device=device)
    target = torch.randn(500, model.predict_dim, device=device)

    def step() -> None:
        optimizer.zero_grad()
        loc, var = model.forward_tensors(state, action)
        gaussian_nll(loc, var, target).mean().backward()
        optimizer.step()

    benchmark(_synchronised(step, device))
    _report(benchmark, 500)
