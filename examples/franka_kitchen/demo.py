"""The paper's kitchens, from an empty folder (sections 4.1 and A.2.1, Fig. 3 and 6).

``make demo`` runs the motivating experiment: collect, fit, score, train the arms side
by side, evaluate, and report. ``python demo.py experiment=all_tasks`` does so with
chains of tasks and all tasks asked for; with ``quick=true`` either is a smoke run. What
is finished in the output folder is not done again.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import hydra
import torch
from collect import collect
from evaluate import evaluate
from fit_world_model import fit
from omegaconf import DictConfig
from score import score
from train import Arm, make_buffer, train

from torchrl_caiac import CAIACTransform
from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KITCHEN_TASKS, KitchenEnv, RenderingUnavailable
from torchrl_caiac.experiments import (
    claim_folder,
    quick_settings,
    run_side_by_side,
    write_json,
)
from torchrl_caiac.plotting import (
    bootstrap_interval,
    plot_frames,
    plot_influence,
    plot_success,
)

_LOGGER = logging.getLogger(__name__)
_SWAP_BATCHES = 50  # batches from which the share of swapped windows is taken


def run_arm(
    cfg: DictConfig, arm: Arm, seed: int
) -> tuple[list[dict[str, Any]], float, float]:
    """Trains and evaluates one arm with one seed; with the seconds that each took."""
    start = time.perf_counter()
    train(cfg, arm, seed)
    trained = time.perf_counter()
    results = evaluate(cfg, arm, seed)
    return results, trained - start, time.perf_counter() - trained


def share_swapped(cfg: DictConfig) -> float:
    """The share of all sampled windows in which at least one entity is swapped."""
    rb = make_buffer(load_transitions(Path(cfg.out) / "demonstrations"), cfg, "caiac")
    torch.manual_seed(0)
    swapped = [rb.sample()["caiac", "swapped"].any(-1) for _ in range(_SWAP_BATCHES)]
    return torch.stack(swapped).float().mean().item()


def draw_influence(cfg: DictConfig, path: Path) -> None:
    """Fig. 6: the influence on every entity along a held-out demonstration."""
    data = load_transitions(Path(cfg.out) / "held_out")
    truth = torch.load(Path(cfg.out) / "held_out_truth.pt", weights_only=True)
    rows = data["episode"] == cfg.demo.influence_episode
    tasks = data["task"][rows].unique_consecutive()
    names = dict.fromkeys(KITCHEN_TASKS[task] for task in tasks if task >= 0)
    plot_influence(
        data["caiac", "score"][rows].numpy(),
        KitchenEnv.layout.names,
        ground_truth=truth[rows].numpy(),
        threshold=cfg.score.threshold,
        exclude=["robot"],
        title="influence along a demonstration:\n" + ", ".join(names).replace("_", " "),
    ).savefig(path, dpi=150)


def draw_counterfactuals(cfg: DictConfig, path: Path) -> None:
    """Fig. 1: a frame of a demonstration of each task beside a counterfactual of it."""
    data = load_transitions(Path(cfg.out) / "demonstrations")
    torch.manual_seed(0)
    copies = 64
    transform = CAIACTransform(
        KitchenEnv.layout,
        threshold=cfg.score.threshold,
        counterfactual_ratio=copies / 512,
    )
    states, titles = [], []
    for task in cfg.demo.frames:
        own = data["task"] == KITCHEN_TASKS.index(task)
        first = data["episode"][own][0]
        demonstration = (own & (data["episode"] == first)).nonzero()
        row = demonstration[int(0.75 * len(demonstration))]
        donors = torch.randint(len(data), (512 - copies,))
        batch = transform(data[torch.cat([donors, row.expand(copies)])])
        made, shown = batch["observation"][-copies:], data["observation"][row]
        states += [shown[0], made[torch.cdist(made, shown).argmax()]]
        name = task.replace("_", " ")
        titles += [f"{name}, demonstration", f"{name}, counterfactual"]
    kitchen = KitchenEnv(render_mode="rgb_array")
    try:
        frames = kitchen.render_states(torch.stack(states).numpy())
    finally:
        kitchen.close()
    plot_frames(frames, titles).savefig(path, dpi=150, bbox_inches="tight")


def report_table(
    cfg: DictConfig,
    influence: dict[str, Any],
    share: float,
    results: list[dict[str, Any]],
    seconds: dict[str, float],
) -> str:
    """The table that the demo prints."""
    lines = ["", "influence on unseen demonstrations"]
    lines.append(
        f"  {'entity':<22}{'AUC':>7}{'influenced':>12}{'score <= theta':>16}"
        f"{'FNR':>10}{'FPR':>10}"
    )
    for name, row in influence.items():
        if name in KitchenEnv.layout.fixed:
            continue
        auc, missed = (
            # There is neither where nothing influences the entity.
            ("-", "-")
            if math.isnan(row["auc"])
            else (f"{row['auc']:.3f}", f"{1 - row['true_positive_rate']:.1%}")
        )
        lines.append(
            f"  {name:<22}{auc:>7}{row['influenced']:>12.1%}"
            f"{row['below_threshold']:>16.1%}{missed:>10}"
            f"{row['false_positive_rate']:>10.1%}"
        )
    lines += [
        "",
        f"windows with a swap: {share:.1%} (counterfactual are "
        f"{cfg.train.counterfactual_ratio:.0%})",
        "",
        "success over all objects, 95 % interval over episodes; over the task's own",
    ]
    for arm, task in product(cfg.demo.arms, cfg.evaluate.tasks):
        mine = [r for r in results if r["arm"] == arm and r["task"] == task]
        solved = [float(r["success"]) for r in mine]
        low, high = bootstrap_interval(solved)
        wrong = {
            name: count
            for name in KITCHEN_TASKS
            if (count := sum(name in r["wrong_tasks"] for r in mine))
        }
        lines.append(
            f"  {arm:<13}{task:<15}{sum(solved) / len(solved):>6.2f} "
            f"[{low:.2f}, {high:.2f}] of {len(mine)}; "
            f"{sum(r['task_success'] for r in mine) / len(mine):.2f}   "
            "wrong tasks done: "
            + (", ".join(f"{name} {count}" for name, count in wrong.items()) or "none")
        )
    lines += ["", "seconds a stage"]
    lines += [f"  {stage:<32}{value:>7.0f}" for stage, value in seconds.items()]
    return "\n".join(lines) + "\n"


def run_demo(cfg: DictConfig) -> None:
    """Runs all steps and reports."""
    seconds: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        _LOGGER.info("%s", name)
        start = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - start

    figures = Path(cfg.out) / "figures"
    with stage("collect"):
        collect(cfg)
    with stage("fit the world model"):
        fit(cfg)
    with stage("score, and ask the simulator"):
        influence = score(cfg)
    with stage("train and evaluate"):
        # Started in pairs of arms, so that each process has both kinds of work.
        jobs = [
            (cfg, arm, seed) for seed, arm in product(cfg.demo.seeds, cfg.demo.arms)
        ]
        by_job = dict(run_side_by_side(run_arm, jobs, processes=cfg.demo.processes))
        finished = [by_job[i] for i in range(len(jobs))]
    seconds["  of it training, a run"] = sum(f[1] for f in finished) / len(finished)
    seconds["  of it evaluation, a run"] = sum(f[2] for f in finished) / len(finished)
    results = [result for run in finished for result in run[0]]
    left_out = ""
    with stage("figures"):
        figures.mkdir(exist_ok=True)
        draw_influence(cfg, figures / f"{cfg.name}_influence.png")
        plot_success(
            {
                arm: {
                    task: [
                        float(r["success"])
                        for r in results
                        if r["arm"] == arm and r["task"] == task
                    ]
                    for task in cfg.evaluate.tasks
                }
                for arm in cfg.demo.arms
            },
            title=cfg.title,
        ).savefig(figures / f"{cfg.name}_success.png", dpi=150)
        try:
            draw_counterfactuals(cfg, figures / f"{cfg.name}_counterfactuals.png")
        except RenderingUnavailable as error:
            left_out = f"left out: the counterfactual frames ({error})"
    table = report_table(cfg, influence, share_swapped(cfg), results, seconds)
    (Path(cfg.out) / f"{cfg.name}.txt").write_text(table)
    write_json(
        Path(cfg.out) / f"{cfg.name}.json",
        {"influence": influence, "results": results, "seconds": seconds},
    )
    print(table)
    print(f"figures: {figures}")
    if left_out:
        print(left_out)


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Runs the demo, in a folder of its own."""
    cfg = quick_settings(cfg)
    torch.set_num_threads(1)
    with claim_folder(cfg.out):
        run_demo(cfg)


if __name__ == "__main__":
    main()
