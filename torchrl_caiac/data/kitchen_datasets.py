"""The kitchen's Minari datasets: demonstrations of the expert and random actions.

Both have the schema of Minari's `D4RL/kitchen/*-v2`, FrankaKitchen-v1's own dict
observations with 59 columns: robot positions 9 and velocities 9, object positions 21
and velocities 20. `kitchen_transitions` makes TorchRL rows with the 30-column state
of them.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
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
from torchrl_caiac.data.minari_files import (
    free_dataset_path,
    index_tree,
    open_minari,
    publish_dataset,
    stack_trees,
    work_folder,
    write_rows,
)

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer
    from numpy.typing import NDArray
    from tensordict import TensorDict

__all__ = [
    "DEMONSTRATIONS_ID",
    "MICROWAVE_KETTLE",
    "RANDOM_ID",
    "STATE_COLUMNS",
    "Demonstrations",
    "create_kitchen_demonstrations",
    "create_kitchen_random",
    "kitchen_transitions",
]

logger = logging.getLogger("torchrl_caiac.data.kitchen_datasets")

DEMONSTRATIONS_ID = "kitchen/microwave-kettle-v0"
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
    from torchrl_caiac.envs.kitchen_expert import TASKS

    target = free_dataset_path(dataset_id, root, overwrite)
    specs: list[dict[str, Any]] = []
    for group in demonstrations:
        if group.task not in TASKS:
            raise KeyError(
                f"no expert for task {group.task!r}; known tasks: {sorted(TASKS)}"
            )
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
    if not specs:
        raise ValueError("no demonstrations asked for: every group has 0 episodes")
    tasks = tuple(dict.fromkeys((*_TASKS, *(group.task for group in demonstrations))))
    with work_folder(work, dataset_id) as folder:
        report = collect_episodes(
            _ExpertFactory(tasks),
            specs,
            folder,
            seed=seed,
            workers=workers,
            progress=progress,
            description="demonstrations",
        )
        buffers = [_demonstration_buffer(file) for file in report.files]
    dataset = publish_dataset(
        dataset_id,
        buffers,
        target,
        lambda: _make_env(tasks),
        code="torchrl_caiac/data/kitchen_datasets.py",
        progress=progress,
        description=(
            "A scripted expert's demonstrations of single kitchen tasks: "
            + "; ".join(
                f"{group.episodes} of {group.task}, start {dict(group.start)}"
                for group in demonstrations
            )
        ),
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
        code="torchrl_caiac/data/kitchen_datasets.py",
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
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Return a kitchen dataset as TorchRL rows with the 30-column state.

    Rows `[T]` hold "observation" `[30]` (columns 0-8 and 18-38 of the 59), "action"
    `[9]`, the same under "next" with "reward", "done", "terminated" and "truncated"
    `[1]`, "episode" `[]` int64, "task" `[]` int64 (position in `KITCHEN_TASKS`, -1
    where the episode's metadata name none) and, where every episode's infos have them,
    the simulator's exact ("sim", "qpos") `[30]` and ("sim", "qvel") `[29]` in
    float64. Everything else with decimals is float32.

    Args:
        dataset: a Minari dataset of FrankaKitchen-v1, `D4RL/kitchen/*` included, or
            its name.
        path: folder for a memory-mapped result; in memory where None.

    Keyword Args:
        root: folder of Minari datasets, for a name.
        overwrite: replace what is at `path`.
        progress: show a progress bar.

    Returns:
        TensorDict of batch size `[T]`.

    Raises:
        FileExistsError: something is at `path` and `overwrite` is False.
        ValueError: observations are not 59 finite columns, or no rows at all.
    """
    import torch
    from tensordict import TensorDict
    from tqdm import tqdm

    from torchrl_caiac.envs.kitchen import KITCHEN_TASKS

    if path is not None and Path(path).exists() and not overwrite:
        raise FileExistsError(
            f"{path} exists; pass overwrite=True to replace it, or open it with "
            "load_transitions"
        )
    if isinstance(dataset, str):
        dataset = open_minari(dataset, root)
    columns = list(STATE_COLUMNS)
    indices = dataset.episode_indices
    metadata = dataset.storage.get_episode_metadata(indices)
    names = ("state", "next", "action", "reward", "terminated", "truncated")
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    simulator: dict[str, list[NDArray[Any]]] = {"qpos": [], "qvel": []}
    tasks, lengths = [], []
    bar = tqdm(
        zip(dataset.iterate_episodes(indices), metadata, strict=True),
        total=len(indices),
        desc=f"loading {dataset.id}",
        disable=not progress,
    )
    for episode, known in bar:
        observation = episode.observations["observation"]
        length = len(episode.actions)
        if observation.shape != (length + 1, 59) or not np.isfinite(observation).all():
            raise ValueError(
                f"episode {episode.id} of {dataset.id} has observations of shape "
                f"{observation.shape} or values that are not finite, wanted "
                f"{(length + 1, 59)} finite numbers"
            )
        parts["state"].append(observation[:-1, columns])
        parts["next"].append(observation[1:, columns])
        parts["action"].append(episode.actions)
        parts["reward"].append(episode.rewards[:, None])
        parts["terminated"].append(episode.terminations[:, None])
        parts["truncated"].append(episode.truncations[:, None])
        task = str((known.get("options") or {}).get("task")).replace(" ", "_")
        tasks.append(KITCHEN_TASKS.index(task) if task in KITCHEN_TASKS else -1)
        lengths.append(length)
        for name, values in simulator.items():
            if name in (episode.infos or {}):
                values.append(episode.infos[name][:length])
    if sum(lengths) == 0:
        raise ValueError(f"{dataset.id} has no rows")

    def joined(values: list[NDArray[Any]], dtype: torch.dtype) -> torch.Tensor:
        return torch.from_numpy(np.concatenate(values)).to(dtype)

    real, flag = torch.float32, torch.bool
    counts = torch.tensor(lengths)
    terminated = joined(parts["terminated"], flag)
    truncated = joined(parts["truncated"], flag)
    # A trajectory's last row is its end whatever the file says about it.
    last = counts.cumsum(0)[counts > 0] - 1
    truncated[last] |= ~terminated[last]
    rows = TensorDict(
        {
            "observation": joined(parts["state"], real),
            "action": joined(parts["action"], real),
            "episode": torch.arange(len(lengths)).repeat_interleave(counts),
            "task": torch.tensor(tasks).repeat_interleave(counts),
            "next": {
                "observation": joined(parts["next"], real),
                "reward": joined(parts["reward"], real),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
        },
        batch_size=[sum(lengths)],
    )
    if all(len(values) == len(lengths) for values in simulator.values()):
        for name, values in simulator.items():
            rows["sim", name] = joined(values, torch.float64)
    return rows if path is None else write_rows(rows, path)


# Sources of episodes. They live in worker processes, made there by their factories.


@dataclasses.dataclass(frozen=True)
class _ExpertFactory:
    tasks: tuple[str, ...]

    def __call__(self) -> EpisodeSource:
        return _ExpertSource(self.tasks)


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
        # It warns of views of simulator memory, which record_episode copies.
        disable_env_checker=True,
    )


class _ExpertSource:
    def __init__(self, tasks: Sequence[str]) -> None:
        self.env = _make_env(tasks)
        self.experts: dict[str, Any] = {}

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any] | None:
        from torchrl_caiac.envs.kitchen_expert import KitchenExpert, set_kitchen_start

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


class _RandomSource:
    def __init__(self, tasks: Sequence[str], states: NDArray[np.float64]) -> None:
        self.env = _make_env(tasks)
        self.states = states

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any]:
        from torchrl_caiac.envs.kitchen_expert import set_kitchen_start

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
    options = {"task": spec["task"], "start": json.dumps(spec["start"])}
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
