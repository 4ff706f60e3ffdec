"""Goal-conditioned diffusion policy on chunks of actions (Chi et al. 2023)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated

import torch
from pydantic import Field
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from tensordict.utils import NestedKey
from torch import nn
from torchrl.envs import ActionChunkTransform
from torchrl.modules import MLP, DiffusionActor
from torchrl.objectives import DiffusionBCLoss

from learners.bc import BC
from learners.chunks import ChunkActor
from learners.settings import BelowOne, Count
from torchrl_caiac.modules import GoalFeatures

__all__ = ["DiffusionBC"]

_FREQUENCIES = 8  # sines and cosines that describe a step of the diffusion


class ScoreNetwork(nn.Module):
    """Predicts the noise in a chunk from ``[chunk, features, step]``.

    The features are encoded apart from the chunk, whose noise would disturb them.

    Args:
        features (int): the number of features.
        chunk (int): the number of values in a chunk.
        hidden_sizes (list of int): widths of the hidden layers of encoder and decoder,
            two at least.
        steps (int): of the diffusion.
    """

    def __init__(
        self, features: int, chunk: int, hidden_sizes: list[int], steps: int
    ) -> None:
        super().__init__()
        self.chunk = chunk
        self.steps = steps
        first, *rest = hidden_sizes
        options = {"num_cells": rest, "activation_class": nn.SiLU}
        self.features = MLP(features, first, **options)
        self.noisy = nn.Linear(chunk + 2 * _FREQUENCIES, first)
        self.noise = nn.Sequential(nn.SiLU(), MLP(first, chunk, **options))

    def forward(self, value: torch.Tensor) -> torch.Tensor:
        """Returns the noise, ``[*B, chunk]``."""
        chunk, features, step = value.tensor_split((self.chunk, -1), -1)
        powers = torch.arange(_FREQUENCIES, dtype=value.dtype, device=value.device)
        angle = 0.5 * math.pi * step / self.steps * 2.0**powers
        noisy = self.noisy(torch.cat([chunk, angle.sin(), angle.cos()], -1))
        noise: torch.Tensor = self.noise(self.features(features) + noisy)
        return noise


class DiffusionBC(BC):
    """Makes chunks of actions by diffusion; plays the first actions of each.

    A row is the first state of a window with the actions of the whole window. All rows
    of a window are swapped together, so the method's rule holds for the whole chunk.
    """

    class Settings(BC.Settings):
        """What the settings may be."""

        chunk: Count
        execute: Count
        sample: bool
        diffusion_steps: Count
        beta_start: BelowOne
        beta_end: BelowOne
        hidden_sizes: Annotated[list[Count], Field(min_length=2)]

    actor: ChunkActor

    def check(self, further: int = 0) -> None:
        """Raises if a setting is wrong; see the base class."""
        super().check(further)
        settings = self.settings
        if settings.execute > settings.chunk:
            raise ValueError(
                f"learner.execute is {settings.execute}, expected at most "
                f"learner.chunk, {settings.chunk}, the actions that are made at once"
            )

    @property
    def window(self) -> int:
        """The number of actions in a chunk."""
        return int(self.settings.chunk)

    def make_actor(
        self, features: GoalFeatures, action_key: NestedKey = "action"
    ) -> ChunkActor:
        """Returns the policy, which carries its chunk from step to step."""
        settings, action_dim = self.settings, self.environment.action_dim
        width = self.window * action_dim
        diffusion = DiffusionActor(
            width,
            score_network=ScoreNetwork(
                features.width,
                width,
                list(settings.hidden_sizes),
                settings.diffusion_steps,
            ),
            num_steps=settings.diffusion_steps,
            beta_start=settings.beta_start,
            beta_end=settings.beta_end,
            in_keys=features.out_keys,
            out_keys=["chunk"],
        )
        return ChunkActor(
            TensorDictSequential(features, diffusion),
            size=self.window,
            execute=settings.execute,
            action_dim=action_dim,
            sample=settings.sample,
        )

    def make_loss(self) -> DiffusionBCLoss:
        """Returns the loss of the noise that is predicted."""
        self.features, diffusion = self.actor.policy
        loss = DiffusionBCLoss(diffusion)
        loss.set_keys(observation="features", action="chunk")
        return loss

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields the first rows of windows, with the actions of the whole windows."""
        chunks = ActionChunkTransform(self.window, chunk_key="chunk")
        while True:
            windows = self.rb.sample().reshape(-1, self.window)
            actions = chunks(windows.select("action", ("next", "done")))["chunk"]
            rows = windows[:, 0].set("chunk", actions[:, 0].flatten(-2))
            yield from self.split(rows)

    def step(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """Takes one step of Adam."""
        return super().step(self.features(batch), step)
