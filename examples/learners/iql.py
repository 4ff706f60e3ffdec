"""Implicit Q-learning with hindsight goals."""

from __future__ import annotations

import json
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torchrl.data import TensorDictReplayBuffer
from torchrl.modules import IndependentNormal
from torchrl.objectives import IQLLoss, SoftUpdate

from learners.goal_conditioned import descend
from learners.hindsight import HindsightLearner
from learners.imitation import future_goals, imitation_buffer
from learners.settings import BelowOne, Count, NotNegative, Positive
from torchrl_caiac.modules import GoalConditionedCritic, GoalConditionedValue
from torchrl_caiac.transforms import TransformKeys
from torchrl_caiac.transforms.rewards import GoalLeaves, goal_vectors

__all__ = ["IQL"]


class IQL(HindsightLearner):
    """IQL on stored transitions; needs an environment with rewards of goals.

    The policy is a normal distribution of constant width around a bounded action: under
    a squashed one, actions at their bounds, as experts prefer them, are infinitely
    unlikely.
    """

    class Settings(HindsightLearner.Settings):
        """What the settings may be."""

        future_goals: Any
        expectile: BelowOne
        temperature: NotNegative
        deviation: Positive
        decay_steps: Count | None

    def check(self, further: int = 0) -> None:
        """Raises if a setting is wrong; see the base class."""
        super().check(further)
        settings = self.settings
        steps = settings.steps + further
        decay = settings.decay_steps
        if decay is not None and decay < steps:
            raise ValueError(
                f"learner.decay_steps is {decay}, expected null or at least {steps}, "
                "the steps of the whole run: later the learning rate would rise again"
            )
        if settings.future_goals is not None:
            future_goals(self)  # or raises
            for name, off in (("successful", None), ("random_goals", False)):
                if settings.get(name) not in (None, False):
                    raise ValueError(
                        f"learner.{name} is {settings[name]}, but has no effect with "
                        f"learner.future_goals: set it to {json.dumps(off)}, or "
                        "learner.future_goals to null"
                    )

    def setup(self, rows: TensorDictBase, seed: int) -> None:
        """Makes policy, values and action values, with statistics of some batches."""
        settings = self.settings
        features = self.start(rows, seed)
        self.actor = self.make_actor(features, "loc")
        self.loss_module = IQLLoss(
            self.make_distribution(),
            [
                GoalConditionedCritic(
                    features,
                    self.environment.action_dim,
                    tuple(settings.hidden_sizes),
                    hidden_dtype=self.hidden_dtype,
                    layer_norm=settings.layer_norm,
                )
                for _ in range(2)
            ],
            GoalConditionedValue(
                features, tuple(settings.hidden_sizes), hidden_dtype=self.hidden_dtype
            ),
            loss_function="l2",
            temperature=settings.temperature,
            expectile=settings.expectile,
            deactivate_vmap=True,
        )
        self.loss_module.make_value_estimator(gamma=settings.gamma)
        self.updater = SoftUpdate(self.loss_module, tau=settings.tau)
        self.optimizer = torch.optim.Adam(
            self.loss_module.parameters(), lr=settings.lr, fused=True
        )
        self.parts = {"loss": self.loss_module, "optimizer": self.optimizer}
        self.scheduler = None
        if settings.decay_steps is not None:
            self.scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(
                self.optimizer, settings.decay_steps
            )
            self.parts["scheduler"] = self.scheduler

    @property
    def swaps_after_goals(self) -> bool:
        """Whether goals are drawn before the swap, for ``lookahead: goal``."""
        return self.settings.future_goals is not None

    def learning_rows(self, stored: TensorDictBase) -> TensorDictBase:
        """Returns what learning reads; goals that are drawn need no stored ones."""
        return self.read_leaves(stored, goals=not self.swaps_after_goals)

    def make_buffer(self, rows: TensorDictBase) -> TensorDictReplayBuffer:
        """Makes the buffer; with ``future_goals``, of goals that imitation learns.

        These are drawn before the swap, so that ``lookahead="goal"`` can be used, and
        an action leads to the goal of every row.
        """
        if not self.swaps_after_goals:
            return super().make_buffer(rows)
        layout = self.environment.layout
        leaves = GoalLeaves(self.environment.reward_fn, None, keys=TransformKeys())

        def set_rewards(batch: TensorDictBase) -> TensorDictBase:
            return batch.update(leaves(batch, *goal_vectors(batch, layout)))

        rb = imitation_buffer(
            self, rows, batch_size=self.rows_at_once, goals=future_goals(self)
        )
        rb.append_transform(set_rewards)
        return rb

    def make_online_buffer(self, rows: TensorDictBase) -> TensorDictReplayBuffer:
        """Makes the buffer of collected rows, with the same goals."""
        if not self.swaps_after_goals:
            return super().make_online_buffer(rows)
        return self.make_buffer(rows)

    def make_distribution(self) -> ProbabilisticTensorDictSequential:
        """Returns the policy as a distribution of actions."""
        deviation = self.settings.deviation
        return ProbabilisticTensorDictSequential(
            self.actor,
            TensorDictModule(
                lambda loc: torch.full_like(loc, deviation), ["loc"], ["scale"]
            ),
            ProbabilisticTensorDictModule(
                ["loc", "scale"], ["action"], distribution_class=IndependentNormal
            ),
        )

    def step(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """Takes one step of Adam, of all networks."""
        # The next state has the goal of its transition.
        batch["next", "desired_goal"] = batch["desired_goal"]
        losses = self.loss_module(batch)
        names = ("loss_actor", "loss_qvalue", "loss_value")
        descend(self.optimizer, sum(losses[name] for name in names))
        if self.scheduler is not None:
            self.scheduler.step()
        self.updater.step()
        scalars = {name: losses[name].detach() for name in names}
        return scalars | self.share_swapped(batch)
