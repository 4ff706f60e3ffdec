"""The speed-up of scoring by two processes, written to ``docs/results``.

``python benchmarks/scaling_scoring.py`` (2 minutes) scores rows of the size of
Fetch-Push with two cubes, 34 columns and 4 actions, by ``caiac``'s estimators CAI (64
actions, 3 x 256) and motion. One process and two, with one thread each, score the same
folder in turns. The seconds are those from the first scored block to the end, without
the import of torch, and ``waiting`` is the share of them in which a process had no
range to score.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from torchrl_caiac._files import whole_file
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.envs import fetch_push_layout
from torchrl_caiac.influence import CAI, MotionInfluence, score_buffer
from torchrl_caiac.modules import GaussianWorldModel

FILE = Path(__file__).parents[1] / "docs" / "results" / "scaling_scoring.csv"
LENGTH = 50  # of an episode


def rows_of(number: int) -> TensorDict:
    """Returns random transitions of the size of Fetch-Push."""
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(number + 1, 34, generator=generator).cumsum(0).mul_(0.01)
    position = torch.arange(number)
    return TensorDict(
        {
            "observation": states[:-1],
            "action": torch.rand(number, 4, generator=generator) * 2 - 1,
            "episode": position // LENGTH,
            "next": {
                "observation": states[1:],
                "done": (position % LENGTH == LENGTH - 1)[:, None],
            },
        },
        [number],
    )


def estimator_of(name: str, rows: TensorDict) -> Any:
    """Returns an estimator, the same in every process."""
    layout = fetch_push_layout(2)
    if name == "motion":
        return MotionInfluence(layout, tolerance=1e-3)
    torch.manual_seed(0)
    columns = {"gripper": 5, "cube0": 3, "cube1": 3}
    predict = {n: layout.columns[n][:k] for n, k in columns.items()}
    model = GaussianWorldModel(layout, 4, (256,) * 3, predict)
    model.fit_statistics(rows["next", "observation"][:4096, :11].diff(dim=0))
    model.set_action_bounds(-1.0, 1.0)
    return CAI(model)


class Timed(torch.nn.Module):
    """An estimator that counts the seconds in which it computes."""

    def __init__(self, inner: Any) -> None:
        super().__init__()
        self.inner, self.layout, self.seconds = inner, inner.layout, 0.0
        self.in_keys = getattr(inner, "in_keys", None)

    def forward(self, states: TensorDict) -> torch.Tensor:
        """Returns the scores."""
        begin = time.perf_counter()
        found = self.inner(states)
        self.seconds += time.perf_counter() - begin
        return found

    def extra_repr(self) -> str:
        """Returns that the seconds are no setting."""
        return ""


def score(
    folder: Path, name: str, shard: tuple[int, int] | None, barrier: Any, results: Any
) -> None:
    """Scores a folder in a new process."""
    torch.set_num_threads(1)
    rb = offline_buffer(load_transitions(folder))
    estimator = Timed(estimator_of(name, rb.storage[:4097]))
    barrier.wait()
    begin = time.perf_counter()
    score_buffer(
        rb,
        estimator,
        lookahead=1 if name == "cai" else 0,
        shard=shard,
        check=False,
        progress=False,
    )
    results.put((begin, time.perf_counter(), estimator.seconds))


def measure(folder: Path, name: str, processes: int) -> dict[str, Any]:
    """Returns a line of the table."""
    context = multiprocessing.get_context("spawn")
    barrier, results = context.Barrier(processes), context.Queue()
    shards = [(i, processes) for i in range(processes)] if processes > 1 else [None]
    started = [
        context.Process(target=score, args=(folder, name, shard, barrier, results))
        for shard in shards
    ]
    for process in started:
        process.start()
    found = [results.get() for _ in started]
    for process in started:
        process.join()
    seconds = max(end for _, end, _ in found) - min(begin for begin, _, _ in found)
    rows = len(load_transitions(folder))
    busy = sum(busy for _, _, busy in found)
    # The leaf and the fingerprints; the parts once more.
    size = rows * (3 * 4 + 8) * (2 if processes > 1 else 1)
    return {
        "estimator": name,
        "processes": processes,
        "rows": rows,
        "seconds": round(seconds, 2),
        "rows_per_s": round(rows / seconds),
        "not_in_estimator": round(1 - busy / seconds / processes, 3),
        "bytes_written": size,
    }


def main() -> None:
    """Measures, and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=131_072)
    parser.add_argument("--out", type=Path, default=FILE)
    args = parser.parse_args()
    table = []
    with tempfile.TemporaryDirectory() as root:
        for name, rows in (("cai", args.rows), ("motion", 8 * args.rows)):
            data = rows_of(rows)
            for processes in (1, 2):
                folder = Path(root, f"{name}{processes}")
                data.memmap(folder)
                table.append(measure(folder, name, processes))
            one, two = table[-2:]
            for line in (one, two):
                line["speed_up"] = round(one["seconds"] / line["seconds"], 2)
            same = [
                Path(root, f"{name}{n}", "caiac", "score.memmap").read_bytes()
                for n in (1, 2)
            ]
            assert same[0] == same[1], "two processes wrote other scores than one"
    with whole_file(args.out) as partial, open(partial, "w", newline="") as stream:
        writer = csv.DictWriter(stream, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


if __name__ == "__main__":
    main()
