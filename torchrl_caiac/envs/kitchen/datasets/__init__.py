"""Datasets of the Franka-Kitchen: collected by the expert, at random, or read.

All have the schema of Minari's ``D4RL/kitchen/*-v2``, the dictionary observations of
``FrankaKitchen-v1`` with 59 columns: robot positions 9 and velocities 9, object
positions 21 and velocities 20. :func:`kitchen_transitions` turns them, Minari's own
included, into TorchRL transitions with the 30-column state; :func:`load_d4rl_kitchen`
does the same with the older files of D4RL.
"""

from __future__ import annotations

from torchrl_caiac.envs.kitchen.datasets.d4rl import load_d4rl_kitchen
from torchrl_caiac.envs.kitchen.datasets.demonstrations import (
    DEMONSTRATIONS_ID,
    MICROWAVE_KETTLE,
    Demonstrations,
    create_kitchen_demonstrations,
)
from torchrl_caiac.envs.kitchen.datasets.play import (
    PLAY_ANY_START_ID,
    PLAY_ANY_START_ORDERS,
    PLAY_ID,
    PLAY_ORDERS,
    create_kitchen_play,
)
from torchrl_caiac.envs.kitchen.datasets.random_actions import (
    RANDOM_ID,
    create_kitchen_random,
)
from torchrl_caiac.envs.kitchen.datasets.restorable import RestorableKitchen
from torchrl_caiac.envs.kitchen.datasets.transitions import kitchen_transitions

__all__ = [
    "DEMONSTRATIONS_ID",
    "MICROWAVE_KETTLE",
    "PLAY_ANY_START_ID",
    "PLAY_ANY_START_ORDERS",
    "PLAY_ID",
    "PLAY_ORDERS",
    "RANDOM_ID",
    "Demonstrations",
    "RestorableKitchen",
    "create_kitchen_demonstrations",
    "create_kitchen_play",
    "create_kitchen_random",
    "kitchen_transitions",
    "load_d4rl_kitchen",
]
