"""Draws the success of each method and task from the published results of a study.

The figures of the results page::

    cd docs
    python figures/success.py results/kitchen_all_tasks.json \\
        images/kitchen_all_tasks_success.png
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from torchrl_caiac.plotting import plot_success

LABELS = {
    "none": "without counterfactuals",
    "caiac": "with counterfactuals (CAIAC)",
    "coda": "CoDA",
    "coda_action": "CoDA-action",
    "oracle": "with counterfactuals (ground truth)",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, help="JSON file of a study")
    parser.add_argument("figure", type=Path, help="PNG file to write")
    parser.add_argument("--title", default="")
    options = parser.parse_args()
    success: dict[str, dict[str, list[float]]] = {}
    for episode in json.loads(options.results.read_text())["results"]:
        tasks = success.setdefault(episode["method"], {})
        tasks.setdefault(episode["task"], []).append(float(episode["success"]))
    plot_success(success, labels=LABELS, title=options.title).savefig(options.figure)


if __name__ == "__main__":
    main()
