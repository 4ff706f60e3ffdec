"""Trains TD3 with hindsight goals on the stored rows, offline (paper, A.5.2).

Run after ``score.py``: ``python train.py arm=caiac seed=0``. A run that was killed goes
on at its last checkpoint and ends as one that was not; one that is whole goes on where
``train.steps`` is raised.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import hydra
import torch
from collect import load_rows, rows_folder
from fit_world_model import LAYOUT
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate
from torchrl.record.loggers import get_logger
from tqdm.auto import tqdm

from torchrl_caiac import CAIACTransform, CoDATransform
from torchrl_caiac.checkpoint import TrainingCheckpoint
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.envs import fetch_push_reward
from torchrl_caiac.experiments import (
    bar_position,
    claim_folder,
    keep_settings,
    whole_file,
)
from torchrl_caiac.modules import (
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalFeatures,
)
from torchrl_caiac.objectives import GoalConditionedTD3Loss
from torchrl_caiac.transforms import HindsightGoal

Arm = Literal["caiac", "coda", "coda_action", "relabel_only", "none", "oracle"]
# The leaf of the rows that an arm takes its scores from.
SCORE_KEYS = {
    "caiac": ("caiac", "score"),
    "coda": ("coda", "graph"),
    "coda_action": ("coda", "action"),
    "relabel_only": ("caiac", "score"),
    "oracle": ("oracle", "score"),
}

_STATISTICS_BATCHES = 100  # from which the features' mean and deviation are taken
_LOGGER = logging.getLogger(__name__)


def training_rows(data: TensorDictBase, arm: Arm) -> TensorDictBase:
    """The leaves that learning reads, in memory."""
    keys = [
        "observation",
        "desired_goal",
        "action",
        "episode",
        *[("next", k) for k in ("observation", "reward", "terminated", "done")],
        *([SCORE_KEYS[arm]] if arm in SCORE_KEYS else []),
    ]
    return data.select(*keys).clone()


def make_buffer(
    data: TensorDictBase, cfg: DictConfig, arm: Arm
) -> TensorDictReplayBuffer:
    """The replay buffer of an arm: rows, counterfactuals, and hindsight goals.

    ``relabel_only`` has the goals and rewards of ``caiac`` for the same share of rows,
    but swaps nothing; ``none`` has as many random goals (A.5.2).
    """
    goals = HindsightGoal(
        LAYOUT,
        fetch_push_reward,
        random=0.5 * cfg.train.counterfactual_ratio if arm == "none" else 0.0,
    )
    rb = offline_buffer(
        data,
        batch_size=cfg.train.batch_size * cfg.train.batches_at_once,
        sample_unit=goals,
    )
    ratio = cfg.train.counterfactual_ratio
    if arm == "coda":
        rb.append_transform(CoDATransform(LAYOUT, cfg.coda.threshold, ratio))
    elif arm != "none":
        # The truth is 0 or 1, a score of CAI in nats, one of attention a share.
        thresholds = {"oracle": 0.5, "coda_action": cfg.coda.threshold}
        rb.append_transform(
            CAIACTransform(
                LAYOUT,
                thresholds.get(arm, cfg.score.threshold),
                ratio,
                swap_prob=0.0 if arm == "relabel_only" else 1.0,
                score_key=SCORE_KEYS[arm],
            )
        )
    rb.append_transform(goals)
    return rb


def batches(rb: TensorDictReplayBuffer, at_once: int) -> Iterator[TensorDictBase]:
    """Batches without end, several of which are one sample, which saves time."""
    while True:
        rows = rb.sample()
        # In strides: the last rows of a sample, and so of each, are counterfactual.
        yield from (rows[first::at_once] for first in range(at_once))


def make_features() -> GoalFeatures:
    """What the networks read: positions relative to the gripper and the goals too."""
    return GoalFeatures(LAYOUT, reference="gripper")


def make_actor(cfg: DictConfig, features: GoalFeatures) -> GoalConditionedActor:
    """The policy."""
    return GoalConditionedActor(
        features,
        4,
        tuple(cfg.train.hidden_sizes),
        hidden_dtype=_hidden_dtype(cfg),
    )


def make_loss(cfg: DictConfig, actor: GoalConditionedActor) -> GoalConditionedTD3Loss:
    """The loss of a policy and two new critics."""
    settings = cfg.train
    loss_module = GoalConditionedTD3Loss(
        actor,
        [
            GoalConditionedCritic(
                actor.features,
                4,
                tuple(settings.hidden_sizes),
                hidden_dtype=_hidden_dtype(cfg),
            )
            for _ in range(2)
        ],
        policy_noise=settings.policy_noise,
        noise_clip=settings.noise_clip,
    )
    loss_module.make_value_estimator(gamma=settings.gamma)
    return loss_module


def _hidden_dtype(cfg: DictConfig) -> torch.dtype | None:
    name = cfg.train.hidden_dtype
    return None if name == "float32" else getattr(torch, name)


def run_folder(cfg: DictConfig, arm: Arm, seed: int) -> Path:
    """Where a training run keeps its checkpoint, policies, log and results."""
    return rows_folder(cfg) / "runs" / f"{arm}-seed{seed}"


def policy_file(cfg: DictConfig, arm: Arm, seed: int, step: int) -> Path:
    """Where the policy after some steps is kept."""
    return run_folder(cfg, arm, seed) / "policies" / f"{step}.pt"


def load_policy(
    cfg: DictConfig, arm: Arm, seed: int, step: int
) -> GoalConditionedActor:
    """The policy after some steps."""
    path = policy_file(cfg, arm, seed, step)
    actor = make_actor(cfg, make_features())
    try:
        actor.load_state_dict(torch.load(path, weights_only=True))
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(
            f"{path} is no readable policy of this training, it may be truncated or "
            f"foreign ({error}): delete the run's folder to begin anew"
        ) from error
    return actor.eval()


def train(cfg: DictConfig, arm: Arm, seed: int) -> GoalConditionedTD3Loss:
    """Trains one arm with one seed, or loads it where that has been done."""
    settings = cfg.train
    for name in ("steps", "checkpoint_every"):
        if settings[name] % settings.batches_at_once:
            raise ValueError(
                f"train.{name} is {settings[name]}, wanted a multiple of "
                f"train.batches_at_once, {settings.batches_at_once}: a run could not "
                "go on in the middle of a sample"
            )
    folder = run_folder(cfg, arm, seed)
    kept: dict[str, Any] = OmegaConf.to_container(settings)
    kept.pop("steps")
    keep_settings(kept, folder / "train.json")
    torch.manual_seed(seed)
    rb = make_buffer(training_rows(load_rows(cfg), arm), cfg, arm)
    features = make_features()
    # Before the networks are made: they copy it.
    features.fit_statistics(
        torch.cat(
            list(islice(batches(rb, settings.batches_at_once), _STATISTICS_BATCHES))
        )
    )
    torch.manual_seed(seed)  # all arms of a seed begin with the same networks
    actor = make_actor(cfg, features)
    loss_module = make_loss(cfg, actor)
    updater = SoftUpdate(loss_module, tau=settings.tau)
    optimizers = {
        name: torch.optim.Adam(
            params.flatten_keys().values(), lr=settings.lr, fused=True
        )
        for name, params in (
            ("actor_optimizer", loss_module.actor_network_params),
            ("critic_optimizer", loss_module.qvalue_network_params),
        )
    }
    checkpoint = TrainingCheckpoint(
        folder / "checkpoint.zip", loss=loss_module, **optimizers
    )
    step = checkpoint.load()
    if step:
        _LOGGER.info("%s goes on at step %d", folder.name, step)
    logger = get_logger(settings.logger, str(folder), "log")
    bar = tqdm(
        total=settings.steps,
        initial=step,
        desc=folder.name,
        unit="step",
        mininterval=5,
        position=bar_position(),
    )
    stream = batches(rb, settings.batches_at_once)
    sums: dict[str, torch.Tensor] = {}
    summed = 0  # fewer than log_every after going on between two logs
    # Denormal numbers slow the networks down; MuJoCo shall have them.
    torch.set_flush_denormal(True)
    try:
        while step < settings.steps:
            batch = next(stream)
            loss, values = loss_module.value_loss(batch)
            _descend(optimizers["critic_optimizer"], loss)
            step += 1
            scalars = {
                "loss_qvalue": loss.detach(),
                "q": values["pred_value"].mean(),
                "target": values["target_value"].mean(),
                "share_reward_0": (batch["next", "reward"] == 0).float().mean(),
                "share_relabeled": batch["hindsight", "relabeled"].float().mean(),
            }
            if arm != "none":
                swapped = batch["caiac", "swapped"].any(-1)
                scalars["share_swapped"] = swapped.float().mean()
            if step % settings.policy_delay == 0:
                loss, values = loss_module.actor_loss(batch)
                _descend(optimizers["actor_optimizer"], loss)
                updater.step()
            for key, value in scalars.items():
                sums[key] = sums.get(key, 0.0) + value
            summed += 1
            bar.update()
            if step % settings.log_every == 0:
                for key, value in sums.items():
                    logger.log_scalar(key, value.item() / summed, step=step)
                sums, summed = {}, 0
            if step % settings.keep_every == 0:
                path = policy_file(cfg, arm, seed, step)
                with whole_file(path) as partial:
                    torch.save(actor.state_dict(), partial)
            if step % settings.checkpoint_every == 0 or step == settings.steps:
                checkpoint.save(step)
    finally:
        torch.set_flush_denormal(False)
    bar.close()
    return loss_module


def _descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Trains ``cfg.arm`` with ``cfg.seed``."""
    torch.set_num_threads(1)
    with claim_folder(run_folder(cfg, cfg.arm, cfg.seed)):
        train(cfg, cfg.arm, cfg.seed)


if __name__ == "__main__":
    main()
