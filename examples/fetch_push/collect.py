"""Collects the expert's and the random episodes, as Minari datasets (A.6.2).

``python collect.py``; a collection that was killed goes on where it stopped.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict

from torchrl_caiac.data import (
    load_minari,
    load_transitions,
    mix_trajectories,
)
from torchrl_caiac.envs import create_fetch_push_expert, create_fetch_push_random
from torchrl_caiac.experiments import claim_folder, keep_settings

MAKERS = {"expert": create_fetch_push_expert, "random": create_fetch_push_random}


def collect(cfg: DictConfig) -> None:
    """Makes what is missing of the datasets, their rows, and the rows to learn from.

    ``held_out`` are episodes with other seeds, which only check the scores.
    """
    settings = cfg.collect
    out = Path(cfg.out)
    kept: dict[str, Any] = OmegaConf.to_container(settings)
    kept.pop("workers")  # changes no result
    keep_settings(kept, out / "collect.json")
    total = settings.expert + settings.random
    shares = [settings.expert / total, settings.random / total]
    held_out = round(settings.held_out * shares[0])
    parts = {
        "expert": (settings.expert, settings.seed),
        "random": (settings.random, settings.seed + 1),
        "held_out_expert": (held_out, settings.seed + 2),
        "held_out_random": (settings.held_out - held_out, settings.seed + 3),
    }
    for name, (episodes, seed) in parts.items():
        if (out / name).exists():
            continue
        dataset = MAKERS[name.removeprefix("held_out_")](
            f"fetch-push-2/{name.replace('_', '-')}-v0",
            episodes=episodes,
            steps=settings.steps,
            root=out / "minari",
            work=out / "work",
            seed=seed,
            workers=settings.workers,
            overwrite=True,
        )
        load_minari(dataset, out / name, infos=["simulator"])
    for path, names, fraction in (
        (rows_folder(cfg) / "rows", ("expert", "random"), cfg.fraction),
        (out / "held_out", ("held_out_expert", "held_out_random"), 1.0),
    ):
        if not path.exists():
            mix_trajectories(
                [load_transitions(out / name) for name in names],
                shares=shares if fraction < 1 else None,
                fraction=fraction,
                seed=settings.seed,
                path=path,
            )


def rows_folder(cfg: DictConfig) -> Path:
    """Where the rows to learn from lie, and all that is made of them."""
    return Path(cfg.out) / f"fraction-{cfg.fraction:g}"


def load_rows(cfg: DictConfig) -> TensorDict:
    """The rows to learn from, ``[T]``, memory-mapped."""
    return load_transitions(rows_folder(cfg) / "rows")


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Collects the data."""
    with claim_folder(cfg.out):
        collect(cfg)


if __name__ == "__main__":
    main()
