"""Compares influence estimators on unseen demonstrations, by the simulator's truth.

``python compare_influence.py`` collects and fits what is missing, and writes the table
and the figure that ``make influence`` publishes, with Fetch-Push's;
``experiment=all_tasks`` does so for chains of tasks.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from collect import collect
from fit_world_model import fit, fit_seconds, fit_transformer
from omegaconf import DictConfig
from score import simulator_truth
from tensordict import TensorDictBase

from torchrl_caiac import EntityLayout
from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KitchenEnv
from torchrl_caiac.evaluation import (
    Candidate,
    compare_influence,
    paper_candidates,
    publish_comparison,
)
from torchrl_caiac.experiments import claim_folder, quick_settings
from torchrl_caiac.influence import CAI, DistanceInfluence, SimulatorInfluence

LAYOUT = KitchenEnv.layout
# The observation has joints; the distance rule reads where hand and handles are.
HANDLES = EntityLayout(
    {name: range(3 * i, 3 * i + 3) for i, name in enumerate(LAYOUT.names)},
    observation_key="handles",
    fixed=LAYOUT.fixed,
)


def candidates(cfg: DictConfig) -> dict[str, Candidate]:
    """The estimators as the arms of the demo use them, and the distance rule."""
    workers = cfg.collect.workers
    return paper_candidates(
        CAI(fit(cfg), num_actions=cfg.score.num_actions),
        fit_transformer(cfg),
        partial(DistanceInfluence, HANDLES, dict(HANDLES.columns)),
        SimulatorInfluence(
            KitchenEnv,
            num_actions=cfg.score.oracle_actions,
            num_workers=workers if workers > 1 else 0,
        ),
        threshold=cfg.score.threshold,
        attention_threshold=cfg.coda.threshold,
        smoothing=cfg.score.smoothing,
        fit_seconds=(fit_seconds(cfg, "world_model"), fit_seconds(cfg, "transformer")),
    )


def with_readings(data: TensorDictBase) -> TensorDictBase:
    """The rows with what the distance rule and the simulator read."""
    data = data.select("observation", "action", "episode", "next", "sim").clone()
    data["simulator"] = torch.cat([data["sim", "qpos"], data["sim", "qvel"]], -1)
    kitchen = KitchenEnv()
    try:
        for part in (data, data["next"]):
            places = kitchen.handle_positions(part["observation"])
            part["handles"] = torch.from_numpy(places).flatten(1).float()
    finally:
        kitchen.close()
    return data


def compare(cfg: DictConfig) -> list[dict[str, Any]]:
    """Compares the estimators on the held-out demonstrations, and publishes it."""
    collect(cfg)
    held_out = load_transitions(Path(cfg.out) / "held_out")
    truth = simulator_truth(
        held_out, Path(cfg.out) / "held_out_truth.pt", cfg, cfg.score.truth_actions
    )
    rows = compare_influence(with_readings(held_out), truth, candidates(cfg))
    publish_comparison(
        cfg.demo.influence,
        rows,
        experiment="kitchen_all_tasks" if cfg.collect.chains else "kitchen",
    )
    return rows


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Compares the estimators."""
    cfg = quick_settings(cfg)
    torch.set_num_threads(1)
    with claim_folder(cfg.out):
        compare(cfg)
    print(f"table and figure: {cfg.demo.influence}")


if __name__ == "__main__":
    main()
