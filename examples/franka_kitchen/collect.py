"""Collects the demonstrations and the random actions, as Minari datasets (A.6.1, A.7).

``python collect.py``; a collection that was killed goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import hydra
from omegaconf import DictConfig
from settings import keep_settings

from torchrl_caiac.data import (
    create_kitchen_demonstrations,
    create_kitchen_random,
    kitchen_transitions,
)
from torchrl_caiac.data.kitchen_datasets import (
    DEMONSTRATIONS_ID,
    MICROWAVE_KETTLE,
    RANDOM_ID,
)


def collect(cfg: DictConfig) -> None:
    """Makes what is missing of the three datasets, and their rows for TorchRL.

    ``demonstrations`` and ``random`` are learnt from; ``held_out`` are demonstrations
    with other seeds, which only check the scores.
    """
    keep_settings(cfg, "collect")
    settings = cfg.collect
    out = Path(cfg.out)
    root, work = out / "minari", out / "work"
    for name, dataset_id, episodes, seed in (
        ("demonstrations", DEMONSTRATIONS_ID, settings.episodes, settings.seed),
        ("held_out", "kitchen/held-out-v0", settings.held_out, settings.seed + 1),
    ):
        if (out / name).exists():
            continue
        dataset, _ = create_kitchen_demonstrations(
            dataset_id,
            demonstrations=[
                dataclasses.replace(group, episodes=episodes)
                for group in MICROWAVE_KETTLE
            ],
            root=root,
            work=work,
            seed=seed,
            workers=settings.workers,
            overwrite=True,
        )
        kitchen_transitions(dataset, out / name)
    if not (out / "random").exists():
        dataset = create_kitchen_random(
            DEMONSTRATIONS_ID,
            RANDOM_ID,
            ratio=settings.random_ratio,
            root=root,
            work=work,
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
