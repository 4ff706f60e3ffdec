"""Collecting episodes with several processes, in a folder that can be resumed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, Union

import numpy as np
from numpy.typing import NDArray

from torchrl_caiac._files import (
    UnreadableFileError,
    read_json,
    remove_leftovers_in,
    whole_file,
    write_json,
)
from torchrl_caiac._processes import available_processors, run_in_processes
from torchrl_caiac.data.npz import read_npz
from torchrl_caiac.data.trees import copy_tree, stack_trees

__all__ = [
    "CollectionReport",
    "EpisodeArrays",
    "EpisodeSource",
    "collect_episodes",
    "collection_folder",
    "load_episode",
    "record_episode",
]

_logger = logging.getLogger("torchrl_caiac.data.collect")

#: Arrays by name, in nested mappings.
EpisodeArrays = Mapping[str, Union[NDArray[Any], "EpisodeArrays"]]
_MANIFEST = "collection.json"
_META = "meta"
_SEPARATOR = "/"
_WHAT = "episode of this collection"
_AGAIN = "delete it and collect again"


class EpisodeSource(Protocol):
    """Generates episodes. It is created in each process and may keep an environment.

    A call receives the specification of the episode and a seed that is unique to the
    attempt. All randomness must come from these two. It returns the arrays of the
    episode, or ``None`` if the attempt failed and is to be repeated with another seed.
    If the source has a ``close()`` method, it is called at the end.
    """

    def __call__(self, spec: Mapping[str, Any], seed: int) -> EpisodeArrays | None:
        """Returns the arrays of the episode, or ``None`` for a failed attempt."""
        ...


@dataclasses.dataclass(frozen=True)
class CollectionReport:
    """The result of a collection.

    Attributes:
        files (tuple of Path): the files of the episodes, in the order of the
            specifications.
        collected (int): the number of episodes that this call collected.
        reused (int): the number of episodes that were in the folder before.
        failures (tuple of int): the number of failed attempts for each specification,
            in this call and earlier ones.
    """

    files: tuple[Path, ...]
    collected: int
    reused: int
    failures: tuple[int, ...]

    @property
    def success_rate(self) -> float:
        """The share of attempts that succeeded."""
        return len(self.files) / max(len(self.files) + sum(self.failures), 1)


def collect_episodes(
    factory: Callable[[], EpisodeSource],
    specs: Sequence[Mapping[str, Any]],
    folder: str | os.PathLike[str],
    *,
    seed: int = 0,
    workers: int | None = None,
    max_attempts: int = 20,
    progress: bool = True,
    description: str = "episodes",
) -> CollectionReport:
    """Collects one episode per specification, each in a file of its own.

    An interrupted collection resumes: a call with the same arguments collects only the
    episodes that ``folder`` lacks. An episode depends only on ``seed``, its position in
    ``specs`` and the number of the attempt, so the files are the same for any number of
    workers. Workers are started by ``spawn``, so a script needs the usual
    ``if __name__ == "__main__":``.

    Args:
        factory (callable): makes an :class:`EpisodeSource` in each process. With more
            than one worker it must be picklable: a function of a module, a class, or a
            ``functools.partial`` of one.
        specs (sequence of mapping): a specification for each episode, in JSON values.
        folder (path): the folder for the files; created if it is missing.

    Keyword Args:
        seed (int): the seed of the collection. Defaults to 0.
        workers (int, optional): the number of processes. With 1, the episodes are
            collected in this process. Defaults to one per processor.
        max_attempts (int): the number of attempts per episode. Defaults to 20.
        progress (bool): if ``True``, shows a progress bar. Defaults to ``True``.
        description (str): what the progress bar counts. Defaults to ``"episodes"``.

    Returns:
        CollectionReport: the files and the numbers of attempts.

    Raises:
        ValueError: ``folder`` contains another collection, or an unreadable file.
        RuntimeError: all attempts for an episode failed, or a worker process ended.
        Exception: whatever a source raised, with the traceback of the worker. Finished
            episodes are kept.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data import collect_episodes, load_episode
        >>> def factory():
        ...     def source(spec, seed):
        ...         return {"actions": np.full((spec["steps"], 2), seed % 7)}
        ...     return source
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     report = collect_episodes(
        ...         factory, [{"steps": 3}, {"steps": 4}], folder, workers=1,
        ...         progress=False)
        ...     arrays, meta = load_episode(report.files[1])
        >>> arrays["actions"].shape, meta["attempts"]
        ((4, 2), 1)
    """
    if max_attempts < 1:
        raise ValueError(f"max_attempts is {max_attempts}, expected at least 1")
    if workers is None:
        workers = available_processors()
    if workers < 1:
        raise ValueError(f"workers is {workers}, expected at least 1")
    root = Path(folder)
    _claim_folder(root, seed, specs)
    remove_leftovers_in(root)
    files = [root / f"episode_{index:06d}.npz" for index in range(len(specs))]
    failures = {
        index: _read_meta(file)["attempts"] - 1
        for index, file in enumerate(files)
        if file.exists()
    }
    missing = [index for index in range(len(specs)) if index not in failures]
    jobs = [
        (dict(specs[index]), index, files[index], seed, max_attempts)
        for index in missing
    ]

    from tqdm import tqdm

    with tqdm(
        total=len(specs), initial=len(failures), desc=description, disable=not progress
    ) as bar:
        processes = min(workers, len(jobs))
        for number, attempts in run_in_processes(
            _collect_episode,
            jobs,
            processes=processes if processes > 1 else 0,
            setup=factory,
        ):
            failures[missing[number]] = attempts - 1
            bar.update()
    report = CollectionReport(
        files=tuple(files),
        collected=len(jobs),
        reused=len(specs) - len(jobs),
        failures=tuple(failures[index] for index in range(len(specs))),
    )
    _logger.info(
        "%s: collected %d, reused %d, %d attempts failed",
        description,
        report.collected,
        report.reused,
        sum(report.failures),
    )
    return report


@contextmanager
def collection_folder(work: str | os.PathLike[str] | None) -> Iterator[Path]:
    """Context manager that provides a folder for a collection.

    Args:
        work (path, optional): the folder, to resume an interrupted collection.
            ``None``: a temporary folder, deleted at the end of the block.

    Yields:
        Path: the folder.

    Examples:
        >>> from torchrl_caiac.data.collect import collection_folder
        >>> with collection_folder("/work/play") as folder:
        ...     folder.as_posix()
        '/work/play'
    """
    if work is not None:
        yield Path(work)
        return
    with tempfile.TemporaryDirectory(prefix="collection-") as folder:
        yield Path(folder)


def load_episode(
    file: str | os.PathLike[str],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads the file of an episode.

    Args:
        file (path): a file that :func:`collect_episodes` wrote.

    Returns:
        tuple[dict, dict]: the arrays, nested as the source returned them, and the
        ``"spec"``, the ``"seed"`` and the ``"attempts"`` of the episode.

    Raises:
        FileNotFoundError: there is no such file.
        UnreadableFileError: the file is truncated or is not an episode.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data import collect_episodes, load_episode
        >>> def factory():
        ...     return lambda spec, seed: {"infos": {"goal": np.zeros(spec["width"])}}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     report = collect_episodes(
        ...         factory, [{"width": 2}], folder, workers=1, progress=False)
        ...     load_episode(report.files[0])[0]
        {'infos': {'goal': array([0., 0.])}}
    """
    path = Path(file)
    stored = read_npz(path, _WHAT, _AGAIN)
    meta = _episode_meta(path, stored.pop(_META, None))
    arrays: dict[str, Any] = {}
    for name, array in stored.items():
        *parents, leaf = name.split(_SEPARATOR)
        place = arrays
        for parent in parents:
            place = place.setdefault(parent, {})
            if not isinstance(place, dict):
                raise UnreadableFileError(
                    f"{path} is not a readable {_WHAT}, it has arrays in and at "
                    f"{parent!r}: {_AGAIN}"
                )
        if leaf in place:
            raise UnreadableFileError(
                f"{path} is not a readable {_WHAT}, it has two entries {name!r}: "
                f"{_AGAIN}"
            )
        place[leaf] = array
    return arrays, meta


