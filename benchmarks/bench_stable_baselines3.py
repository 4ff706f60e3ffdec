"""Gradient steps of TD3 with hindsight goals against Stable-Baselines3's.

Run with ``pytest benchmarks/bench_stable_baselines3.py`` (``make bench``). Both sides
learn from the same synthetic episodes of Fetch-Push's shapes (200 of 100 steps, two
cubes), in one process, in turns, with the same number of threads. A step is a sample
of 512 rows, an update of two critics and, every second step, of the policy and the
targets; networks of 3 x 256 read 52 numbers (and the critics 4 of the action); γ 0.97,
τ 0.005, Adam at 1e-3.

- Stable-Baselines3: ``TD3("MultiInputPolicy")`` with ``HerReplayBuffer``, half of the
  goals from the future of their own episode; what is timed is ``train()``. Its
  observation contains the 34 state columns and 6 of the cubes relative to the gripper,
  and achieved and desired goals of 6 each.
- Ours: :class:`GoalConditionedTD3Loss` as ``examples/learners/td3.py`` uses it, with
  half of the rows counterfactual (``CAIACTransform``), goals relabelled and rewards
  recomputed (``HindsightGoal``), the relative features (12 columns) computed in every
  pass; four batches are sampled at once.

Stable-Baselines3 has no setting for bfloat16. Two of torch act on it from outside:
``torch.set_float32_matmul_precision("medium")``, which allows products in bfloat16 (a
CPU without AMX takes oneDNN's float32 kernels instead, on AMD twice as fast as MKL's),
and ``torch.autocast``, which casts the factors as our hidden layers do. Their times are
in ``extra_info["ms_per_step"]``. "Everything allowed" is the faster dtype of ours, as
with ``hidden_dtype: auto`` in the examples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer

from benchmarks.bench_td3 import LAYOUT, Learner
from benchmarks.ratios import seconds
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.modules import faster_dtype
from torchrl_caiac.transforms import CAIACTransform, HindsightGoal

EPISODES, LENGTH, BATCH = 200, 100, 512
STEPS = 32  # of one side before it is the turn of the next, all code then in cache
AT_ONCE = 4  # batches, which take little more time to sample than a single one


def sparse_reward(achieved: Any, desired: Any) -> Any:
    """0 if both cubes are within 5 cm of their goals, else -1; in NumPy or torch."""
    squares = ((achieved - desired) ** 2).reshape(-1, 2, 3).sum(-1)
    return (squares < 0.05**2).all(-1) * 1.0 - 1.0


class Goals(gym.Env):
    """What Stable-Baselines3 needs of an environment to learn from a buffer."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Dict(
            {
                name: gym.spaces.Box(-np.inf, np.inf, (width,), np.float32)
                for name, width in (
                    ("observation", 40),
                    ("achieved_goal", 6),
                    ("desired_goal", 6),
                )
            }
        )
        self.action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return sparse_reward(achieved, desired)


def episodes() -> TensorDict:
    """Random walks, one object in ten steps touched."""
    generator = torch.Generator().manual_seed(0)
    rows = EPISODES * LENGTH
    walks = torch.randn(EPISODES, LENGTH + 1, 34, generator=generator)
    walks = 0.02 * walks.cumsum(1)
    goals = 0.1 * torch.randn(EPISODES, 1, 6, generator=generator)
    done = torch.zeros(EPISODES, LENGTH, 1, dtype=torch.bool)
    done[:, -1] = True
    touched = torch.rand(rows, 3, generator=generator) < 0.1
    flat = TensorDict(
        {
            "observation": walks[:, :-1],
            "desired_goal": goals.expand(-1, LENGTH, -1),
            "action": torch.rand(EPISODES, LENGTH, 4, generator=generator) * 2 - 1,
            "episode": torch.arange(EPISODES).unsqueeze(1).expand(-1, LENGTH),
            "next": {
                "observation": walks[:, 1:],
                "reward": -torch.ones(EPISODES, LENGTH, 1),
                "terminated": torch.zeros_like(done),
                "done": done,
            },
        },
        [EPISODES, LENGTH],
    ).reshape(rows)
    flat["caiac", "score"] = touched.float()
    return flat.contiguous()


