"""Scores, indexes and samples more rows than the memory of a process holds.

Run with ``python benchmarks/larger_than_memory.py`` (``--rows 1_000_000`` for a quick
look). It writes 20 M transitions of 294 bytes, 5.5 GiB, to ``--folder``, measures each
step in a fresh process that may have 1 GiB of anonymous memory (``RLIMIT_DATA``; the
pages of memory-mapped files are not part of it, as the system takes them back at any
time), writes ``docs/results/scaling_memory.txt`` and deletes the data.

For each step: seconds; the peak of ``RssAnon`` while it runs, above what the process
had before it, with torch imported and the data open; and that in bytes for each row.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer, SliceSampler, TensorStorage

from torchrl_caiac import (
    CAIACTransform,
    CoDATransform,
    EntityLayout,
    check_dataset,
)
from torchrl_caiac._kernels import machine
from torchrl_caiac.data import TransitionWriter, load_transitions, open_dataset
from torchrl_caiac.data.select_successful import select_successful
from torchrl_caiac.influence import (
    CAI,
    AttentionInfluence,
    MotionInfluence,
    score_buffer,
    suggest_thresholds,
)
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel
from torchrl_caiac.trajectories import trajectory_index
from torchrl_caiac.transforms import HindsightGoal, WindowGoal

RESULT = Path(__file__).parents[1] / "docs" / "results" / "scaling_memory.txt"
EPISODE = 100
EPISODES_AT_ONCE = 100
MOVES = 1e-3
LAYOUT = EntityLayout(
    {"gripper": range(8), "cube0": range(8, 16), "cube1": range(16, 24)},
    goal={"cube0": range(3), "cube1": range(3, 6)},
    achieved={"cube0": range(8, 11), "cube1": range(16, 19)},
    positions={"gripper": range(3), "cube0": range(8, 11), "cube1": range(16, 19)},
    fixed=("gripper",),
)
Call = Callable[[], Any]


# --- data ----------------------------------------------------------------------------


def write(folder: Path, rows: int) -> None:
    """Writes random walks, in which a tenth of the time the gripper moves a cube."""
    generator = torch.Generator().manual_seed(0)
    count = EPISODES_AT_ONCE
    with TransitionWriter(folder, rows=rows) as writer:
        while writer.rows < rows:
            shape = count, EPISODE
            moves = torch.randn(*shape, 24, generator=generator) * 0.01
            for first in (8, 16):
                rests = torch.rand(*shape, 1, generator=generator) > 0.1
                moves[..., first : first + 8] *= ~rests
            states = torch.cat([torch.zeros(count, 1, 24), moves.cumsum(1)], 1)
            states += torch.rand(count, 1, 24, generator=generator)
            goals = states[..., [8, 9, 10, 16, 17, 18]]
            desired = torch.rand(count, 1, 6, generator=generator)
            desired = desired.expand(-1, EPISODE, -1)
            actions = torch.rand(*shape, 4, generator=generator) * 2 - 1
            end = torch.zeros(*shape, 1, dtype=torch.bool)
            end[:, -1] = True
            success = torch.rand(*shape, 1, generator=generator) > 0.9995
            block = TensorDict(
                {
                    "observation": states[:, :-1],
                    "action": actions,
                    "achieved_goal": goals[:, :-1],
                    "desired_goal": desired,
                    "next": {
                        "observation": states[:, 1:],
                        "achieved_goal": goals[:, 1:],
                        "reward": success.float() - 1,
                        "terminated": torch.zeros_like(end),
                        "truncated": end,
                        "done": end,
                    },
                },
                shape,
            )
            for episode in block[: (rows - writer.rows) // EPISODE].unbind(0):
                writer.add(episode)


def sparse_reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    """-1 where a cube is more than 5 cm from its goal."""
    far = (achieved - desired).unflatten(-1, (2, 3)).norm(dim=-1) > 0.05
    return -far.any(-1).float()


# --- steps ---------------------------------------------------------------------------


def buffer(data: TensorDictBase, *transforms: Any, **kwargs: Any) -> ReplayBuffer:
    """A buffer of 500 transitions over the data."""
    rb = ReplayBuffer(storage=TensorStorage(data), **{"batch_size": 500, **kwargs})
    for transform in transforms:
        rb.append_transform(transform)
    return rb


def sampling(kind: str, data: TensorDictBase) -> ReplayBuffer:
    """A buffer that samples in the way that a step is named after."""
    if kind == "hindsight":
        unit = HindsightGoal(LAYOUT, sparse_reward)
        return buffer(data, CAIACTransform(LAYOUT), unit, sample_unit=unit)
    if kind == "windows":
        goals = WindowGoal(LAYOUT, 20)
        sampler = SliceSampler(slice_len=20, traj_key="episode", cache_values=True)
        swap = CAIACTransform(LAYOUT, window=20)
        return buffer(data, goals, swap, sample_unit=goals, sampler=sampler)
    if kind == "donors":
        return buffer(data, CAIACTransform(LAYOUT, donors=TensorStorage(data)))
    if kind == "donor windows":
        swap = CAIACTransform(
            LAYOUT, window=20, donors=TensorStorage(data), goals=WindowGoal(LAYOUT, 20)
        )
        sampler = SliceSampler(slice_len=20, traj_key="episode", cache_values=True)
        return buffer(data, swap, sampler=sampler)
    if kind == "components":
        return buffer(data, CoDATransform(LAYOUT, donors=TensorStorage(data)))
    if kind == "lookahead":
        return buffer(data, CAIACTransform(LAYOUT, lookahead="next"))
    if kind == "plain windows":
        sampler = SliceSampler(slice_len=20, traj_key="episode", cache_values=True)
        return buffer(data, sampler=sampler)
    return buffer(data, *[CAIACTransform(LAYOUT)] * (kind == "in the batch"))


SAMPLES = (
    "plain",
    "in the batch",
    "donors",
    "components",
    "hindsight",
    "lookahead",
    "plain windows",
    "windows",
    "donor windows",
)


def score(data: TensorDictBase, kind: Literal["motion", "cai", "coda"]) -> None:
    """Scores all rows, by motion or by a small model; what it predicts is no matter."""
    estimator: Callable[[TensorDictBase], torch.Tensor]
    estimator, key = MotionInfluence(LAYOUT, MOVES), ("caiac", "score")
    if kind == "cai":
        model = GaussianWorldModel(LAYOUT, action_dim=4, hidden_sizes=(8,))
        model.fitted = True
        estimator, key = CAI(model, num_actions=2), ("cai", "score")
    elif kind == "coda":
        transformer = TransformerWorldModel(
            LAYOUT, action_dim=4, layers=1, heads=1, width=8
        )
        transformer.fitted = True
        estimator, key = AttentionInfluence(transformer), ("coda", "graph")
    score_buffer(buffer(data), estimator, key=key, progress=False)


def steps(folder: Path, work: Path) -> dict[str, Callable[[TensorDictBase], Call]]:
    """What is measured; each is given the data, and returns what to time."""
    found: dict[str, Callable[[TensorDictBase], Call]] = {
        "load_transitions": lambda data: lambda: load_transitions(folder),
        "open_dataset": lambda data: lambda: open_dataset(str(folder), work / "x"),
        "trajectory_index": lambda data: lambda: trajectory_index(data),
        "check_dataset": lambda data: lambda: check_dataset(data, LAYOUT),
        "score_buffer, motion": lambda data: lambda: score(data, "motion"),
        "score_buffer again": lambda data: lambda: score(data, "motion"),
        "score_buffer, CAI": lambda data: lambda: score(data, "cai"),
        "score_buffer, CoDA": lambda data: lambda: score(data, "coda"),
        "suggest_thresholds": lambda data: lambda: suggest_thresholds(data, LAYOUT),
        "select_successful": lambda data: (
            lambda: select_successful(
                data, ("next", "reward"), above=-0.5, path=work / "selected"
            )
        ),
    }
    for kind in SAMPLES:
        found[f"sample {kind}, first"] = lambda data, kind=kind: (
            sampling(kind, data).sample
        )
        found[f"sample {kind}, later"] = lambda data, kind=kind: warm(kind, data)
    return found


def warm(kind: str, data: TensorDictBase) -> Call:
    """Twenty samples after the first one."""
    rb = sampling(kind, data)
    rb.sample()
    return lambda: [rb.sample() for _ in range(20)]


# --- measuring -----------------------------------------------------------------------


def status(name: str) -> int:
    """Returns a size of this process from ``/proc``, in bytes."""
    text = Path("/proc/self/status").read_text()
    return int(text.split(f"{name}:")[1].split()[0]) << 10


def anonymous() -> int:
    """Returns the resident anonymous memory of this process."""
    return status("RssAnon")


class Peak(threading.Thread):
    """Records the peak of the anonymous memory while something runs."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.before = self.most = anonymous()
        self.ended = threading.Event()

    def run(self) -> None:
        """Looks every 2 ms."""
        while not self.ended.wait(0.002):
            self.most = max(self.most, anonymous())


