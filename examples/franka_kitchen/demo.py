"""The paper's first result, from an empty folder (section 4.1, Fig. 3).

``make demo`` runs this: collect, fit, score, train the arms side by side, evaluate, and
report. ``python demo.py quick=true`` is a smoke run of the same steps. What is finished
in the output folder is not done again.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import hydra
import torch
from collect import collect
from evaluate import evaluate
from fit_world_model import fit
from omegaconf import DictConfig, OmegaConf
from score import score
from train import Arm, make_buffer, train

from torchrl_caiac import CAIACTransform
from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KITCHEN_TASKS, KitchenEnv, RenderingUnavailable
from torchrl_caiac.plotting import (
    bootstrap_interval,
    plot_frames,
    plot_influence,
    plot_success,
)

_LOGGER = logging.getLogger(__name__)
_SWAP_BATCHES = 50  # batches from which the share of swapped windows is taken


def run_arm(
    cfg: DictConfig, arm: Arm, seed: int, position: int
) -> tuple[list[dict[str, Any]], float, float]:
    """Trains and evaluates one arm with one seed; with the seconds that each took."""
    torch.set_num_threads(1)
    os.environ["TQDM_POSITION"] = str(position)
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
    rows = data["episode"] == data["episode"][data["task"] == 0][0]
    plot_influence(
        data["caiac", "score"][rows].numpy(),
        KitchenEnv.layout.names,
        truth=truth[rows].numpy(),
        threshold=cfg.score.threshold,
        exclude=["robot"],
        title="influence along a demonstration of the microwave",
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
    for task in ("microwave", "kettle"):
        own = data["episode"][data["task"] == KITCHEN_TASKS.index(task)]
        demonstration = (data["episode"] == own[0]).nonzero()
        row = demonstration[int(0.75 * len(demonstration))]
        donors = torch.randint(len(data), (512 - copies,))
        batch = transform(data[torch.cat([donors, row.expand(copies)])])
        made, shown = batch["observation"][-copies:], data["observation"][row]
        states += [shown[0], made[torch.cdist(made, shown).argmax()]]
        titles += [f"{task}, demonstration", f"{task}, counterfactual"]
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
    lines.append(f"  {'entity':<22}{'AUC':>7}{'influenced':>12}{'score <= theta':>16}")
    for name, row in influence.items():
        if name in KitchenEnv.layout.fixed:
            continue
        auc = "-" if row["auc"] != row["auc"] else f"{row['auc']:.3f}"
        lines.append(
            f"  {name:<22}{auc:>7}{row['influenced']:>12.1%}"
            f"{row['below_threshold']:>16.1%}"
        )
    lines += [
        "",
        f"windows with a swap: {share:.1%} (counterfactual are "
        f"{cfg.train.counterfactual_ratio:.0%})",
        "",
        "success over all objects, 95 % interval over episodes",
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
            f"  {arm:<8}{task:<12}{sum(solved) / len(solved):>6.2f} "
            f"[{low:.2f}, {high:.2f}] of {len(mine)}   wrong tasks done: "
            + (", ".join(f"{name} {count}" for name, count in wrong.items()) or "none")
        )
    lines += ["", "seconds a stage"]
    lines += [f"  {stage:<32}{value:>7.0f}" for stage, value in seconds.items()]
    return "\n".join(lines) + "\n"


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Runs all steps and reports."""
    if cfg.quick:
        cfg = OmegaConf.merge(cfg, cfg.quick_settings)
    torch.set_num_threads(1)
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
    with (
        stage("train and evaluate"),
        ProcessPoolExecutor(
            cfg.demo.processes, mp_context=multiprocessing.get_context("spawn")
        ) as pool,
    ):
        # Started in pairs of arms, so that each process has both kinds of work.
        runs = [
            pool.submit(run_arm, cfg, arm, seed, position)
            for seed, (position, arm) in product(
                cfg.demo.seeds, enumerate(cfg.demo.arms)
            )
        ]
        finished = [run.result() for run in runs]
    seconds["  of it training, a run"] = sum(f[1] for f in finished) / len(finished)
    seconds["  of it evaluation, a run"] = sum(f[2] for f in finished) / len(finished)
    results = [result for run in finished for result in run[0]]
    left_out = ""
    with stage("figures"):
        figures.mkdir(exist_ok=True)
        draw_influence(cfg, figures / "demo_influence.png")
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
            title="success over all objects, the cabinet is closed",
        ).savefig(figures / "demo_success.png", dpi=150)
        try:
            draw_counterfactuals(cfg, figures / "demo_counterfactuals.png")
        except RenderingUnavailable as error:
            left_out = f"left out: the counterfactual frames ({error})"
    table = report_table(cfg, influence, share_swapped(cfg), results, seconds)
    (Path(cfg.out) / "demo.txt").write_text(table)
    (Path(cfg.out) / "demo.json").write_text(
        json.dumps({"results": results, "seconds": seconds}, indent=1) + "\n"
    )
    print(table)
    print(f"figures: {figures}")
    if left_out:
        print(left_out)


if __name__ == "__main__":
    main()
