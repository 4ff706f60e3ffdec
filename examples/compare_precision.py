"""Draws learning curves of several studies in one figure, from their tables.

``python compare_precision.py`` compares the precisions of the hidden layers, from
``docs/results/fetch_push_{bfloat16,float32}.csv``, of an earlier version of
``study.py``; the page on performance says which runs these are.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from torchrl_caiac._files import whole_file
from torchrl_caiac.plotting import plot_learning_curves

RESULTS = Path(__file__).parents[1] / "docs" / "results"


def read_curves(path: Path) -> tuple[list[int], list[list[float]]]:
    """Reads the steps ``[P]`` of a study, and full success ``[R, P]`` by seed."""
    runs: dict[int, dict[int, float]] = defaultdict(dict)
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            runs[int(row["seed"])][int(row["step"])] = float(row["full"])
    steps = sorted(set().union(*runs.values()))
    lacking = [seed for seed, run in sorted(runs.items()) if len(run) < len(steps)]
    if not steps or lacking:
        raise ValueError(
            f"{path} lacks steps of the seeds {lacking}: run study.py again"
        )
    return steps, [[runs[seed][step] for step in steps] for seed in sorted(runs)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--names", nargs="+", default=["bfloat16", "float32"])
    chosen = parser.parse_args(arguments)
    curves = {
        name: read_curves(chosen.results / f"fetch_push_{name}.csv")
        for name in chosen.names
    }
    figure = plot_learning_curves(
        curves,
        labels={
            name: f"{name}, {len(runs)} seeds" for name, (_, runs) in curves.items()
        },
        title="two cubes pushed, by the precision of the hidden layers",
    )
    with whole_file(chosen.results / "fetch_push_precision.png") as partial:
        figure.savefig(partial, dpi=150)


if __name__ == "__main__":
    main()
