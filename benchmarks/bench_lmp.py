"""Milliseconds of an LMP gradient step, and the share of sampling and swapping.

Run with ``pytest benchmarks/bench_lmp.py`` (``make bench``). The data have the
kitchen's shapes: 100 demonstrations of 60 steps, 30 state columns, 9 entities of
which the robot is never swapped, 21 goal columns. ``extra_info`` of the last
benchmark holds the share of the step that goes to ``rb.sample()``.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, SliceSampler

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules.lmp import LMPModel
from torchrl_caiac.objectives.lmp import LMPLoss
from torchrl_caiac.transforms import CAIACTransform, WindowGoal

TRAJECTORIES, STEPS, D, G, A = 100, 60, 30, 21, 9
SIZES = pytest.mark.parametrize(
    ("windows", "window"), [(128, 10), (500, 20)], ids=["128x10", "500x20"]
)


def kitchen_layout() -> EntityLayout:
    """The kitchen's entities by their columns."""
    objects = {
        "bottom_right_burner": range(9, 11),
        "bottom_burner": range(11, 13),
        "top_right_burner": range(13, 15),
        "top_burner": range(15, 17),
        "light_switch": range(17, 19),
        "slide_cabinet": range(19, 20),
        "hinge_cabinet": range(20, 22),
        "microwave": range(22, 23),
        "kettle": range(23, 30),
    }
    return EntityLayout(
        {"robot": range(9), **objects},
        goal={name: [c - 9 for c in columns] for name, columns in objects.items()},
        achieved=objects,
        fixed=("robot",),
    )


def make_buffer(windows: int, window: int, *, swap: bool) -> ReplayBuffer:
    """Scored demonstrations in memory, sampled in windows with goals."""
    layout = kitchen_layout()
    generator = torch.Generator().manual_seed(0)
    rows = TRAJECTORIES * STEPS
    state = torch.randn(rows + 1, D, generator=generator)
    # One row in ten touches each object, in runs: about every third window does.
    touched = torch.rand(rows // 20, 10, generator=generator) < 0.1
    done = torch.arange(1, rows + 1).remainder(STEPS).eq(0).unsqueeze(-1)
    data = TensorDict(
        {
            "observation": state[:-1],
            "action": torch.rand(rows, A, generator=generator) * 2 - 1,
            "episode": torch.arange(TRAJECTORIES).repeat_interleave(STEPS),
            "next": {"observation": state[1:], "done": done},
            "caiac": {"score": touched.float().repeat_interleave(20, dim=0)},
        },
        batch_size=[rows],
    )
    goals = WindowGoal(layout, window)
    rb = ReplayBuffer(
        storage=LazyTensorStorage(rows),
        sampler=SliceSampler(slice_len=window, traj_key="episode", cache_values=True),
        sample_unit=goals,
        batch_size=windows * window,
    )
    rb.extend(data)
    rb.append_transform(goals)
    if swap:
        rb.append_transform(CAIACTransform(layout, threshold=0.3, window=window))
    return rb


def make_step(window: int) -> Callable[[TensorDict], None]:
    """One gradient step of the LMP on a batch of flat windows."""
    torch.manual_seed(0)
    model = LMPModel(D, G, A, window)
    loss = LMPLoss(model, kl_weight=0.1)
    optimizer = torch.optim.Adam(model.parameters(), lr=2e-3, fused=True)

    def step(batch: TensorDict) -> None:
        losses = loss(batch.reshape(-1, window))
        optimizer.zero_grad()
        (losses["loss_reconstruction"] + losses["loss_kl"]).backward()
        optimizer.step()

    return step


@SIZES
def test_gradient_step(benchmark, windows, window):
    """The step alone, on a batch that is there."""
    batch = make_buffer(windows, window, swap=True).sample()
    benchmark.pedantic(make_step(window), args=(batch,), rounds=20, warmup_rounds=3)


@SIZES
@pytest.mark.parametrize("swap", [False, True], ids=["plain", "swap"])
def test_sample(benchmark, windows, window, swap):
    """``rb.sample()`` with window goals, without and with counterfactuals."""
    rb = make_buffer(windows, window, swap=swap)
    benchmark.pedantic(rb.sample, rounds=40, warmup_rounds=3)


@SIZES
def test_gradient_step_with_sampling(benchmark, windows, window):
    """Sampling, swapping and the step, with the share of the first two."""
    rb, step = make_buffer(windows, window, swap=True), make_step(window)
    spent = []

    def run() -> None:
        start = time.perf_counter()
        batch = rb.sample()
        middle = time.perf_counter()
        step(batch)
        spent.append((middle - start, time.perf_counter() - middle))

    benchmark.pedantic(run, rounds=20, warmup_rounds=3)
    sampling = sum(s for s, _ in spent[3:])
    whole = sampling + sum(s for _, s in spent[3:])
    benchmark.extra_info["share_of_sampling_and_swapping"] = round(sampling / whole, 3)
    benchmark.extra_info["ms_sampling"] = round(1e3 * sampling / len(spent[3:]), 2)
