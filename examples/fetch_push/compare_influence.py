"""Compares influence estimators on unseen episodes, by the simulator's truth.

``python compare_influence.py`` collects and fits what is missing, and writes the table
and the figure that ``make influence`` publishes, with the kitchen's.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from collect import collect
from fit_world_model import LAYOUT, fit, fit_seconds, fit_transformer
from omegaconf import DictConfig
from score import make_truth, simulator_truth

from torchrl_caiac.data import load_transitions
from torchrl_caiac.evaluation import (
    Candidate,
    compare_influence,
    paper_candidates,
    publish_comparison,
)
from torchrl_caiac.experiments import claim_folder, quick_settings
from torchrl_caiac.influence import CAI, DistanceInfluence

POSITIONS = {name: LAYOUT.columns[name][:3] for name in LAYOUT.names}


def candidates(cfg: DictConfig) -> dict[str, Candidate]:
    """The estimators as the arms of the study use them, and the distance rule."""
    return paper_candidates(
        CAI(fit(cfg), num_actions=cfg.score.num_actions),
        fit_transformer(cfg),
        partial(DistanceInfluence, LAYOUT, POSITIONS),
        make_truth(cfg, cfg.truth.oracle_actions),
        threshold=cfg.score.threshold,
        attention_threshold=cfg.coda.threshold,
        smoothing=cfg.score.smoothing,
        fit_seconds=(fit_seconds(cfg, "world_model"), fit_seconds(cfg, "transformer")),
    )


def compare(cfg: DictConfig) -> list[dict[str, Any]]:
    """Compares the estimators on the held-out episodes, and publishes the result."""
    collect(cfg)
    held_out = load_transitions(Path(cfg.out) / "held_out")
    simulator_truth(held_out, cfg, cfg.truth.actions)
    rows = compare_influence(
        held_out.exclude("oracle"), held_out["oracle", "score"] > 0.5, candidates(cfg)
    )
    publish_comparison(cfg.study.influence, rows, experiment="fetch_push")
    return rows


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Compares the estimators."""
    cfg = quick_settings(cfg)
    torch.set_num_threads(1)
    with claim_folder(cfg.out):
        compare(cfg)
    print(f"table and figure: {cfg.study.influence}")


if __name__ == "__main__":
    main()