def measure(name: str, folder: Path, work: Path, limit: int) -> None:
    """Measures one step in this process, and prints its line."""
    torch.set_num_threads(1)
    data = load_transitions(folder)
    if limit:
        # The limit is on what is reserved: imports reserve more than they use.
        most = (limit << 20) + status("VmData") - anonymous()
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    call = steps(folder, work)[name](data)
    peak = Peak()
    peak.start()
    begin = time.perf_counter()
    call()
    seconds = time.perf_counter() - begin
    peak.ended.set()
    peak.join()
    if name.endswith("later"):
        seconds /= 20
    used = max(peak.most, anonymous()) - peak.before
    print(
        f"{name:34s} {seconds:10.4f} {peak.most / 2**20:9.0f} {used / 2**20:9.0f} "
        f"{used / len(data):8.1f}",
        flush=True,
    )


def main() -> None:
    """Writes the data, and measures each step in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=20_000_000)
    parser.add_argument("--limit", type=int, default=1024, help="MiB; 0 for none")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--result", type=Path, default=RESULT)
    parser.add_argument("--only", default="", help="steps whose names contain this")
    parser.add_argument("--keep", type=Path, help="use or make these data, keep them")
    parser.add_argument("--step", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.step:
        measure(args.step, args.keep, args.folder, args.limit)
        return
    work = Path(tempfile.mkdtemp(dir=args.folder))
    folder = args.keep or work / "data"
    head = f"{'step':34s} {'seconds':>10s} {'peak MiB':>9s} {'added MiB':>9s} B/row"
    lines = [
        f"{args.rows:,} rows, {args.limit} MiB of anonymous memory (RLIMIT_DATA), one "
        f"thread, {os.cpu_count()} x {machine()['processor']}, "
        f"torch {torch.__version__}",
        head,
    ]
    print("\n".join(lines), flush=True)
    try:
        if not folder.exists():
            write(folder, args.rows)
        for name in steps(folder, work):
            if args.only not in name:
                continue
            command = [sys.executable, __file__, "--step", name, "--keep", str(folder)]
            command += ["--folder", str(work), "--limit", str(args.limit)]
            done = subprocess.run(command, capture_output=True, text=True)
            line = done.stdout.rstrip()
            if done.returncode:
                error = (done.stderr.strip().splitlines() or ["killed"])[-1][:90]
                line = f"{name:34s} failed: {error}"
            print(line, flush=True)
            lines.append(line)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    args.result.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
