"""What CAIACTransform adds to ``rb.sample()``: time, growth with the storage, memory.

Run with ``pytest benchmarks/bench_sampling.py`` (``make bench``). Two shapes: 512
transitions of Fetch-Push (34 columns, 3 entities) and 500 windows of 20 rows of the
kitchen (30 columns, 10 entities), from storages of 10 k, 1 M and 10 M rows in memory
and memory-mapped. ``-k 10k`` or ``-k "not 10M and not growth"`` keeps it short: the
largest storage takes 4 GB of disk or memory. The example samples four batches of
transitions at once, which is timed too. With ``--device=cuda`` there are storages
on the GPU too; samples of the others are moved there before all transforms.

Ratios are to the same sample without the transform, all timed in turns, from TorchRL's
``TensorStorage``. The storage of ``offline_buffer`` is compared with it. One ratio has
another divisor: 4,900 windows per second, the rate of the authors' sampler, measured on
another machine of ours.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import ReplayBuffer, SliceSampler, TensorStorage

from benchmarks.ratios import seconds
from torchrl_caiac import EntityLayout
from torchrl_caiac._fingerprints import fingerprint, fingerprint_key, state_hash
from torchrl_caiac._torchrl import storage_data
from torchrl_caiac.data.offline_buffer import offline_storage
from torchrl_caiac.transforms import CAIACTransform, HindsightGoal, WindowGoal

EPISODE = 100
CHUNK = 10_000
AUTHORS_WINDOWS_PER_S = 4_900

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
# Layout, columns, action, whether there are goals in the storage, rows per window.
TRANSITIONS = (FETCH, 34, 4, True, 1)
WINDOWS = (KITCHEN, 30, 9, False, 20)


@dataclass
class Setting:
    """A storage, and what is sampled from it."""

    layout: EntityLayout
    storage: TensorStorage
    window: int
    windows: int
    device: torch.device
    sampler: dict[str, Any] = field(default_factory=dict)

    def buffer(self, *transforms: Any, unit: Any = None) -> ReplayBuffer:
        """Returns a buffer over the storage; its samples are on the device."""
        sampler = None
        on_device = torch.device(self.storage.device).type == self.device.type
        if self.window > 1:
            on_gpu = on_device and self.device.type != "cpu"
            sampler = SliceSampler(
                slice_len=self.window,
                traj_key="episode",
                cache_values=True,
                use_gpu=self.device if on_gpu else False,
                **self.sampler,
            )
        rb = ReplayBuffer(
            storage=self.storage,
            sampler=sampler,
            sample_unit=unit,
            batch_size=self.windows * self.window,
        )
        if not on_device:
            rb.append_transform(lambda td: td.to(self.device))
        for transform in transforms:
            rb.append_transform(transform)
        return rb

    def offline(self) -> Setting:
        """The same rows in the storage of ``offline_buffer``."""
        return replace(self, storage=offline_storage(storage_data(self.storage)))

    def calls(self, goals: bool = True) -> dict[str, Callable[[], Any]]:
        """Samples without the transform, with it, and with goals or other donors."""
        plain, swap = self.buffer(), self.buffer(self.caiac())
        donors = self.buffer(self.caiac(donors=self.storage))
        # The same scores without fingerprints.
        trusted = self.buffer(self.caiac(score_key="trusted"))
        calls = {
            "plain": plain.sample,
            "swap": swap.sample,
            "donors": donors.sample,
            "trusted": trusted.sample,
        }
        if goals:
            calls["goals"] = self.with_goals().sample
        if goals and self.window == 1:
            calls["lookahead"] = self.buffer(self.caiac(lookahead="next")).sample
        return calls

    def offline_calls(self) -> dict[str, Callable[[], Any]]:
        """Plain samples, and those with goals and swap, of :meth:`offline`."""
        setting = self.offline()
        return {
            "offline": setting.buffer().sample,
            "offline goals": setting.with_goals().sample,
        }

    def caiac(self, **kwargs: Any) -> CAIACTransform:
        """The transform for this layout and window."""
        return CAIACTransform(self.layout, window=self.window, **kwargs)

    def with_goals(self) -> ReplayBuffer:
        """A buffer that swaps, and draws goals as the shape's learner needs them."""
        if self.window == 1:
            relabel = HindsightGoal(self.layout, sparse_reward)
            return self.buffer(self.caiac(), relabel, unit=relabel)
        draw = WindowGoal(self.layout, self.window)
        return self.buffer(draw, self.caiac(), unit=draw)


