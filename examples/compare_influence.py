"""Compares influence estimators on unseen data, by the ground truth of the simulator.

``python compare_influence.py env=kitchen`` collects and fits what is missing, and
writes the table and the figure that ``make influence`` publishes for all environments.
With ``'method=[motion]'``, the rows of other methods stay as they are.
"""

from __future__ import annotations

import math
import time
from typing import Any

import hydra
from omegaconf import DictConfig

from collect import collect
from fit import fit, fit_seconds
from score import make_scoring
from shared.console import Console, progress, start
from shared.parts import make_environment, make_methods
from shared.tables import publish_comparison
from torchrl_caiac.evaluation import Candidate, compare_influence


def candidates(cfg: DictConfig) -> dict[str, Candidate]:
    """Returns the estimators of the methods."""
    scoring = make_scoring(cfg)
    found = {}
    for name, method in make_methods(cfg).items():
        if method.score_key is None:
            continue
        begin = time.process_time()
        estimator = method.estimator(scoring)
        seconds = time.process_time() - begin if method.fits_itself else math.nan
        found[name] = Candidate(
            estimator,
            method.transform(scoring.environment.layout),
            method.scoring_options(scoring).get("smoothing", 1),
            fit_seconds(cfg, method.models[0]) if method.models else seconds,
        )
    return found


def compare(cfg: DictConfig, console: Console) -> list[dict[str, Any]]:
    """Compares the estimators on the held-out data, and publishes the result."""
    environment = make_environment(cfg)
    with console.stage(environment.data_name):
        collect(cfg)
    with console.stage("world models"):
        fit(cfg)
    with console.stage("ground truth"):
        truth = environment.ground_truth(progress=progress())
    with console.stage("comparison"):
        rows = compare_influence(
            environment.held_out().exclude("oracle"),
            truth,
            candidates(cfg),
            progress=progress(),
        )
        publish_comparison(cfg.publish, rows, experiment=cfg.env.name)
    return rows


@hydra.main(version_base=None, config_path="conf", config_name="compare_influence")
def main(cfg: DictConfig) -> None:
    """Compares the estimators."""
    with start(cfg, stages=4) as console:
        compare(cfg, console)
        console.print(f"table and figure: {cfg.publish}")


if __name__ == "__main__":
    main()
