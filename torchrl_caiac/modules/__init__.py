"""World models, goal-conditioned networks and Latent Motor Plans."""

from __future__ import annotations

from torchrl_caiac._kernels import linear_kernel
from torchrl_caiac.modules.entity_dynamics_model import EntityDynamicsModel
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
from torchrl_caiac.modules.goal_features import GoalFeatures
from torchrl_caiac.modules.goal_networks import (
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalConditionedValue,
)
from torchrl_caiac.modules.linear import faster_dtype
from torchrl_caiac.modules.lmp import LMPModel
from torchrl_caiac.modules.lmp_actor import LMPActor
from torchrl_caiac.modules.running_norm import RunningNorm
from torchrl_caiac.modules.transformer_world_model import TransformerWorldModel

__all__ = [
    "EntityDynamicsModel",
    "GaussianWorldModel",
    "GoalConditionedActor",
    "GoalConditionedCritic",
    "GoalConditionedValue",
    "GoalFeatures",
    "LMPActor",
    "LMPModel",
    "RunningNorm",
    "TransformerWorldModel",
    "faster_dtype",
    "linear_kernel",
]
