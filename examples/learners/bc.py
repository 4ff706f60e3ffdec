"""Goal-conditioned behaviour cloning."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDictBase, TensorDictParams
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import BCLoss, LossModule

from learners.goal_conditioned import GoalConditioned, descend
from learners.imitation import (
    check_demonstrations,
    future_goals,
    imitation_buffer,
)
from learners.settings import NotNegative, Positive

__all__ = ["BC"]


class _BCLoss(BCLoss):
    # Without it TorchRL warns that its own class does not name it.
    target_actor_network_params: TensorDictParams | None


class BC(GoalConditioned):
    """Repeats the actions of demonstrations, of counterfactual ones too."""

    class Settings(GoalConditioned.Settings):
        """What the settings may be."""

        goals: Literal["own", "future"]
        future_goals: Any
        lr: Positive
        weight_decay: NotNegative

    window = 1
    """Rows that follow each other, from which a row to learn from is made."""

    def check(self, further: int = 0) -> None:
        """Raises if a setting is wrong; see the base class."""
        super().check(further)
        environment = self.environment
        check_demonstrations(self)
        if self.swaps_after_goals or self.settings.future_goals is not None:
            future_goals(self, self.window)  # or raises
        if not (self.swaps_after_goals or environment.demonstrations_have_goals):
            raise ValueError(
                "learner.goals is 'own', but the demonstrations of "
                f"{type(environment).__name__} have no goals of their own: set it to "
                "future"
            )

    @property
    def swaps_after_goals(self) -> bool:
        """Whether goals are drawn before the swap, for ``lookahead: goal``."""
        return bool(self.settings.goals == "future")

    def stored_rows(self) -> TensorDictBase:
        """Returns the demonstrations."""
        return self.environment.demonstrations()

    def rows(self) -> TensorDictBase:
        """Returns what learning reads of the demonstrations, in memory."""
        return self.read_leaves(self.stored_rows(), goals=not self.swaps_after_goals)

    def make_buffer(self, rows: TensorDictBase) -> TensorDictReplayBuffer:
        """Makes the buffer of transitions, their goals, and counterfactuals."""
        return imitation_buffer(
            self,
            rows,
            batch_size=self.rows_at_once * self.window,
            window=self.window,
            goals=future_goals(self, self.window) if self.swaps_after_goals else None,
        )

    def setup(self, rows: TensorDictBase, seed: int) -> None:
        """Makes the policy, with the statistics of some batches."""
        features = self.start(rows, seed)
        self.actor = self.make_actor(features)
        self.loss_module = self.make_loss()
        self.optimizer = torch.optim.AdamW(
            self.loss_module.parameters(),
            lr=self.settings.lr,
            weight_decay=self.settings.weight_decay,
            fused=True,
        )
        self.scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(
            self.optimizer, self.settings.steps
        )
        self.parts = {
            "loss": self.loss_module,
            "optimizer": self.optimizer,
            "scheduler": self.scheduler,
        }

    def make_loss(self) -> LossModule:
        """Returns the loss of the policy, which writes one leaf."""
        return _BCLoss(self.actor, loss_function="l2")

    def step(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """Takes one step of AdamW."""
        losses = self.loss_module(batch)
        (name,) = losses.keys()
        descend(self.optimizer, losses[name])
        self.scheduler.step()
        return {name: losses[name].detach(), **self.share_swapped(batch)}
