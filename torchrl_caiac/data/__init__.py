"""Collecting episodes, and loading, mixing and storing transitions."""

from __future__ import annotations

from torchrl_caiac._files import UnreadableFileError
from torchrl_caiac.data.action_bounds import action_bounds
from torchrl_caiac.data.add_leaf import add_leaf
from torchrl_caiac.data.collect import collect_episodes, load_episode, record_episode
from torchrl_caiac.data.digests import verify_digests, write_digests
from torchrl_caiac.data.episodes import episode_transitions
from torchrl_caiac.data.from_arrays import from_arrays
from torchrl_caiac.data.from_replay_buffer import from_replay_buffer
from torchrl_caiac.data.from_stream import from_stream
from torchrl_caiac.data.load_lerobot import lerobot_tasks, load_lerobot
from torchrl_caiac.data.load_minari import load_minari
from torchrl_caiac.data.load_ogbench import load_ogbench
from torchrl_caiac.data.load_robomimic import load_robomimic
from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.mix_trajectories import mix_trajectories
from torchrl_caiac.data.offline_buffer import offline_buffer
from torchrl_caiac.data.offline_to_online import offline_to_online_buffer
from torchrl_caiac.data.open_dataset import FORMATS, DatasetFormat, open_dataset
from torchrl_caiac.data.select_successful import select_successful
from torchrl_caiac.data.to_minari import to_minari
from torchrl_caiac.data.transition_writer import TransitionWriter
from torchrl_caiac.data.write_transitions import write_transitions

__all__ = [
    "FORMATS",
    "DatasetFormat",
    "TransitionWriter",
    "UnreadableFileError",
    "action_bounds",
    "add_leaf",
    "collect_episodes",
    "episode_transitions",
    "from_arrays",
    "from_replay_buffer",
    "from_stream",
    "lerobot_tasks",
    "load_episode",
    "load_lerobot",
    "load_minari",
    "load_ogbench",
    "load_robomimic",
    "load_transitions",
    "mix_trajectories",
    "offline_buffer",
    "offline_to_online_buffer",
    "open_dataset",
    "record_episode",
    "select_successful",
    "to_minari",
    "verify_digests",
    "write_digests",
    "write_transitions",
]
