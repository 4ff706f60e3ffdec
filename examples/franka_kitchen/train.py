"""Trains goal-conditioned Latent Motor Plans on the demonstrations (paper, A.5.1).

Run after ``score.py``: ``python train.py arm=caiac seed=0``. A run that was killed goes
on at its last checkpoint and ends as one that was not.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.data import (
    ImmutableDatasetWriter,
    SliceSampler,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.record.loggers import get_logger
from tqdm.auto import tqdm

from torchrl_caiac import CAIACTransform, CoDATransform
from torchrl_caiac.checkpoint import TrainingCheckpoint
from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KitchenEnv
from torchrl_caiac.experiments import (
    bar_position,
    keep_settings,
)
from torchrl_caiac.modules import LMPModel
from torchrl_caiac.objectives import LMPLoss
from torchrl_caiac.transforms import WindowGoal

Arm = Literal["caiac", "coda", "coda_action", "none", "oracle"]

_LOGGER = logging.getLogger(__name__)


def make_buffer(
    data: TensorDictBase, cfg: DictConfig, arm: Arm
) -> TensorDictReplayBuffer:
    """The replay buffer of an arm: windows, their goals, and counterfactuals."""
    settings = cfg.train
    goals = WindowGoal(
        KitchenEnv.layout,
        window=settings.window,
        mixture=dict(settings.goals),
        p=settings.goal_p,
    )
    rb = TensorDictReplayBuffer(
        storage=TensorStorage(data),
        sampler=SliceSampler(
            slice_len=settings.window, traj_key="episode", cache_values=True
        ),
        writer=ImmutableDatasetWriter(),
        sample_unit=goals,
        batch_size=settings.windows * settings.window,
    )
    rb.append_transform(goals)
    options = {
        "counterfactual_ratio": settings.counterfactual_ratio,
        "swap_prob": settings.swap_prob,
        "window": settings.window,
    }
    if arm == "coda":
        rb.append_transform(
            CoDATransform(KitchenEnv.layout, cfg.coda.threshold, **options)
        )
    elif arm != "none":
        threshold, key = {
            "caiac": (cfg.score.threshold, ("caiac", "score")),
            "coda_action": (cfg.coda.threshold, ("coda", "action")),
            # The truth is 0 or 1, a score of CAI in nats, one of attention a share.
            "oracle": (0.5, ("oracle", "score")),
        }[arm]
        rb.append_transform(
            CAIACTransform(KitchenEnv.layout, threshold, score_key=key, **options)
        )
    return rb


def make_model(cfg: DictConfig) -> LMPModel:
    """The model of Latent Motor Plans for the kitchen."""
    layout = KitchenEnv.layout
    return LMPModel(
        observation_dim=sum(layout.widths().values()),
        goal_dim=layout.goal_width,
        action_dim=9,
        window=cfg.train.window,
        plan_dim=cfg.train.plan_dim,
        hidden_size=cfg.train.hidden_size,
        decoder=cfg.train.decoder,
        observation_floor=cfg.train.observation_floor,
        goal_floor=cfg.train.observation_floor,
    )


def run_folder(cfg: DictConfig, arm: Arm, seed: int) -> Path:
    """Where a training run keeps its checkpoint, its log and its results."""
    return Path(cfg.out) / "runs" / f"{arm}-seed{seed}"


def train(cfg: DictConfig, arm: Arm, seed: int) -> LMPModel:
    """Trains one arm with one seed, or loads it where that has been done."""
    settings = cfg.train
    folder = run_folder(cfg, arm, seed)
    keep_settings(settings, folder / "train.json")
    torch.manual_seed(seed)
    data = load_transitions(Path(cfg.out) / "demonstrations")
    model = make_model(cfg)
    goals = KitchenEnv.layout.achieved_goal(data, next=True)
    model.fit_statistics(data, goals=goals)
    # What rests in all demonstrations is left out: its weights would stay as they were
    # drawn, and other values of it at test time disturb everything.
    for norm, values in (
        (model.observation_norm, data["observation"]),
        (model.goal_norm, goals),
    ):
        norm.ignore(values.std(0) < settings.resting)
    loss_module = LMPLoss(
        model,
        kl_weight=settings.kl_weight,
        reconstruction_weight=settings.reconstruction_weight,
    )
    optimizer = torch.optim.Adam(model.parameters(), lr=settings.lr, fused=True)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.steps)
    rb = make_buffer(data, cfg, arm)
    checkpoint = TrainingCheckpoint(
        folder / "checkpoint.zip",
        model=model,
        optimizer=optimizer,
        scheduler=scheduler,
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
    swapped = torch.zeros(())
    model.train()
    # Denormal numbers slow the LSTM's backward pass down; MuJoCo shall have them.
    torch.set_flush_denormal(True)
    try:
        while step < settings.steps:
            batch = rb.sample()
            losses = loss_module(batch.reshape(-1, settings.window))
            loss = losses["loss_reconstruction"] + losses["loss_kl"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            scheduler.step()
            step += 1
            bar.update()
            if arm != "none":
                # Rows of a window share their flags.
                any_swap = batch["caiac", "swapped"].any(-1)
                swapped += any_swap.float().mean()
            if step % settings.log_every == 0:
                scalars = {key: value.item() for key, value in losses.items()}
                scalars["share_swapped"] = swapped.item() / settings.log_every
                swapped.zero_()
                for key, value in scalars.items():
                    logger.log_scalar(key, value, step=step)
                bar.set_postfix(loss=f"{loss.item():.3f}")
            if step % settings.checkpoint_every == 0 or step == settings.steps:
                checkpoint.save(step)
    finally:
        torch.set_flush_denormal(False)
    bar.close()
    return model.eval()


@hydra.main(version_base=None, config_path=".", config_name="config")
def main(cfg: DictConfig) -> None:
    """Trains ``cfg.arm`` with ``cfg.seed``."""
    torch.set_num_threads(1)
    train(cfg, cfg.arm, cfg.seed)


if __name__ == "__main__":
    main()
