"""Fits the Gaussian world model to the rows that are learnt from (A.7).

Run after ``collect.py``: ``python fit_world_model.py``. A fit that was killed goes on
at its last checkpoint.
"""

from __future__ import annotations

import logging

import hydra
import torch
from collect import load_rows, rows_folder
from omegaconf import DictConfig

from torchrl_caiac.envs import fetch_push_layout
from torchrl_caiac.experiments import claim_folder, keep_settings
from torchrl_caiac.modules import GaussianWorldModel
from torchrl_caiac.objectives import fit_world_model

# What the model predicts, per entity: the gripper's and fingers' positions, the cubes'.
POSITIONS = {"gripper": 5, "cube0": 3, "cube1": 3}

_LOGGER = logging.getLogger(__name__)


def fit(cfg: DictConfig) -> GaussianWorldModel:
    """Fits the world model, or loads it where that has been done."""
    settings = cfg.world_model
    folder = rows_folder(cfg)
    keep_settings(settings, folder / "world_model.json")
    torch.manual_seed(settings.seed)
    layout = fetch_push_layout(2)
    model = GaussianWorldModel(
        layout,
        4,
        tuple(settings.hidden_sizes),
        predict={name: layout.columns[name][:n] for name, n in POSITIONS.items()},
        variance_floor=settings.variance_floor,
    )
    history = fit_world_model(
        model,
        load_rows(cfg),
        steps=settings.steps,
        batch_size=settings.batch_size,
        lr=settings.lr,
        eval_every=settings.eval_every,
        checkpoint=folder / "world_model",
        checkpoint_every=settings.checkpoint_every,
        seed=settings.seed,
    )
    best = history[history["best"]][-1]
    _LOGGER.info(
        "best validation NLL %.3f at step %d; root mean squared errors: %s",
        best["validation_nll"],
        best["step"],
        ", ".join(
            f"{name} {1e3 * best['validation_mse', name].sqrt():.2g} mm"
            for name in POSITIONS
        ),
    )
    return model


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Fits the world model."""
    torch.set_num_threads(1)
    with claim_folder(cfg.out):
        fit(cfg)


if __name__ == "__main__":
    main()
