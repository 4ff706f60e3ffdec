"""Simulated environments and their scripted experts."""

from __future__ import annotations

from torchrl_caiac.envs.fetch_push import (
    FETCH_PUSH_ENV_ID,
    FetchPushCubes,
    FetchPushExpert,
    FetchPushState,
    FetchPushTruth,
    create_fetch_push_expert,
    create_fetch_push_random,
    fetch_push_distances,
    fetch_push_layout,
    fetch_push_reward,
    make_fetch_push_env,
)
from torchrl_caiac.envs.kitchen import (
    KITCHEN_ENV_ID,
    KITCHEN_TASKS,
    KitchenEnv,
    KitchenState,
    kitchen_reward,
    make_kitchen_env,
)
from torchrl_caiac.envs.kitchen_expert import KitchenChain, KitchenExpert
from torchrl_caiac.envs.rendering import RenderingUnavailable

__all__ = [
    "FETCH_PUSH_ENV_ID",
    "KITCHEN_ENV_ID",
    "KITCHEN_TASKS",
    "FetchPushCubes",
    "FetchPushExpert",
    "FetchPushState",
    "FetchPushTruth",
    "KitchenChain",
    "KitchenEnv",
    "KitchenExpert",
    "KitchenState",
    "RenderingUnavailable",
    "create_fetch_push_expert",
    "create_fetch_push_random",
    "fetch_push_distances",
    "fetch_push_layout",
    "fetch_push_reward",
    "kitchen_reward",
    "make_fetch_push_env",
    "make_kitchen_env",
]
