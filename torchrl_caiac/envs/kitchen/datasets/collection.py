"""Parts shared by the functions that collect datasets in the Franka-Kitchen."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.data.collect import (
    CollectionReport,
    EpisodeSource,
    collect_episodes,
    load_episode,
)
from torchrl_caiac.data.minari_files import (
    free_dataset_path,
    publish_dataset,
    work_folder,
)
from torchrl_caiac.envs._requirements import REQUIREMENTS
from torchrl_caiac.envs.kitchen.waypoints import get_task

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer
    from numpy.typing import NDArray

__all__ = [
    "DEFAULT_TASKS",
    "KitchenSource",
    "collect_expert_dataset",
    "make_franka_kitchen",
]

#: Tasks whose goals are observed in datasets of single tasks and of random actions.
DEFAULT_TASKS = ("microwave", "kettle")

# Objects settle by up to 7 mm (or mrad) when an episode starts; more is a collision.
_UNTOUCHED = 0.02


def make_franka_kitchen(tasks: Sequence[str]) -> Any:
    """Creates the ``FrankaKitchen-v1`` in which datasets are collected.

    Args:
        tasks (sequence of str): the tasks whose goals it observes.

    Returns:
        gymnasium.Env: the environment.

    Examples:
        >>> env = make_franka_kitchen(["kettle"])
        >>> observation, _ = env.reset(seed=0)
        >>> list(observation["achieved_goal"])
        ['kettle']
    """
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(
        "FrankaKitchen-v1",
        tasks_to_complete=list(tasks),
        # Complete motions, and rewards that do not depend on earlier steps.
        terminate_on_tasks_completed=False,
        remove_task_when_completed=False,
        # As in Minari's datasets: chains take longer than the 280 of an evaluation.
        max_episode_steps=450,
        # It warns of views of simulator memory, which record_episode copies.
        disable_env_checker=True,
    )


class KitchenSource:
    """A source of episodes in an environment of its own, which it closes.

    Args:
        tasks (sequence of str): as for :func:`make_franka_kitchen`.
    """

    def __init__(self, tasks: Sequence[str]) -> None:
        self.env = make_franka_kitchen(tasks)

    @property
    def data(self) -> Any:
        """The simulator's ``mujoco.MjData``."""
        return self.env.unwrapped.robot_env.data

    def simulator_state(self) -> dict[str, NDArray[np.float64]]:
        """Returns the exact positions and velocities, as views of the simulator.

        Returns:
            dict: ``"qpos"`` ``[30]`` and ``"qvel"`` ``[29]``.
        """
        return {"qpos": self.data.qpos, "qvel": self.data.qvel}

    def others_moved(self, qpos: NDArray[np.float64], own: Sequence[int]) -> bool:
        """Returns whether an object moved that should have stayed unchanged.

        Args:
            qpos (numpy.ndarray): the positions ``[L + 1, 30]`` of an episode.
            own (sequence of int): columns of the objects that may move.

        Returns:
            bool: whether any other object moved by more than 2 cm (or 0.02 rad).
        """
        others = np.setdiff1d(np.arange(9, qpos.shape[1]), own)
        return bool(np.abs(qpos - qpos[0])[:, others].max() > _UNTOUCHED)

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()


def collect_expert_dataset(
    dataset_id: str,
    source: Callable[[], EpisodeSource],
    specs: Sequence[Mapping[str, Any]],
    *,
    tasks: Sequence[str],
    root: str | os.PathLike[str] | None,
    work: str | os.PathLike[str] | None,
    seed: int,
    workers: int | None,
    overwrite: bool,
    progress: bool,
    description: str,
) -> tuple[MinariDataset, CollectionReport]:
    """Collects one episode per specification and publishes them as a dataset.

    Args:
        dataset_id (str): Minari's name of the dataset.
        source (Callable): creates the source of the episodes in each process.
        specs (sequence of Mapping): the specifications.

    Keyword Args:
        tasks (sequence of str): as for :func:`make_franka_kitchen`.
        root (path, optional): folder of Minari datasets; ``None`` for the default.
        work (path, optional): folder for finished episodes; ``None`` for a temporary
            one.
        seed (int): seed of the collection.
        workers (int, optional): number of processes; ``None`` for one per processor.
        overwrite (bool): whether to replace a dataset of that name.
        progress (bool): whether to show progress bars.
        description (str): what the dataset contains.

    Returns:
        tuple: the dataset and the numbers of attempts.

    Raises:
        FileExistsError: the dataset exists and ``overwrite`` is ``False``.
        ValueError: there are no specifications.
    """
    for task in tasks:
        get_task(task)
    target = free_dataset_path(dataset_id, root, overwrite)
    if not specs:
        raise ValueError("no demonstrations requested: every group has 0 episodes")
    with work_folder(work, dataset_id) as folder:
        report = collect_episodes(
            source,
            specs,
            folder,
            seed=seed,
            workers=workers,
            progress=progress,
            description=f"episodes of {dataset_id}",
        )
        buffers = [_buffer(file) for file in report.files]
    dataset = publish_dataset(
        dataset_id,
        buffers,
        target,
        lambda: make_franka_kitchen(tasks),
        code="torchrl_caiac/envs/kitchen/datasets",
        requirements=REQUIREMENTS,
        progress=progress,
        description=description,
        algorithm_name="torchrl_caiac scripted expert",
    )
    return dataset, report


def _buffer(file: Path) -> EpisodeBuffer:
    from minari.data_collector import EpisodeBuffer

    arrays, meta = load_episode(file)
    spec = meta["spec"]
    options = (
        {"tasks": json.dumps(spec["tasks"]), "speed": spec["speed"]}
        if "tasks" in spec
        else {"task": spec["task"], "start": json.dumps(spec["start"])}
    )
    return EpisodeBuffer(seed=meta["seed"], options=options, **arrays)
