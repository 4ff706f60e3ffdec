"""Compares variance floors of the world model by the ground truth of the simulator.

``python sweep_variance_floor.py env=fetch_push`` fits one short model for each floor
and for ``"auto"``, and scores held-out rows. Finished fits are kept. OGBench's
positions are scaled: ``env=ogbench_cube_double unit=10``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf, open_dict

from collect import collect
from environments.base import Environment
from fit import make_gaussian
from shared.console import progress, start
from shared.parts import make_environment
from shared.settings import keep_settings
from shared.tables import update_csv
from torchrl_caiac.data.digests import content_digests
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import CAI, influence_report
from torchrl_caiac.modules import GaussianWorldModel

COLUMNS = (
    "floor",
    "entity",
    "value",
    "auc",
    "best_threshold",
    "best_balanced_accuracy",
    "best_step",
    "reason",
)


def floors(cfg: DictConfig) -> dict[str, Any]:
    """Returns the floors by name, in the units of the data."""
    given = {f"{1000 * floor:g} mm": floor * cfg.unit for floor in cfg.floors}
    return {**given, "auto": "auto"}


def fit_floor(
    cfg: DictConfig, environment: Environment, name: str, floor: Any
) -> tuple[GaussianWorldModel, int]:
    """Fits a model with a floor, and returns it with the number of its best step."""
    settings = cfg.env.world_model.copy()
    with open_dict(settings):
        settings.update({"variance_floor": floor, "steps": cfg.steps})
    folder = environment.folder / "floors"
    folder.mkdir(parents=True, exist_ok=True)
    rows, file = environment.model_rows(), name.replace(" ", "")
    kept: dict[str, Any] = {
        **OmegaConf.to_container(settings),
        "layout": environment.layout.to_dict(),
        "data": {str(i): content_digests(part) for i, part in enumerate(rows)},
    }
    keep_settings(folder, file, kept)
    torch.manual_seed(settings.seed)
    model = make_gaussian(environment, settings)
    history = fit_world_model(
        model,
        rows,
        action_spec=environment.action_spec,
        steps=cfg.steps,
        batch_size=settings.batch_size,
        lr=settings.lr,
        eval_every=min(settings.eval_every, max(1, cfg.steps // 10)),
        checkpoint=folder / file,
        checkpoint_every=settings.checkpoint_every,
        seed=settings.seed,
        progress=progress(),
    )
    return model, int(history[history["best"]][-1]["step"])


def sweep(cfg: DictConfig) -> list[dict[str, Any]]:
    """Returns one line for each floor and entity that is not fixed."""
    environment = make_environment(cfg)
    truth = environment.ground_truth(progress=progress())
    held_out, layout = environment.held_out(), environment.layout
    lines = []
    for name, floor in floors(cfg).items():
        model, best_step = fit_floor(cfg, environment, name, floor)
        with torch.no_grad():
            scores = CAI(model, cfg.env.score.num_actions)(held_out)
        report: Any = influence_report(
            scores, truth, layout.names, threshold=cfg.env.augmentation.threshold
        )
        for entity, values in model.entity_floors().items():
            if entity in layout.fixed:
                continue
            shared = {key: report[entity][key] for key in COLUMNS[3:6]}
            lines.append(
                {
                    "floor": name,
                    "entity": entity,
                    "value": sum(values) / len(values) / cfg.unit,
                    **shared,
                    "best_step": best_step,
                    "reason": model.floor_reasons.get(entity),
                }
            )
    return lines


@hydra.main(version_base=None, config_path="conf", config_name="sweep_variance_floor")
def main(cfg: DictConfig) -> None:
    """Compares the floors, and writes ``variance_floor.csv``."""
    with start(cfg, stages=2) as console:
        with console.stage(make_environment(cfg).data_name):
            collect(cfg)
        with console.stage("floors"):
            lines = sweep(cfg)
        table = Path(cfg.publish) / "variance_floor.csv"
        update_csv(table, lines, COLUMNS, experiment=cfg.env.name)
        console.print(f"table: {table}")


if __name__ == "__main__":
    main()
