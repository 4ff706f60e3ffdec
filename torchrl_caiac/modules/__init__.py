"""World models and Latent Motor Plans as tensordict modules."""

from __future__ import annotations

from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
from torchrl_caiac.modules.lmp import LMPModel
from torchrl_caiac.modules.lmp_actor import LMPActor
from torchrl_caiac.modules.running_norm import RunningNorm

__all__ = ["GaussianWorldModel", "LMPActor", "LMPModel", "RunningNorm"]
