"""Goal-conditioned Latent Motor Plans (paper, A.5.1)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer

from learners.base import Learner
from learners.imitation import (
    check_demonstrations,
    imitation_buffer,
    window_goals,
)
from learners.settings import Count, NotNegative, Positive
from torchrl_caiac.modules import LMPActor, LMPModel
from torchrl_caiac.objectives import LMPLoss
from torchrl_caiac.transforms import WindowGoal

__all__ = ["LMP"]


class LMP(Learner):
    """Plans for windows of trajectories, whose goals are later states."""

    class Settings(Learner.Settings):
        """What the settings may be."""

        windows: Count
        window: Count
        goals: dict[str, Any]
        goal_p: Annotated[float, Field(gt=0, le=1)]
        plan_dim: Count
        hidden_size: Count
        decoder: Literal["open_loop", "closed_loop"]
        observation_floor: Positive
        resting: NotNegative
        reconstruction_weight: NotNegative
        kl_weight: NotNegative
        lr: Positive

    def check(self, further: int = 0) -> None:
        """Raises if a setting is wrong; see the base class."""
        super().check(further)
        check_demonstrations(self)
        self.make_goals()  # or raises

    @property
    def swaps_after_goals(self) -> bool:
        """Whether goals are drawn before the swap, for ``lookahead: goal``."""
        return True

    def make_goals(self) -> WindowGoal:
        """Returns what draws the goals of windows."""
        settings = self.settings
        return window_goals(
            self, "goals", dict(settings.goals), settings.window, p=settings.goal_p
        )

    def stored_rows(self) -> TensorDictBase:
        """Returns the demonstrations."""
        return self.environment.demonstrations()

    def rows(self) -> TensorDictBase:
        """Returns what learning reads of the demonstrations, in memory."""
        return self.read_leaves(self.stored_rows(), goals=False)

    def make_buffer(self, rows: TensorDictBase) -> TensorDictReplayBuffer:
        """Makes the buffer of windows, their goals, and counterfactuals."""
        settings = self.settings
        return imitation_buffer(
            self,
            rows,
            batch_size=settings.windows * self.at_once * settings.window,
            window=settings.window,
            goals=self.make_goals(),
        )

    def setup(self, rows: TensorDictBase, seed: int) -> None:
        """Makes the model, with the statistics of the rows."""
        settings = self.settings
        torch.manual_seed(seed)
        self.model = self.make_model()
        goals = self.environment.layout.achieved_goal(rows, next=True)
        self.model.fit_statistics(rows, goals=goals)
        # Columns that are constant in all demonstrations are ignored: their weights
        # would keep their initial values, and other values at test time would disturb
        # the output.
        for norm, values in (
            (self.model.observation_norm, rows["observation"]),
            (self.model.goal_norm, goals),
        ):
            norm.ignore(values.std(0) < settings.resting)
        self.loss_module = LMPLoss(
            self.model,
            kl_weight=settings.kl_weight,
            reconstruction_weight=settings.reconstruction_weight,
        )
        self.optimizer = torch.optim.Adam(
            self.model.parameters(), lr=settings.lr, fused=True
        )
        self.scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(
            self.optimizer, settings.steps
        )
        self.rb = self.make_buffer(rows)
        self.model.train()
        self.parts = {
            "model": self.model,
            "optimizer": self.optimizer,
            "scheduler": self.scheduler,
        }

    def make_model(self) -> LMPModel:
        """Returns the model, without statistics."""
        settings, layout = self.settings, self.environment.layout
        return LMPModel(
            observation_dim=sum(layout.widths().values()),
            goal_dim=layout.goal_width,
            action_dim=self.environment.action_dim,
            window=settings.window,
            plan_dim=settings.plan_dim,
            hidden_size=settings.hidden_size,
            decoder=settings.decoder,
            observation_floor=settings.observation_floor,
            goal_floor=settings.observation_floor,
        )

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields batches of windows, ``[windows, window]``."""
        while True:
            yield from self.split(self.rb.sample().reshape(-1, self.settings.window))

    def step(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """Takes one step of Adam."""
        losses = self.loss_module(batch)
        loss = losses["loss_reconstruction"] + losses["loss_kl"]
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.scheduler.step()
        scalars = {key: value.detach() for key, value in losses.items()}
        return scalars | self.share_swapped(batch)

    def policy_state(self) -> dict[str, Any]:
        """Returns the state of the model."""
        return self.model.state_dict()

    def load_policy(self, state: dict[str, Any]) -> LMPActor:
        """Plays a plan for a window, then the next one."""
        model = self.make_model()
        model.load_state_dict(state)
        return LMPActor(model.eval())
