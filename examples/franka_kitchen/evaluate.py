"""Asks a trained agent for each task, from the default start or from random ones.

Run after ``train.py``: ``python evaluate.py arm=caiac seed=0``. Success means that
*all* objects are where the goal wants them (paper, A.6.1).
"""

from __future__ import annotations

import gc
import json
import logging
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import SerialEnv, TransformedEnv
from tqdm.auto import tqdm
from train import Arm, run_folder, train

from torchrl_caiac.envs import KITCHEN_TASKS, KitchenEnv, make_kitchen_env
from torchrl_caiac.experiments import bar_position, write_json
from torchrl_caiac.modules import LMPActor, LMPModel
from torchrl_caiac.plotting import plot_frames

_LOGGER = logging.getLogger(__name__)


def evaluate_task(
    model: LMPModel,
    task: str,
    *,
    start: str,
    episodes: int,
    seed: int,
    strips: int,
    folder: Path,
) -> list[dict[str, Any]]:
    """Plays episodes of one task side by side; one result an episode."""
    torch.manual_seed(seed)
    threads = torch.get_num_threads()
    actor = LMPActor(model)
    base = SerialEnv(episodes, partial(make_kitchen_env, task, start=start))
    env = TransformedEnv(base, actor.make_tensordict_primer())
    env.set_seed(seed)
    try:
        with torch.no_grad():
            rollout = env.rollout(10_000, actor, break_when_all_done=True)
    finally:
        env.close()
        # TorchRL gives torch more threads when environments close, and processes side
        # by side then wait for each other's.
        torch.set_num_threads(threads)
        # A kitchen holds 60 MB that Python's collector does not know of.
        del env, base
        gc.collect()
    after = rollout["next"]
    results = []
    for number in range(episodes):
        done = after["done"][number, :, 0].nonzero()
        length = int(done[0]) + 1
        wrong = after["wrong_tasks"][number, length - 1]
        results.append(
            {
                "task": task,
                "episode": number,
                "success": bool(after["success"][number, length - 1]),
                "task_success": bool(after["task_success"][number, :length].any()),
                "wrong_tasks": [
                    name
                    for name, was_done in zip(KITCHEN_TASKS, wrong, strict=True)
                    if was_done
                ],
                "steps": length,
            }
        )
        if number < strips:
            shown = torch.linspace(0, length - 1, 6).round().long()
            kitchen = KitchenEnv(task, render_mode="rgb_array")
            try:
                frames = kitchen.render_states(
                    after["observation"][number, shown].numpy()
                )
            finally:
                kitchen.close()
            figure = plot_frames(frames, [f"step {int(i) + 1}" for i in shown])
            figure.savefig(
                folder / f"{task}-{number}.png", dpi=150, bbox_inches="tight"
            )
    return results


def evaluate(cfg: DictConfig, arm: Arm, seed: int) -> list[dict[str, Any]]:
    """Evaluates one trained arm on all tasks; writes ``evaluation.json`` beside it.

    What is there with the same settings is not done again.
    """
    model = train(cfg, arm, seed)
    folder = run_folder(cfg, arm, seed)
    path = folder / "evaluation.json"
    settings = OmegaConf.to_container(cfg.evaluate)
    if path.exists():
        kept = json.loads(path.read_text())
        if kept["settings"] == settings:
            return kept["results"]
    results: list[dict[str, Any]] = []
    bar = tqdm(
        cfg.evaluate.tasks,
        desc=f"{folder.name} plays",
        unit="task",
        position=bar_position(),
    )
    for task in bar:
        results += evaluate_task(
            model,
            task,
            start=cfg.evaluate.start,
            episodes=cfg.evaluate.episodes,
            seed=cfg.evaluate.seed + seed,
            strips=cfg.evaluate.strips,
            folder=folder,
        )
    for result in results:
        result |= {"arm": arm, "seed": seed}
    write_json(path, {"settings": settings, "results": results})
    for task in cfg.evaluate.tasks:
        mine = [result for result in results if result["task"] == task]
        _LOGGER.info(
            "%s: %s solved in %.0f %%, its own object right in %.0f %%",
            folder.name,
            task,
            *(
                100 * sum(result[key] for result in mine) / len(mine)
                for key in ("success", "task_success")
            ),
        )
    return results


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Evaluates ``cfg.arm`` with ``cfg.seed``."""
    torch.set_num_threads(1)
    evaluate(cfg, cfg.arm, cfg.seed)


if __name__ == "__main__":
    main()
