"""Demonstrations of single tasks in the Franka-Kitchen, by the scripted expert."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.data.collect import CollectionReport, record_episode
from torchrl_caiac.envs.kitchen.datasets.collection import (
    DEFAULT_TASKS,
    KitchenSource,
    collect_expert_dataset,
)
from torchrl_caiac.envs.kitchen.expert import KitchenExpert
from torchrl_caiac.envs.kitchen.starts import set_kitchen_start

if TYPE_CHECKING:
    from minari import MinariDataset

__all__ = [
    "DEMONSTRATIONS_ID",
    "MICROWAVE_KETTLE",
    "Demonstrations",
    "create_kitchen_demonstrations",
]

#: Minari's name of the demonstrations, unless another is given.
DEMONSTRATIONS_ID = "kitchen/microwave-kettle-v0"


@dataclasses.dataclass(frozen=True)
class Demonstrations:
    """A number of demonstrations of one task from one start.

    Args:
        task (str): FrankaKitchen's name of the task.
        episodes (int): number of demonstrations. Defaults to 50.
        start (Mapping of str to float): object joints that differ from the default
            start, by name. Defaults to none.
        speed (float): speed factor of the expert. Defaults to 1.

    Examples:
        >>> Demonstrations("kettle", episodes=2).speed
        1.0
    """

    task: str
    episodes: int = 50
    start: Mapping[str, float] = dataclasses.field(default_factory=dict)
    speed: float = 1.0


#: The paper's motivating experiment (section 4.1, A.6.1): the microwave is shown only
#: with the slide cabinet open, the kettle only with it closed.
MICROWAVE_KETTLE = (
    Demonstrations("microwave", start={"slide_cabinet": 0.37}, speed=0.46),
    Demonstrations("kettle", speed=0.34),
)


def create_kitchen_demonstrations(
    dataset_id: str = DEMONSTRATIONS_ID,
    *,
    demonstrations: Sequence[Demonstrations] = MICROWAVE_KETTLE,
    root: str | os.PathLike[str] | None = None,
    work: str | os.PathLike[str] | None = None,
    waypoint_noise: float = 0.005,
    action_noise: float = 0.03,
    speed_range: float = 0.05,
    keep_steps: int = 8,
    max_steps: int = 120,
    seed: int = 0,
    workers: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> tuple[MinariDataset, CollectionReport]:
    """Collects successful episodes of the expert as a Minari dataset.

    Each episode's metadata contain its task and start (``"options"``), its infos the
    simulator's exact ``"qpos"`` ``[L + 1, 30]`` and ``"qvel"`` ``[L + 1, 29]``.

    Args:
        dataset_id (str): Minari's name of the dataset. Defaults to
            :data:`DEMONSTRATIONS_ID`.

    Keyword Args:
        demonstrations (sequence of Demonstrations): tasks, starts and numbers of
            episodes. Defaults to :data:`MICROWAVE_KETTLE`.
        root (path, optional): folder of Minari datasets. Defaults to
            ``MINARI_DATASETS_PATH`` or Minari's own.
        work (path, optional): folder that keeps finished episodes, so that an
            interrupted collection resumes. Defaults to a temporary one.
        waypoint_noise (float): of the expert, standard deviation in metres.
            Defaults to 0.005.
        action_noise (float): of the expert, standard deviation. Defaults to 0.03.
        speed_range (float): of the expert, fraction of the speed. Defaults to 0.05.
        keep_steps (int): number of steps kept after the first in which the task is
            done. Defaults to 8.
        max_steps (int): number of steps after which an attempt counts as failed.
            Defaults to 120.
        seed (int): seed of the collection. Defaults to 0.
        workers (int, optional): number of processes. Defaults to one per processor.
        overwrite (bool): whether to replace a dataset of that name. Defaults to
            ``False``.
        progress (bool): whether to show progress bars. Defaults to ``True``.

    Returns:
        tuple: the dataset and the numbers of attempts.

    Raises:
        FileExistsError: the dataset exists and ``overwrite`` is ``False``.
        KeyError: the expert has no table for a task.
        ValueError: no demonstrations were requested.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dataset, report = create_kitchen_demonstrations(
        ...         demonstrations=[Demonstrations("kettle", episodes=1)],
        ...         root=folder, workers=1, progress=False,
        ...     )
        >>> report.collected
        1
    """
    specs: list[dict[str, Any]] = []
    for group in demonstrations:
        spec = {
            "task": group.task,
            "start": dict(group.start),
            "speed": group.speed,
            "waypoint_noise": waypoint_noise,
            "action_noise": action_noise,
            "speed_range": speed_range,
            "keep_steps": keep_steps,
            "max_steps": max_steps,
        }
        specs += [spec] * group.episodes
    tasks = tuple(
        dict.fromkeys((*DEFAULT_TASKS, *(group.task for group in demonstrations)))
    )
    return collect_expert_dataset(
        dataset_id,
        functools.partial(_ExpertSource, tasks),
        specs,
        tasks=tasks,
        root=root,
        work=work,
        seed=seed,
        workers=workers,
        overwrite=overwrite,
        progress=progress,
        description=(
            "A scripted expert's demonstrations of single kitchen tasks: "
            + "; ".join(
                f"{group.episodes} of {group.task}, start {dict(group.start)}"
                for group in demonstrations
            )
        ),
    )


class _ExpertSource(KitchenSource):
    def __init__(self, tasks: Sequence[str]) -> None:
        super().__init__(tasks)
        self.experts: dict[str, Any] = {}

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any] | None:
        self.env.reset(seed=seed)
        observation = set_kitchen_start(self.env, spec["start"])
        task = spec["task"]
        expert = self.experts.get(task)
        if expert is None:
            expert = self.experts[task] = KitchenExpert(self.env, task)
        expert.speed = spec["speed"]
        expert.speed_range = spec["speed_range"]
        expert.waypoint_noise = spec["waypoint_noise"]
        expert.action_noise = spec["action_noise"]
        # Another stream than that of the environment's own noise.
        expert.rng = np.random.default_rng([seed, 1])
        expert.reset()
        done_steps = 0

        def enough(_: Mapping[str, Any]) -> bool:
            nonlocal done_steps
            done_steps += expert.success
            return done_steps > spec["keep_steps"]

        episode = record_episode(
            self.env,
            expert,
            observation,
            max_steps=spec["max_steps"],
            stop=enough,
            state=self.simulator_state,
        )
        if done_steps <= spec["keep_steps"]:
            return None
        moved = self.others_moved(episode["infos"]["qpos"], expert.task.columns)
        return None if moved else episode
