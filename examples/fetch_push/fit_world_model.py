"""Fits the world models to the rows that are learnt from (A.7).

The Gaussian one gives CAI's scores, the transformer, for the arms ``coda`` and
``coda_action``, those of attention.

Run after ``collect.py``: ``python fit_world_model.py``. A fit that was killed goes on
at its last checkpoint.
"""

from __future__ import annotations

import json
import logging
import math
import time
from typing import Any

import hydra
import torch
from collect import load_rows, rows_folder
from omegaconf import DictConfig

from torchrl_caiac.envs import fetch_push_layout
from torchrl_caiac.experiments import claim_folder, keep_settings, write_json
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel

LAYOUT = fetch_push_layout(2)
# What the models predict: the positions of the gripper and its fingers, and the cubes'.
PREDICTED = {
    name: LAYOUT.columns[name][:n]
    for name, n in {"gripper": 5, "cube0": 3, "cube1": 3}.items()
}

_LOGGER = logging.getLogger(__name__)


def fit(cfg: DictConfig) -> GaussianWorldModel:
    """Fits the Gaussian world model, or loads it where that has been done."""
    settings = cfg.world_model
    torch.manual_seed(settings.seed)
    model = GaussianWorldModel(
        LAYOUT,
        4,
        tuple(settings.hidden_sizes),
        PREDICTED,
        variance_floor=settings.variance_floor,
    )
    return _fitted(model, cfg, "world_model")


def fit_transformer(cfg: DictConfig) -> TransformerWorldModel:
    """Fits the transformer, or loads it where that has been done."""
    settings = cfg.transformer
    torch.manual_seed(settings.seed)
    model = TransformerWorldModel(
        LAYOUT,
        4,
        settings.layers,
        settings.heads,
        settings.width,
        PREDICTED,
        variance_floor=settings.variance_floor,
    )
    return _fitted(model, cfg, "transformer")


def fit_seconds(cfg: DictConfig, name: str) -> float:
    """The processor time that fitting a model took; NaN where it was interrupted."""
    path = rows_folder(cfg) / f"{name}_fit.json"
    return json.loads(path.read_text())["seconds"] if path.exists() else math.nan


def _fitted(model: Any, cfg: DictConfig, name: str) -> Any:
    settings, folder = cfg[name], rows_folder(cfg)
    keep_settings(settings, folder / f"{name}.json")
    checkpoint = folder / name
    new = not checkpoint.exists()
    begin = time.process_time()
    history = fit_world_model(
        model,
        load_rows(cfg),
        steps=settings.steps,
        batch_size=settings.batch_size,
        lr=settings.lr,
        eval_every=settings.eval_every,
        checkpoint=checkpoint,
        checkpoint_every=settings.checkpoint_every,
        seed=settings.seed,
    )
    if new:  # else the time of the whole fit is not known, or already kept
        seconds = time.process_time() - begin
        write_json(folder / f"{name}_fit.json", {"seconds": seconds})
    best = history[history["best"]][-1]
    _LOGGER.info(
        "%s: best validation NLL %.3f at step %d; root mean squared errors: %s",
        name,
        best["validation_nll"],
        best["step"],
        ", ".join(
            f"{entity} {1e3 * best['validation_mse', entity].sqrt():.2g} mm"
            for entity in PREDICTED
        ),
    )
    return model


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Fits the world models that ``cfg.arm`` and ``cfg.study.arms`` need."""
    torch.set_num_threads(1)
    with claim_folder(cfg.out):
        fit(cfg)
        if {"coda", "coda_action"} & {cfg.arm, *cfg.study.arms}:
            fit_transformer(cfg)


if __name__ == "__main__":
    main()
