"""Collecting episodes with several processes, in a folder that can be resumed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import multiprocessing
import os
import queue
import tempfile
import traceback
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, Union

import numpy as np
from numpy.typing import NDArray

from torchrl_caiac.experiments import end_with_parent

__all__ = [
    "CollectionReport",
    "EpisodeArrays",
    "EpisodeSource",
    "collect_episodes",
    "load_episode",
    "record_episode",
]

logger = logging.getLogger("torchrl_caiac.data.collect")

#: Arrays by name, mappings nested.
EpisodeArrays = Mapping[str, Union[NDArray[Any], "EpisodeArrays"]]
_MANIFEST = "collection.json"
_META = "meta"
_SEPARATOR = "/"
# A worker that was killed answers nothing: how often to look, seconds.
_POLL_SECONDS = 1.0


class EpisodeSource(Protocol):
    """Makes one episode; lives in a worker process and may keep an environment.

    It is called with the episode's specification and a seed that no other attempt of
    the collection has, and everything it draws must come from the two. It returns the
    episode's arrays, or None where the attempt failed and is to be made again with
    another seed. A `close()` method, where there is one, is called at the end.
    """

    def __call__(self, spec: Mapping[str, Any], seed: int) -> EpisodeArrays | None:
        """Return the arrays of the episode, or None for a failed attempt."""
        ...


@dataclasses.dataclass(frozen=True)
class CollectionReport:
    """What a collection did.

    Attributes:
        files: the episodes' files, in the order of the specifications.
        collected: episodes made by this call.
        reused: episodes that were there before it.
        failures: failed attempts per specification, of this call and earlier ones.
    """

    files: tuple[Path, ...]
    collected: int
    reused: int
    failures: tuple[int, ...]

    @property
    def success_rate(self) -> float:
        """Share of attempts that succeeded."""
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
    """Make one episode per specification and keep each in a file of its own.

    Finished episodes stay in `folder` whatever happens to the rest: called again with
    the same arguments, the collection goes on with those that are missing. An
    episode depends on `seed`, its position in `specs` and the number of the attempt
    alone, so any number of workers gives the same files. Workers are started by
    `spawn`: a script needs the usual `if __name__ == "__main__":`.

    Args:
        factory: makes an `EpisodeSource`; must be picklable where `workers` > 1 (a
            module's function, a class, an instance of a frozen dataclass).
        specs: what each episode shall be, as JSON values.
        folder: where the episodes' files go; made where missing.

    Keyword Args:
        seed: seed of the whole collection.
        workers: number of processes; as many as there are processors where None; with
            1 the episodes are made in this process.
        max_attempts: attempts per episode.
        progress: show a progress bar.
        description: what the bar counts.

    Returns:
        the files and the numbers of attempts.

    Raises:
        ValueError: `folder` holds another collection, or a file in it is unreadable.
        RuntimeError: an episode failed in all attempts, or a worker broke off; episodes
            that were finished stay.

    Example:
        >>> import tempfile
        >>> import numpy as np
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
        raise ValueError(f"max_attempts is {max_attempts}, wanted at least 1")
    if workers is None:
        workers = (
            len(os.sched_getaffinity(0))
            if hasattr(os, "sched_getaffinity")
            else os.cpu_count() or 1
        )
    if workers < 1:
        raise ValueError(f"workers is {workers}, wanted at least 1")
    root = Path(folder)
    _claim_folder(root, seed, specs)
    files = [root / f"episode_{index:06d}.npz" for index in range(len(specs))]
    missing = []
    failures = [0] * len(specs)
    for index, file in enumerate(files):
        if file.exists():
            failures[index] = _read_meta(file)["attempts"] - 1
        else:
            missing.append(index)
    jobs = [
        _Job(index, dict(specs[index]), seed, str(files[index]), max_attempts)
        for index in missing
    ]

    from tqdm import tqdm

    bar = tqdm(
        total=len(specs),
        initial=len(specs) - len(jobs),
        desc=description,
        disable=not progress,
    )
    with bar:
        results = (
            _serial(factory, jobs)
            if workers == 1 or len(jobs) <= 1
            else _parallel(factory, jobs, min(workers, len(jobs)))
        )
        for index, attempts in results:
            failures[index] = attempts - 1
            bar.update()
    report = CollectionReport(
        tuple(files), len(jobs), len(specs) - len(jobs), tuple(failures)
    )
    logger.info(
        "%d %s collected, %d there before, %d attempts failed",
        report.collected,
        description,
        report.reused,
        sum(report.failures),
    )
    return report


def load_episode(
    file: str | os.PathLike[str],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read an episode's file.

    Args:
        file: a file that `collect_episodes` wrote.

    Returns:
        the arrays, nested as they were, and what is known about the episode: "spec",
        "seed", "attempts".

    Raises:
        ValueError: the file is truncated or not an episode; delete it and collect
            again.
    """
    path = Path(file)
    meta = _read_meta(path)
    arrays: dict[str, Any] = {}
    try:
        with np.load(path, allow_pickle=False) as stored:
            for name in stored.files:
                if name == _META:
                    continue
                *parents, leaf = name.split(_SEPARATOR)
                place = arrays
                for parent in parents:
                    place = place.setdefault(parent, {})
                place[leaf] = stored[name]
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _unreadable(path, error) from error
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
    """Play an episode and keep what a Minari episode keeps.

    Args:
        env: a Gymnasium environment that has just been reset.
        policy: action for an observation.
        observation: the first observation.

    Keyword Args:
        max_steps: number of steps after which the episode is truncated.
        stop: called with the step's info after each step; ends the episode (as
            truncated) where it returns True.
        state: what to record of the simulator with every observation.

    Returns:
        "observations" (and "infos", where `state` is given) with one entry more than
        "actions" `[L, A]`, "rewards" `[L]`, "terminations" `[L]`, "truncations"
        `[L]`.
    """
    if max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}, wanted at least 1")
    observations = [_copied(observation)]
    infos = [] if state is None else [_copied(state())]
    actions, rewards, terminations, truncations = [], [], [], []
    for step in range(max_steps):
        action = np.array(policy(observation))
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(_copied(observation))
        if state is not None:
            infos.append(_copied(state()))
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
        "observations": _stacked(observations),
        "actions": np.stack(actions),
        "rewards": np.array(rewards),
        "terminations": np.array(terminations),
        "truncations": np.array(truncations),
    }
    if state is not None:
        episode["infos"] = _stacked(infos)
    return episode


def _copied(value: Any) -> Any:
    # Some environments hand out views of simulator memory.
    if isinstance(value, Mapping):
        return {key: _copied(entry) for key, entry in value.items()}
    return np.array(value)


def _stacked(values: Sequence[Any]) -> Any:
    if isinstance(values[0], Mapping):
        return {key: _stacked([value[key] for value in values]) for key in values[0]}
    return np.stack(values)


@dataclasses.dataclass(frozen=True)
class _Job:
    index: int
    spec: dict[str, Any]
    seed: int
    file: str
    max_attempts: int


def _make(source: EpisodeSource, job: _Job) -> int:
    """Make and store one episode; return the number of attempts."""
    for attempt in range(job.max_attempts):
        words = np.random.SeedSequence([job.seed, job.index, attempt])
        # 31 bits: within what every library takes as a seed.
        seed = int(words.generate_state(1)[0] >> 1)
        arrays = source(job.spec, seed)
        if arrays is not None:
            meta = {"spec": job.spec, "seed": seed, "attempts": attempt + 1}
            _write(Path(job.file), arrays, meta)
            return attempt + 1
    raise RuntimeError(
        f"episode {job.index} ({job.spec}) failed in all {job.max_attempts} attempts; "
        "make the task easier or raise max_attempts"
    )


def _serial(
    factory: Callable[[], EpisodeSource], jobs: Sequence[_Job]
) -> Iterator[tuple[int, int]]:
    if not jobs:
        return
    source = factory()
    try:
        for job in jobs:
            yield job.index, _make(source, job)
    finally:
        _close(source)


def _parallel(
    factory: Callable[[], EpisodeSource], jobs: Sequence[_Job], workers: int
) -> Iterator[tuple[int, int]]:
    context = multiprocessing.get_context("spawn")
    waiting: Any = context.Queue()
    finished: Any = context.Queue()
    for job in jobs:
        waiting.put(job)
    for _ in range(workers):
        waiting.put(None)
    processes = [
        context.Process(target=_work, args=(factory, waiting, finished), daemon=True)
        for _ in range(workers)
    ]
    # Linear algebra threads of two workers on two cores only get in each other's way;
    # the libraries read this when they are loaded, so it must be set before the start.
    previous = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        for process in processes:
            process.start()
    finally:
        for name, value in previous.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
    done = 0
    try:
        ended = False
        while done < len(jobs):
            try:
                index, attempts, error = finished.get(timeout=_POLL_SECONDS)
            except queue.Empty:
                if ended:
                    codes = [process.exitcode for process in processes]
                    raise RuntimeError(
                        f"collecting processes ended (exit codes {codes}) before their "
                        "episodes were done; finished episodes are kept, call again "
                        "to go on"
                    ) from None
                # What they sent may still be on its way: look once more.
                ended = any(p.exitcode not in (None, 0) for p in processes) or all(
                    p.exitcode is not None for p in processes
                )
                continue
            if error is not None:
                raise RuntimeError(f"a collecting process failed:\n{error}")
            done += 1
            yield index, attempts
        for process in processes:
            process.join()
    finally:
        for process in processes:
            if process.is_alive():
                process.terminate()
                process.join()
        for channel in (waiting, finished):
            channel.cancel_join_thread()
            channel.close()


_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _work(factory: Callable[[], EpisodeSource], waiting: Any, finished: Any) -> None:
    end_with_parent()
    source = None
    try:
        source = factory()
        while (job := waiting.get()) is not None:
            finished.put((job.index, _make(source, job), None))
    except Exception:
        finished.put((-1, 0, traceback.format_exc()))
    finally:
        if source is not None:
            _close(source)


def _close(source: EpisodeSource) -> None:
    close = getattr(source, "close", None)
    if close is not None:
        close()


def _claim_folder(root: Path, seed: int, specs: Sequence[Mapping[str, Any]]) -> None:
    """Write what the folder is for, or check that it is for this collection."""
    text = json.dumps([dict(spec) for spec in specs], sort_keys=True)
    manifest = {
        "seed": seed,
        "episodes": len(specs),
        "specs_sha256": hashlib.sha256(text.encode()).hexdigest(),
    }
    path = root / _MANIFEST
    root.mkdir(parents=True, exist_ok=True)
    if path.exists():
        try:
            found = json.loads(path.read_text())
        except ValueError as error:
            raise _unreadable(path, error) from error
        if found != manifest:
            raise ValueError(
                f"{root} holds another collection: found {found}, wanted {manifest}; "
                "give another folder or delete this one"
            )
        return
    if any(root.glob("episode_*.npz")):
        raise ValueError(
            f"{root} holds episodes but no {_MANIFEST}, so it cannot be told which "
            "collection they belong to; give another folder or delete this one"
        )
    _replace(path, lambda file: file.write(json.dumps(manifest).encode()))


def _flat(arrays: EpisodeArrays, prefix: str = "") -> dict[str, NDArray[Any]]:
    flat: dict[str, NDArray[Any]] = {}
    for key, value in arrays.items():
        if _SEPARATOR in key or (not prefix and key == _META):
            raise ValueError(
                f"an episode's key is {key!r}; {_SEPARATOR!r} and the name {_META!r} "
                "are used by the file format"
            )
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}{_SEPARATOR}"))
        else:
            array = np.asarray(value)
            if array.dtype == object:
                raise ValueError(
                    f"episode key {prefix + key!r} holds Python objects, wanted numbers"
                )
            flat[prefix + key] = array
    return flat


def _write(path: Path, arrays: EpisodeArrays, meta: Mapping[str, Any]) -> None:
    flat = _flat(arrays)
    flat[_META] = np.array(json.dumps(meta))
    _replace(path, lambda file: np.savez(file, **flat))  # type: ignore[arg-type]


def _replace(path: Path, write: Callable[[Any], Any]) -> None:
    """Write a file so that it is there whole or not at all."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".partial-")
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _read_meta(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as stored:
            meta = json.loads(str(stored[_META]))
        return {key: meta[key] for key in ("spec", "seed", "attempts")}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> ValueError:
    return ValueError(
        f"{path} is truncated or was not written by this collection "
        f"({type(error).__name__}: {error}); delete it and collect again"
    )
