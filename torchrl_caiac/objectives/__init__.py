"""Losses of world models and of policies."""

from __future__ import annotations

from torchrl_caiac.objectives.entity_dynamics import EntityDynamicsLoss
from torchrl_caiac.objectives.goal_conditioned_td3 import GoalConditionedTD3Loss
from torchrl_caiac.objectives.lmp import LMPLoss

__all__ = ["EntityDynamicsLoss", "GoalConditionedTD3Loss", "LMPLoss"]
