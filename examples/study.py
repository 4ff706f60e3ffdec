"""Runs all steps for several methods and seeds, from an empty folder, and reports.

``python study.py study=demo`` is the motivating experiment in the kitchen,
``study=fetch_push`` offline reinforcement learning; ``size=quick`` makes either a smoke
run. Finished steps are skipped, interrupted ones resume.
"""

from __future__ import annotations

import csv
import math
import shutil
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from collect import collect
from environments.base import Evaluation
from evaluate import evaluate
from fit import fit
from score import score
from shared.console import Console, log_in_process, start
from shared.parts import (
    last_policies,
    make_environment,
    make_learner,
    make_methods,
    policy_steps,
    run_folder,
)
from torchrl_caiac._files import claim_folder, whole_file, write_json
from torchrl_caiac._processes import run_in_processes
from torchrl_caiac.plotting import plot_learning_curves, plot_success
from train import train

_SWAP_BATCHES = 50  # batches from which the share of swaps is taken


def run(
    cfg: DictConfig, method: str, seed: int
) -> tuple[list[Evaluation], float, float]:
    """Trains and evaluates one method with one seed, and times both in seconds."""
    log_in_process()
    with claim_folder(run_folder(cfg, method, seed)):
        begin = time.perf_counter()
        train(cfg, method, seed)
        trained = time.perf_counter()
        evaluations = evaluate(cfg, method, seed)
    return evaluations, trained - begin, time.perf_counter() - trained


def share_swapped(cfg: DictConfig, method: str) -> float:
    """Returns the share of sampled rows in which an entity is swapped."""
    learner = make_learner(cfg, method)
    rb = learner.make_buffer(learner.rows())
    torch.manual_seed(0)
    swapped = [rb.sample()["caiac", "swapped"].any(-1) for _ in range(_SWAP_BATCHES)]
    return torch.stack(swapped).float().mean().item()


