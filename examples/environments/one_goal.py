"""A policy that is told the goal of one entity at a time."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch.nn.functional import one_hot

from torchrl_caiac import EntityLayout

__all__ = ["OneGoal"]


class OneGoal:
    """Tells a policy the goal of one entity; the others are to stay where they are.

    Where two goals call for different actions, a policy that predicts their mean does
    neither. Of the goals that are not reached yet, the lowest one comes first, since
    things rest on each other. It stays until it is reached.

    Args:
        actor (TensorDictModule): the policy.
        layout (EntityLayout): goals that are positions in space, x, y and z.
        tolerance (float): the distance at which a goal is reached.
    """

    def __init__(self, actor: Any, layout: EntityLayout, tolerance: float) -> None:
        self.actor, self.layout, self.tolerance = actor, layout, tolerance
        self._columns = torch.tensor(list(layout.goal.values()))  # [M, 3]

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        """Returns what the policy writes, and under ``next`` the entity of the goal.

        Args:
            td (TensorDictBase): states with desired goals, ``[B]``.

        Returns:
            TensorDictBase: has to be passed on to the next call, as
            :func:`~environments.playing.play_together` does.
        """
        goals = td["desired_goal"]
        wanted = goals[:, self._columns]
        here = self.layout.achieved_goal(td)[:, self._columns]
        is_far = (here - wanted).norm(dim=-1) > self.tolerance  # [B, M]
        height = torch.where(is_far, wanted[..., 2], torch.inf)
        chosen = height.argmin(-1)
        if (before := td.get("goal_of", None)) is not None:
            is_still_far = is_far.gather(-1, before[:, None])[:, 0]
            chosen = torch.where(is_still_far, before, chosen)
        is_told = one_hot(chosen, is_far.shape[-1]).bool() | ~is_far.any(-1, True)
        told = goals.clone()
        told[:, self._columns] = torch.where(is_told[..., None], wanted, here)
        out = self.actor(td.copy().set("desired_goal", told))
        out["next", "goal_of"] = chosen
        return out
