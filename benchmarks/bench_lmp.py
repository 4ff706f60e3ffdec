"""Milliseconds of an LMP gradient step, and the share of sampling and swapping.

Run with ``pytest benchmarks/bench_lmp.py`` (``make bench``). The data have the
kitchen's shapes: 100 demonstrations of 60 steps, 30 state columns, 10 entities of which
the robot is never swapped, 21 goal columns. ``extra_info`` of the last benchmark
contains the share of ``rb.sample()`` in the step. With ``--device=cuda`` the storage is
on the device, too.

The step is compared with a bare one: the same modules called on plain tensors, the
squared error and the KL divergence written out, no tensordict, no checks. Both end with
the backward pass; the optimizer, the same on both sides, is left out.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer, SliceSampler

from benchmarks.ratios import seconds
from torchrl_caiac.data.offline_buffer import offline_storage
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


def make_buffer(
    windows: int, window: int, device: torch.device, *, swap: bool
) -> ReplayBuffer:
    """Scored demonstrations on a device, sampled in windows with goals."""
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
        storage=offline_storage(data.to(device)),
        sampler=slices(window),
        sample_unit=goals,
        batch_size=windows * window,
    )
    rb.append_transform(goals)
    if swap:
        rb.append_transform(CAIACTransform(layout, threshold=0.3, window=window))
    return rb


def slices(window: int) -> SliceSampler:
    """The sampler of the examples, which writes no end flags into windows."""
    return SliceSampler(
        slice_len=window, traj_key="episode", cache_values=True, truncated_key=None
    )


def make_loss(window: int, device: torch.device) -> LMPLoss:
    """A new model and its loss."""
    torch.manual_seed(0)
    return LMPLoss(LMPModel(D, G, A, window), kl_weight=0.1).to(device)


def make_step(window: int, device: torch.device) -> Callable[[TensorDict], None]:
    """One gradient step of the LMP on a batch of flat windows."""
    loss = make_loss(window, device)
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-3, fused=True)

    def step(batch: TensorDict) -> None:
        losses = loss(batch.reshape(-1, window))
        optimizer.zero_grad()
        (losses["loss_reconstruction"] + losses["loss_kl"]).backward()
        optimizer.step()
        wait(device)

    return step


def wait(device: torch.device) -> None:
    """Waits until the device has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def bare_pass(
    model: LMPModel, observation: torch.Tensor, action: torch.Tensor, goal: torch.Tensor
) -> None:
    """Forward and backward pass of the modules on tensors ``[*B, κ, *]``."""
    loc_q, log_std_q = model.posterior.module(observation, action)
    loc_p, log_std_p = model.prior.module(observation[:, 0], goal[:, 0])
    plan = loc_q + log_std_q.exp() * torch.randn_like(loc_q)
    error = (model.decoder.module(plan) - action).square().sum(-1).mean()
    variance = (2 * log_std_q).exp() + (loc_q - loc_p).square()
    ratio = variance / (2 * log_std_p).exp()
    kl = (log_std_p - log_std_q + 0.5 * (ratio - 1)).sum(-1).mean()
    (2 * error + 0.1 * kl).backward()


@SIZES
def test_gradient_step(benchmark, device, windows, window):
    """The step alone, on an existing batch."""
    batch = make_buffer(windows, window, device, swap=True).sample()
    step = make_step(window, device)
    benchmark.pedantic(step, args=(batch,), rounds=20, warmup_rounds=3)


@SIZES
def test_loss_beside_the_bare_modules(benchmark, judge, device, windows, window):
    """Forward and backward pass, and the same without the loss around it."""
    batch = make_buffer(windows, window, device, swap=True).sample()
    loss, plain = make_loss(window, device), make_loss(window, device).model
    leaves = [
        batch[key].reshape(windows, window, -1)
        for key in ("observation", "action", "desired_goal")
    ]

    def whole() -> None:
        losses = loss(batch.reshape(-1, window))
        (losses["loss_reconstruction"] + losses["loss_kl"]).backward()
        loss.zero_grad()

    def bare() -> None:
        bare_pass(plain, *leaves)
        plain.zero_grad()

    times = seconds({"loss": whole, "bare": bare}, rounds=20)
    name = f"LMP, {windows} windows of {window}, loss / bare modules"
    judge(name, times["loss"] / times["bare"], at_most=1.3)
    benchmark.pedantic(whole, rounds=5)


@SIZES
@pytest.mark.parametrize("swap", [False, True], ids=["plain", "swap"])
def test_sample(benchmark, device, windows, window, swap):
    """``rb.sample()`` with window goals, without and with counterfactuals."""
    rb = make_buffer(windows, window, device, swap=swap)

    def sample() -> None:
        rb.sample()
        wait(device)

    benchmark.pedantic(sample, rounds=40, warmup_rounds=3)


@SIZES
def test_gradient_step_with_sampling(benchmark, device, windows, window):
    """Sampling, swapping and the step, with the share of the first two."""
    rb = make_buffer(windows, window, device, swap=True)
    step = make_step(window, device)
    spent = []

    def run() -> None:
        start = time.perf_counter()
        batch = rb.sample()
        wait(device)
        middle = time.perf_counter()
        step(batch)
        spent.append((middle - start, time.perf_counter() - middle))

    benchmark.pedantic(run, rounds=20, warmup_rounds=3)
    sampling = sum(s for s, _ in spent[3:])
    whole = sampling + sum(s for _, s in spent[3:])
    benchmark.extra_info["share_of_sampling_and_swapping"] = round(sampling / whole, 3)
    benchmark.extra_info["ms_sampling"] = round(1e3 * sampling / len(spent[3:]), 2)
