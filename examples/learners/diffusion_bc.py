"""Goal-conditioned diffusion policy on chunks of actions (Chi et al. 2023)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from tensordict.utils import NestedKey
from torch import nn
from torchrl.envs import ActionChunkTransform
from torchrl.modules import MLP, DiffusionActor
from torchrl.objectives import DiffusionBCLoss

from learners.bc import BC
from learners.chunks import ChunkActor
from torchrl_caiac.modules import GoalFeatures

__all__ = ["DiffusionBC"]

_FREQUENCIES = 8  # sines and cosines that describe a step of the diffusion


class ScoreNetwork(nn.Module):
    """Predicts the noise in a chunk from ``[chunk, features, step]``.

    Args:
        features (int): the number of features.
        chunk (int): the number of values in a chunk.
        hidden_sizes (list of int): widths of the hidden layers.
        steps (int): of the diffusion.
    """

    def __init__(
        self, features: int, chunk: int, hidden_sizes: list[int], steps: int
    ) -> None:
        super().__init__()
        self.steps = steps
        self.network = MLP(
            chunk + features + 2 * _FREQUENCIES,
            chunk,
            num_cells=hidden_sizes,
            activation_class=nn.SiLU,
        )

    def forward(self, value: torch.Tensor) -> torch.Tensor:
        """Returns the noise, ``[*B, chunk]``."""
        rest, step = value[..., :-1], value[..., -1:]
        powers = torch.arange(_FREQUENCIES, dtype=value.dtype, device=value.device)
        angle = 0.5 * math.pi * step / self.steps * 2.0**powers
        noise: torch.Tensor = self.network(
            torch.cat([rest, angle.sin(), angle.cos()], -1)
        )
        return noise


class DiffusionBC(BC):
    """Draws chunks of actions by diffusion; plays the first actions of each.

    A row is the first state of a window with the actions of the whole window. All rows
    of a window are swapped together, so the method's rule holds for the whole chunk.
    """

    actor: ChunkActor  # type: ignore[assignment]

    @property
    def window(self) -> int:  # type: ignore[override]
        """The number of actions in a chunk."""
        return int(self.settings.chunk)

    def make_actor(  # type: ignore[override]
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
        at_once = self.settings.batches_at_once
        while True:
            windows = self.rb.sample().reshape(-1, self.window)
            actions = chunks(windows.select("action", ("next", "done")))["chunk"]
            rows = windows[:, 0].set("chunk", actions[:, 0].flatten(-2))
            yield from (rows[first::at_once] for first in range(at_once))

    def step(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """Takes one step of Adam."""
        return super().step(self.features(batch), step)
