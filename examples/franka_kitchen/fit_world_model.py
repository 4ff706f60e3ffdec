"""Fits the world models to the demonstrations and the random actions (A.7).

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
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig

from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KitchenEnv
from torchrl_caiac.experiments import keep_settings, write_json
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel

_LOGGER = logging.getLogger(__name__)


def fit(cfg: DictConfig) -> GaussianWorldModel:
    """Fits the Gaussian world model, or loads it where that has been done."""
    settings = cfg.world_model
    torch.manual_seed(settings.seed)
    model = GaussianWorldModel(
        KitchenEnv.layout,
        9,
        tuple(settings.hidden_sizes),
        variance_floor=settings.variance_floor,
        spectral_norm=settings.spectral_norm,
    )
    return _fitted(model, cfg, "world_model")


def fit_transformer(cfg: DictConfig) -> TransformerWorldModel:
    """Fits the transformer, or loads it where that has been done."""
    settings = cfg.transformer
    torch.manual_seed(settings.seed)
    model = TransformerWorldModel(
        KitchenEnv.layout,
        9,
        settings.layers,
        settings.heads,
        settings.width,
        variance_floor=settings.variance_floor,
    )
    return _fitted(model, cfg, "transformer")


def fit_seconds(cfg: DictConfig, name: str) -> float:
    """The processor time that fitting a model took; NaN where it was interrupted."""
    path = Path(cfg.out) / f"{name}_fit.json"
    return json.loads(path.read_text())["seconds"] if path.exists() else math.nan


def _fitted(model: Any, cfg: DictConfig, name: str) -> Any:
    settings, out = cfg[name], Path(cfg.out)
    keep_settings(settings, out / f"{name}.json")
    checkpoint = out / name
    new = not checkpoint.exists()
    begin = time.process_time()
    history = fit_world_model(
        model,
        [load_transitions(out / part) for part in ("demonstrations", "random")],
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
        write_json(out / f"{name}_fit.json", {"seconds": seconds})
    best = history[history["best"]][-1]
    _LOGGER.info(
        "%s: best validation NLL %.3f at step %d; root mean squared errors: %s",
        name,
        best["validation_nll"],
        best["step"],
        ", ".join(
            f"{entity} {best['validation_mse', entity].sqrt():.2g}"
            for entity in KitchenEnv.layout.names
        ),
    )
    return model


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Fits the world models that ``cfg.arm`` and ``cfg.demo.arms`` need."""
    torch.set_num_threads(1)
    fit(cfg)
    if {"coda", "coda_action"} & {cfg.arm, *cfg.demo.arms}:
        fit_transformer(cfg)


if __name__ == "__main__":
    main()