def sparse_reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    """-1 where a cube is more than 5 cm from its goal."""
    far = (achieved - desired).unflatten(-1, (2, 3)).norm(dim=-1) > 0.05
    return -far.any(-1).float()


# --- storages ------------------------------------------------------------------------


def chunk(layout: EntityLayout, width: int, action: int, goals: bool) -> TensorDict:
    """Returns one chunk of data, which is repeated to fill a storage."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(CHUNK, *shape, generator=generator)

    flag = torch.zeros(CHUNK, 1, dtype=torch.bool)
    flag[EPISODE - 1 :: EPISODE] = True
    # Influence comes in stretches: a tenth of the episodes for each entity.
    score = random(len(layout))[::EPISODE].repeat_interleave(EPISODE, 0) * 0.05
    score[score > 0.045] = 1.0
    states = torch.rand(CHUNK + 1, width, generator=generator)
    td = {
        "observation": states[:-1],
        "action": random(action),
        "episode": torch.zeros(CHUNK, dtype=torch.int64),
        "next": {
            "observation": states[1:],
            "reward": random(1),
            "done": flag,
            "terminated": torch.zeros_like(flag),
            "truncated": flag.clone(),
        },
        ("caiac", "score"): score,
        "trusted": score,
    }
    if goals:
        width = layout.goal_width
        td |= {"achieved_goal": random(width), "desired_goal": random(width)}
        td["next"]["achieved_goal"] = random(width)  # type: ignore[index]
    rows = TensorDict(td, [CHUNK])
    state = state_hash(rows, layout.in_keys)
    after = state_hash(rows, [layout.next(key) for key in layout.in_keys])
    assert state is not None
    rows[fingerprint_key(("caiac", "score"))] = fingerprint(
        state, after, layout.names, 0
    )
    return rows


def filled(part: TensorDict, rows: int, where: Path | torch.device) -> TensorStorage:
    """A storage in a folder or on a device."""
    empty = part[:1].expand(rows)
    if isinstance(where, Path):
        data, device = empty.memmap_like(where), torch.device("cpu")
    else:
        data, device = (
            empty.apply(lambda leaf: leaf.new_empty(leaf.shape, device=where)),
            where,
        )
    for begin in range(0, rows, CHUNK):
        view = data[begin : begin + CHUNK]
        view.update_(part)
        view["episode"].copy_(torch.arange(begin, begin + CHUNK) // EPISODE)
    return TensorStorage(data, device=device)


@pytest.fixture(autouse=True, scope="module")
def settled_memory() -> None:
    """Frees one large block, as any training step does.

    Up to the size of the largest block that was freed, malloc keeps memory for later.
    Before that, it depends on chance whether a sample of a few MB needs new pages.
    """
    torch.empty(31 << 20, dtype=torch.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Yields a folder that is deleted after the benchmark: it has gigabytes."""
    yield tmp_path
    shutil.rmtree(tmp_path, ignore_errors=True)


