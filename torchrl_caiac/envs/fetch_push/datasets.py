"""Fetch-Push's Minari datasets: episodes of the scripted expert and random ones.

Both have the schema of a goal environment, `FetchPushCubes`' own observations; with
:func:`~torchrl_caiac.data.load_minari.load_minari` they become TorchRL rows, with
:func:`~torchrl_caiac.data.mix_trajectories.mix_trajectories` a mixture of the two.
"""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.data.collect import (
    EpisodeSource,
    collect_episodes,
    load_episode,
    record_episode,
)
from torchrl_caiac.data.minari_files import (
    free_dataset_path,
    publish_dataset,
    work_folder,
)
from torchrl_caiac.data.trees import index_tree, stack_trees
from torchrl_caiac.envs._requirements import REQUIREMENTS

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer

__all__ = ["create_fetch_push_expert", "create_fetch_push_random"]

logger = logging.getLogger("torchrl_caiac.envs.fetch_push.datasets")

_POLICIES = _EXPERT, _RANDOM = ("expert", "random")


def create_fetch_push_expert(
    dataset_id: str | None = None,
    *,
    episodes: int = 600,
    num_cubes: int = 2,
    steps: int = 100,
    action_noise: float = 0.2,
    simulator_states: bool = True,
    root: str | os.PathLike[str] | None = None,
    work: str | os.PathLike[str] | None = None,
    episodes_per_file: int = 10,
    seed: int = 0,
    workers: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> MinariDataset:
    """Collect episodes of the scripted expert as a Minari dataset.

    Every episode has `steps` steps and is kept, successful or not: the paper's expert
    fails now and then too (A.6.2). Logged, and in the dataset's description, are the
    shares of episodes in which all cubes are at their goals at some time, which the
    paper calls success, and at the end. Infos hold, with `L = steps`, "success" bool
    `[L + 1]` and "simulator" float64 `[L + 1, S]`, the simulator's exact state
    (`FetchPushCubes.set_simulator_state` restores it).

    Args:
        dataset_id: Minari's name of the dataset; `fetch-push-2/expert-v0`, or with the
            number of cubes in its place, where None.

    Keyword Args:
        episodes: how many.
        num_cubes: cubes on the table.
        steps: steps of an episode.
        action_noise: of the expert, standard deviation; actions are in [-1, 1].
        simulator_states: keep "simulator" in the infos.
        root: folder of Minari datasets; `MINARI_DATASETS_PATH` or Minari's own where
            None.
        work: folder that keeps what is finished, so that a collection that was cut off
            goes on; a temporary one where None.
        episodes_per_file: episodes that a process makes at a time.
        seed: seed of the collection.
        workers: processes; one per processor where None.
        overwrite: replace a dataset of that name.
        progress: show progress bars.

    Returns:
        the dataset.

    Raises:
        FileExistsError: there is a dataset of that name and `overwrite` is False.
        ValueError: a number is out of range.

    Example:
        >>> import tempfile
        >>> from torchrl_caiac.data import load_minari
        >>> from torchrl_caiac.envs import create_fetch_push_expert
        >>> with tempfile.TemporaryDirectory() as root:
        ...     dataset = create_fetch_push_expert(
        ...         episodes=2, steps=5, root=root, workers=1, progress=False)
        ...     rows = load_minari(
        ...         dataset, f"{root}/rows", infos=["simulator"], progress=False)
        >>> dataset.id, rows.batch_size, rows["next", "achieved_goal"].shape
        ('fetch-push-2/expert-v0', torch.Size([10]), torch.Size([10, 6]))
    """
    if not (np.isfinite(action_noise) and action_noise >= 0):
        raise ValueError(f"action_noise is {action_noise}, wanted at least 0")
    return _create(
        dataset_id or f"fetch-push-{num_cubes}/expert-v0",
        _Policy(_EXPERT, num_cubes, steps, action_noise),
        f"A scripted expert with action noise {action_noise:g}",
        "torchrl_caiac scripted expert",
        episodes=episodes,
        simulator_states=simulator_states,
        root=root,
        work=work,
        episodes_per_file=episodes_per_file,
        seed=seed,
        workers=workers,
        overwrite=overwrite,
        progress=progress,
    )


def create_fetch_push_random(
    dataset_id: str | None = None,
    *,
    episodes: int = 1400,
    num_cubes: int = 2,
    steps: int = 100,
    simulator_states: bool = True,
    root: str | os.PathLike[str] | None = None,
    work: str | os.PathLike[str] | None = None,
    episodes_per_file: int = 10,
    seed: int = 0,
    workers: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> MinariDataset:
    """Collect episodes of uniformly random actions as a Minari dataset.

    The same schema as :func:`create_fetch_push_expert`.

    Args:
        dataset_id: Minari's name of the dataset; `fetch-push-2/random-v0`, or with the
            number of cubes in its place, where None.

    Keyword Args:
        episodes: how many.
        num_cubes: cubes on the table.
        steps: steps of an episode.
        simulator_states: keep "simulator" in the infos.
        root: folder of Minari datasets; `MINARI_DATASETS_PATH` or Minari's own where
            None.
        work: folder that keeps what is finished, so that a collection that was cut off
            goes on; a temporary one where None.
        episodes_per_file: episodes that a process makes at a time.
        seed: seed of the collection.
        workers: processes; one per processor where None.
        overwrite: replace a dataset of that name.
        progress: show progress bars.

    Returns:
        the dataset.

    Raises:
        FileExistsError: there is a dataset of that name and `overwrite` is False.
        ValueError: a number is out of range.
    """
    return _create(
        dataset_id or f"fetch-push-{num_cubes}/random-v0",
        _Policy(_RANDOM, num_cubes, steps),
        "Uniformly random actions",
        "uniform random actions",
        episodes=episodes,
        simulator_states=simulator_states,
        root=root,
        work=work,
        episodes_per_file=episodes_per_file,
        seed=seed,
        workers=workers,
        overwrite=overwrite,
        progress=progress,
    )


@dataclasses.dataclass(frozen=True)
class _Policy:
    """What acts, and in which environment."""

    name: str
    num_cubes: int
    steps: int
    action_noise: float = 0.0


def _create(
    dataset_id: str,
    policy: _Policy,
    description: str,
    algorithm_name: str,
    *,
    episodes: int,
    simulator_states: bool,
    root: str | os.PathLike[str] | None,
    work: str | os.PathLike[str] | None,
    episodes_per_file: int,
    seed: int,
    workers: int | None,
    overwrite: bool,
    progress: bool,
) -> MinariDataset:
    for name, value in {
        "episodes": episodes,
        "num_cubes": policy.num_cubes,
        "steps": policy.steps,
        "episodes_per_file": episodes_per_file,
    }.items():
        if value < 1:
            raise ValueError(f"{name} is {value}, wanted at least 1")
    target = free_dataset_path(dataset_id, root, overwrite)
    specs = [
        {
            **dataclasses.asdict(policy),
            "episodes": min(episodes_per_file, episodes - first),
            "simulator_states": simulator_states,
        }
        for first in range(0, episodes, episodes_per_file)
    ]
    with work_folder(work, dataset_id) as folder:
        report = collect_episodes(
            _Factory(policy.num_cubes, policy.steps),
            specs,
            folder,
            seed=seed,
            workers=workers,
            progress=progress,
            description=f"{policy.name} episodes, {episodes_per_file} at a time",
        )
        reached, ended = _success_shares(report.files)
        summary = (
            f"{episodes} episodes of {policy.steps} steps with {policy.num_cubes} "
            f"cubes; every cube is at its goal in {reached:.1%} of them at some time, "
            f"in {ended:.1%} at the end"
        )
        logger.info("%s: %s", dataset_id, summary)
        return publish_dataset(
            dataset_id,
            (buffer for file in report.files for buffer in _buffers(file)),
            target,
            lambda: _make_env(policy.num_cubes, policy.steps),
            code="torchrl_caiac/envs/fetch_push/datasets.py",
            requirements=REQUIREMENTS,
            progress=progress,
            description=f"{description}: {summary}",
            algorithm_name=algorithm_name,
        )


# Sources of episodes. They live in worker processes, made there by the factory.


@dataclasses.dataclass(frozen=True)
class _Factory:
    num_cubes: int
    steps: int

    def __call__(self) -> EpisodeSource:
        return _Source(_make_env(self.num_cubes, self.steps))


def _make_env(num_cubes: int, steps: int) -> Any:
    import gymnasium

    from torchrl_caiac.envs.fetch_push.env import FETCH_PUSH_ENV_ID, FetchPushCubes

    arguments: dict[str, Any] = {"num_cubes": num_cubes, "max_episode_steps": steps}
    env = FetchPushCubes(**arguments)
    # gymnasium.make keeps max_episode_steps to itself, but not what a specification
    # holds: from this one Minari makes the same environment again.
    env.spec = dataclasses.replace(gymnasium.spec(FETCH_PUSH_ENV_ID), kwargs=arguments)
    return env


class _Source:
    """Makes some episodes at a time, stacked `[M, *]`."""

    def __init__(self, env: Any) -> None:
        self.env = env

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any]:
        # The two datasets must not share starts and goals, whatever seeds they have.
        words = np.random.SeedSequence([seed, _POLICIES.index(spec["name"])])
        seeds = words.generate_state(spec["episodes"]) >> 1
        episodes = [self._episode(spec, int(one)) for one in seeds]
        return {"seeds": seeds, **stack_trees(episodes)}

    def _episode(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any]:
        from torchrl_caiac.envs.fetch_push.env import fetch_push_distances

        observation, _ = self.env.reset(seed=seed)
        # Not the stream that starts and goals are drawn from.
        rng = np.random.default_rng([seed, 1])
        if spec["name"] == _EXPERT:
            from torchrl_caiac.envs.fetch_push.expert import FetchPushExpert

            act: Callable[[Any], Any] = FetchPushExpert(
                spec["num_cubes"], action_noise=spec["action_noise"], rng=rng
            )
        else:

            def act(_: Any) -> Any:
                return rng.uniform(-1.0, 1.0, 4)

        episode = record_episode(
            self.env,
            # What is stored is what was done: the action space is float32.
            lambda observation: np.asarray(act(observation), np.float32),
            observation,
            max_steps=spec["steps"],
            state=(lambda: {"simulator": self.env.simulator_state()})
            if spec["simulator_states"]
            else None,
        )
        states = episode["observations"]
        reached = (
            fetch_push_distances(states["achieved_goal"], states["desired_goal"])
            < self.env.distance_threshold
        )
        episode.setdefault("infos", {})["success"] = reached.all(-1)
        return episode

    def close(self) -> None:
        self.env.close()


# Minari.


def _success_shares(files: Sequence[Path]) -> tuple[float, float]:
    """Return the shares of episodes with success at some time, and at the end."""
    success = np.concatenate(
        [load_episode(file)[0]["infos"]["success"] for file in files]
    )
    return float(success.any(1).mean()), float(success[:, -1].mean())


def _buffers(file: Path) -> Iterator[EpisodeBuffer]:
    from minari.data_collector import EpisodeBuffer

    arrays, _ = load_episode(file)
    seeds = arrays.pop("seeds")
    for index, seed in enumerate(seeds):
        yield EpisodeBuffer(seed=int(seed), **index_tree(arrays, index))
