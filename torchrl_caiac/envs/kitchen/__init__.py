"""The Franka-Kitchen: environment, scripted expert and datasets."""

from __future__ import annotations

from torchrl_caiac.envs.kitchen.datasets import (
    DEMONSTRATIONS_ID,
    MICROWAVE_KETTLE,
    PLAY_ID,
    PLAY_ORDERS,
    RANDOM_ID,
    Demonstrations,
    create_kitchen_demonstrations,
    create_kitchen_play,
    create_kitchen_random,
    kitchen_transitions,
    load_d4rl_kitchen,
)
from torchrl_caiac.envs.kitchen.env import (
    KITCHEN_ENV_ID,
    KITCHEN_TASKS,
    KitchenEnv,
    KitchenState,
    kitchen_distances,
    kitchen_reward,
    make_kitchen_env,
    register_kitchen,
)
from torchrl_caiac.envs.kitchen.expert import KitchenChain, KitchenExpert

__all__ = [
    "DEMONSTRATIONS_ID",
    "KITCHEN_ENV_ID",
    "KITCHEN_TASKS",
    "MICROWAVE_KETTLE",
    "PLAY_ID",
    "PLAY_ORDERS",
    "RANDOM_ID",
    "Demonstrations",
    "KitchenChain",
    "KitchenEnv",
    "KitchenExpert",
    "KitchenState",
    "create_kitchen_demonstrations",
    "create_kitchen_play",
    "create_kitchen_random",
    "kitchen_distances",
    "kitchen_reward",
    "kitchen_transitions",
    "load_d4rl_kitchen",
    "make_kitchen_env",
    "register_kitchen",
]
