"""Milliseconds of a goal-conditioned TD3 step, its parts, and what compiling gives.

Run with ``pytest benchmarks/bench_td3.py`` (``make bench``). The shapes are those of
Fetch-Push with two cubes: 34 state columns, 6 of the goal and 12 relative features, 4
actions, networks of 3 x 256, two critics. A round of ``bench_step`` is two critic
updates, one update of the policy and of the targets (policy delay 2), so ``extra_info``
contains ``ms_per_step``, half of the fastest round.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules import (
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalFeatures,
)
from torchrl_caiac.objectives import GoalConditionedTD3Loss

D, G, A = 34, 6, 4
LAYOUT = EntityLayout(
    {"gripper": range(10), "cube0": range(10, 22), "cube1": range(22, 34)},
    goal={"cube0": range(3), "cube1": range(3, 6)},
    achieved={"cube0": range(10, 13), "cube1": range(22, 25)},
    fixed=("gripper",),
)
BATCH = pytest.mark.parametrize("batch_size", [256, 512])
DTYPE = pytest.mark.parametrize(
    "dtype", [None, torch.bfloat16], ids=["float32", "bfloat16"]
)


def make_batch(rows: int, device: torch.device) -> TensorDict:
    """Transitions as a relabelling buffer returns them."""
    generator = torch.Generator().manual_seed(0)

    def draw(width: int) -> torch.Tensor:
        return torch.randn(rows, width, generator=generator)

    never = torch.zeros(rows, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": draw(D),
            "desired_goal": draw(G),
            "action": draw(A).tanh(),
            "next": {
                "observation": draw(D),
                "reward": -torch.ones(rows, 1),
                "terminated": never,
                "done": never,
            },
        },
        [rows],
    ).to(device)


class Learner:
    """A loss with its optimizers, and the updates of one step."""

    def __init__(
        self,
        dtype: torch.dtype | None,
        device: torch.device,
        *,
        compiled: bool = False,
    ) -> None:
        torch.manual_seed(0)
        features = GoalFeatures(LAYOUT, reference="gripper")
        features.fit_statistics(make_batch(4096, torch.device("cpu")))
        self.loss = GoalConditionedTD3Loss(
            GoalConditionedActor(features, A, hidden_dtype=dtype),
            [GoalConditionedCritic(features, A, hidden_dtype=dtype) for _ in range(2)],
        ).to(device)
        self.loss.make_value_estimator(gamma=0.97)
        self.updater = SoftUpdate(self.loss, tau=0.005)
        self.critic_optimizer, self.actor_optimizer = (
            torch.optim.Adam(params.flatten_keys().values(), lr=1e-3, fused=True)
            for params in (
                self.loss.qvalue_network_params,
                self.loss.actor_network_params,
            )
        )
        self.value_loss, self.actor_loss = self.loss.value_loss, self.loss.actor_loss
        if compiled:
            self.value_loss = torch.compile(self.value_loss)
            self.actor_loss = torch.compile(self.actor_loss)

    def update_critics(self, batch: TensorDict) -> None:
        self.value_loss(batch)[0].backward()
        self.critic_optimizer.step()
        self.critic_optimizer.zero_grad()

    def update_actor(self, batch: TensorDict) -> None:
        self.actor_loss(batch)[0].backward()
        self.actor_optimizer.step()
        self.actor_optimizer.zero_grad()

    def two_steps(self, batch: TensorDict) -> None:
        self.update_critics(batch)
        self.update_critics(batch)
        self.update_actor(batch)
        self.updater.step()
        if batch.device is not None and batch.device.type == "cuda":
            torch.cuda.synchronize(batch.device)


def measure(benchmark, function: Callable[[TensorDict], None], batch: TensorDict):
    """Measures the fastest of 50 rounds, since other jobs may run."""
    benchmark.pedantic(function, args=(batch,), rounds=50, warmup_rounds=5)


@BATCH
@DTYPE
def bench_step(benchmark, device, batch_size, dtype):
    """Whole updates."""
    learner = Learner(dtype, device)
    measure(benchmark, learner.two_steps, make_batch(batch_size, device))
    if benchmark.stats is not None:
        fastest = benchmark.stats.stats.min
        benchmark.extra_info["ms_per_step"] = round(1e3 * fastest / 2, 2)


@DTYPE
@pytest.mark.parametrize("part", ["update_critics", "update_actor", "soft_update"])
def bench_parts(benchmark, device, dtype, part):
    """Where the time of a step goes, at batch 512."""
    learner, batch = Learner(dtype, device), make_batch(512, device)

    def function(batch: TensorDict) -> None:
        if part == "soft_update":
            learner.updater.step()
        else:
            getattr(learner, part)(batch)
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    measure(benchmark, function, batch)


def bench_compiled_step(benchmark, device):
    """``torch.compile`` on both losses, batch 512 in bfloat16, compiling apart."""
    learner = Learner(torch.bfloat16, device, compiled=True)
    batch = make_batch(512, device)
    start = time.perf_counter()
    learner.two_steps(batch)
    benchmark.extra_info["s_compiling"] = round(time.perf_counter() - start, 1)
    measure(benchmark, learner.two_steps, batch)
