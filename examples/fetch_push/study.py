"""The paper's comparison on Fetch-Push with two cubes, from an empty folder (A.3.1).

``make fetch-push`` runs this: collect, fit, score, train and evaluate the arms side by
side, and report. ``python study.py quick=true`` is a smoke run of the same steps. What
is finished in the output folder is not done again, and what was killed goes on.
"""

from __future__ import annotations

import csv
import json
import logging
import shutil
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from collect import collect, rows_folder
from evaluate import evaluate, policy_steps
from omegaconf import DictConfig, OmegaConf
from score import score
from train import Arm, run_folder, train

from torchrl_caiac.experiments import (
    claim_folder,
    quick_settings,
    run_side_by_side,
    whole_file,
)
from torchrl_caiac.plotting import (
    bootstrap_interval,
    plot_learning_curves,
    plot_success,
)

MEASURES = ("full", "cube0", "cube1", "final")
_LOGGER = logging.getLogger(__name__)


def run(cfg: DictConfig, arm: Arm, seed: int) -> list[dict[str, Any]]:
    """Trains and evaluates one arm with one seed."""
    with claim_folder(run_folder(cfg, arm, seed)):
        train(cfg, arm, seed)
        return evaluate(cfg, arm, seed)


def write_csv(path: Path, results: Sequence[dict[str, Any]]) -> None:
    """Writes one line a policy."""
    with whole_file(path) as partial, partial.open("w", newline="") as file:
        names = ("fraction", "arm", "seed", "step", *MEASURES)
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(results)


def last_policies(cfg: DictConfig) -> list[int]:
    """The steps of the policies whose mean is a run's result."""
    return policy_steps(cfg)[-cfg.evaluate.last :]


def of_run(
    cfg: DictConfig, results: Sequence[dict[str, Any]], arm: str, measure: str
) -> list[float]:
    """An arm's results at the configured fraction, one a seed."""
    steps = last_policies(cfg)
    mine = [r for r in results if r["arm"] == arm and r["fraction"] == cfg.fraction]
    return [
        float(
            np.mean([r[measure] for r in mine if r["seed"] == s and r["step"] in steps])
        )
        for s in sorted({r["seed"] for r in mine})
    ]


def by_start(cfg: DictConfig, arm: Arm) -> np.ndarray:
    """An arm's full success from each start, mean over seeds and last policies."""
    return np.mean(
        [
            json.loads(
                (run_folder(cfg, arm, s) / "evaluation" / f"{step}.json").read_text()
            )["full"]
            for s, step in product(cfg.study.seeds, last_policies(cfg))
        ],
        axis=0,
    )


def report_table(
    cfg: DictConfig, influence: dict[str, Any], results: Sequence[dict[str, Any]]
) -> str:
    """The table of one fraction of the data."""
    lines = ["", f"{100 * cfg.fraction:g} % of the data", "", "influence, unseen data"]
    lines.append(f"  {'':<20}{'AUC':>7}{'TPR':>10}{'FPR':>14}{'best θ':>8}")
    lines += [
        f"  {f'{name}, {smoothing}':<20}{row['auc']:>7.3f}"
        f"{row['true_positive_rate']:>10.3f}"
        f"{row['false_positive_rate']:>14.3f}{row['best_threshold']:>8.3f}"
        for smoothing, entities in influence.items()
        for name, row in entities.items()
        if name != "gripper"
    ]
    steps = last_policies(cfg)
    lines += [
        "",
        f"success in {cfg.evaluate.episodes} episodes, mean of the policies from step "
        f"{steps[0]} to {steps[-1]}, 95 % interval over seeds",
        f"  {'':<14}" + "".join(f"{name:>22}" for name in MEASURES),
    ]
    for arm in cfg.study.arms:
        cells = []
        for measure in MEASURES:
            values = of_run(cfg, results, arm, measure)
            low, high = bootstrap_interval(values)
            cells.append(f"{np.mean(values):.3f} [{low:.3f}, {high:.3f}]")
        lines.append(f"  {arm:<14}" + "".join(f"{cell:>22}" for cell in cells))
    arms = list(cfg.study.arms)
    if "caiac" in arms:
        lines += ["", "full success of caiac minus that of, 95 % interval over starts"]
        own = by_start(cfg, "caiac")
        for arm in arms:
            if arm == "caiac":
                continue
            difference = own - by_start(cfg, arm)
            low, high = bootstrap_interval(difference)
            lines.append(
                f"  {arm:<14}{difference.mean():>+7.3f} [{low:.3f}, {high:.3f}]"
            )
    return "\n".join(lines) + "\n"


def draw_curves(cfg: DictConfig, results: Sequence[dict[str, Any]], path: Path) -> None:
    """Full success along training, of the policies that were evaluated."""
    steps = policy_steps(cfg)
    curves = {}
    for arm in cfg.study.arms:
        mine = {
            (r["seed"], r["step"]): r["full"]
            for r in results
            if r["arm"] == arm and r["fraction"] == cfg.fraction
        }
        curves[arm] = steps, [[mine[s, x] for x in steps] for s in cfg.study.seeds]
    figure = plot_learning_curves(
        curves, title=f"two cubes pushed, {100 * cfg.fraction:g} % of the data"
    )
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=150)


def run_study(cfg: DictConfig) -> str:
    """Runs all steps, writes the results and figures, and returns the table."""
    out = Path(cfg.out)
    parts = [
        OmegaConf.merge(cfg, {"fraction": float(fraction)})
        for fraction in cfg.study.fractions
    ]
    influence = []
    for part in parts:
        _LOGGER.info("collect, fit and score: %s", rows_folder(part))
        collect(part)
        influence.append(score(part))
    # All arms of a seed before the next one, so that they can be compared early.
    jobs = list(product(parts, cfg.study.arms, cfg.study.seeds))
    jobs.sort(key=lambda job: (job[2], parts.index(job[0])))
    finished: dict[int, list[dict[str, Any]]] = {}
    results: list[dict[str, Any]] = []
    for number, rows in run_side_by_side(run, jobs, processes=cfg.study.processes):
        part, arm, seed = jobs[number]
        _LOGGER.info("finished: %g %s %d", part.fraction, arm, seed)
        finished[number] = rows
        results = [row for n in sorted(finished) for row in finished[n]]
        write_csv(out / "fetch_push.csv", results)
    table = "".join(
        report_table(part, report, results)
        for part, report in zip(parts, influence, strict=True)
    )
    with whole_file(out / "fetch_push.txt") as partial:
        partial.write_text(table)
    files = ["fetch_push.csv", "fetch_push.txt", "fetch_push_success.png"]
    figure = plot_success(
        {
            arm: {
                f"{100 * part.fraction:g} % of the data": of_run(
                    part, results, arm, "full"
                )
                for part in parts
            }
            for arm in cfg.study.arms
        },
        title="two cubes pushed to their goals",
    )
    with whole_file(out / files[-1]) as partial:
        figure.savefig(partial, dpi=150)
    for part in parts:
        files.append(f"fetch_push_curves_{part.fraction:g}.png")
        draw_curves(part, results, out / files[-1])
    if cfg.study.publish is not None:
        for name in files:
            with whole_file(Path(cfg.study.publish) / name) as partial:
                shutil.copyfile(out / name, partial)
    return table


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Runs the study and prints its table."""
    cfg = quick_settings(cfg)
    torch.set_num_threads(1)
    with claim_folder(cfg.out):
        print(run_study(cfg))
    print(f"results and figures: {cfg.out}")


if __name__ == "__main__":
    main()
