"""Offline TD3 with hindsight goals (paper, A.5.2)."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.objectives import SoftUpdate

from learners.goal_conditioned import descend
from learners.hindsight import HindsightLearner
from learners.settings import Count, NotNegative
from torchrl_caiac.modules import GoalConditionedCritic
from torchrl_caiac.objectives import GoalConditionedTD3Loss

__all__ = ["TD3"]


class TD3(HindsightLearner):
    """TD3 on stored transitions; needs an environment with rewards of goals."""

    class Settings(HindsightLearner.Settings):
        """What the settings may be."""

        policy_delay: Count
        policy_noise: NotNegative
        noise_clip: NotNegative

    def setup(self, rows: TensorDictBase, seed: int) -> None:
        """Makes policy and critics, with the statistics of some batches."""
        settings = self.settings
        features = self.start(rows, seed)
        self.actor = self.make_actor(features)
        self.loss_module = GoalConditionedTD3Loss(
            self.actor,
            [
                GoalConditionedCritic(
                    self.actor.features,
                    self.environment.action_dim,
                    tuple(settings.hidden_sizes),
                    hidden_dtype=self.hidden_dtype,
                    layer_norm=settings.get("layer_norm", False),
                )
                for _ in range(2)
            ],
            policy_noise=settings.policy_noise,
            noise_clip=settings.noise_clip,
            **self.loss_options(),
        )
        self.loss_module.make_value_estimator(gamma=settings.gamma)
        self.updater = SoftUpdate(self.loss_module, tau=settings.tau)
        self.optimizers = {
            name: torch.optim.Adam(
                params.flatten_keys().values(), lr=settings.lr, fused=True
            )
            for name, params in (
                ("actor_optimizer", self.loss_module.actor_network_params),
                ("critic_optimizer", self.loss_module.qvalue_network_params),
            )
        }
        self.parts = {"loss": self.loss_module, **self.optimizers}

    def loss_options(self) -> dict[str, Any]:
        """Returns further arguments of the loss."""
        return {}

    def step(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """Takes a step of the critics, and every ``policy_delay``-th of the policy."""
        loss, values = self.loss_module.value_loss(batch)
        descend(self.optimizers["critic_optimizer"], loss)
        scalars = {
            "loss_qvalue": loss.detach(),
            "q": values["pred_value"].mean(),
            "target": values["target_value"].mean(),
            "share_reward_0": (batch["next", "reward"] == 0).float().mean(),
            "share_relabeled": batch["hindsight", "relabeled"].float().mean(),
        }
        if step % self.settings.policy_delay == 0:
            loss, policy = self.loss_module.actor_loss(batch)
            descend(self.optimizers["actor_optimizer"], loss)
            self.updater.step()
            if "bc_loss" in policy:
                scalars["loss_bc"] = policy["bc_loss"]
        return scalars | self.share_swapped(batch)
