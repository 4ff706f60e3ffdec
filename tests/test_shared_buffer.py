"""Buffers that several processes sample and extend."""

from __future__ import annotations

import multiprocessing
import warnings
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyMemmapStorage

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.caiac_buffer import CAIACReplayBuffer
from torchrl_caiac.transforms import HindsightGoal

LAYOUT = EntityLayout(
    {"arm": [0], "cup": [1]},
    goal={"cup": [0]},
    achieved={"cup": [1]},
    fixed=["arm"],
)


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return -(achieved != desired).any(-1).float()


def transitions(first: float, rows: int = 20) -> TensorDict:
    state = (first + torch.arange(rows)).float().unsqueeze(-1).expand(-1, 2).clone()
    done = torch.zeros(rows, 1, dtype=torch.bool)
    done[-1] = True
    return TensorDict(
        {
            "observation": state,
            "desired_goal": -torch.ones(rows, 1),
            "episode": torch.full((rows,), int(first)),
            "caiac": {"score": torch.zeros(rows, 2)},
            "next": {
                "observation": state + 1,
                "reward": -torch.ones(rows, 1),
                "done": done,
            },
        },
        [rows],
    )


def make(**kwargs: Any) -> CAIACReplayBuffer:
    rb = CAIACReplayBuffer(
        partial(LazyMemmapStorage, 20),
        augmentation=partial(CAIACTransform, LAYOUT, 0.5, 0.0),
        goals=partial(HindsightGoal, LAYOUT, reward, future=1.0),
        batch_size=64,
        shared=True,
        **kwargs,
    )
    rb.extend(transitions(0.0))
    return rb


def work(rb: Any, answers: Any, rows: TensorDictBase | None, seed: int | None) -> None:
    if seed is not None:
        torch.manual_seed(seed)
    if rows is not None:
        rb.extend(rows)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        batch = rb.sample()
    answers.put(
        (
            batch["index"].tolist(),
            (batch["desired_goal"] - batch["observation"][:, 1:]).flatten().tolist(),
            [str(x.message) for x in seen if "forked" in str(x.message)],
        )
    )


def in_process(method: str, rb: Any, rows: Any, seed: int | None) -> Any:
    context = multiprocessing.get_context(method)
    answers = context.Queue()
    process = context.Process(target=work, args=(rb, answers, rows, seed))
    process.start()
    found = answers.get(timeout=120)
    process.join()
    return found


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_goals_follow_what_another_process_writes(method: str) -> None:
    rb = make()
    rb.sample()  # builds the index of trajectories here
    _, ahead, _ = in_process(method, rb, transitions(1000.0), 0)
    assert min(ahead) >= 1
    batch = rb.sample()
    assert (batch["observation"] >= 1000).all()
    ahead = batch["desired_goal"] - batch["observation"][:, 1:]
    assert (ahead >= 1).all()
    assert (ahead <= 20).all()


def test_forked_processes_with_the_same_numbers_are_warned_of() -> None:
    rb = make()
    one, other = (in_process("fork", rb, None, None) for _ in range(2))
    assert one[0] == other[0]
    assert "torch.manual_seed" in one[2][0]
    seeded, again = (in_process("fork", rb, None, 10**6 + seed) for seed in range(2))
    assert seeded[0] != again[0]
    assert not seeded[2]
    assert "set_generator" in in_process("fork", make(seed=0), None, 5)[2][0]