def record_episode(
    env: Any,
    policy: Callable[[Any], NDArray[Any]],
    observation: Any,
    *,
    max_steps: int,
    stop: Callable[[dict[str, Any]], bool] | None = None,
    state: Callable[[], Mapping[str, NDArray[Any]]] | None = None,
) -> dict[str, Any]:
    """Plays an episode and returns the arrays of a Minari episode.

    Args:
        env (gymnasium.Env): an environment that has just been reset.
        policy (callable): returns the action for an observation.
        observation (Any): the first observation.

    Keyword Args:
        max_steps (int): the number of steps after which the episode is truncated.
        stop (callable, optional): called with the info of each step; if it returns
            ``True``, the episode is truncated there.
        state (callable, optional): returns what to record of the simulator with every
            observation.

    Returns:
        dict: ``"actions"`` ``[L, A]``, ``"rewards"``, ``"terminations"`` and
        ``"truncations"`` ``[L]``, and ``"observations"`` (and ``"infos"``, if ``state``
        is given) with ``L + 1`` entries.

    Raises:
        ValueError: ``max_steps`` is less than 1.

    Examples:
        >>> import gymnasium
        >>> from torchrl_caiac.data import record_episode
        >>> env = gymnasium.make("CartPole-v1")
        >>> observation, _ = env.reset(seed=0)
        >>> episode = record_episode(env, lambda _: 0, observation, max_steps=5)
        >>> episode["observations"].shape, episode["truncations"].tolist()
        ((6, 4), [False, False, False, False, True])
    """
    if max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}, expected at least 1")
    observations = [copy_tree(observation)]
    infos = [] if state is None else [copy_tree(state())]
    actions, rewards, terminations, truncations = [], [], [], []
    for step in range(max_steps):
        action = np.array(policy(observation))
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(copy_tree(observation))
        if state is not None:
            infos.append(copy_tree(state()))
        over = terminated or truncated
        if not over:
            truncated = step + 1 == max_steps or (stop is not None and stop(info))
        actions.append(action)
        rewards.append(float(reward))
        terminations.append(bool(terminated))
        truncations.append(bool(truncated))
        if terminated or truncated:
            break
    episode = {
        "observations": stack_trees(observations),
        "actions": np.stack(actions),
        "rewards": np.array(rewards),
        "terminations": np.array(terminations),
        "truncations": np.array(truncations),
    }
    if state is not None:
        episode["infos"] = stack_trees(infos)
    return episode


