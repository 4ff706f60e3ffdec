"""Evaluates the saved policies of a run.

Run after ``train.py``: ``python evaluate.py method=caiac seed=0``. Every policy that is
kept plays from validation starts. The best one plays from the test starts, whose
results are those of the run.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from typing import Any

import hydra
import numpy as np
from omegaconf import DictConfig, OmegaConf

from environments.base import Evaluation
from environments.playing import Split
from shared.console import progress_bar, start
from shared.parts import (
    candidates,
    check_learner,
    make_environment,
    policy_file,
    run_folder,
)
from shared.settings import keep_settings
from torchrl_caiac._files import read_json, write_json
from torchrl_caiac.data.digests import file_digest
from train import check_run, load_policy

_LOGGER = logging.getLogger(__name__)


def evaluate(cfg: DictConfig, method: str, seed: int) -> list[Evaluation]:
    """Returns all of :func:`evaluations`."""
    return list(evaluations(cfg, method, seed))


def evaluations(cfg: DictConfig, method: str, seed: int) -> Iterator[Evaluation]:
    """Evaluates the policies of a run: all on validation starts, then the best one.

    A run with one policy has nothing to choose, and is not validated. Of policies that
    are equally good, the last one counts.

    The episodes are saved in ``<split>-<step>.json``; existing ones are not repeated.
    They are refused if the run, or the policy, is another one by now.

    Yields:
        Evaluation: the last one has the split ``"test"``.
    """
    key, steps = make_environment(cfg).success_key, candidates(cfg)
    best, success = steps[-1], -1.0
    if len(steps) > 1:
        name = run_folder(cfg, method, seed).name
        with progress_bar(total=len(steps), desc=f"{name} plays", unit="policy") as bar:
            for step in steps:
                evaluation = play(cfg, method, seed, step, "validation")
                share = float(np.mean([e[key] for e in evaluation.episodes]))
                if share >= success:
                    best, success = step, share
                bar.update()
                yield evaluation
    yield play(cfg, method, seed, best, "test")


def play(
    cfg: DictConfig, method: str, seed: int, step: int, split: Split
) -> Evaluation:
    """Returns the episodes of a policy, which are played if they have not been."""
    environment = make_environment(cfg)
    folder = run_folder(cfg, method, seed) / cfg.evaluations
    kept: dict[str, Any] = OmegaConf.to_container(cfg.env.evaluate)
    kept.pop("strips", None)  # figures
    kept["collect"] = OmegaConf.to_container(cfg.env.collect)  # has lengths of episodes
    keep_settings(folder, "evaluate", kept)
    check_run(cfg, method, seed)
    path = folder / f"{split}-{step}.json"
    policy = policy_file(cfg, method, seed, step)
    if policy.exists():
        keep_settings(folder, f"policy-{step}", {"sha256": file_digest(policy)})
    if not path.exists():
        actor = load_policy(cfg, method, seed, step)
        begin = time.process_time()
        episodes = environment.play(actor, seed, folder, split=split)
        seconds = time.process_time() - begin
        write_json(path, {"seconds": seconds, "episodes": episodes})
    found = read_json(path, "evaluation", "delete it, to play the episodes again")
    success = [episode[environment.success_key] for episode in found["episodes"]]
    _LOGGER.info(
        "%s, step %d: %d of %d %s episodes succeed",
        *(folder.parent.name, step, sum(success), len(success), split),
    )
    return Evaluation(method, seed, step, split, found["seconds"], found["episodes"])


@hydra.main(version_base=None, config_path="conf", config_name="config")
def main(cfg: DictConfig) -> None:
    """Evaluates ``cfg.method`` with ``cfg.seed``."""
    for method in cfg.method:
        check_learner(cfg, method)
    for method in cfg.method:
        folder = run_folder(cfg, method, cfg.seed)
        with start(cfg, folder=folder) as console:
            with console.stage(f"{folder.name} plays"):
                *_, best = evaluate(cfg, method, cfg.seed)
            for row in make_environment(cfg).measures(best.episodes):
                console.print(
                    f"{method}, step {best.step}, {row['task']}, {row['measure']}: "
                    f"{row['value']:.3f} of {row['episodes']} episodes"
                )


if __name__ == "__main__":
    main()
