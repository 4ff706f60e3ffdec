"""Simulated environments and their scripted experts."""

from __future__ import annotations

from torchrl_caiac.envs.kitchen import (
    KITCHEN_ENV_ID,
    KITCHEN_TASKS,
    KitchenEnv,
    KitchenState,
    kitchen_reward,
    make_kitchen_env,
)
from torchrl_caiac.envs.kitchen_expert import KitchenExpert
from torchrl_caiac.envs.rendering import RenderingUnavailable

__all__ = [
    "KITCHEN_ENV_ID",
    "KITCHEN_TASKS",
    "KitchenEnv",
    "KitchenExpert",
    "KitchenState",
    "RenderingUnavailable",
    "kitchen_reward",
    "make_kitchen_env",
]