def _collect_episode(
    source: EpisodeSource,
    spec: Mapping[str, Any],
    index: int,
    file: Path,
    collection_seed: int,
    max_attempts: int,
) -> int:
    """Collects and stores one episode; returns the number of attempts."""
    for attempt in range(max_attempts):
        words = np.random.SeedSequence([collection_seed, index, attempt])
        # 31 bits: every library takes them as a seed.
        seed = int(words.generate_state(1)[0] >> 1)
        arrays = source(spec, seed)
        if arrays is None:
            continue
        flat = _flat(arrays)
        meta = {"spec": spec, "seed": seed, "attempts": attempt + 1}
        flat[_META] = np.array(json.dumps(meta))
        with whole_file(file, tidy=False) as partial:
            np.savez(partial, **flat)  # type: ignore[arg-type]
        return attempt + 1
    raise RuntimeError(
        f"episode {index} ({spec}) failed in all {max_attempts} attempts: make the "
        "task easier or raise max_attempts"
    )


def _claim_folder(root: Path, seed: int, specs: Sequence[Mapping[str, Any]]) -> None:
    """Records the collection in its folder, or checks that the folder belongs to it."""
    text = json.dumps([dict(spec) for spec in specs], sort_keys=True)
    manifest = {
        "seed": seed,
        "episodes": len(specs),
        "specs_sha256": hashlib.sha256(text.encode()).hexdigest(),
    }
    path = root / _MANIFEST
    if path.exists():
        found = read_json(path, "record of a collection", _AGAIN)
        if found != manifest:
            raise ValueError(
                f"{root} has another collection: found {found}, expected {manifest}; "
                "give another folder or delete this one"
            )
        return
    if any(root.glob("episode_*.npz")):
        raise ValueError(
            f"{root} has episodes but no {_MANIFEST}, so their collection is unknown: "
            "give another folder or delete this one"
        )
    write_json(path, manifest)


def _flat(arrays: EpisodeArrays, prefix: str = "") -> dict[str, NDArray[Any]]:
    flat: dict[str, NDArray[Any]] = {}
    for key, value in arrays.items():
        if _SEPARATOR in key or (not prefix and key == _META):
            raise ValueError(
                f"an episode's key is {key!r}, but the file format reserves "
                f"{_SEPARATOR!r} and the name {_META!r}: rename it"
            )
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}{_SEPARATOR}"))
        else:
            array = np.asarray(value)
            if array.dtype == object:
                raise ValueError(
                    f"episode key {prefix + key!r} has Python objects, expected an "
                    "array of numbers"
                )
            flat[prefix + key] = array
    return flat


def _read_meta(path: Path) -> dict[str, Any]:
    stored = read_npz(path, _WHAT, _AGAIN, names=[_META])
    return _episode_meta(path, stored.get(_META))


def _episode_meta(path: Path, stored: NDArray[Any] | None) -> dict[str, Any]:
    try:
        if stored is None or stored.ndim or stored.dtype.kind != "U":
            raise ValueError(f"{_META!r} is missing or not a text")
        meta = json.loads(str(stored))
        if not isinstance(meta, dict):
            raise ValueError(f"{_META!r} is {meta!r}")
        kept: dict[str, Any] = {
            key: meta.get(key) for key in ("spec", "seed", "attempts")
        }
        if not isinstance(kept["spec"], dict):
            raise ValueError(f"'spec' is {kept['spec']!r}")
        for key, least in (("seed", 0), ("attempts", 1)):
            if type(kept[key]) is not int or kept[key] < least:
                raise ValueError(f"{key!r} is {kept[key]!r}")
    except (ValueError, RecursionError) as error:
        raise UnreadableFileError(
            f"{path} is not a readable {_WHAT} ({error}): {_AGAIN}"
        ) from error
    return kept
