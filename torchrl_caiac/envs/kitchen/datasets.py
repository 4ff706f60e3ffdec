"""The kitchen's Minari datasets: single tasks and chains of them, random actions.

All have the schema of Minari's `D4RL/kitchen/*-v2`, FrankaKitchen-v1's own dict
observations with 59 columns: robot positions 9 and velocities 9, object positions 21
and velocities 20. `kitchen_transitions` makes TorchRL rows with the 30-column state
of them, of Minari's own datasets too; `load_d4rl_kitchen` those of D4RL's older files.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.data.collect import (
    CollectionReport,
    EpisodeSource,
    collect_episodes,
    load_episode,
    record_episode,
)
from torchrl_caiac.data.load_minari import load_minari
from torchrl_caiac.data.minari_files import (
    free_dataset_path,
    open_minari,
    publish_dataset,
    work_folder,
)
from torchrl_caiac.data.trees import index_tree, stack_trees
from torchrl_caiac.data.write_transitions import check_free, write_transitions
from torchrl_caiac.envs._requirements import REQUIREMENTS

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer
    from numpy.typing import NDArray
    from tensordict import TensorDict

__all__ = [
    "DEMONSTRATIONS_ID",
    "MICROWAVE_KETTLE",
    "PLAY_ID",
    "PLAY_ORDERS",
    "RANDOM_ID",
    "STATE_COLUMNS",
    "Demonstrations",
    "create_kitchen_demonstrations",
    "create_kitchen_play",
    "create_kitchen_random",
    "kitchen_transitions",
    "load_d4rl_kitchen",
]

logger = logging.getLogger("torchrl_caiac.envs.kitchen.datasets")

DEMONSTRATIONS_ID = "kitchen/microwave-kettle-v0"
PLAY_ID = "kitchen/play-v0"
RANDOM_ID = "kitchen/random-v0"
#: Columns of the 59 that make the 30-column state: robot and object positions.
STATE_COLUMNS = (*range(0, 9), *range(18, 39))
_TASKS = ("microwave", "kettle")
_ENV_ID = "FrankaKitchen-v1"
# Objects settle by up to 7 mm (or mrad) when an episode starts; more is a collision.
_UNTOUCHED = 0.02


@dataclasses.dataclass(frozen=True)
class Demonstrations:
    """A number of demonstrations of one task from one start.

    Args:
        task: FrankaKitchen's name of the task.
        episodes: how many.
        start: object joints that differ from the default start, by name.
        speed: the expert's speed factor.
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

