"""The Franka-Kitchen: environment, ground truth, scripted expert and datasets."""

from __future__ import annotations

from torchrl_caiac.envs.kitchen.chain import KitchenChain
from torchrl_caiac.envs.kitchen.datasets import (
    DEMONSTRATIONS_ID,
    MICROWAVE_KETTLE,
    PLAY_ANY_START_ID,
    PLAY_ANY_START_ORDERS,
    PLAY_ID,
    PLAY_ORDERS,
    RANDOM_ID,
    Demonstrations,
    RestorableKitchen,
    create_kitchen_demonstrations,
    create_kitchen_play,
    create_kitchen_random,
    kitchen_transitions,
    load_d4rl_kitchen,
)
from torchrl_caiac.envs.kitchen.env import KitchenEnv
from torchrl_caiac.envs.kitchen.expert import KitchenExpert
from torchrl_caiac.envs.kitchen.registration import (
    KITCHEN_ENV_ID,
    make_kitchen_env,
    register_kitchen,
)
from torchrl_caiac.envs.kitchen.simulator import KitchenState
from torchrl_caiac.envs.kitchen.starts import set_kitchen_start
from torchrl_caiac.envs.kitchen.tasks import (
    KITCHEN_TASKS,
    kitchen_distances,
    kitchen_reward,
)
from torchrl_caiac.envs.kitchen.truth import KitchenTruth

__all__ = [
    "DEMONSTRATIONS_ID",
    "KITCHEN_ENV_ID",
    "KITCHEN_TASKS",
    "MICROWAVE_KETTLE",
    "PLAY_ANY_START_ID",
    "PLAY_ANY_START_ORDERS",
    "PLAY_ID",
    "PLAY_ORDERS",
    "RANDOM_ID",
    "Demonstrations",
    "KitchenChain",
    "KitchenEnv",
    "KitchenExpert",
    "KitchenState",
    "KitchenTruth",
    "RestorableKitchen",
    "create_kitchen_demonstrations",
    "create_kitchen_play",
    "create_kitchen_random",
    "kitchen_distances",
    "kitchen_reward",
    "kitchen_transitions",
    "load_d4rl_kitchen",
    "make_kitchen_env",
    "register_kitchen",
    "set_kitchen_start",
]
