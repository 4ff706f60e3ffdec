"""Minari datasets of Fetch-Push: episodes of the scripted expert and random ones.

Both have the observations of :class:`~torchrl_caiac.envs.FetchPushCubes`.
:func:`~torchrl_caiac.data.load_minari` turns them into TorchRL transitions, and
:func:`~torchrl_caiac.data.mix_trajectories` mixes the two.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from torchrl_caiac.data.collect import collect_episodes, load_episode, record_episode
from torchrl_caiac.data.minari_files import (
    free_dataset_path,
    publish_dataset,
    work_folder,
)
from torchrl_caiac.data.trees import index_tree, stack_trees
from torchrl_caiac.envs._requirements import REQUIREMENTS
from torchrl_caiac.envs.fetch_push.env import FetchPushCubes
from torchrl_caiac.envs.fetch_push.expert import FetchPushExpert
from torchrl_caiac.envs.fetch_push.registration import FETCH_PUSH_ENV_ID
from torchrl_caiac.envs.fetch_push.task import fetch_push_distances

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer
    from numpy.typing import NDArray

__all__ = ["create_fetch_push_expert", "create_fetch_push_random"]

_logger = logging.getLogger("torchrl_caiac.envs.fetch_push.datasets")

_POLICIES = _EXPERT, _RANDOM = ("expert", "random")


def create_fetch_push_expert(
    dataset_id: str | None = None,
    *,
    episodes: int = 600,
    num_cubes: int = 2,
    steps: int = 100,
    action_noise: float = 0.2,
    simulator_states: bool = True,
    cube_friction: float | None = None,
    cube_speed: float = 0.0,
    root: str | os.PathLike[str] | None = None,
    work: str | os.PathLike[str] | None = None,
    episodes_per_file: int = 10,
    seed: int = 0,
    workers: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> MinariDataset:
    """Collects episodes of the scripted expert as a Minari dataset.

    Every episode has ``steps`` steps and is kept, successful or not: the expert of the
    paper sometimes fails too (A.6.2). The log and the description of the dataset report
    two shares of episodes: those in which all cubes are at their goals at some step,
    which the paper calls success, and those in which they are at the end. With
    ``L = steps``, the infos contain ``"success"``, bool ``[L + 1]``, and
    ``"simulator"``, float64 ``[L + 1, S]``, the exact simulator state, which
    ``FetchPushCubes.set_simulator_state`` restores.

    Args:
        dataset_id (str, optional): the name of the dataset in Minari. Defaults to
            ``fetch-push-{num_cubes}/expert-v0``.

    Keyword Args:
        episodes (int): the number of episodes. Defaults to 600.
        num_cubes (int): the number of cubes. Defaults to 2.
        steps (int): the number of steps of an episode. Defaults to 100.
        action_noise (float): the standard deviation of the noise on the expert's
            actions, which are in [-1, 1]. Defaults to 0.2.
        simulator_states (bool): if ``True``, the infos contain ``"simulator"``.
            Defaults to ``True``.
        cube_friction (float, optional): as in
            :class:`~torchrl_caiac.envs.FetchPushCubes`. Defaults to ``None``.
        cube_speed (float): the same. Defaults to 0.
        root (path, optional): the folder of Minari datasets. Defaults to
            ``MINARI_DATASETS_PATH`` or Minari's own.
        work (path, optional): a folder for finished episodes, from which an interrupted
            collection resumes. Defaults to a temporary folder.
        episodes_per_file (int): the number of episodes that a process collects at a
            time. Defaults to 10.
        seed (int): the seed of the collection. Defaults to 0.
        workers (int, optional): the number of processes. Defaults to one per processor.
        overwrite (bool): if ``True``, replaces a dataset of that name. Defaults to
            ``False``.
        progress (bool): if ``True``, shows progress bars. Defaults to ``True``.

    Returns:
        MinariDataset: the dataset.

    Raises:
        FileExistsError: there is a dataset of that name and ``overwrite`` is ``False``.
        ValueError: a number is out of range, or ``work`` has another collection.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.data import load_minari
        >>> from torchrl_caiac.envs import create_fetch_push_expert
        >>> with tempfile.TemporaryDirectory() as root:
        ...     dataset = create_fetch_push_expert(
        ...         episodes=2, steps=5, root=root, workers=1, progress=False
        ...     )
        ...     rows = load_minari(
        ...         dataset, f"{root}/rows", infos=["simulator"], progress=False
        ...     )
        >>> dataset.id, rows.batch_size, rows["next", "achieved_goal"].shape
        ('fetch-push-2/expert-v0', torch.Size([10]), torch.Size([10, 6]))
    """
    if not (np.isfinite(action_noise) and action_noise >= 0):
        raise ValueError(f"action_noise is {action_noise}, expected at least 0")
    return _create(
        dataset_id or f"fetch-push-{num_cubes}/expert-v0",
        _Policy(_EXPERT, num_cubes, steps, action_noise, cube_friction, cube_speed),
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
    cube_friction: float | None = None,
    cube_speed: float = 0.0,
    root: str | os.PathLike[str] | None = None,
    work: str | os.PathLike[str] | None = None,
    episodes_per_file: int = 10,
    seed: int = 0,
    workers: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> MinariDataset:
    """Collects episodes of uniformly random actions as a Minari dataset.

    The dataset has the schema of :func:`create_fetch_push_expert`.

    Args:
        dataset_id (str, optional): the name of the dataset in Minari. Defaults to
            ``fetch-push-{num_cubes}/random-v0``.

    Keyword Args:
        episodes (int): the number of episodes. Defaults to 1400.
        num_cubes (int): the number of cubes. Defaults to 2.
        steps (int): the number of steps of an episode. Defaults to 100.
        simulator_states (bool): if ``True``, the infos contain ``"simulator"``.
            Defaults to ``True``.
        cube_friction (float, optional): as in
            :class:`~torchrl_caiac.envs.FetchPushCubes`. Defaults to ``None``.
        cube_speed (float): the same. Defaults to 0.
        root (path, optional): the folder of Minari datasets. Defaults to
            ``MINARI_DATASETS_PATH`` or Minari's own.
        work (path, optional): a folder for finished episodes, from which an interrupted
            collection resumes. Defaults to a temporary folder.
        episodes_per_file (int): the number of episodes that a process collects at a
            time. Defaults to 10.
        seed (int): the seed of the collection. Defaults to 0.
        workers (int, optional): the number of processes. Defaults to one per processor.
        overwrite (bool): if ``True``, replaces a dataset of that name. Defaults to
            ``False``.
        progress (bool): if ``True``, shows progress bars. Defaults to ``True``.

    Returns:
        MinariDataset: the dataset.

    Raises:
        FileExistsError: there is a dataset of that name and ``overwrite`` is ``False``.
        ValueError: a number is out of range, or ``work`` has another collection.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.envs import create_fetch_push_random
        >>> with tempfile.TemporaryDirectory() as root:
        ...     dataset = create_fetch_push_random(
        ...         episodes=2, steps=5, root=root, workers=1, progress=False
        ...     )
        >>> dataset.id, dataset.total_steps
        ('fetch-push-2/random-v0', 10)
    """
    return _create(
        dataset_id or f"fetch-push-{num_cubes}/random-v0",
        _Policy(
            _RANDOM,
            num_cubes,
            steps,
            cube_friction=cube_friction,
            cube_speed=cube_speed,
        ),
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
    """A policy and the settings of its environment."""

    name: str
    num_cubes: int
    steps: int
    action_noise: float = 0.0
    cube_friction: float | None = None
    cube_speed: float = 0.0

    def make_env(self) -> FetchPushCubes:
        arguments: dict[str, Any] = {
            "num_cubes": self.num_cubes,
            "max_episode_steps": self.steps,
        }
        if self.cube_friction is not None:
            arguments["cube_friction"] = self.cube_friction
        if self.cube_speed:
            arguments["cube_speed"] = self.cube_speed
        env = FetchPushCubes(**arguments)
        # Minari recreates the environment from its specification. ``gymnasium.make``
        # would leave max_episode_steps out of it.
        spec = gymnasium.spec(FETCH_PUSH_ENV_ID)
        env.spec = dataclasses.replace(spec, kwargs=arguments)
        return env


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
            raise ValueError(f"{name} is {value}, expected at least 1")
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
            functools.partial(_Source, policy),
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
        _logger.info("%s: %s", dataset_id, summary)
        return publish_dataset(
            dataset_id,
            (buffer for file in report.files for buffer in _buffers(file)),
            target,
            policy.make_env,
            code="torchrl_caiac/envs/fetch_push/datasets.py",
            requirements=REQUIREMENTS,
            progress=progress,
            description=f"{description}: {summary}",
            algorithm_name=algorithm_name,
        )


class _Source:
    """Collects several episodes at a time, stacked ``[M, *]``."""

    def __init__(self, policy: _Policy) -> None:
        self.env = policy.make_env()

    def __call__(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any]:
        # The two datasets must not share starts and goals, whatever their seeds are.
        words = np.random.SeedSequence([seed, _POLICIES.index(spec["name"])])
        seeds = words.generate_state(spec["episodes"]) >> 1
        episodes = [self._episode(spec, int(one)) for one in seeds]
        return {"seeds": seeds, **stack_trees(episodes)}

    def _episode(self, spec: Mapping[str, Any], seed: int) -> dict[str, Any]:
        observation, _ = self.env.reset(seed=seed)
        # Not the stream from which starts and goals are drawn.
        act = _policy(spec, np.random.default_rng([seed, 1]))
        episode = record_episode(
            self.env,
            # The action space is float32: the stored action is the executed one.
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


def _policy(
    spec: Mapping[str, Any], rng: np.random.Generator
) -> Callable[[Any], NDArray[Any]]:
    if spec["name"] == _RANDOM:
        return lambda observation: rng.uniform(-1.0, 1.0, 4)
    return FetchPushExpert(
        spec["num_cubes"], action_noise=spec["action_noise"], rng=rng
    )


def _success_shares(files: Sequence[Path]) -> tuple[float, float]:
    """Returns the shares of episodes with success at some step, and at the end."""
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
