"""Collects the data of an environment, as Minari datasets and as transitions.

``python collect.py env=kitchen``. An interrupted collection resumes where it stopped.
"""

from __future__ import annotations

from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from shared.console import progress, start
from shared.parts import make_environment
from shared.settings import keep_settings
from torchrl_caiac.data import verify_digests


def collect(cfg: DictConfig) -> None:
    """Collects what is missing, and verifies the digests of all data."""
    environment = make_environment(cfg)
    kept: dict[str, Any] = OmegaConf.to_container(cfg.env.collect)
    keep_settings(environment.out, "collect", kept)
    environment.collect(progress=progress())
    for file in sorted(environment.out.rglob("digests.json")):
        verify_digests(file.parent)


@hydra.main(version_base=None, config_path="conf", config_name="config")
def main(cfg: DictConfig) -> None:
    """Collects the data."""
    with start(cfg) as console, console.stage("data"):
        collect(cfg)


if __name__ == "__main__":
    main()
