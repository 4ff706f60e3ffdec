"""The speed-up of scoring by two processes, written to ``docs/results``.

``python benchmarks/scaling_scoring.py`` (8 minutes) scores rows of the size of
Fetch-Push with two cubes, 34 columns and 4 actions, by CAI (64 actions, 3 x 256) and by
motion. One process and two, with one thread each, score copies of the same folder, and
must write the same bytes.

``seconds`` is the time from the start of the first process to the end of the last one.
``fixed_s`` of them do not depend on the number of rows: a process imports torch, has
torch compile CAI's kernel, and ends. That is 5 to 10 s, and two processes need as long
as one. So two million rows are needed for it to be a small part of ``speed_up``, the
ratio of ``seconds``. ``rows_per_s`` is the rate without it, and ``rate_up`` the ratio
of the rates. ``not_in_estimator`` is the share of that time that is reading, writing
and waiting.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
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
        self.ready = 0.0

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Prepares the estimator, and has it compile."""
        if hasattr(self.inner, "prepare"):
            self.inner.prepare(*args, **kwargs)
            self.inner(args[0][:2])
        self.ready = time.perf_counter()

    def forward(self, states: TensorDict) -> torch.Tensor:
        """Returns the scores."""
        begin = time.perf_counter()
        found = self.inner(states)
        self.seconds += time.perf_counter() - begin
        return found

    def extra_repr(self) -> str:
        """Returns that the seconds are no setting."""
        return ""


def score(folder: Path, name: str, number: int, processes: int) -> None:
    """Scores a folder in this process, and prints when it began and ended."""
    torch.set_num_threads(1)
    rb = offline_buffer(load_transitions(folder))
    estimator = Timed(estimator_of(name, rb.storage[:4097]))
    score_buffer(
        rb,
        estimator,
        lookahead=1 if name == "cai" else 0,
        shard=(number, processes) if processes > 1 else None,
        check=False,
        progress=False,
    )
    end = time.perf_counter()
    ready = estimator.ready or end  # the other process has scored all
    print(json.dumps([ready, end, estimator.seconds]))


def measure(folder: Path, name: str, processes: int) -> dict[str, Any]:
    """Returns a line of the table."""
    command = [sys.executable, __file__, "--score", str(folder), name]
    begin = time.perf_counter()
    started = [
        subprocess.Popen(
            [*command, str(i), str(processes)], stdout=subprocess.PIPE, text=True
        )
        for i in range(processes)
    ]
    printed = [process.communicate()[0] for process in started]
    seconds = time.perf_counter() - begin
    for process, text in zip(started, printed, strict=True):
        assert process.returncode == 0, text
    found = [json.loads(text.splitlines()[-1]) for text in printed]
    ready, ends, busy = zip(*found, strict=True)  # all by the clock of the machine
    scoring = max(ends) - sum(ready) / processes
    rows = len(load_transitions(folder))
    # The leaf and the fingerprints; the parts once more.
    size = rows * (3 * 4 + 8) * (2 if processes > 1 else 1)
    return {
        "estimator": name,
        "processes": processes,
        "rows": rows,
        "seconds": round(seconds, 2),
        "fixed_s": round(seconds - scoring, 2),
        "rows_per_s": round(rows / scoring),
        "not_in_estimator": round(1 - sum(busy) / scoring / processes, 3),
        "bytes_written": size,
    }


def main() -> None:
    """Measures, and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1 << 21)
    parser.add_argument("--out", type=Path, default=FILE)
    parser.add_argument("--score", nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.score:
        folder, name, number, processes = args.score
        score(Path(folder), name, int(number), int(processes))
        return
    table = []
    with tempfile.TemporaryDirectory() as root:
        data = rows_of(args.rows)
        for name in ("cai", "motion"):
            for processes in (1, 2):
                folder = Path(root, f"{name}{processes}")
                data.memmap(folder)
                table.append(measure(folder, name, processes))
            one, two = table[-2:]
            for line in (one, two):
                line["speed_up"] = round(one["seconds"] / line["seconds"], 2)
                line["rate_up"] = round(line["rows_per_s"] / one["rows_per_s"], 2)
                print(line)
            for file in ("score.memmap", "score_fingerprint.memmap"):
                same = [
                    Path(root, f"{name}{n}", "caiac", file).read_bytes() for n in (1, 2)
                ]
                assert same[0] == same[1], f"{file}: two processes wrote other bytes"
    with whole_file(args.out) as partial, open(partial, "w", newline="") as stream:
        writer = csv.DictWriter(stream, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


if __name__ == "__main__":
    main()
