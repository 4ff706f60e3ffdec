"""Plays kept policies from fresh starts, the same for all arms (paper, A.6.2).

Run after ``train.py``: ``python evaluate.py arm=caiac seed=0``. As in the paper an
episode is a success when the goals are reached at any of its steps.
"""

from __future__ import annotations

import json
import logging
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from tqdm.auto import tqdm
from train import Arm, load_policy, run_folder

from torchrl_caiac.envs import FetchPushCubes
from torchrl_caiac.experiments import (
    bar_position,
    claim_folder,
    keep_settings,
    write_json,
)
from torchrl_caiac.modules import GoalConditionedActor

_LOGGER = logging.getLogger(__name__)


def policy_steps(cfg: DictConfig) -> list[int]:
    """The training steps after which policies are evaluated."""
    every, last = cfg.train.keep_every, cfg.train.steps
    kept = range(every, last + 1, every)
    if not kept:
        raise ValueError(
            f"train.steps is {last}, wanted at least train.keep_every, {every}: no "
            "policy is kept"
        )
    result = set(kept[-cfg.evaluate.last :])
    return sorted(result | {s for s in kept if s % cfg.evaluate.curve_every == 0})


def play(
    actor: GoalConditionedActor, *, episodes: int, steps: int, seed: int
) -> dict[str, list[bool]]:
    """Plays episodes side by side, from the starts that the seed gives.

    Returns:
        for each episode whether all cubes were at their goals at some step (``full``)
        and at the last one (``final``), and whether each cube was at some step.
    """
    envs = [FetchPushCubes(2, max_episode_steps=steps) for _ in range(episodes)]
    states = [env.reset(seed=seed + i)[0] for i, env in enumerate(envs)]
    reached = np.zeros((steps, episodes, 2), dtype=np.bool_)
    keys = actor.in_keys
    for step in range(steps):
        inputs = {k: torch.from_numpy(np.stack([s[k] for s in states])) for k in keys}
        with torch.no_grad():
            actions = actor(TensorDict(inputs, [episodes]))["action"].numpy()
        for i, env in enumerate(envs):
            states[i], _, _, _, info = env.step(actions[i])
            reached[step, i] = info["cube_success"]
    for env in envs:
        env.close()
    together = reached.all(-1)
    return {
        "full": together.any(0).tolist(),
        "cube0": reached[..., 0].any(0).tolist(),
        "cube1": reached[..., 1].any(0).tolist(),
        "final": together[-1].tolist(),
    }


def evaluate(cfg: DictConfig, arm: Arm, seed: int) -> list[dict[str, Any]]:
    """Evaluates the kept policies of one run; one result a policy.

    What each episode came to is kept beside the run, ``evaluation/<step>.json``.
    """
    settings = cfg.evaluate
    folder = run_folder(cfg, arm, seed) / "evaluation"
    kept = {"episodes": settings.episodes, "seed": settings.seed}
    keep_settings(kept, folder / "evaluate.json")
    results = []
    for step in tqdm(
        policy_steps(cfg),
        desc=f"{folder.parent.name} plays",
        unit="policy",
        position=bar_position(),
    ):
        path = folder / f"{step}.json"
        if not path.exists():
            episodes = play(
                load_policy(cfg, arm, seed, step),
                episodes=settings.episodes,
                steps=cfg.collect.steps,
                seed=settings.seed,
            )
            write_json(path, episodes)
        episodes = json.loads(path.read_text())
        shares = {name: float(np.mean(values)) for name, values in episodes.items()}
        results.append(
            {
                "fraction": float(cfg.fraction),
                "arm": arm,
                "seed": seed,
                "step": step,
                **shares,
            }
        )
    _LOGGER.info("%s: %s", folder.parent.name, results[-1])
    return results


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Evaluates ``cfg.arm`` with ``cfg.seed``."""
    torch.set_num_threads(1)
    with claim_folder(run_folder(cfg, cfg.arm, cfg.seed)):
        evaluate(cfg, cfg.arm, cfg.seed)


if __name__ == "__main__":
    main()
