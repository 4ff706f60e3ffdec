"""Collects the demonstrations and the random actions, as Minari datasets (A.6.1, A.7).

``python collect.py``; a collection that was killed goes on where it stopped.
``experiment=all_tasks`` collects chains of tasks instead of single ones.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import hydra
from minari import MinariDataset
from omegaconf import DictConfig, OmegaConf

from torchrl_caiac.envs.kitchen import (
    DEMONSTRATIONS_ID,
    MICROWAVE_KETTLE,
    PLAY_ID,
    RANDOM_ID,
    create_kitchen_demonstrations,
    create_kitchen_play,
    create_kitchen_random,
    kitchen_transitions,
)
from torchrl_caiac.experiments import keep_settings


def create(cfg: DictConfig, dataset_id: str, episodes: int, seed: int) -> MinariDataset:
    """Collects as many demonstrations a task, or a chain of tasks."""
    options: dict[str, Any] = {
        "root": Path(cfg.out) / "minari",
        "work": Path(cfg.out) / "work",
        "seed": seed,
        "workers": cfg.collect.workers,
        "overwrite": True,
    }
    if cfg.collect.chains:
        return create_kitchen_play(dataset_id, episodes=episodes, **options)[0]
    groups = [dataclasses.replace(g, episodes=episodes) for g in MICROWAVE_KETTLE]
    return create_kitchen_demonstrations(dataset_id, demonstrations=groups, **options)[
        0
    ]


def collect(cfg: DictConfig) -> None:
    """Makes what is missing of the three datasets, and their rows for TorchRL.

    ``demonstrations`` and ``random`` are learnt from; ``held_out`` are demonstrations
    with other seeds, which only check the scores.
    """
    settings = cfg.collect
    out = Path(cfg.out)
    kept: dict[str, Any] = OmegaConf.to_container(settings)
    kept.pop("workers")  # changes no result
    keep_settings(kept, out / "collect.json")
    demonstrations = PLAY_ID if settings.chains else DEMONSTRATIONS_ID
    for name, dataset_id, episodes, seed in (
        ("demonstrations", demonstrations, settings.episodes, settings.seed),
        ("held_out", "kitchen/held-out-v0", settings.held_out, settings.seed + 1),
    ):
        if not (out / name).exists():
            dataset = create(cfg, dataset_id, episodes, seed)
            kitchen_transitions(dataset, out / name)
    if not (out / "random").exists():
        dataset = create_kitchen_random(
            demonstrations,
            RANDOM_ID,
            ratio=settings.random_ratio,
            root=out / "minari",
            work=out / "work",
            seed=settings.seed,
            workers=settings.workers,
            overwrite=True,
        )
        kitchen_transitions(dataset, out / "random")


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Collects the data."""
    collect(cfg)


if __name__ == "__main__":
    main()
