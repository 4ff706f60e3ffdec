"""Fitting a world model in two processes, written to ``docs/results``.

``python benchmarks/scaling_fitting.py`` (5 minutes) fits models of several sizes to
random rows of the size of Fetch-Push with two cubes, with several batch sizes, in three
ways: in one process with one thread, in one with two, and in two processes under
``torchrun`` with one thread each, which halve the batch. All three see ``batch`` rows
in a step. A rate is that of the steps between a short and a long call, each the faster
one of two, without what a call does once.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import logging
import os
import subprocess
import sys
import time
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import distributed
from torchrl.data import Bounded

from torchrl_caiac._files import whole_file
from torchrl_caiac.envs import fetch_push_layout
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.modules import GaussianWorldModel

FILE = Path(__file__).parents[1] / "docs" / "results" / "scaling_fitting.csv"
WIDTHS, BATCHES = (128, 256, 512), (512, 2_048, 8_192)
ROWS, SHORT, REPEATS = 20_000, 10, 2


def fit(
    data: TensorDict, width: int, batch: int, steps: int, *, together: bool
) -> float:
    """Returns the seconds of a call."""
    torch.manual_seed(0)
    model = GaussianWorldModel(fetch_push_layout(2), 4, (width,) * 3)
    begin = time.perf_counter()
    fit_world_model(
        model,
        data,
        action_spec=Bounded(-1, 1, (4,)),
        steps=steps,
        eval_every=steps,
        batch_size=batch // (2 if together else 1),
        check=False,
        progress=False,
        distributed=together,
    )
    return time.perf_counter() - begin


def rate(data: TensorDict, width: int, batch: int, work: int, way: str) -> float | None:
    """Returns the steps a second in one of three ways, in the process of rank 0."""
    together = way == "two_processes"
    steps = max(10, work * 256**2 // (batch * width**2))
    seconds = []
    for count in (SHORT, SHORT + steps):
        found = []
        for _ in range(REPEATS):
            distributed.barrier()
            if together or distributed.get_rank() == 0:
                torch.set_num_threads(2 if way == "two_threads" else 1)
                found.append(fit(data, width, batch, count, together=together))
        seconds.append(min(found, default=0.0))
    return None if distributed.get_rank() else steps / (seconds[1] - seconds[0])


def measure(out: Path, work: int) -> None:
    """Measures in a process of ``torchrun``; that of rank 0 writes the table."""
    distributed.init_process_group("gloo")
    logging.getLogger("torchrl_caiac").setLevel(logging.ERROR)  # short fits are bad
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(ROWS + 1, 34, generator=generator).cumsum(0).mul_(0.01)
    data = TensorDict(
        {
            "observation": states[:-1],
            "action": torch.rand(ROWS, 4, generator=generator) * 2 - 1,
            "episode": torch.arange(ROWS) // 50,
            "next": {"observation": states[1:]},
        },
        [ROWS],
    )
    table = []
    for width, batch in itertools.product(WIDTHS, BATCHES):
        line: dict[str, object] = {"hidden": f"3 x {width}", "batch": batch}
        rates = {
            way: rate(data, width, batch, work, way)
            for way in ("one_process", "two_threads", "two_processes")
        }
        if distributed.get_rank() == 0:
            line |= {f"{way}_steps_per_s": f"{r:.1f}" for way, r in rates.items()}
            best = max(rates["one_process"], rates["two_threads"])
            line["speed_up"] = f"{rates['two_processes'] / rates['one_process']:.2f}"
            line["to_the_best_alone"] = f"{rates['two_processes'] / best:.2f}"
            table.append(line)
            print(line, flush=True)
    if distributed.get_rank() == 0:
        with whole_file(out) as partial, open(partial, "w", newline="") as stream:
            writer = csv.DictWriter(stream, list(table[0]))
            writer.writeheader()
            writer.writerows(table)
    distributed.destroy_process_group()


def main() -> None:
    """Starts two processes with ``torchrun``, or measures in one of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=FILE)
    parser.add_argument("--work", type=int, default=200_000, help="rows of a rate")
    args = parser.parse_args()
    if "LOCAL_RANK" in os.environ:
        measure(args.out, args.work)
        return
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc-per-node=2", __file__, *sys.argv[1:]]
    subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
