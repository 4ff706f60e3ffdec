"""Offline TD3 with hindsight goals and a cloning term (TD3+BC)."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from learners.hindsight import UNEXPLAINED, until_success
from learners.settings import NotNegative
from learners.td3 import TD3

__all__ = ["TD3BC"]

_NOT_CLONED = "not_cloned"


class TD3BC(TD3):
    """TD3 that repeats the actions of successful episodes up to their first success.

    Where no episode has a goal of its own it repeats all actions. It repeats those of
    counterfactuals too: a swap leaves out what the action is for.
    """

    class Settings(TD3.Settings):
        """What the settings may be."""

        bc_alpha: NotNegative

    def learning_rows(self, stored: TensorDictBase) -> TensorDictBase:
        """Returns what learning reads, and which actions are not repeated."""
        rows = super().learning_rows(stored)
        cloned = torch.ones(len(rows), dtype=torch.bool)
        # Play reaches no goal of its own, and all of its rows lead to later states.
        if self.environment.episodes_have_goals:
            cloned = until_success(rows)
        return rows.set(_NOT_CLONED, ~cloned.unsqueeze(-1))

    def loss_options(self) -> dict[str, Any]:
        """Returns the arguments of the cloning term."""
        return {"bc_alpha": self.settings.bc_alpha, "bc_mask_key": _NOT_CLONED}

    def step(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """Takes a step; actions do not explain goals that other rows achieve."""
        batch[_NOT_CLONED] = batch[_NOT_CLONED] | batch[UNEXPLAINED]
        return super().step(batch, step)