def result_rows(
    cfg: DictConfig, evaluations: Sequence[Evaluation]
) -> list[dict[str, Any]]:
    """Returns the table of results, one or several rows per policy."""
    environment = make_environment(cfg)
    return [
        {
            "fraction": evaluation.fraction,
            "method": evaluation.method,
            "seed": evaluation.seed,
            "step": evaluation.step,
            **row,
        }
        for evaluation in evaluations
        for row in environment.results(evaluation)
    ]


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Writes the table of results."""
    with whole_file(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def influence_table(cfg: DictConfig, report: dict[str, Any]) -> list[str]:
    """Reports how well the scores find what the action moves, on unseen data."""
    lines = [
        "influence on unseen data",
        f"  {'':<22}{'AUC':>7}{'influenced':>12}{'score <= θ':>12}"
        f"{'true positive':>15}{'false positive':>16}{'best θ':>9}",
    ]
    fixed = make_environment(cfg).layout.fixed
    for smoothing, entities in report.items():
        if len(report) > 1:
            lines.append(f"  {smoothing}")
        for name, row in entities.items():
            if name in fixed:
                continue
            rates = ("true_positive_rate", "false_positive_rate")
            cells = [
                _number(row["auc"], ".3f"),
                *(_number(row[k], ".1%") for k in ("influenced", "below_threshold")),
                *(_number(row[k], ".1%") for k in rates),
                _number(row["best_threshold"], ".3f"),
            ]
            widths = (7, 12, 12, 15, 16, 9)
            lines.append(
                f"  {name:<22}"
                + "".join(f"{cell:>{n}}" for cell, n in zip(cells, widths, strict=True))
            )
    return lines


def _number(value: float, form: str) -> str:
    # NaN where nothing, or everything, is influenced.
    return "-" if math.isnan(value) else f"{value:{form}}"


def report_table(
    cfg: DictConfig,
    influence: dict[str, Any],
    swapped: dict[str, float],
    evaluations: Sequence[Evaluation],
) -> str:
    """Returns the table of one fraction of the data."""
    lines = []
    if "fraction" in cfg.env:
        lines += [f"{100 * cfg.env.fraction:g} % of the data", ""]
    lines += [*influence_table(cfg, influence), ""]
    if swapped:
        shares = ", ".join(f"{name} {share:.1%}" for name, share in swapped.items())
        ratio = cfg.env.augmentation.counterfactual_ratio
        lines += [
            f"rows with a swap: {shares} (counterfactual: {ratio:.0%})",
            "",
        ]
    steps = last_policies(cfg)
    lines += make_environment(cfg).table([e for e in evaluations if e.step in steps])
    return "\n".join(lines) + "\n"


def method_labels(cfg: DictConfig) -> dict[str, str]:
    """Returns the names of the methods in figures."""
    # A method that extends another one does not take over its label.
    labels = {
        name: vars(type(method)).get("label", "")
        for name, method in make_methods(cfg).items()
    }
    return {name: label for name, label in labels.items() if label}


def draw_curves(cfg: DictConfig, evaluations: Sequence[Evaluation], path: Path) -> None:
    """Draws success along training, of the policies that were evaluated."""
    steps, key = policy_steps(cfg), make_environment(cfg).success_key
    success = {
        (e.method, e.seed, e.step): float(np.mean([p[key] for p in e.episodes]))
        for e in evaluations
    }
    curves = {
        method: (
            steps,
            [[success[method, s, step] for step in steps] for s in cfg.study.seeds],
        )
        for method in cfg.method
    }
    title = cfg.study.title
    if "fraction" in cfg.env:
        title = f"{title}, {100 * cfg.env.fraction:g} % of the data"
    figure = plot_learning_curves(curves, labels=method_labels(cfg), title=title)
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=150)


def draw_success(
    cfg: DictConfig, evaluations: Sequence[Evaluation], path: Path
) -> None:
    """Draws the success of all methods."""
    environment, steps = make_environment(cfg), last_policies(cfg)
    bars = {
        method: environment.bars(
            [e for e in evaluations if e.method == method and e.step in steps]
        )
        for method in cfg.method
    }
    figure = plot_success(bars, labels=method_labels(cfg), title=cfg.study.title)
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=150)


def parts_of(cfg: DictConfig) -> list[DictConfig]:
    """Returns the configurations of all fractions of the data."""
    if cfg.study.fractions is None:
        return [cfg]
    return [
        OmegaConf.merge(cfg, {"env": {"fraction": float(fraction)}})
        for fraction in cfg.study.fractions
    ]


def run_study(cfg: DictConfig, console: Console) -> None:
    """Runs all steps, writes the results and figures, and prints them."""
    out, name, parts = Path(cfg.out), cfg.study.name, parts_of(cfg)
    figures = out / "figures"
    figures.mkdir(exist_ok=True)
    with console.stage(make_environment(cfg).data_name):
        for part in parts:
            collect(part)
    with console.stage("world model"):
        for part in parts:
            fit(part)
    with console.stage("scores"):
        influence = [score(part) for part in parts]
    # All methods of a seed before the next one, so that they can be compared early.
    jobs = list(product(parts, cfg.method, cfg.study.seeds))
    jobs.sort(key=lambda job: (job[2], parts.index(job[0])))
    finished: dict[int, tuple[list[Evaluation], float, float]] = {}
    evaluations: list[Evaluation] = []
    with console.stage(f"training and evaluation, {len(jobs)} runs"):
        for number, result in run_in_processes(
            run, jobs, processes=cfg.study.processes
        ):
            finished[number] = result
            evaluations = [e for n in sorted(finished) for e in finished[n][0]]
            write_csv(out / f"{name}.csv", result_rows(cfg, evaluations))
    remarks, tables = [], []
    with console.stage("figures"):
        files = [figures / f"{name}_success.png"]
        draw_success(cfg, evaluations, files[0])
        for part, report in zip(parts, influence, strict=True):
            fraction = float(part.env.get("fraction", 1.0))
            mine = [e for e in evaluations if e.fraction == fraction]
            if len(policy_steps(part)) > 1:
                files.append(figures / f"{name}_curves_{fraction:g}.png")
                draw_curves(part, mine, files[-1])
            swapped = {
                method: share_swapped(part, method)
                for method, parts_ in make_methods(part).items()
                if parts_.score_key is not None
            }
            tables.append(report_table(part, report, swapped, mine))
        environment = make_environment(cfg)
        threshold = cfg.env.augmentation.threshold
        remarks += environment.draw(figures, name, threshold=threshold)
    with whole_file(out / f"{name}.txt") as partial:
        partial.write_text("\n".join(tables))
    seconds = {
        **console.seconds,
        "training, a run": np.mean([run[1] for run in finished.values()]).item(),
        "evaluation, a run": np.mean([run[2] for run in finished.values()]).item(),
    }
    write_json(
        out / f"{name}.json",
        {
            "influence": influence[0],
            "results": result_rows(cfg, evaluations),
            "seconds": seconds,
        },
    )
    if cfg.study.publish is not None:
        for file in (*(out / f"{name}.{kind}" for kind in ("csv", "txt")), *files):
            with whole_file(Path(cfg.study.publish) / file.name) as partial:
                shutil.copyfile(file, partial)
    console.print("\n" + "\n".join(tables))
    for remark in remarks:
        console.print(remark)
    console.print(f"results: {out / name}.txt, .csv, .json; figures: {figures}")
    last = set(last_policies(cfg))
    console.print(environment.answer([e for e in evaluations if e.step in last]))


@hydra.main(version_base=None, config_path="conf", config_name="config")
def main(cfg: DictConfig) -> None:
    """Runs the study."""
    with start(cfg, stages=5) as console:
        run_study(cfg, console)


if __name__ == "__main__":
    main()
