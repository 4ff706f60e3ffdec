"""Gradient steps a second from a buffer here and from one in an actor of Ray.

Run with ``python benchmarks/scaling_buffers.py``, which takes about two minutes and
writes ``docs/results/scaling_buffers.txt``. The data are random, with the shapes of
Fetch-Push with two cubes. Both buffers relabel goals and swap entities; a step is one
of TD3 with both losses. What is measured is repeated in turn, since other work on the
machine would else favour one.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import RayReplayBuffer, ReplayBuffer

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.caiac_buffer import CAIACReplayBuffer
from torchrl_caiac.modules import (
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalFeatures,
)
from torchrl_caiac.objectives import GoalConditionedTD3Loss
from torchrl_caiac.transforms import HindsightGoal

LAYOUT = EntityLayout(
    {"gripper": range(10), "cube0": range(10, 22), "cube1": range(22, 34)},
    goal={"cube0": range(3), "cube1": range(3, 6)},
    achieved={"cube0": range(10, 13), "cube1": range(22, 25)},
    fixed=("gripper",),
)
ROWS, EPISODE, BATCH, STEPS, ROUNDS = 100_000, 100, 512, 60, 5
RESULT = Path(__file__).parents[1] / "docs" / "results" / "scaling_buffers.txt"


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    """Returns 0 near the goal, else -1."""
    return -((achieved - desired).norm(dim=-1) > 0.05).float()


def write_rows(folder: Path) -> None:
    """Writes random transitions with scores."""
    state = torch.randn(ROWS, 34)
    done = (torch.arange(ROWS) % EPISODE == EPISODE - 1).unsqueeze(-1)
    TensorDict(
        {
            "observation": state,
            "action": torch.randn(ROWS, 4).tanh(),
            "desired_goal": torch.randn(ROWS, 6),
            "episode": torch.arange(ROWS) // EPISODE,
            "caiac": {"score": torch.rand(ROWS, 3) * 0.1},
            "next": {
                "observation": state.roll(-1, 0),
                "reward": -torch.ones(ROWS, 1),
                "done": done,
                "terminated": torch.zeros(ROWS, 1, dtype=torch.bool),
            },
        },
        [ROWS],
    ).memmap(folder)


def learner(batch: TensorDictBase) -> Callable[[TensorDictBase], None]:
    """Returns a function that takes a step of TD3."""
    features = GoalFeatures(LAYOUT)
    features.fit_statistics(batch)
    loss = GoalConditionedTD3Loss(
        GoalConditionedActor(features, 4, (256,) * 3),
        [GoalConditionedCritic(features, 4, (256,) * 3) for _ in range(2)],
    )
    loss.make_value_estimator(gamma=0.97)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)

    def step(batch: TensorDictBase) -> None:
        out = loss(batch)
        optimizer.zero_grad()
        (out["loss_qvalue"] + out["loss_actor"]).backward()
        optimizer.step()

    return step


def seconds(work: Callable[[], None]) -> float:
    """Returns the seconds of one call, averaged over some."""
    start = time.perf_counter()
    for _ in range(STEPS):
        work()
    return (time.perf_counter() - start) / STEPS


def bytes_of(batch: TensorDictBase) -> int:
    """Returns the size of a batch."""
    return sum(x.numel() * x.element_size() for x in batch.values(True, True))


def main() -> None:
    """Measures, and writes the table."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows"
        write_rows(path)
        settings = dict(
            augmentation=partial(CAIACTransform, LAYOUT, threshold=0.05),
            goals=partial(HindsightGoal, LAYOUT, reward),
            batch_size=BATCH,
            seed=0,
        )
        remote = partial(
            RayReplayBuffer,
            path,
            replay_buffer_cls=CAIACReplayBuffer,
            ray_init_config={
                "num_cpus": 2,
                "include_dashboard": False,
                "object_store_memory": 200 << 20,
                "log_to_driver": False,
            },
            remote_config={"num_cpus": 1, "num_gpus": 0},
            **settings,
        )
        buffers: dict[str, ReplayBuffer] = {
            "here": CAIACReplayBuffer(path, **settings),
            "here, prefetch=1": CAIACReplayBuffer(path, prefetch=1, **settings),
            "Ray": remote(),
            "Ray, prefetch=1": remote(prefetch=1),
        }
        batch = buffers["here"].sample()
        step = learner(batch)
        for rb in buffers.values():  # starts the actors, and builds what is cached
            step(rb.sample())
        samples: dict[str, list[float]] = {name: [] for name in buffers}
        steps: dict[str, list[float]] = {name: [] for name in buffers}
        for _ in range(ROUNDS):
            for name, rb in buffers.items():
                samples[name].append(seconds(lambda rb=rb: rb.sample()))
                steps[name].append(seconds(lambda rb=rb: step(rb.sample())))
        for name, rb in buffers.items():
            if name.startswith("Ray"):
                rb.close()
    sample, whole = (
        {name: statistics.median(values) for name, values in table.items()}
        for table in (samples, steps)
    )
    transfer = sample["Ray"] - sample["here"]
    lines = [
        f"TD3 steps with batches of {BATCH} rows ({bytes_of(batch) / 1024:.0f} KiB), "
        f"{ROWS} rows in a folder, one thread, {os.cpu_count()} cores",
        f"{'buffer':20}{'ms a sample':>12}{'ms a step':>12}{'steps a second':>16}",
        *[
            f"{name:20}{1e3 * sample[name]:12.2f}{1e3 * whole[name]:12.2f}"
            f"{1 / whole[name]:16.1f}"
            for name in buffers
        ],
        f"Transfer: {1e3 * transfer:.2f} ms, {transfer / sample['Ray']:.0%} of a "
        f"sample and {transfer / whole['Ray']:.0%} of a step without prefetch.",
        f"Steps a second from Ray, relative to here: "
        f"{whole['here'] / whole['Ray']:.2f} without prefetch, "
        f"{whole['here, prefetch=1'] / whole['Ray, prefetch=1']:.2f} with it.",
    ]
    RESULT.write_text("\n".join(lines) + "\n")
    print(RESULT.read_text(), end="")


if __name__ == "__main__":
    main()
