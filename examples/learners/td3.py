"""Offline TD3 with hindsight goals (paper, A.5.2)."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from learners.base import Learner
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.modules import (
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalFeatures,
)
from torchrl_caiac.objectives import GoalConditionedTD3Loss
from torchrl_caiac.transforms import HindsightGoal

__all__ = ["TD3"]

_STATISTICS_BATCHES = 100  # from which the features' mean and deviation are taken


class TD3(Learner):
    """TD3 on stored transitions; needs an environment with rewards of goals."""

    extendable = True

    def rows(self) -> TensorDictBase:
        """Returns the leaves that learning reads, in memory."""
        keys = [
            "observation",
            "desired_goal",
            "action",
            "episode",
            *[("next", k) for k in ("observation", "reward", "terminated", "done")],
            *([] if self.method.score_key is None else [self.method.score_key]),
        ]
        return self.environment.goal_rows().select(*keys).clone()

    def make_buffer(self, rows: TensorDictBase) -> TensorDictReplayBuffer:
        """Makes the buffer of transitions, counterfactuals, and hindsight goals.

        Without augmentation there are as many random goals as counterfactuals would
        have (A.5.2).
        """
        environment = self.environment
        if environment.reward_fn is None:
            raise ValueError(
                "learner=td3 needs rewards for goals, which "
                f"{type(environment).__name__} does not have: set its reward_fn, or "
                "choose another learner"
            )
        ratio = self.augmentation.counterfactual_ratio
        augmentation = self.method.transform(
            environment.layout, ratio, swap_prob=self.augmentation.swap_prob
        )
        goals = HindsightGoal(
            environment.layout,
            environment.reward_fn,
            random=0.5 * ratio if augmentation is None else 0.0,
        )
        rb = offline_buffer(
            rows,
            batch_size=self.settings.batch_size * self.settings.batches_at_once,
            sample_unit=goals,
        )
        if augmentation is not None:
            rb.append_transform(augmentation)
        rb.append_transform(goals)
        return rb

    def setup(self, rows: TensorDictBase, seed: int) -> None:
        """Makes policy and critics, with the statistics of some batches."""
        settings = self.settings
        for name in ("steps", "checkpoint_every"):
            if settings[name] % settings.batches_at_once:
                raise ValueError(
                    f"learner.{name} is {settings[name]}, expected a multiple of "
                    f"learner.batches_at_once, {settings.batches_at_once}: a run could "
                    "not resume in the middle of a sample"
                )
        torch.manual_seed(seed)
        self.rb = self.make_buffer(rows)
        features = self.make_features()
        # Before the networks are created: they copy it.
        features.fit_statistics(
            torch.cat(list(islice(self.batches(), _STATISTICS_BATCHES)))
        )
        torch.manual_seed(seed)  # all methods of a seed start with the same networks
        self.actor = self.make_actor(features)
        self.loss_module = GoalConditionedTD3Loss(
            self.actor,
            [
                GoalConditionedCritic(
                    self.actor.features,
                    self.environment.action_dim,
                    tuple(settings.hidden_sizes),
                    hidden_dtype=self._hidden_dtype(),
                )
                for _ in range(2)
            ],
            policy_noise=settings.policy_noise,
            noise_clip=settings.noise_clip,
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

    def make_features(self) -> GoalFeatures:
        """Creates the input of the networks, with relative positions and goals."""
        return GoalFeatures(
            self.environment.layout, reference=self.environment.goal_reference
        )

    def make_actor(self, features: GoalFeatures) -> GoalConditionedActor:
        """Returns the policy."""
        return GoalConditionedActor(
            features,
            self.environment.action_dim,
            tuple(self.settings.hidden_sizes),
            hidden_dtype=self._hidden_dtype(),
        )

    def _hidden_dtype(self) -> torch.dtype | None:
        name = self.settings.hidden_dtype
        return None if name == "float32" else getattr(torch, name)

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields batches, several from one sample, which saves time."""
        at_once = self.settings.batches_at_once
        while True:
            rows = self.rb.sample()
            # In strides: the last rows of a sample, and so of each, are counterfactual.
            yield from (rows[first::at_once] for first in range(at_once))

    def step(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """Takes a step of the critics, and every ``policy_delay``-th of the policy."""
        loss, values = self.loss_module.value_loss(batch)
        _descend(self.optimizers["critic_optimizer"], loss)
        scalars = {
            "loss_qvalue": loss.detach(),
            "q": values["pred_value"].mean(),
            "target": values["target_value"].mean(),
            "share_reward_0": (batch["next", "reward"] == 0).float().mean(),
            "share_relabeled": batch["hindsight", "relabeled"].float().mean(),
        }
        if step % self.settings.policy_delay == 0:
            loss, _ = self.loss_module.actor_loss(batch)
            _descend(self.optimizers["actor_optimizer"], loss)
            self.updater.step()
        return scalars | self.share_swapped(batch)

    def policy_state(self) -> dict[str, Any]:
        """Returns the state of the policy."""
        return self.actor.state_dict()

    def load_policy(self, state: dict[str, Any]) -> GoalConditionedActor:
        """Returns the policy."""
        actor = self.make_actor(self.make_features())
        actor.load_state_dict(state)
        return actor.eval()


def _descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
