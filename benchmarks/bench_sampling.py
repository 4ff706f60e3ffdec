"""Milliseconds of ``rb.sample()`` with and without CAIACTransform.

Run with ``pytest benchmarks/bench_sampling.py`` (``make bench``). Two shapes: 512
transitions of Fetch-Push (34 columns, 3 entities) and 500 windows of 20 rows of the
kitchen (30 columns, 10 entities), from storages of 10 k, 1 M and 10 M rows in memory
and memory-mapped. ``-k 10k`` or ``-k "not 10M"`` keeps it short: the largest storage
takes 4 GB of disk or memory. With ``--device=cuda`` samples are moved there before
all transforms; storages stay on the host.

``extra_info["ratio"]`` is the time against the same buffer without the transform, the
median over rounds in which both were timed in turn.
"""

from __future__ import annotations

import shutil
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer, SliceSampler, TensorStorage

from torchrl_caiac import EntityLayout
from torchrl_caiac.transforms import CAIACTransform, HindsightGoal, WindowGoal

EPISODE = 100
CHUNK = 10_000

FETCH = EntityLayout(
    {"gripper": range(10), "cube0": range(10, 22), "cube1": range(22, 34)},
    goal={"cube0": range(3), "cube1": range(3, 6)},
    achieved={"cube0": range(10, 13), "cube1": range(22, 25)},
    fixed=("gripper",),
)
OBJECTS = [(9, 11), (11, 13), (13, 15), (15, 17), (17, 19), (19, 20), (20, 22)]
OBJECTS += [(22, 23), (23, 30)]
KITCHEN = EntityLayout(
    {"robot": range(9), **{f"object{i}": range(*c) for i, c in enumerate(OBJECTS)}},
    goal={f"object{i}": range(a - 9, b - 9) for i, (a, b) in enumerate(OBJECTS)},
    achieved={f"object{i}": range(*c) for i, c in enumerate(OBJECTS)},
    fixed=("robot",),
)
ROWS = {"10k": 10_000, "1M": 1_000_000, "10M": 10_000_000}


@dataclass
class Setting:
    layout: EntityLayout
    storage: TensorStorage
    window: int
    windows: int
    device: torch.device

    def buffer(self, *transforms: Any, unit: Any = None) -> ReplayBuffer:
        sampler = None
        if self.window > 1:
            sampler = SliceSampler(
                slice_len=self.window, traj_key="episode", cache_values=True
            )
        rb = ReplayBuffer(
            storage=self.storage,
            sampler=sampler,
            sample_unit=unit,
            batch_size=self.windows * self.window,
        )
        if self.device.type != "cpu":
            rb.append_transform(lambda td: td.to(self.device))
        for transform in transforms:
            rb.append_transform(transform)
        return rb

    def sampling(self, rb: ReplayBuffer) -> Callable[[], None]:
        """Takes a sample, and waits until it is there."""

        def sample() -> None:
            rb.sample()
            if self.device.type == "cuda":
                torch.cuda.synchronize()

        return sample

    def caiac(self, **kwargs: Any) -> CAIACTransform:
        return CAIACTransform(self.layout, window=self.window, **kwargs)


