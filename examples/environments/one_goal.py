"""A policy that is told the goal of one entity at a time."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_caiac import EntityLayout

__all__ = ["OneGoal"]


class OneGoal:
    """Tells a policy the goal of one entity; the others are to stay where they are.

    Where two goals call for different actions, a policy that predicts their mean does
    neither. Of the goals that are not reached yet, the lowest one comes first, since
    things rest on each other. It stays until it is reached. Once all are reached, the
    policy is told all of them.

    Args:
        actor (TensorDictModule): the policy.
        layout (EntityLayout): goals that are positions in space, x, y and z.
        tolerance (float): the distance at which a goal is reached.

    Raises:
        ValueError: goals are not positions in space.
    """

    def __init__(self, actor: Any, layout: EntityLayout, tolerance: float) -> None:
        self.actor, self.layout, self.tolerance = actor, layout, tolerance
        columns = [places for places in layout.goal.values() if places]
        if not columns or any(len(places) != 3 for places in columns):
            raise ValueError(
                f"goals are columns {columns}, expected x, y and z of each entity: "
                "tell the policy all goals, env.evaluate.goals=[all]"
            )
        self._columns = torch.tensor(columns)  # [M, 3]

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        """Returns what the policy writes, and under ``next`` the entity of the goal.

        Args:
            td (TensorDictBase): states with desired goals, ``[B]``.

        Returns:
            TensorDictBase: has to be passed on to the next call, as
            :func:`~environments.playing.play_together` does. The entity is -1 if all
            goals are reached.
        """
        key = self.layout.desired_goal_key
        goals = td[key]
        wanted = goals[:, self._columns]
        here = self.layout.achieved_goal(td)[:, self._columns]
        is_far = (here - wanted).norm(dim=-1) > self.tolerance  # [B, M]
        entities = torch.arange(is_far.shape[-1])
        chosen = torch.where(is_far, wanted[..., 2], torch.inf).argmin(-1, True)
        if (before := td.get("goal_of", None)) is not None:
            is_still_far = (is_far & (entities == before)).any(-1, True)
            chosen = torch.where(is_still_far, before, chosen)
        chosen = torch.where(is_far.any(-1, True), chosen, -1)
        is_told = (entities == chosen) | (chosen < 0)
        told = goals.clone()
        told[:, self._columns] = torch.where(is_told[..., None], wanted, here)
        out = self.actor(td.copy().set(key, told))
        out["next", "goal_of"] = chosen
        return out