def stable_baselines(data: TensorDict, device: torch.device) -> Any:
    """Their TD3, its buffer filled with the data."""
    from stable_baselines3 import TD3, HerReplayBuffer
    from stable_baselines3.common.logger import configure

    model = TD3(
        "MultiInputPolicy",
        Goals(),
        learning_rate=1e-3,
        buffer_size=len(data),
        batch_size=BATCH,
        tau=0.005,
        gamma=0.97,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 1},
        policy_kwargs={"net_arch": [256, 256, 256]},
        seed=0,
        device=device,
    )
    model.set_logger(configure(None, []))

    def observations(state: torch.Tensor) -> dict[str, np.ndarray]:
        achieved = torch.cat([state[:, 10:13], state[:, 22:25]], -1)
        relative = achieved - state[:, :3].repeat(1, 2)
        return {
            "observation": torch.cat([state, relative], -1).numpy(),
            "achieved_goal": achieved.numpy(),
            "desired_goal": data["desired_goal"].numpy(),
        }

    before, after = (observations(td["observation"]) for td in (data, data["next"]))
    done = data["next", "done"].squeeze(-1).numpy()
    for i in range(len(data)):
        model.replay_buffer.add(
            *({key: x[i : i + 1] for key, x in td.items()} for td in (before, after)),
            data["action"][i : i + 1].numpy(),
            data["next", "reward"][i].numpy(),
            done[i : i + 1],
            [{"TimeLimit.truncated": bool(done[i])}],
        )
    return model


def make_buffer(data: TensorDict) -> TensorDictReplayBuffer:
    """Creates our buffer, as the method ``caiac`` of the example does."""
    goals = HindsightGoal(LAYOUT, sparse_reward)
    rb = offline_buffer(data, batch_size=AT_ONCE * BATCH, sample_unit=goals)
    rb.append_transform(CAIACTransform(LAYOUT, threshold=0.05, rows="last"))
    rb.append_transform(goals)
    return rb


@contextmanager
def products_in_bfloat16() -> Iterator[None]:
    """Allows bfloat16 in float32 products."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@pytest.fixture(scope="module")
def sides(device: torch.device) -> tuple[Any, TensorDictReplayBuffer]:
    """Their model and our buffer, filled with the same episodes."""
    data = episodes()
    return stable_baselines(data, device), make_buffer(data.to(device))


def bench_step(benchmark, judge, device, sides):
    """Steps of both sides in turns, sampling included."""
    model, rb = sides
    torch.set_num_threads(1)  # Stable-Baselines3 sets its own

    def theirs() -> None:
        model.train(gradient_steps=STEPS, batch_size=BATCH)

    def switched() -> None:
        with products_in_bfloat16():
            theirs()

    def autocast() -> None:
        # Cached casts of weights outlive the optimizer's steps: nothing is learned.
        with torch.autocast(device.type, torch.bfloat16, cache_enabled=False):
            theirs()

    def ours(dtype: torch.dtype | None) -> Callable[[], None]:
        learner = Learner(dtype, device)

        def steps() -> None:
            for step in range(STEPS):
                if step % AT_ONCE == 0:
                    rows = rb.sample()
                # In strides: the last rows of a sample are the counterfactual ones.
                batch = rows[step % AT_ONCE :: AT_ONCE]
                learner.update_critics(batch)
                if step % 2:
                    learner.update_actor(batch)
                    learner.updater.step()

        return steps

    calls = {
        "SB3": theirs,
        "SB3, bfloat16 products allowed": switched,
        "SB3, bfloat16 autocast": autocast,
        "ours, float32": ours(None),
        "ours, bfloat16": ours(torch.bfloat16),
    }
    times = seconds(calls, rounds=8)
    benchmark.extra_info["ms_per_step"] = {
        name: round(1e3 * value / STEPS, 2) for name, value in times.items()
    }
    allowed = str(faster_dtype(BATCH, 256)).removeprefix("torch.")
    times["ours, everything allowed"] = times[f"ours, {allowed}"]
    for side, other, target in (
        ("SB3", "ours, float32", 1.2),
        ("SB3", "ours, everything allowed", 1.5),
        ("SB3, bfloat16 products allowed", "ours, everything allowed", 1.3),
    ):
        judge(f"TD3+HER, {side} / {other}", times[side] / times[other], at_least=target)
    benchmark.pedantic(calls["ours, bfloat16"], rounds=5)
