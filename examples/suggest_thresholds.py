"""Compares suggested thresholds with the best ones by the ground truth.

``python suggest_thresholds.py env=kitchen`` collects and fits what is missing. The
thresholds are suggested from the scores of the training data, as a user would, and
judged on held-out states. ``publish=docs/results`` keeps the table, in which each call
replaces the rows of its environment.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from collect import collect
from methods.base import Scoring
from score import make_scoring
from shared.console import Console, progress, start
from shared.parts import make_environment, make_methods
from shared.tables import update_csv
from shared.thresholds import COLUMNS, compare_thresholds
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.influence import (
    MotionInfluence,
    score_buffer,
    suggest_thresholds,
)

_KEY = ("suggested", "score")


def estimators(scoring: Scoring, cfg: DictConfig) -> dict[str, Any]:
    """Returns CAI, and motion where positions are known."""
    found = {
        name: method.estimator(scoring) for name, method in make_methods(cfg).items()
    }
    layout = scoring.environment.layout
    if layout.positions:
        found["motion"] = MotionInfluence(layout).fit(scoring.environment.rows())
    return found


def compare(cfg: DictConfig, console: Console) -> list[dict[str, Any]]:
    """Compares the thresholds, and publishes the table."""
    environment = make_environment(cfg)
    with console.stage(environment.data_name):
        collect(cfg)
    with console.stage("world model"):
        scoring = make_scoring(cfg)
        candidates = estimators(scoring, cfg)
    with console.stage("ground truth"):
        truth = environment.ground_truth(progress=progress())
    rows = []
    with console.stage("comparison"):
        for name, estimator in candidates.items():
            scored = {}
            for part, data in (
                ("training", environment.rows()),
                ("held out", environment.held_out()),
            ):
                # Copies, without leaves of other steps. The ground truth is that of a
                # row's own state, and so are the scores.
                rb = offline_buffer(data.exclude("oracle", "caiac").clone(), 1)
                score_buffer(
                    rb,
                    estimator,
                    key=_KEY,
                    lookahead=0,
                    check=False,
                    progress=progress(),
                )
                scored[part] = rb
            found = suggest_thresholds(
                scored["training"], environment.layout, score_key=_KEY
            )
            console.print(f"{name}\n{found}")
            rows += compare_thresholds(
                found,
                scored["held out"].storage[:][_KEY],
                truth,
                environment.layout,
                estimator=name,
            )
            figure = f"thresholds_{cfg.env.name}_{name}.png"
            found.plot(Path(cfg.out) / figure)
        path = Path(cfg.publish) / "thresholds.csv"
        update_csv(path, rows, COLUMNS, experiment=cfg.env.name)
    return rows


@hydra.main(version_base=None, config_path="conf", config_name="suggest_thresholds")
def main(cfg: DictConfig) -> None:
    """Compares the thresholds."""
    with start(cfg, stages=4) as console:
        compare(cfg, console)
        console.print(f"table: {cfg.publish}")


if __name__ == "__main__":
    main()