def made(
    shape: tuple[Any, ...],
    windows: int,
    rows: str,
    kind: str,
    folder: Path,
    device: torch.device,
) -> Setting:
    """A setting whose storage is of the kind ``memory``, ``memmap`` or ``cuda``."""
    layout, width, action, goals, window = shape
    where = {"memory": torch.device("cpu"), "memmap": folder / rows, "cuda": device}
    storage = filled(chunk(layout, width, action, goals), ROWS[rows], where[kind])
    return Setting(layout, storage, window, windows, device)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Storages on the GPU are measured if samples are needed there."""
    if "kind" in metafunc.fixturenames:
        on_gpu = metafunc.config.getoption("--device") == "cuda"
        metafunc.parametrize("kind", ["memory", "memmap", *["cuda"] * on_gpu])


# --- time ----------------------------------------------------------------------------


@pytest.mark.parametrize("rows", ROWS)
def bench_transitions(
    benchmark: Any, judge: Any, rows: str, kind: str, folder: Path, device: torch.device
) -> None:
    """512 transitions, 3 entities; and four such batches in one sample."""
    setting = made(TRANSITIONS, 512, rows, kind, folder, device)
    on_gpu = device.type == "cuda"
    sizes = [("512", 512, 600), ("4 x 512", 4 * 512, 150)]
    for what, size, rounds in [*sizes, *[("4,096", 4096, 150)] * on_gpu]:
        some = replace(setting, windows=size)
        times = seconds(some.calls() | some.offline_calls(), rounds=rounds, warmup=20)
        judge_offline(judge, f"{what} transitions", times, f"{rows} {kind}")
        for name, target in (
            ("swap", 1.5),
            ("lookahead", 2.0),
            ("goals", 1.6 if on_gpu else 2.0),
            ("donors", 1.6),
        ):
            label = f"{what} transitions, {LABELS[name]} / plain, {rows} {kind}"
            judge(label, times[name] / times["plain"], at_most=target)
        for name, target in (("swap", 0.15), ("goals", 0.3)):
            if what == "512" and rows == "10k":
                label = f"{what} transitions, {LABELS[name]} - plain, ms, {rows} {kind}"
                added = 1e3 * (times[name] - times["plain"])
                judge(label, added, at_most=target)
        label = f"{what} transitions, fingerprints compared / not, {rows} {kind}"
        judge(label, times["swap"] / times["trusted"], at_most=1.05)
    benchmark.pedantic(setting.buffer(setting.caiac()).sample, rounds=50)


@pytest.mark.parametrize("rows", ROWS)
def bench_windows(
    benchmark: Any, judge: Any, rows: str, kind: str, folder: Path, device: torch.device
) -> None:
    """500 windows of 20 and of 10, 10 entities."""
    setting = made(WINDOWS, 500, rows, kind, folder, device)
    calls = setting.calls()
    # LMP reads no end flags.
    short = replace(setting, window=10, sampler={"truncated_key": None})
    calls["short"] = short.with_goals().sample
    times = seconds(calls | setting.offline_calls(), rounds=60)
    judge_offline(judge, "500 windows of 20", times, f"{rows} {kind}")
    # Donors of a buffer have the target of transitions: their rows are read too.
    for name, target in (("swap", 1.2), ("goals", 1.2), ("donors", 1.6)):
        label = f"500 windows of 20, {LABELS[name]} / plain, {rows} {kind}"
        judge(label, times[name] / times["plain"], at_most=target)
    label = f"500 windows of 20, fingerprints compared / not, {rows} {kind}"
    judge(label, times["swap"] / times["trusted"], at_most=1.05)
    rate = 500 / times["short"] / AUTHORS_WINDOWS_PER_S
    label = f"windows of 10 a second, goals and swap / quoted 4,900, {rows} {kind}"
    judge(label, rate, at_least=20)
    benchmark.pedantic(calls["swap"], rounds=20)


def judge_offline(judge: Any, what: str, times: dict[str, float], where: str) -> None:
    """Judges the storage of ``offline_buffer`` by plain samples of a TensorStorage."""
    for name, label, target in (
        ("offline", "plain, offline_buffer", 0.7),
        ("offline goals", "goals and swap, offline_buffer", 1.6),
    ):
        ratio = times[name] / times["plain"]
        judge(f"{what}, {label} / plain, {where}", ratio, at_most=target)


class Operations(TorchDispatchMode):
    """Counts operations of torch, and those that the host reads a result of."""

    READS = ("aten._local_scalar_dense", "aten.equal", "aten.nonzero")

    def __init__(self) -> None:
        super().__init__()
        self.count = self.reads = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        self.count += 1
        self.reads += str(func).startswith(self.READS)
        return func(*args, **(kwargs or {}))


def small_calls(shape: str, folder: Path, device: torch.device) -> dict[str, Any]:
    """Returns what samples 512 transitions or 500 windows of 10,000 rows in memory."""
    kind = "memory" if device.type == "cpu" else "cuda"
    if shape == "transitions":
        return made(TRANSITIONS, 512, "10k", kind, folder, device).calls()
    return made(WINDOWS, 500, "10k", kind, folder, device).calls()


@pytest.mark.parametrize("shape", ["transitions", "windows"])
def bench_operations(
    benchmark: Any, judge: Any, shape: str, folder: Path, device: torch.device
) -> None:
    """Operations, views included, and results read: the same on every processor."""
    calls = small_calls(shape, folder, device)
    found = {}
    for name in ("plain", *LABELS):
        if name in calls:
            for _ in range(FIRST_BATCHES):
                calls[name]()
            with Operations() as found[name]:
                calls[name]()
    plain = found.pop("plain")
    for name, other in found.items():
        label = f"{shape}, {LABELS[name]}: operations more than plain"
        judge(label, other.count - plain.count, at_most=MOST_OPERATIONS[name])
        label = f"{shape}, {LABELS[name]}: results read more than plain"
        judge(
            label, other.reads - plain.reads, at_most=7 if device.type == "cpu" else 0
        )
    benchmark.pedantic(calls["swap"], rounds=20)


# Batches in which the share of free entities and stored end flags are looked at.
FIRST_BATCHES = 21
MOST_OPERATIONS = {"swap": 20, "lookahead": 30, "goals": 50, "donors": 20}

LABELS = {
    "swap": "swap",
    "lookahead": "swap with lookahead",
    "goals": "goals and swap",
    "donors": "donor buffer",
}


@pytest.mark.parametrize("rows", ROWS)
def bench_lookahead_table(
    benchmark: Any, judge: Any, rows: str, kind: str, folder: Path, device: torch.device
) -> None:
    """What the first sample after a write adds: the table of lookahead."""
    setting = made(TRANSITIONS, 512, rows, kind, folder, device)
    transform = setting.caiac(lookahead="next")
    rb = setting.buffer(transform)

    def build() -> None:
        transform.refresh_donors()
        rb.sample()

    took = seconds({"build": build, "plain": rb.sample}, rounds=5)
    nanoseconds = (took["build"] - took["plain"]) / ROWS[rows] * 1e9
    label = f"lookahead, building the table, ns a row, {rows} {kind}"
    judge(label, nanoseconds, at_most=500)
    benchmark.pedantic(build, rounds=5)


# --- growth and memory ---------------------------------------------------------------


@pytest.mark.parametrize("shape", ["transitions", "windows"])
def bench_growth(
    benchmark: Any, judge: Any, shape: str, folder: Path, device: torch.device
) -> None:
    """From 10 k to 10 M rows, read in three ways.

    A plain sample grows too, by the rows that are no longer in a cache. The time that
    the transform adds to a sample includes the eviction of such rows by its tensors, so
    it is timed alone as well, on batches just drawn.
    """
    settings = {
        rows: made(
            TRANSITIONS if shape == "transitions" else WINDOWS,
            512 if shape == "transitions" else 500,
            rows,
            "memmap",
            folder,
            device,
        )
        for rows in ("10k", "10M")
    }
    calls: dict[Any, Callable[[], Any]] = {}
    for rows, setting in settings.items():
        calls |= {(rows, k): call for k, call in setting.calls(goals=False).items()}
    rounds = 400 if shape == "transitions" else 40
    times = seconds(calls, rounds=rounds, warmup=5)
    for name, donors in (("swap", False), ("donors", True)):
        alone: dict[Any, Callable[[], Any]] = {}
        for rows, setting in settings.items():
            transform = setting.caiac(donors=setting.storage if donors else None)
            alone |= on_fresh_batches(rows, setting.buffer(), transform)
        once = seconds(alone, rounds=rounds, warmup=5)
        for what, small, large in (
            ("transform alone", once["10k"], once["10M"]),
            (
                "added time",
                times["10k", name] - times["10k", "plain"],
                times["10M", name] - times["10M", "plain"],
            ),
            (
                "ratio to plain",
                times["10k", name] / times["10k", "plain"],
                times["10M", name] / times["10M", "plain"],
            ),
        ):
            label = f"{shape}, {LABELS[name]}: {what}, 10M / 10k memmap"
            judge(label, large / small, at_most=1.2)
    benchmark.pedantic(calls["10M", "swap"], rounds=20)


def on_fresh_batches(
    rows: str, plain: ReplayBuffer, transform: CAIACTransform
) -> dict[Any, Callable[[], Any]]:
    """Draws a batch in one call, and transforms it in the next one, called ``rows``."""
    batch = [plain.sample()]

    def draw() -> None:
        batch[0] = plain.sample()

    return {(rows, "draw"): draw, rows: lambda: transform(batch[0])}


@pytest.mark.parametrize("shape", ["transitions", "windows"])
def bench_memory(
    benchmark: Any, judge: Any, shape: str, folder: Path, device: torch.device
) -> None:
    """The peak memory of a sample, including the batch."""
    calls = small_calls(shape, folder, device)
    for name, label in LABELS.items():
        if name not in calls:
            continue
        batch = calls[name]().bytes()
        judge(
            f"{shape}, {label}: peak memory / batch",
            peak(calls[name]) / batch,
            at_most=3,
        )
    benchmark.pedantic(calls["swap"], rounds=20)


def peak(call: Callable[[], Any]) -> int:
    """Returns the peak size in bytes of the live tensors of a call."""
    if torch.cuda.is_initialized():
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        call()
        return torch.cuda.max_memory_allocated() - before
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiled:
        call()
    events = profiled.profiler.kineto_results.events()
    alive = most = 0
    for event in sorted(events, key=lambda event: event.start_ns()):
        if event.name() == "[memory]":
            alive += event.nbytes()
            most = max(most, alive)
    return most