def chunk(layout: EntityLayout, width: int, action: int, goals: bool) -> TensorDict:
    """One chunk of data, that fills a storage by being repeated."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(CHUNK, *shape, generator=generator)

    flag = torch.zeros(CHUNK, 1, dtype=torch.bool)
    flag[EPISODE - 1 :: EPISODE] = True
    # Influence comes in stretches: a tenth of the episodes for each entity.
    score = random(len(layout))[::EPISODE].repeat_interleave(EPISODE, 0) * 0.05
    score[score > 0.045] = 1.0
    td = {
        "observation": random(width),
        "action": random(action),
        "episode": torch.zeros(CHUNK, dtype=torch.int64),
        "next": {
            "observation": random(width),
            "reward": random(1),
            "done": flag,
            "terminated": torch.zeros_like(flag),
            "truncated": flag.clone(),
        },
        ("caiac", "score"): score,
    }
    if goals:
        width = layout.goal_width
        td |= {"achieved_goal": random(width), "desired_goal": random(width)}
        td["next"]["achieved_goal"] = random(width)  # type: ignore[index]
    return TensorDict(td, [CHUNK])


def filled(part: TensorDict, rows: int, path: Any) -> TensorStorage:
    empty = part[:1].expand(rows)
    if path is None:
        data = empty.apply(lambda leaf: torch.empty(leaf.shape, dtype=leaf.dtype))
    else:
        data = empty.memmap_like(path)
    for begin in range(0, rows, CHUNK):
        view = data[begin : begin + CHUNK]
        view.update_(part)
        view["episode"].copy_(torch.arange(begin, begin + CHUNK) // EPISODE)
    return TensorStorage(data)


@pytest.fixture(
    scope="module",
    params=[(rows, kind) for rows in ROWS for kind in ("memory", "memmap")],
    ids=lambda param: "-".join(param),
)
def transitions(
    request: pytest.FixtureRequest, tmp_path_factory: Any, device: torch.device
) -> Any:
    return made(request, tmp_path_factory, device, FETCH, 34, 4, True, 1, 512)


@pytest.fixture(
    scope="module",
    params=[(rows, kind) for rows in ROWS for kind in ("memory", "memmap")],
    ids=lambda param: "-".join(param),
)
def windows(
    request: pytest.FixtureRequest, tmp_path_factory: Any, device: torch.device
) -> Any:
    return made(request, tmp_path_factory, device, KITCHEN, 30, 9, False, 20, 500)


def made(
    request: pytest.FixtureRequest,
    tmp_path_factory: Any,
    device: torch.device,
    layout: EntityLayout,
    width: int,
    action: int,
    goals: bool,
    window: int,
    number: int,
) -> Setting:
    rows, kind = request.param
    path = tmp_path_factory.mktemp("storage") if kind == "memmap" else None
    if path is not None:  # gigabytes: not to be kept until pytest cleans up
        request.addfinalizer(lambda: shutil.rmtree(path, ignore_errors=True))
    storage = filled(chunk(layout, width, action, goals), ROWS[rows], path)
    return Setting(layout, storage, window, number, device)


def ratio(plain: Callable[[], Any], other: Callable[[], Any], rounds: int) -> float:
    found = []
    for _ in range(rounds):
        times = []
        for call in (plain, other):
            begin = time.perf_counter()
            call()
            times.append(time.perf_counter() - begin)
        found.append(times[1] / times[0])
    return statistics.median(found)


def measure(benchmark: Any, setting: Setting, rb: ReplayBuffer, target: float) -> None:
    plain, sample = setting.sampling(setting.buffer()), setting.sampling(rb)
    rounds = 200 if setting.window == 1 else 50
    ratio(plain, sample, 10)  # warm: indices and page tables
    benchmark.extra_info["rows"] = len(setting.storage)
    benchmark.extra_info["target"] = target
    benchmark.extra_info["ratio"] = round(ratio(plain, sample, rounds), 3)
    benchmark.pedantic(sample, rounds=rounds)


def sparse_reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    far = (achieved - desired).unflatten(-1, (2, 3)).norm(dim=-1) > 0.05
    return -far.any(-1).float()


def bench_transitions_plain(benchmark: Any, transitions: Setting) -> None:
    measure(benchmark, transitions, transitions.buffer(), 1.0)


def bench_transitions_batch_donors(benchmark: Any, transitions: Setting) -> None:
    rb = transitions.buffer(transitions.caiac())
    measure(benchmark, transitions, rb, 1.6)


def bench_transitions_rewards(benchmark: Any, transitions: Setting) -> None:
    rb = transitions.buffer(transitions.caiac(reward_fn=sparse_reward))
    measure(benchmark, transitions, rb, 2.2)


def bench_transitions_hindsight(benchmark: Any, transitions: Setting) -> None:
    goals = HindsightGoal(transitions.layout, sparse_reward)
    rb = transitions.buffer(transitions.caiac(), goals, unit=goals)
    measure(benchmark, transitions, rb, 2.2)


def bench_transitions_buffer_donors(benchmark: Any, transitions: Setting) -> None:
    rb = transitions.buffer(transitions.caiac(donors=transitions.storage))
    measure(benchmark, transitions, rb, 1.6)


def bench_windows_plain(benchmark: Any, windows: Setting) -> None:
    measure(benchmark, windows, windows.buffer(), 1.0)


def bench_windows_batch_donors(benchmark: Any, windows: Setting) -> None:
    rb = windows.buffer(windows.caiac())
    measure(benchmark, windows, rb, 1.25)


def bench_windows_goals(benchmark: Any, windows: Setting) -> None:
    goals = WindowGoal(windows.layout, windows.window)
    rb = windows.buffer(goals, windows.caiac(), unit=goals)
    measure(benchmark, windows, rb, 1.25)


def bench_windows_buffer_donors(benchmark: Any, windows: Setting) -> None:
    rb = windows.buffer(windows.caiac(donors=windows.storage))
    measure(benchmark, windows, rb, 1.25)
