"""Fits the Gaussian world model to the demonstrations and the random actions (A.7).

Run after ``collect.py``: ``python fit_world_model.py``. A fit that was killed goes on
at its last checkpoint.
"""

from __future__ import annotations

import logging
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig

from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KitchenEnv
from torchrl_caiac.experiments import keep_settings
from torchrl_caiac.modules import GaussianWorldModel
from torchrl_caiac.objectives import fit_world_model

_LOGGER = logging.getLogger(__name__)


def fit(cfg: DictConfig) -> GaussianWorldModel:
    """Fits the world model, or loads it where that has been done."""
    settings = cfg.world_model
    out = Path(cfg.out)
    keep_settings(settings, out / "world_model.json")
    torch.manual_seed(settings.seed)
    model = GaussianWorldModel(
        KitchenEnv.layout,
        9,
        tuple(settings.hidden_sizes),
        variance_floor=settings.variance_floor,
        spectral_norm=settings.spectral_norm,
    )
    history = fit_world_model(
        model,
        [load_transitions(out / name) for name in ("demonstrations", "random")],
        steps=settings.steps,
        batch_size=settings.batch_size,
        lr=settings.lr,
        eval_every=settings.eval_every,
        checkpoint=out / "world_model",
        checkpoint_every=settings.checkpoint_every,
        seed=settings.seed,
    )
    best = history[history["best"]][-1]
    _LOGGER.info(
        "best validation NLL %.3f at step %d; root mean squared errors: %s",
        best["validation_nll"],
        best["step"],
        ", ".join(
            f"{name} {best['validation_mse', name].sqrt():.2g}"
            for name in KitchenEnv.layout.names
        ),
    )
    return model


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Fits the world model."""
    torch.set_num_threads(1)
    fit(cfg)


if __name__ == "__main__":
    main()
