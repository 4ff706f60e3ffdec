"""Collecting, loading and storing demonstrations."""

from __future__ import annotations

from torchrl_caiac.data.collect import collect_episodes, load_episode, record_episode
from torchrl_caiac.data.kitchen_datasets import (
    create_kitchen_demonstrations,
    create_kitchen_random,
    kitchen_transitions,
)
from torchrl_caiac.data.load_minari import load_minari
from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.offline_buffer import offline_buffer

__all__ = [
    "collect_episodes",
    "create_kitchen_demonstrations",
    "create_kitchen_random",
    "kitchen_transitions",
    "load_episode",
    "load_minari",
    "load_transitions",
    "offline_buffer",
    "record_episode",
]
