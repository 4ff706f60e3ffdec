"""Scores the action's influence on the cubes, and judges the scores by the simulator.

Run after ``fit_world_model.py``: ``python score.py``. The learned scores go into the
leaf ``("caiac", "score")`` of the rows. The arms ``coda`` and ``coda_action`` also have
the attention of a transformer scored, ``("coda", "graph")`` and ``("coda", "action")``,
and ``oracle`` the simulator asked for the truth, ``("oracle", "score")``. What was
killed goes on where it stopped.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import hydra
import torch
from collect import load_rows, rows_folder
from fit_world_model import LAYOUT, fit, fit_transformer
from omegaconf import DictConfig
from tensordict import TensorDictBase

from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.envs import FetchPushTruth
from torchrl_caiac.experiments import claim_folder, keep_settings, write_json
from torchrl_caiac.influence import (
    CAI,
    AttentionInfluence,
    SimulatorInfluence,
    influence_report,
    score_buffer,
)

_LOGGER = logging.getLogger(__name__)


def make_truth(cfg: DictConfig, num_actions: int) -> SimulatorInfluence:
    """The simulator's truth as an estimator."""
    workers = cfg.collect.workers
    return SimulatorInfluence(
        FetchPushTruth,
        state_key=("info", "simulator"),
        num_actions=num_actions,
        threshold=cfg.truth.threshold,
        num_workers=workers if workers > 1 else 0,
    )


def simulator_truth(data: TensorDictBase, cfg: DictConfig, num_actions: int) -> None:
    """Adds ``("oracle", "score")``: 1 where the action can move an entity, else 0."""
    score_buffer(
        offline_buffer(data, batch_size=1),
        make_truth(cfg, num_actions),
        key=("oracle", "score"),
        batch_size=cfg.truth.batch_size,
        lookahead=0,
    )


def score(cfg: DictConfig) -> dict[str, Any]:
    """Scores the rows and reports how good scores are on held-out ones.

    The report is that of unsmoothed scores, and of those smoothed as they are used.
    """
    settings = cfg.score
    folder = rows_folder(cfg)
    keep_settings(settings, folder / "score.json")
    keep_settings(cfg.truth, Path(cfg.out) / "truth.json")
    estimator = CAI(fit(cfg), num_actions=settings.num_actions)
    options = {"batch_size": settings.batch_size, "lookahead": settings.lookahead}
    rows = load_rows(cfg)
    rb = offline_buffer(rows, batch_size=1)
    score_buffer(rb, estimator, smoothing=settings.smoothing, **options)
    arms = {cfg.arm, *cfg.study.arms}
    if arms & {"coda", "coda_action"}:
        model = fit_transformer(cfg)
        for name in ("graph", "action"):
            attention = AttentionInfluence(model, action_only=name == "action")
            score_buffer(
                rb,
                attention,
                smoothing=settings.smoothing,
                key=("coda", name),
                **options,
            )
    if "oracle" in arms:
        simulator_truth(rows, cfg, cfg.truth.oracle_actions)
    held_out = load_transitions(Path(cfg.out) / "held_out")
    simulator_truth(held_out, cfg, cfg.truth.actions)
    truth = held_out["oracle", "score"] > 0.5
    # A copy: the scores of other fractions' models come to the same rows.
    rb = offline_buffer(held_out.exclude("info").clone(), batch_size=1)
    report: dict[str, Any] = {}
    for smoothing in sorted({1, settings.smoothing}):
        key = ("caiac", f"smoothing_{smoothing}")
        score_buffer(rb, estimator, smoothing=smoothing, key=key, **options)
        report[f"smoothing {smoothing}"] = influence_report(
            rb.storage[:][key], truth, LAYOUT.names, threshold=settings.threshold
        )
    write_json(folder / "influence.json", report)
    for smoothing, entities in report.items():
        for name in ("cube0", "cube1"):
            _LOGGER.info("%s, %s: %s", smoothing, name, entities[name])
    return report


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Scores the rows."""
    torch.set_num_threads(1)
    with claim_folder(cfg.out):
        score(cfg)


if __name__ == "__main__":
    main()
