"""Random actions from states of demonstrations in the Franka-Kitchen."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.data.collect import collect_episodes, load_episode
from torchrl_caiac.data.minari_checks import episode_lengths
from torchrl_caiac.data.minari_files import (
    free_dataset_path,
    open_minari,
    publish_dataset,
    work_folder,
)
from torchrl_caiac.data.trees import index_tree, stack_trees
from torchrl_caiac.envs._requirements import REQUIREMENTS
from torchrl_caiac.envs.kitchen.datasets.collection import (
    DEFAULT_TASKS,
    make_franka_kitchen,
)
from torchrl_caiac.envs.kitchen.datasets.demonstrations import DEMONSTRATIONS_ID
from torchrl_caiac.envs.kitchen.datasets.restorable import RestorableFrankaKitchen
from torchrl_caiac.envs.random_transitions import keep_array, random_episodes

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer
    from numpy.typing import NDArray

__all__ = ["RANDOM_ID", "create_kitchen_random"]

#: Minari's name of the random actions, unless another is given.
RANDOM_ID = "kitchen/random-v0"


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
    """Collects random actions from states of demonstrations as a Minari dataset.

    Each episode restores one state of the demonstrations, velocities included, and
    takes a few uniform actions: a world model that is queried with uniform actions has
    to know their effects (paper A.7). States are used in random order, none twice
    before all have been used.

    Args:
        demonstrations (MinariDataset or str): a dataset with ``"qpos"`` and ``"qvel"``
            in its infos, or its name. Defaults to :data:`DEMONSTRATIONS_ID`.
        dataset_id (str): Minari's name of the new dataset. Defaults to
            :data:`RANDOM_ID`.

    Keyword Args:
        ratio (float): transitions of the new dataset per transition of the
            demonstrations. Defaults to 1.
        steps (int): number of actions per episode. Defaults to 4.
        simulator_states (bool): whether the infos contain ``"qpos"`` and ``"qvel"``
            here too. Minari stores every array separately, so leaving them out saves
            time with short episodes. Defaults to ``False``.
        root (path, optional): folder of Minari datasets. Defaults to
            ``MINARI_DATASETS_PATH`` or Minari's own.
        work (path, optional): folder that keeps finished episodes, so that an
            interrupted collection resumes. Defaults to a temporary one.
        starts_per_file (int): number of episodes that a process collects at a time.
            Defaults to 128.
        seed (int): seed of the collection. Defaults to 0.
        workers (int, optional): number of processes. Defaults to one per processor.
        overwrite (bool): whether to replace a dataset of that name. Defaults to
            ``False``.
        progress (bool): whether to show progress bars. Defaults to ``True``.

    Returns:
        MinariDataset: the dataset.

    Raises:
        FileExistsError: the dataset exists and ``overwrite`` is ``False``.
        KeyError: the demonstrations have no simulator states.
        ValueError: ``ratio``, ``steps`` or ``starts_per_file`` is out of range.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.envs import create_kitchen_demonstrations
        >>> from torchrl_caiac.envs.kitchen import Demonstrations
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     options = {"root": folder, "workers": 1, "progress": False}
        ...     dataset, _ = create_kitchen_demonstrations(
        ...         demonstrations=[Demonstrations("kettle", episodes=1)], **options
        ...     )
        ...     random = create_kitchen_random(dataset, ratio=0.5, **options)
        >>> bool(random.total_steps > 0)
        True
    """
    if not (np.isfinite(ratio) and ratio > 0):
        raise ValueError(f"ratio is {ratio}, expected a positive number")
    if steps < 1 or starts_per_file < 1:
        raise ValueError(
            f"steps is {steps} and starts_per_file {starts_per_file}, expected at "
            "least 1"
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
        keep_array(stored, states)
        report = collect_episodes(
            functools.partial(_RandomSource, str(stored)),
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
        lambda: make_franka_kitchen(DEFAULT_TASKS),
        code="torchrl_caiac/envs/kitchen/datasets",
        requirements=REQUIREMENTS,
        progress=progress,
        description=(
            f"{steps} uniformly random actions from each of {total} states of "
            f"{demonstrations.id}, velocities restored"
        ),
        algorithm_name="uniform random actions",
    )


class _RandomSource:
    def __init__(self, states: str) -> None:
        self.env = RestorableFrankaKitchen()
        # Mapped: an array's header could ask for any amount of memory.
        self.states = np.load(states, mmap_mode="r", allow_pickle=False)

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any]:
        self.env.seed(seed)
        episodes = random_episodes(
            self.env,
            self.states[spec["starts"]],
            steps=spec["steps"],
            rng=np.random.default_rng([seed, 1]),
            record=spec["simulator_states"],
        )
        return stack_trees(list(episodes))

    def close(self) -> None:
        self.env.close()


def _random_buffers(file: Path) -> Iterator[EpisodeBuffer]:
    from minari.data_collector import EpisodeBuffer

    arrays, _ = load_episode(file)
    for index in range(len(arrays["actions"])):
        yield EpisodeBuffer(**index_tree(arrays, index))


def _simulator_states(dataset: MinariDataset) -> NDArray[np.float64]:
    """Returns positions and velocities ``[M, 59]`` of all states with an action."""
    states = []
    episode_lengths(dataset)  # raises before an episode is read
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
