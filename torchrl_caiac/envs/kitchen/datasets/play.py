"""Chains of tasks in the Franka-Kitchen, by the scripted expert."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.data.collect import CollectionReport, record_episode
from torchrl_caiac.envs.kitchen.chain import KitchenChain
from torchrl_caiac.envs.kitchen.datasets.collection import (
    KitchenSource,
    collect_expert_dataset,
)
from torchrl_caiac.envs.kitchen.starts import set_kitchen_start
from torchrl_caiac.envs.kitchen.tasks import task_number
from torchrl_caiac.envs.kitchen.waypoints import TASKS

if TYPE_CHECKING:
    from minari import MinariDataset
    from numpy.typing import NDArray

__all__ = [
    "PLAY_ANY_START_ID",
    "PLAY_ANY_START_ORDERS",
    "PLAY_ID",
    "PLAY_ORDERS",
    "create_kitchen_play",
]

#: Minari's name of the chains, unless another is given.
PLAY_ID = "kitchen/play-v0"
#: Orders of tasks like those of D4RL's mixed and partial kitchens: an early task comes
#: first, and most combinations of done and open tasks never occur. Every task is
#: followed by another in some order: counterfactuals show an object in its final
#: position only if it rests there during another task.
PLAY_ORDERS = (
    ("microwave", "kettle", "top burner", "light switch"),
    ("microwave", "kettle", "hinge cabinet", "slide cabinet"),
    ("kettle", "bottom burner", "light switch", "slide cabinet"),
    ("microwave", "bottom burner", "light switch", "hinge cabinet"),
    ("kettle", "light switch", "hinge cabinet", "slide cabinet"),
    ("bottom burner", "light switch", "slide cabinet", "hinge cabinet"),
)
#: Minari's name of the chains of :data:`PLAY_ANY_START_ORDERS`.
PLAY_ANY_START_ID = "kitchen/play-any-start-v0"
# The hinge cabinet comes before tasks that its open door does not obstruct.
_CYCLE = (
    "microwave",
    "kettle",
    "bottom burner",
    "top burner",
    "light switch",
    "slide cabinet",
    "hinge cabinet",
)
#: Orders in which every task is once the first, second, third and last: four tasks of
#: a cycle, from each of the seven. So every task is shown from the default start, which
#: :data:`PLAY_ORDERS` shows for three. When a task begins, either nothing is done or
#: exactly the one, two or three tasks before it in the cycle: 4 of the 64 combinations
#: of the six others. No object is ever between its two configurations, except while its
#: own task is played. Pass ``max_steps=440``: at the lowest speed, chains with the
#: hinge cabinet take up to 420 steps.
PLAY_ANY_START_ORDERS = tuple(
    tuple(_CYCLE[(first + step) % len(_CYCLE)] for step in range(4))
    for first in range(len(_CYCLE))
)


def create_kitchen_play(
    dataset_id: str = PLAY_ID,
    *,
    orders: Sequence[Sequence[str]] = PLAY_ORDERS,
    episodes: int = 50,
    root: str | os.PathLike[str] | None = None,
    work: str | os.PathLike[str] | None = None,
    speeds: tuple[float, float] = (0.4, 0.7),
    waypoint_noise: float = 0.005,
    action_noise: float = 0.03,
    keep_steps: int = 12,
    max_steps: int = 400,
    seed: int = 0,
    workers: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> tuple[MinariDataset, CollectionReport]:
    """Collects chains of tasks as a Minari dataset.

    Every episode starts in the default state and does the tasks of one order. Few
    orders give what D4RL's kitchens contain, a narrow joint support (paper A.6.1). A
    chain in which a task fails twice, or another object moves, is collected again. The
    metadata contain the order (``"options"``), the infos the simulator's exact
    ``"qpos"`` ``[L + 1, 30]`` and ``"qvel"`` ``[L + 1, 29]`` and the current ``"task"``
    ``[L + 1]``, an index in :data:`~torchrl_caiac.envs.KITCHEN_TASKS`.

    Args:
        dataset_id (str): Minari's name of the dataset. Defaults to :data:`PLAY_ID`.

    Keyword Args:
        orders (sequence of sequence of str): FrankaKitchen's names of the tasks, in the
            orders in which they are done. Defaults to :data:`PLAY_ORDERS`.
        episodes (int): number of episodes of each order. Defaults to 50.
        root (path, optional): folder of Minari datasets. Defaults to
            ``MINARI_DATASETS_PATH`` or Minari's own.
        work (path, optional): folder that keeps finished episodes, so that an
            interrupted collection resumes. Defaults to a temporary one.
        speeds (tuple of float): lowest and highest speed of an episode, factors of the
            expert's own. Defaults to ``(0.4, 0.7)``.
        waypoint_noise (float): of the expert, standard deviation in metres.
            Defaults to 0.005.
        action_noise (float): of the expert, standard deviation. Defaults to 0.03.
        keep_steps (int): number of steps kept after the first in which all tasks are
            done; the last motion continues during them. Defaults to 12.
        max_steps (int): number of steps after which an attempt counts as failed.
            Defaults to 400.
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
        ValueError: no episodes were requested, an order repeats a task, or the speeds
            are not in order.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dataset, report = create_kitchen_play(
        ...         orders=[["kettle", "slide cabinet"]], episodes=1,
        ...         root=folder, workers=1, progress=False,
        ...     )
        >>> report.collected
        1
    """
    for order in orders:
        if not order or len(set(order)) < len(order):
            raise ValueError(
                f"an order is {tuple(order)}, expected at least one task, each only "
                "once"
            )
    low, high = speeds
    if not 0 < low <= high:
        raise ValueError(f"speeds are {speeds}, expected 0 < lowest <= highest")
    rng = np.random.default_rng([seed, 2])
    specs = [
        {
            "tasks": list(order),
            "speed": float(rng.uniform(low, high)),
            "waypoint_noise": waypoint_noise,
            "action_noise": action_noise,
            "keep_steps": keep_steps,
            "max_steps": max_steps,
        }
        for order in orders
        for _ in range(episodes)
    ]
    tasks = tuple(dict.fromkeys(task for order in orders for task in order))
    return collect_expert_dataset(
        dataset_id,
        functools.partial(_PlaySource, tasks),
        specs,
        tasks=tasks,
        root=root,
        work=work,
        seed=seed,
        workers=workers,
        overwrite=overwrite,
        progress=progress,
        description=(
            f"A scripted expert's chains of kitchen tasks, {episodes} of each order: "
            + "; ".join(", ".join(order) for order in orders)
        ),
    )


class _PlaySource(KitchenSource):
    def __init__(self, tasks: Sequence[str]) -> None:
        super().__init__(tasks)
        self.chain: KitchenChain | None = None

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any] | None:
        self.env.reset(seed=seed)
        observation = set_kitchen_start(self.env)
        if self.chain is None:
            self.chain = KitchenChain(
                self.env,
                spec["tasks"],
                speed_range=0.0,
                waypoint_noise=spec["waypoint_noise"],
                action_noise=spec["action_noise"],
            )
        chain = self.chain
        chain.speed = spec["speed"]
        # Another stream than that of the environment's own noise.
        chain.rng = np.random.default_rng([seed, 1])
        chain.reset(spec["tasks"])
        played: list[str] = []
        done_steps = 0

        def play(observation: Any) -> NDArray[np.float64]:
            action = chain(observation)
            # None at the end, when the motion of the last task finishes.
            played.append(chain.task or played[-1])
            return action

        def enough(_: Mapping[str, Any]) -> bool:
            nonlocal done_steps
            done_steps += chain.success
            return chain.finished or done_steps > spec["keep_steps"]

        episode = record_episode(
            self.env,
            play,
            observation,
            max_steps=spec["max_steps"],
            stop=enough,
            state=self.simulator_state,
        )
        own = [column for task in spec["tasks"] for column in TASKS[task].columns]
        if not chain.success or self.others_moved(episode["infos"]["qpos"], own):
            return None
        numbers = [task_number(name) for name in played]
        episode["infos"]["task"] = np.array([*numbers, numbers[-1]])
        return episode
