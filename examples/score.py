"""Scores the action's influence on the entities, and checks the scores.

Run after ``fit.py``: ``python score.py env=kitchen 'method=[caiac,oracle]'``. Each
method's scores become a leaf of the rows. CAI's scores of held-out rows are compared
with the ground truth of the simulator. Interrupted scoring resumes where it stopped.
"""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf

from fit import fit_model
from methods.base import Scoring
from methods.caiac import CAIAC
from shared.console import progress, start
from shared.parts import make_environment, make_methods, new_learner
from shared.settings import keep_settings
from torchrl_caiac._files import whole_file, write_json
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.data.digests import content_digests
from torchrl_caiac.influence import influence_report, score_buffer

_LOGGER = logging.getLogger(__name__)


def make_scoring(cfg: DictConfig) -> Scoring:
    """Returns the inputs of the methods' estimators."""
    return Scoring(
        make_environment(cfg), partial(fit_model, cfg), cfg.env.score, progress()
    )


def score(cfg: DictConfig) -> dict[str, Any]:
    """Scores what the learner trains on, and checks CAI on held-out rows.

    Returns:
        dict: the report of unsmoothed scores, and of those smoothed as they are used,
        also written to ``influence.json``; empty without the method ``caiac``.
    """
    scoring = make_scoring(cfg)
    environment = scoring.environment
    kept: dict[str, Any] = OmegaConf.to_container(scoring.settings)
    kept.pop("batch_size")  # changes no result
    kept |= {
        "layout": environment.layout.to_dict(),
        "data": content_digests(environment.rows()),
    }
    keep_settings(environment.folder, "score", kept)
    methods = make_methods(cfg)
    keys = {str(method.score_key): name for name, method in methods.items()}
    for name in keys.values():  # methods with the same scores are scored once
        rows = new_learner(cfg, name).stored_rows()
        methods[name].score(offline_buffer(rows, batch_size=1), scoring)
    return check_scores(cfg, scoring) if "caiac" in methods else {}


def check_scores(cfg: DictConfig, scoring: Scoring) -> dict[str, Any]:
    """Compares CAI's scores of held-out rows with the ground truth."""
    environment, settings = scoring.environment, scoring.settings
    kept: dict[str, Any] = OmegaConf.to_container(cfg.env.truth)
    kept.pop("batch_size")
    kept |= {
        "layout": environment.layout.to_dict(),
        "data": content_digests(environment.held_out()),
    }
    keep_settings(environment.folder, "truth", kept)
    threshold = cfg.env.augmentation.threshold
    estimator = CAIAC(threshold).estimator(scoring)
    truth = environment.ground_truth(progress=scoring.progress)
    # A copy: the scores of other numbers of demonstrations are of the same rows.
    rb = offline_buffer(environment.held_out().clone(), batch_size=1)
    report: dict[str, Any] = {}
    for smoothing in sorted({1, settings.smoothing}):
        key = ("caiac", f"smoothing_{smoothing}")
        score_buffer(
            rb,
            estimator,
            batch_size=settings.batch_size,
            smoothing=smoothing,
            # The ground truth is that of a row's own state, like these scores.
            lookahead=0,
            key=key,
            progress=scoring.progress,
        )
        scores = rb.storage[:][key]
        report[f"smoothing {smoothing}"] = influence_report(
            scores, truth, environment.layout.names, threshold=threshold
        )
        if smoothing == settings.smoothing:
            with whole_file(environment.folder / "held_out_scores.pt") as partial_file:
                torch.save(scores.clone(), partial_file)
    write_json(environment.folder / "influence.json", report)
    _LOGGER.info("influence: %s", report)
    return report


@hydra.main(version_base=None, config_path="conf", config_name="config")
def main(cfg: DictConfig) -> None:
    """Scores the rows."""
    with start(cfg) as console, console.stage("scores"):
        score(cfg)


if __name__ == "__main__":
    main()
