"""Fits the world models that the methods need (A.7).

Run after ``collect.py``: ``python fit.py env=kitchen 'method=[caiac,coda]'``. The
Gaussian model gives the scores of CAI, the transformer those of attention. An
interrupted fit resumes at its last checkpoint.
"""

from __future__ import annotations

import logging
import math
import time
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf

from environments.base import Environment
from shared.console import progress, start
from shared.parts import make_environment, make_methods
from shared.settings import keep_settings
from torchrl_caiac._files import read_json, write_json
from torchrl_caiac.data.digests import content_digests
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel

_LOGGER = logging.getLogger(__name__)


def make_gaussian(environment: Environment, settings: DictConfig) -> GaussianWorldModel:
    """Returns the Gaussian world model of an environment."""
    return GaussianWorldModel(
        environment.layout,
        environment.action_dim,
        tuple(settings.hidden_sizes),
        environment.predicted,
        variance_floor=settings.variance_floor,
        spectral_norm=settings.spectral_norm,
        inputs=environment.inputs,
    )


def make_transformer(
    environment: Environment, settings: DictConfig
) -> TransformerWorldModel:
    """Returns the transformer of an environment."""
    return TransformerWorldModel(
        environment.layout,
        environment.action_dim,
        settings.layers,
        settings.heads,
        settings.width,
        environment.predicted,
        variance_floor=settings.variance_floor,
        inputs=environment.inputs,
    )


MAKERS = {"world_model": make_gaussian, "transformer": make_transformer}


def fit_model(cfg: DictConfig, name: str) -> Any:
    """Fits a world model, or loads it if it has been fitted.

    Args:
        cfg (DictConfig): the configuration.
        name (str): ``"world_model"`` or ``"transformer"``.

    Returns:
        EntityDynamicsModel: the fitted model.
    """
    environment, settings = make_environment(cfg), cfg.env[name]
    folder = environment.folder
    rows = environment.model_rows()
    kept: dict[str, Any] = {
        **OmegaConf.to_container(settings, resolve=True),
        "layout": environment.layout.to_dict(),
        "data": {str(i): content_digests(part) for i, part in enumerate(rows)},
    }
    keep_settings(folder, name, kept)
    torch.manual_seed(settings.seed)
    model = MAKERS[name](environment, settings)
    checkpoint = folder / name
    new = not checkpoint.exists()
    begin = time.process_time()
    history = fit_world_model(
        model,
        rows,
        action_spec=environment.action_spec,
        steps=settings.steps,
        batch_size=settings.batch_size,
        lr=settings.lr,
        eval_every=settings.eval_every,
        checkpoint=checkpoint,
        checkpoint_every=settings.checkpoint_every,
        seed=settings.seed,
        progress=progress(),
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
            f"{entity} {best['validation_mse', entity].sqrt():.2g}"
            for entity in environment.predicted or environment.layout.names
        ),
    )
    return model


def fit_seconds(cfg: DictConfig, name: str) -> float:
    """Returns the processor time of a fit; NaN if it was interrupted."""
    path = make_environment(cfg).folder / f"{name}_fit.json"
    if not path.exists():
        return math.nan
    return read_json(path, "time of a fit", "delete it")["seconds"]


def fit(cfg: DictConfig) -> None:
    """Fits the models that the methods need."""
    methods = make_methods(cfg).values()
    needed = {name for method in methods for name in method.models}
    for name in MAKERS:
        if name in needed:
            fit_model(cfg, name)


@hydra.main(version_base=None, config_path="conf", config_name="config")
def main(cfg: DictConfig) -> None:
    """Fits the world models."""
    with start(cfg) as console, console.stage("world models"):
        fit(cfg)


if __name__ == "__main__":
    main()
