"""Trains a learner on the data of an environment, augmented by a method.

Run after ``score.py``: ``python train.py method=caiac seed=0`` trains with all methods
that are given, one after another. An interrupted run resumes at its last checkpoint and
ends with the same weights as one that was not interrupted.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig

from learners.base import Learner
from shared.console import progress_bar, start
from shared.log import ScalarLog
from shared.parts import check_learner, make_learner, policy_file, run_folder
from shared.settings import check_settings, keep_settings
from torchrl_caiac._files import read_json, whole_file, write_json
from torchrl_caiac.checkpoint import TrainingCheckpoint

_LOGGER = logging.getLogger(__name__)


def train(cfg: DictConfig, method: str, seed: int) -> Learner:
    """Trains with one method and one seed, or loads a finished run."""
    settings = cfg.learner
    folder = run_folder(cfg, method, seed)
    learner = make_learner(cfg, method)
    kept = learner.kept_settings(seed)
    if (folder / "train.json").exists():
        check_settings(folder, "train", kept)
    learner.setup(learner.rows(), seed)
    keep_settings(folder, "train", kept)  # of a run that can begin
    log = ScalarLog(settings.logger, folder)
    checkpoint = TrainingCheckpoint(
        folder / "checkpoint.zip", settings=kept, log=log, **learner.parts
    )
    step = checkpoint.load()
    log.resume(step)
    if step:
        _LOGGER.info("%s resumes at step %d", folder.name, step)
    before, begin = train_seconds(folder) if step else 0.0, time.process_time()
    batches = learner.batches()
    bar = progress_bar(
        total=settings.steps, initial=step, desc=folder.name, unit="step"
    )
    # Denormal numbers slow networks down; MuJoCo needs them.
    torch.set_flush_denormal(True)
    try:
        while step < settings.steps:
            step += 1
            log.add(learner.step(next(batches), step))
            bar.update()
            if step % settings.log_every == 0:
                log.write(step)
            if step % (settings.keep_every or settings.steps) == 0:
                with whole_file(policy_file(cfg, method, seed, step)) as partial:
                    torch.save(learner.policy_state(), partial)
            if step % settings.checkpoint_every == 0 or step == settings.steps:
                checkpoint.save(step)
                seconds = before + time.process_time() - begin
                write_json(folder / "seconds.json", {"seconds": seconds})
    finally:
        torch.set_flush_denormal(False)
        bar.close()
    return learner


def train_seconds(folder: Path) -> float:
    """Returns the processor time that the training of a run has taken so far."""
    path = folder / "seconds.json"
    if not path.exists():  # killed right after its first checkpoint
        return 0.0
    return float(read_json(path, "time of a training", "delete it")["seconds"])


def check_run(cfg: DictConfig, method: str, seed: int) -> None:
    """Raises if a run was not begun, or with other settings, data or scores."""
    kept = make_learner(cfg, method).kept_settings(seed)
    check_settings(run_folder(cfg, method, seed), "train", kept)


def load_policy(cfg: DictConfig, method: str, seed: int, step: int) -> Any:
    """Returns the policy of a run after some steps.

    Raises:
        FileNotFoundError: the run has not come so far.
        ValueError: the run has other settings or data, or the file is damaged.
    """
    check_run(cfg, method, seed)
    path = policy_file(cfg, method, seed, step)
    learner = make_learner(cfg, method)
    try:
        return learner.load_policy(torch.load(path, weights_only=True))
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(
            f"{path} is not a readable policy of this training, it may be truncated or "
            f"of another one ({error}): delete the run's folder to train from scratch"
        ) from error


@hydra.main(version_base=None, config_path="conf", config_name="config")
def main(cfg: DictConfig) -> None:
    """Trains with ``cfg.method`` and ``cfg.seed``."""
    for method in cfg.method:
        check_learner(cfg, method)
    for method in cfg.method:
        folder = run_folder(cfg, method, cfg.seed)
        with start(cfg, folder=folder) as console, console.stage(folder.name):
            train(cfg, method, cfg.seed)


if __name__ == "__main__":
    main()