#: Orders of tasks like those of D4RL's mixed and partial kitchens: an early task comes
#: first, and most combinations of what is done and what is not never occur. Every task
#: is followed by another in some order: counterfactuals show an object's last place
#: only where it is at rest while something else is done.
PLAY_ORDERS = (
    ("microwave", "kettle", "top burner", "light switch"),
    ("microwave", "kettle", "hinge cabinet", "slide cabinet"),
    ("kettle", "bottom burner", "light switch", "slide cabinet"),
    ("microwave", "bottom burner", "light switch", "hinge cabinet"),
    ("kettle", "light switch", "hinge cabinet", "slide cabinet"),
    ("bottom burner", "light switch", "slide cabinet", "hinge cabinet"),
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
    """Collect successful episodes of the expert as a Minari dataset.

    Each episode's metadata holds its task and start (`"options"`), its infos the
    simulator's exact "qpos" `[L + 1, 30]` and "qvel" `[L + 1, 29]`.

    Args:
        dataset_id: Minari's name of the dataset.

    Keyword Args:
        demonstrations: which tasks, from where, how many.
        root: folder of Minari datasets; `MINARI_DATASETS_PATH` or Minari's own where
            None.
        work: folder that keeps finished episodes, so that a collection that was cut
            off goes on; a temporary one where None.
        waypoint_noise: of the expert, standard deviation in metres.
        action_noise: of the expert, standard deviation.
        speed_range: of the expert, share of the speed.
        keep_steps: steps kept after the first in which the task is done.
        max_steps: steps after which an attempt counts as failed.
        seed: seed of the collection.
        workers: processes; one per processor where None.
        overwrite: replace a dataset of that name.
        progress: show progress bars.

    Returns:
        the dataset, and the numbers of attempts.

    Raises:
        FileExistsError: there is a dataset of that name and `overwrite` is False.
        ValueError: no demonstrations were asked for.
    """
    _check_tasks([group.task for group in demonstrations])
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
    tasks = tuple(dict.fromkeys((*_TASKS, *(group.task for group in demonstrations))))
    return _create(
        dataset_id,
        _ExpertFactory(tasks),
        specs,
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
    """Collect chains of tasks, one after another, as a Minari dataset.

    Every episode begins in the default start and does the tasks of one order; few
    orders make what D4RL's kitchens are made of, a narrow joint support (paper A.6.1).
    A chain in which a task fails twice, or another object is moved, is made again. The
    metadata hold the order (`"options"`), the infos the simulator's exact "qpos"
    `[L + 1, 30]` and "qvel" `[L + 1, 29]` and the "task" `[L + 1]` being done, a
    position in `KITCHEN_TASKS`.

    Args:
        dataset_id: Minari's name of the dataset.

    Keyword Args:
        orders: FrankaKitchen's names of the tasks, in the orders to do them.
        episodes: how many of each order.
        root: folder of Minari datasets; `MINARI_DATASETS_PATH` or Minari's own where
            None.
        work: folder that keeps finished episodes, so that a collection that was cut
            off goes on; a temporary one where None.
        speeds: lowest and highest speed of an episode, factors of the expert's own.
        waypoint_noise: of the expert, standard deviation in metres.
        action_noise: of the expert, standard deviation.
        keep_steps: steps kept after the first in which all tasks are done, in which the
            last motion goes on.
        max_steps: steps after which an attempt counts as failed.
        seed: seed of the collection.
        workers: processes; one per processor where None.
        overwrite: replace a dataset of that name.
        progress: show progress bars.

    Returns:
        the dataset, and the numbers of attempts.

    Raises:
        FileExistsError: there is a dataset of that name and `overwrite` is False.
        KeyError: the expert does not know a task.
        ValueError: no episodes were asked for, an order repeats a task, or speeds are
            out of order.
    """
    _check_tasks([task for order in orders for task in order])
    for order in orders:
        if not order or len(set(order)) < len(order):
            raise ValueError(
                f"an order is {tuple(order)}, wanted at least one task, each only once"
            )
    low, high = speeds
    if not 0 < low <= high:
        raise ValueError(f"speeds are {speeds}, wanted 0 < lowest <= highest")
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
    return _create(
        dataset_id,
        _PlayFactory(tasks),
        specs,
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


def _check_tasks(names: Sequence[str]) -> None:
    from torchrl_caiac.envs.kitchen.expert import TASKS

    for name in names:
        if name not in TASKS:
            raise KeyError(f"no expert for task {name!r}; known tasks: {sorted(TASKS)}")


def _create(
    dataset_id: str,
    factory: _ExpertFactory | _PlayFactory,
    specs: Sequence[Mapping[str, Any]],
    *,
    root: str | os.PathLike[str] | None,
    work: str | os.PathLike[str] | None,
    seed: int,
    workers: int | None,
    overwrite: bool,
    progress: bool,
    description: str,
) -> tuple[MinariDataset, CollectionReport]:
    """Collect an episode per specification and publish them."""
    target = free_dataset_path(dataset_id, root, overwrite)
    if not specs:
        raise ValueError("no demonstrations asked for: every group has 0 episodes")
    with work_folder(work, dataset_id) as folder:
        report = collect_episodes(
            factory,
            specs,
            folder,
            seed=seed,
            workers=workers,
            progress=progress,
            description=f"episodes of {dataset_id}",
        )
        buffers = [_demonstration_buffer(file) for file in report.files]
    dataset = publish_dataset(
        dataset_id,
        buffers,
        target,
        lambda: _make_env(factory.tasks),
        code="torchrl_caiac/envs/kitchen/datasets.py",
        requirements=REQUIREMENTS,
        progress=progress,
        description=description,
        algorithm_name="torchrl_caiac scripted expert",
    )
    return dataset, report


def create_kitchen_random(
    demonstrations: MinariDataset | str = DEMONSTRATIONS_ID,
    dataset_id: str = RANDOM_ID,
    *,
    ratio: float = 1.0,
    steps: int = 4,
    simulator_states: bool = False,
    root: str | os.PathLike[str] | None = None,
    work: str | os.PathLike[str] | None = None,
    starts_per_file: int = 128,
    seed: int = 0,
    workers: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> MinariDataset:
    """Collect random actions from states of demonstrations as a Minari dataset.

    Each episode restores one state of the demonstrations, velocities included, and
    takes a few uniform actions, which is what a world model that is asked about
    uniform actions has to know (paper A.7). States are used in random order, none
    twice before all have been used.

    Args:
        demonstrations: a dataset with "qpos" and "qvel" in its infos, or its name.
        dataset_id: Minari's name of the new dataset.

    Keyword Args:
        ratio: rows of the new dataset per row of the demonstrations.
        steps: actions per episode.
        simulator_states: keep "qpos" and "qvel" in the infos here too. Minari stores
            every array on its own, so leaving them out saves time with short
            episodes.
        root: folder of Minari datasets; `MINARI_DATASETS_PATH` or Minari's own where
            None.
        work: folder that keeps what is finished; a temporary one where None.
        starts_per_file: episodes that a process makes at a time.
        seed: seed of the collection.
        workers: processes; one per processor where None.
        overwrite: replace a dataset of that name.
        progress: show progress bars.

    Returns:
        the dataset.

    Raises:
        FileExistsError: there is a dataset of that name and `overwrite` is False.
        KeyError: the demonstrations have no simulator states.
        ValueError: ratio, steps or starts_per_file out of range.
    """
    if not (np.isfinite(ratio) and ratio > 0):
        raise ValueError(f"ratio is {ratio}, wanted a positive number")
    if steps < 1 or starts_per_file < 1:
        raise ValueError(
            f"steps is {steps} and starts_per_file {starts_per_file}, wanted at least 1"
        )
    target = free_dataset_path(dataset_id, root, overwrite)
    if isinstance(demonstrations, str):
        demonstrations = open_minari(demonstrations, root)
    states = _simulator_states(demonstrations)
    total = max(round(ratio * int(demonstrations.total_steps) / steps), 1)
    rng = np.random.default_rng([seed, 1])
    rounds = -(-total // len(states))
    starts = np.concatenate([rng.permutation(len(states)) for _ in range(rounds)])
    starts = starts[:total]
    specs = [
        {
            "starts": starts[first : first + starts_per_file].tolist(),
            "steps": steps,
            "simulator_states": simulator_states,
        }
        for first in range(0, total, starts_per_file)
    ]
    with work_folder(work, dataset_id) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        stored = folder / "states.npy"
        if not (stored.exists() and _same_array(stored, states)):
            if (folder / "collection.json").exists():
                raise ValueError(
                    f"{folder} holds random actions from other demonstrations; give "
                    "another folder or delete this one"
                )
            np.save(stored, states)
        report = collect_episodes(
            _RandomFactory(_TASKS, str(stored)),
            specs,
            folder,
            seed=seed,
            workers=workers,
            progress=progress,
            description=f"random actions, {starts_per_file} x {steps}",
        )
        buffers = [buffer for file in report.files for buffer in _random_buffers(file)]
    return publish_dataset(
        dataset_id,
        buffers,
        target,
        lambda: _make_env(_TASKS),
        code="torchrl_caiac/envs/kitchen/datasets.py",
        requirements=REQUIREMENTS,
        progress=progress,
        description=(
            f"{steps} uniformly random actions from each of {total} states of "
            f"{demonstrations.id}, velocities restored"
        ),
        algorithm_name="uniform random actions",
    )


def kitchen_transitions(
    dataset: MinariDataset | str,
    path: str | os.PathLike[str] | None = None,
    *,
    root: str | os.PathLike[str] | None = None,
    download: bool = False,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Return a kitchen dataset as TorchRL rows with the 30-column state.

    Rows `[T]` hold "observation" `[30]` (columns 0-8 and 18-38 of the 59), "action"
    `[9]`, the same under "next" with "reward", "done", "terminated" and "truncated"
    `[1]`, "episode" `[]` int64, "task" `[]` int64 and, where the episodes' infos have
    them, the simulator's exact ("sim", "qpos") `[30]` and ("sim", "qvel") `[29]` in
    float64. "task" is what is being done, a position in `KITCHEN_TASKS`: that of the
    step where the infos have a "task", else the one that the episode's metadata name,
    else -1. Everything else with decimals is float32. Goals are left out: they are
    drawn from later states.

    Args:
        dataset: a Minari dataset of FrankaKitchen-v1, `D4RL/kitchen/*` included, or
            its name.
        path: folder for a memory-mapped result; in memory where None.

    Keyword Args:
        root: folder of Minari datasets, for a name.
        download: fetch a dataset that is not there ("D4RL/kitchen/mixed-v2", say),
            with :func:`minari.download_dataset`.
        overwrite: replace what is at `path`.
        progress: show a progress bar.

    Returns:
        TensorDict of batch size `[T]`.

    Raises:
        FileExistsError: something is at `path` and `overwrite` is False.
        FileNotFoundError: the dataset is not on this machine.
        ValueError: observations are not 59 columns or actions not 9, an episode does
            not fit together or has values that are not finite, or no rows at all.
    """
    import torch

    from torchrl_caiac.envs.kitchen.env import KITCHEN_TASKS

    check_free(path, overwrite)
    if isinstance(dataset, str):
        dataset = open_minari(dataset, root, download=download)
    indices = dataset.episode_indices
    known = dataset.storage.get_episode_metadata(indices)
    names = [str((m.get("options") or {}).get("task")).replace(" ", "_") for m in known]
    tasks = torch.tensor(
        [KITCHEN_TASKS.index(n) if n in KITCHEN_TASKS else -1 for n in names]
    )
    first = (dataset[indices[0]].infos or {}) if len(indices) else {}
    infos = [name for name in ("qpos", "qvel", "task") if name in first]
    with tempfile.TemporaryDirectory(prefix="kitchen-") as folder:
        loaded = load_minari(
            dataset,
            Path(folder) / "rows",
            infos=infos,
            progress=progress,
        )
        for name, width in (("observation", 59), ("action", 9)):
            if loaded[name].shape[1:] != (width,):
                raise ValueError(
                    f"the {name}s of {dataset.id} have shape "
                    f"{list(loaded[name].shape[1:])}, wanted [{width}]: is it of "
                    "FrankaKitchen-v1?"
                )
        columns = list(STATE_COLUMNS)
        # In memory: the files that were loaded go when the block ends.
        rows = loaded.select("action", "episode").clone()
        rows["next"] = loaded["next"].exclude("achieved_goal", "desired_goal").clone()
        rows["observation"] = loaded["observation"][:, columns]
        rows["next", "observation"] = loaded["next", "observation"][:, columns]
        rows["task"] = tasks[rows["episode"]]
        for name in infos:
            key = "task" if name == "task" else ("sim", name)
            rows[key] = loaded["info", name].clone()
    if path is None:
        return rows
    return write_transitions(rows, path, overwrite=overwrite)


def load_d4rl_kitchen(
    file: str | os.PathLike[str],
    path: str | os.PathLike[str] | None = None,
    *,
    overwrite: bool = False,
) -> TensorDict:
    """Return a kitchen file of the original D4RL as rows of `kitchen_transitions`.

    Such an HDF5 file holds "observations" `[M, 60]` (robot positions 9, object
    positions 21, a goal that is left out 30), "actions" `[M, 9]`, "rewards",
    "terminals" and "timeouts" `[M]`, episodes one after another. Next states are not
    stored: an episode's last row has none, so it is left out, and the row before it is
    the trajectory's end (truncated). "task" is -1.

    Args:
        file: the HDF5 file.
        path: folder for a memory-mapped result; in memory where None.

    Keyword Args:
        overwrite: replace what is at `path`.

    Returns:
        TensorDict of batch size `[T]`.

    Raises:
        FileExistsError: something is at `path` and `overwrite` is False.
        KeyError: the file lacks one of the five arrays.
        ValueError: the file is no HDF5 file or truncated; widths or lengths are wrong;
            values are not finite; no episode has two rows.

    Example:
        >>> import tempfile, h5py, numpy as np
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with h5py.File(f"{folder}/kitchen.hdf5", "w") as file:
        ...         file["observations"] = np.zeros((5, 60))
        ...         file["actions"] = np.zeros((5, 9))
        ...         file["rewards"] = np.zeros(5)
        ...         file["terminals"] = np.array([0, 1, 0, 0, 0], bool)
        ...         file["timeouts"] = np.array([0, 0, 0, 0, 1], bool)
        ...     rows = load_d4rl_kitchen(f"{folder}/kitchen.hdf5")
        >>> rows["episode"].tolist()
        [0, 1, 1]
    """
    import torch
    from tensordict import TensorDict

    check_free(path, overwrite)
    arrays = _read_d4rl(Path(file))
    over = (arrays["terminals"] | arrays["timeouts"]).copy()
    over[-1:] = True
    kept = np.flatnonzero(~over)
    if not len(kept):
        raise ValueError(f"{file} has no rows that are followed by another")
    # The episodes that are left, numbered without gaps.
    numbers = np.concatenate([[0], np.cumsum(over)[:-1]])[kept]
    last = torch.from_numpy(over[kept + 1]).unsqueeze(-1)
    state = torch.from_numpy(arrays["observations"][:, :30].astype(np.float32))
    rows = TensorDict(
        {
            "observation": state[kept],
            "action": torch.from_numpy(arrays["actions"][kept].astype(np.float32)),
            "episode": torch.from_numpy(np.unique(numbers, return_inverse=True)[1]),
            "task": torch.full((len(kept),), -1),
            "next": {
                "observation": state[kept + 1],
                "reward": torch.from_numpy(
                    arrays["rewards"][kept, None].astype(np.float32)
                ),
                "terminated": torch.zeros_like(last),
                "truncated": last,
                "done": last.clone(),
            },
        },
        batch_size=[len(kept)],
    )
    if path is None:
        return rows
    return write_transitions(rows, path, overwrite=overwrite)


#: Shapes and kinds of a D4RL kitchen's arrays, without the rows.
_D4RL_ARRAYS: Mapping[str, tuple[int, ...]] = {
    "observations": (60,),
    "actions": (9,),
    "rewards": (),
    "terminals": (),
    "timeouts": (),
}


def _read_d4rl(file: Path) -> dict[str, NDArray[Any]]:
    import h5py

    if not file.exists():
        raise FileNotFoundError(f"no file at {file}")
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with h5py.File(file, "r") as stored:
            missing = sorted(set(_D4RL_ARRAYS) - set(stored))
            if missing:
                raise KeyError(
                    f"{file} lacks {missing}, it has {sorted(stored)}: is it a kitchen "
                    "file of D4RL?"
                )
            for name in _D4RL_ARRAYS:
                arrays[name] = np.asarray(stored[name])
    except OSError as error:
        raise ValueError(
            f"{file} is no HDF5 file, or a truncated one ({error}): get it again"
        ) from error
    length = len(arrays["observations"])
    for name, shape in _D4RL_ARRAYS.items():
        array = arrays[name]
        if array.shape != (length, *shape):
            raise ValueError(
                f"{name!r} in {file} has shape {array.shape}, wanted {(length, *shape)}"
            )
        if not np.isfinite(array).all():
            raise ValueError(
                f"{name!r} in {file} has NaN or infinite values, the first in row "
                f"{int((~np.isfinite(array)).nonzero()[0][0])}: leave its episode out"
            )
        if name in ("terminals", "timeouts"):
            arrays[name] = array.astype(np.bool_)
    return arrays


# Sources of episodes. They live in worker processes, made there by their factories.


@dataclasses.dataclass(frozen=True)
class _ExpertFactory:
    tasks: tuple[str, ...]

    def __call__(self) -> EpisodeSource:
        return _ExpertSource(self.tasks)


@dataclasses.dataclass(frozen=True)
class _PlayFactory:
    tasks: tuple[str, ...]

    def __call__(self) -> EpisodeSource:
        return _PlaySource(self.tasks)


@dataclasses.dataclass(frozen=True)
class _RandomFactory:
    tasks: tuple[str, ...]
    states: str

    def __call__(self) -> EpisodeSource:
        return _RandomSource(self.tasks, np.load(self.states))


def _make_env(tasks: Sequence[str]) -> Any:
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(
        _ENV_ID,
        tasks_to_complete=list(tasks),
        # Whole motions, and rewards that do not depend on what happened before.
        terminate_on_tasks_completed=False,
        remove_task_when_completed=False,
        # As in Minari's own: chains take longer than the 280 of an evaluation.
        max_episode_steps=450,
        # It warns of views of simulator memory, which record_episode copies.
        disable_env_checker=True,
    )


class _ExpertSource:
    def __init__(self, tasks: Sequence[str]) -> None:
        self.env = _make_env(tasks)
        self.experts: dict[str, Any] = {}

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any] | None:
        from torchrl_caiac.envs.kitchen.expert import KitchenExpert, set_kitchen_start

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
        # Not the stream that the environment's own noise has.
        expert.rng = np.random.default_rng([seed, 1])
        expert.reset()
        data = expert.data
        start = data.qpos.copy()
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
            state=lambda: {"qpos": data.qpos, "qvel": data.qvel},
        )
        others = np.setdiff1d(np.arange(9, data.qpos.size), expert.task.columns)
        moved = np.abs(episode["infos"]["qpos"] - start)[:, others].max()
        if done_steps <= spec["keep_steps"] or moved > _UNTOUCHED:
            return None
        return episode

    def close(self) -> None:
        self.env.close()


class _PlaySource:
    def __init__(self, tasks: Sequence[str]) -> None:
        self.env = _make_env(tasks)
        self.chain: Any = None

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any] | None:
        from torchrl_caiac.envs.kitchen.env import KITCHEN_TASKS
        from torchrl_caiac.envs.kitchen.expert import (
            TASKS,
            KitchenChain,
            set_kitchen_start,
        )

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
        # Not the stream that the environment's own noise has.
        chain.rng = np.random.default_rng([seed, 1])
        chain.reset(spec["tasks"])
        data = self.env.unwrapped.robot_env.data
        start = data.qpos.copy()
        played: list[str] = []
        done_steps = 0

        def play(observation: Any) -> NDArray[np.float64]:
            action = chain(observation)
            # None once all is over: the last task's motion ends then.
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
            state=lambda: {"qpos": data.qpos, "qvel": data.qvel},
        )
        own = [column for task in spec["tasks"] for column in TASKS[task].columns]
        others = np.setdiff1d(np.arange(9, data.qpos.size), own)
        moved = np.abs(episode["infos"]["qpos"] - start)[:, others].max()
        if not chain.success or moved > _UNTOUCHED:
            return None
        numbers = [KITCHEN_TASKS.index(name.replace(" ", "_")) for name in played]
        episode["infos"]["task"] = np.array([*numbers, numbers[-1]])
        return episode

    def close(self) -> None:
        self.env.close()


class _RandomSource:
    def __init__(self, tasks: Sequence[str], states: NDArray[np.float64]) -> None:
        self.env = _make_env(tasks)
        self.states = states

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any]:
        from torchrl_caiac.envs.kitchen.expert import set_kitchen_start

        rng = np.random.default_rng([seed, 1])
        data = self.env.unwrapped.robot_env.data
        self.env.reset(seed=seed)
        episodes = []
        for start in spec["starts"]:
            # The environment without its wrappers: they count steps over episodes.
            observation = set_kitchen_start(
                self.env,
                qpos=self.states[start, :30],
                qvel=self.states[start, 30:],
            )
            episodes.append(
                record_episode(
                    self.env.unwrapped,
                    lambda _: rng.uniform(-1.0, 1.0, 9),
                    observation,
                    max_steps=spec["steps"],
                    state=(lambda: {"qpos": data.qpos, "qvel": data.qvel})
                    if spec["simulator_states"]
                    else None,
                )
            )
        return stack_trees(episodes)

    def close(self) -> None:
        self.env.close()


# Minari.


def _demonstration_buffer(file: Path) -> EpisodeBuffer:
    from minari.data_collector import EpisodeBuffer

    arrays, meta = load_episode(file)
    spec = meta["spec"]
    options = (
        {"tasks": json.dumps(spec["tasks"]), "speed": spec["speed"]}
        if "tasks" in spec
        else {"task": spec["task"], "start": json.dumps(spec["start"])}
    )
    return EpisodeBuffer(seed=meta["seed"], options=options, **arrays)


def _random_buffers(file: Path) -> Iterator[EpisodeBuffer]:
    from minari.data_collector import EpisodeBuffer

    arrays, _ = load_episode(file)
    for index in range(len(arrays["actions"])):
        yield EpisodeBuffer(**index_tree(arrays, index))


def _simulator_states(dataset: MinariDataset) -> NDArray[np.float64]:
    """Return positions and velocities `[M, 59]` of all states that have an action."""
    states = []
    for episode in dataset.iterate_episodes():
        infos = episode.infos or {}
        missing = {"qpos", "qvel"} - set(infos)
        if missing:
            raise KeyError(
                f"the infos of {dataset.id} have no {sorted(missing)}, which are "
                "needed to restore its states; collect it with "
                "create_kitchen_demonstrations"
            )
        both = np.concatenate([infos["qpos"], infos["qvel"]], axis=1)
        states.append(both[: len(episode.actions)])
    return np.concatenate(states)


def _same_array(file: Path, array: NDArray[Any]) -> bool:
    try:
        return np.array_equal(np.load(file, allow_pickle=False), array)
    except (OSError, ValueError, EOFError):
        return False
