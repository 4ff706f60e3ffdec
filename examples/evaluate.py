"""Evaluates the saved policies of a run.

Run after ``train.py``: ``python evaluate.py method=caiac seed=0``.
"""

from __future__ import annotations

import logging
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from environments.base import Evaluation
from shared.console import progress_bar, start
from shared.parts import make_environment, policy_file, policy_steps, run_folder
from shared.settings import keep_settings
from torchrl_caiac._files import read_json, write_json
from torchrl_caiac.data.digests import file_digest
from train import check_run, load_policy

_LOGGER = logging.getLogger(__name__)


def evaluate(cfg: DictConfig, method: str, seed: int) -> list[Evaluation]:
    """Evaluates the saved policies of one run.

    The results are saved in ``evaluation/<step>.json``; existing ones are not repeated.
    They are refused if the run, or the policy, is another one by now.
    """
    environment = make_environment(cfg)
    folder = run_folder(cfg, method, seed) / "evaluation"
    kept: dict[str, Any] = OmegaConf.to_container(cfg.env.evaluate)
    for name in ("last", "curve_every"):  # which policies, not what they do
        kept.pop(name)
    kept["collect"] = OmegaConf.to_container(cfg.env.collect)  # has lengths of episodes
    keep_settings(folder, "evaluate", kept)
    check_run(cfg, method, seed)
    evaluations = []
    steps = policy_steps(cfg)
    bar = progress_bar(
        total=len(steps), desc=f"{folder.parent.name} plays", unit="policy"
    )
    with bar:
        for step in steps:
            path = folder / f"{step}.json"
            policy = policy_file(cfg, method, seed, step)
            if policy.exists():
                played = {"sha256": file_digest(policy)}
                keep_settings(folder, f"policy-{step}", played)
            if not path.exists():
                actor = load_policy(cfg, method, seed, step)
                write_json(path, environment.play(actor, seed, folder))
            fraction = float(cfg.env.get("fraction", 1.0))
            remedy = "delete it, to play the episodes again"
            episodes = read_json(path, "evaluation", remedy)
            evaluations.append(Evaluation(method, seed, step, fraction, episodes))
            bar.update()
    success = [episode[environment.success_key] for episode in evaluations[-1].episodes]
    _LOGGER.info(
        "%s: %d of %d episodes succeed", folder.parent.name, sum(success), len(success)
    )
    return evaluations


@hydra.main(version_base=None, config_path="conf", config_name="config")
def main(cfg: DictConfig) -> None:
    """Evaluates ``cfg.method`` with ``cfg.seed``."""
    for method in cfg.method:
        folder = run_folder(cfg, method, cfg.seed)
        with start(cfg, folder=folder) as console:
            with console.stage(f"{folder.name} plays"):
                evaluations = evaluate(cfg, method, cfg.seed)
            for line in make_environment(cfg).table(evaluations[-1:]):
                console.print(line)


if __name__ == "__main__":
    main()
