"""Compares influence estimators on unseen demonstrations, by the simulator's truth.

``python compare_influence.py`` collects and fits what is missing, and writes the table
and the figure that ``make influence`` publishes, with Fetch-Push's;
``experiment=all_tasks`` does so for chains of tasks.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import hydra
import torch
from collect import collect
from fit_world_model import fit, fit_transformer
from omegaconf import DictConfig
from score import simulator_truth
from tensordict import TensorDictBase

from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KitchenEnv
from torchrl_caiac.experiments import claim_folder, quick_settings
from torchrl_caiac.influence import (
    CAI,
    AttentionInfluence,
    Candidate,
    DistanceInfluence,
    SimulatorInfluence,
    compare_influence,
    publish_comparison,
)

LAYOUT = KitchenEnv.layout
# The observation has joints; the distance rule reads where hand and handles are.
HANDLES = EntityLayout(
    {name: range(3 * i, 3 * i + 3) for i, name in enumerate(LAYOUT.names)},
    observation_key="handles",
    fixed=LAYOUT.fixed,
)


def candidates(cfg: DictConfig) -> dict[str, Candidate]:
    """The estimators as the arms of the demo use them, and two distance rules."""
    gaussian, transformer = fit(cfg), fit_transformer(cfg)
    seconds = {
        name: json.loads((Path(cfg.out) / f"{name}_fit.json").read_text())["seconds"]
        for name in ("world_model", "transformer")
    }
    smoothing, workers = cfg.score.smoothing, cfg.collect.workers
    positions = dict(HANDLES.columns)
    return {
        "caiac": Candidate(
            CAI(gaussian, num_actions=cfg.score.num_actions),
            CAIACTransform(LAYOUT, cfg.score.threshold),
            smoothing,
            seconds["world_model"],
        ),
        "coda": Candidate(
            AttentionInfluence(transformer),
            CoDATransform(LAYOUT, cfg.coda.threshold),
            smoothing,
            seconds["transformer"],
        ),
        "coda_action": Candidate(
            AttentionInfluence(transformer, action_only=True),
            CAIACTransform(LAYOUT, cfg.coda.threshold),
            smoothing,
            seconds["transformer"],
        ),
        "distance": Candidate(
            DistanceInfluence(HANDLES, positions), CoDATransform(LAYOUT, 0.5)
        ),
        "distance_action": Candidate(
            DistanceInfluence(HANDLES, positions, action_only=True),
            CAIACTransform(LAYOUT, 0.5),
        ),
        "oracle": Candidate(
            SimulatorInfluence(
                KitchenEnv,
                num_actions=cfg.score.oracle_actions,
                num_workers=workers if workers > 1 else 0,
            ),
            CAIACTransform(LAYOUT, 0.5),
        ),
    }


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
