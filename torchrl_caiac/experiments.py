"""What experiments share: files that appear whole, resuming, processes side by side.

It needs no extra: settings are plain mappings, Hydra's among them.
"""

from __future__ import annotations

import csv
import json
import math
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, GlobalRNGState, StateDictCheckpointAdapter

__all__ = [
    "TrainingCheckpoint",
    "bar_position",
    "claim_folder",
    "end_with_parent",
    "keep_settings",
    "quick_settings",
    "run_side_by_side",
    "update_csv",
    "whole_file",
    "write_json",
]

_POSITION = "TQDM_POSITION"


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a file to write, which takes its place when all is written.

    The folder is made where it is missing. What raises leaves the old file as it was.

    Args:
        path (path): the file that is wanted.

    Yields:
        Path: a file beside it with the same suffix.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.experiments import whole_file
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with whole_file(f"{folder}/results/table.txt") as partial:
        ...         _ = partial.write_text("42")
        ...     open(f"{folder}/results/table.txt").read()
        '42'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def claim_folder(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keeps every other process that claims a folder out of it.

    A process that ends, in whatever way, gives its folders up.

    Args:
        folder (path): made where it is missing; gets a file ``.lock``.

    Raises:
        RuntimeError: another process has claimed the folder.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.experiments import claim_folder
        >>> with tempfile.TemporaryDirectory() as folder, claim_folder(folder):
        ...     pass  # this process alone writes its results
    """
    from filelock import FileLock, Timeout  # torch needs it too

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise RuntimeError(
            f"another process works in {folder}: wait for it, end it, or give another "
            "folder with out=..."
        ) from None
    try:
        yield
    finally:
        lock.release()


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Writes a value as JSON, whole or not at all.

    Args:
        path (path): the file, replaced where it exists.
        value (Any): mappings, sequences, strings, numbers, booleans and ``None``.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.experiments import write_json
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_json(f"{folder}/a.json", {"b": (1, 2)})
        ...     json.load(open(f"{folder}/a.json"))
        {'b': [1, 2]}
    """
    with whole_file(path) as partial:
        partial.write_text(json.dumps(_plain(value), indent=1) + "\n")


def update_csv(
    path: str | os.PathLike[str],
    rows: Sequence[Mapping[str, Any]],
    columns: Sequence[str],
    *,
    experiment: str,
) -> list[dict[str, str]]:
    """Writes the rows of one experiment into a table that several share.

    Args:
        path (path): the CSV file, made where it is missing.
        rows (sequence of mapping): by the names of columns; what is missing, or NaN, is
            left empty.
        columns (sequence of str): the columns after the first, ``"experiment"``.

    Keyword Args:
        experiment (str): whose rows these are; they take the place of earlier ones.

    Returns:
        list of dict: all rows of the file, as strings.

    Raises:
        ValueError: the file has other columns.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.experiments import update_csv
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = f"{folder}/table.csv"
        ...     for name, auc in (("push", 0.5), ("kitchen", 0.8), ("push", 0.9)):
        ...         found = update_csv(path, [{"auc": auc}], ["auc"], experiment=name)
        >>> [(row["experiment"], row["auc"]) for row in found]
        [('push', '0.9'), ('kitchen', '0.8')]
    """
    path, names = Path(path), ["experiment", *columns]
    table: dict[str, list[dict[str, str]]] = {}
    if path.exists():
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            if list(reader.fieldnames or []) != names:
                raise ValueError(
                    f"{path} has the columns {reader.fieldnames}, wanted {names}: "
                    "delete it, or give another file"
                )
            for row in reader:
                table.setdefault(row["experiment"], []).append(row)
    table[experiment] = [
        {"experiment": experiment, **{name: _cell(row.get(name)) for name in columns}}
        for row in rows
    ]
    written = [row for part in table.values() for row in part]
    with whole_file(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(written)
    return written


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def quick_settings(cfg: Any) -> Any:
    """The settings that a Hydra script runs with, those of a smoke run if asked for.

    Args:
        cfg (DictConfig): with ``quick``, and in ``quick_settings`` what a smoke run has
            other.

    Returns:
        DictConfig: ``cfg``; where ``cfg.quick``, with the quick settings over it, and
        what the command line gave over both.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl_caiac.experiments import quick_settings
        >>> cfg = SimpleNamespace(quick=False)
        >>> quick_settings(cfg) is cfg
        True
    """
    if not cfg.quick:
        return cfg
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    hydra = HydraConfig.get()
    given = [
        text
        for text in hydra.overrides.task
        if text.split("=")[0] not in hydra.runtime.choices
    ]
    return OmegaConf.merge(cfg, cfg.quick_settings, OmegaConf.from_dotlist(given))


def keep_settings(settings: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Keeps the results of a folder to one set of settings.

    The first call writes the settings, a later one compares.

    Args:
        settings (Mapping): what the results depend on, of a ``DictConfig`` say.
        path (path): a JSON file beside the results.

    Raises:
        ValueError: the results were made with other settings.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.experiments import keep_settings
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     keep_settings({"lr": 0.1}, f"{folder}/train.json")
        ...     keep_settings({"lr": 0.1}, f"{folder}/train.json")
    """
    path = Path(path)
    if not path.exists():
        write_json(path, settings)
        return
    try:
        kept = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(
            f"{path} holds no settings ({error}): delete the folder, or give another "
            "one with out=..."
        ) from error
    # Through JSON, so that tuples and lists are the same.
    wanted = json.loads(json.dumps(_plain(settings)))
    if kept != wanted:
        differ: Any = "all"
        if isinstance(kept, dict):
            same = {k for k in kept.keys() & wanted if kept[k] == wanted[k]}
            differ = sorted((kept.keys() | wanted) - same)
        raise ValueError(
            f"{path.parent} holds results of other settings, see {path} ({differ} "
            "differ): delete the folder, or give another one with out=..."
        )


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(value[key]) for key in value}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value


class TrainingCheckpoint:
    """Where a training run goes on after it was killed, in one file.

    Holds the state of every part, and of the global random number generators of torch,
    NumPy and Python. Loaded without pickle; replaced atomically.

    Args:
        path (path): the file, ``checkpoint.zip`` say.

    Keyword Args:
        parts (Any): what has ``state_dict`` and ``load_state_dict``: models,
            optimizers, schedulers.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_caiac.experiments import TrainingCheckpoint
        >>> model = torch.nn.Linear(2, 1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     checkpoint = TrainingCheckpoint(f"{folder}/checkpoint.zip", model=model)
        ...     before = checkpoint.load()
        ...     checkpoint.save(step=10)
        ...     before, checkpoint.load()
        (0, 10)
    """

    def __init__(self, path: str | os.PathLike[str], **parts: Any) -> None:
        self.path = Path(path)
        self._checkpoint = Checkpoint(format="archive")
        for name, part in {**parts, "rng": GlobalRNGState()}.items():
            # As tensordicts optimizers would get views of the file, and write into it.
            adapter = StateDictCheckpointAdapter(payload_format="torch")
            self._checkpoint.register(name, part, adapter=adapter)

    def save(self, step: int) -> None:
        """Writes the file.

        Args:
            step (int): gradient steps that were taken.
        """
        # TorchRL moves an old file away before it puts the new one in its place.
        with whole_file(self.path) as partial:
            self._checkpoint.save(partial, metadata={"step": step})

    def load(self) -> int:
        """Restores all parts, where there is a file.

        Returns:
            int: the steps that were taken, 0 without a file.

        Raises:
            ValueError: the file is truncated, or of something else.
        """
        if not self.path.exists():
            return 0
        try:
            loaded = self._checkpoint.load(self.path)
            return int(loaded.manifest["metadata"]["step"])
        except Exception as error:
            raise ValueError(
                f"{self.path} is no readable checkpoint of this training, it may be "
                f"truncated or foreign ({error}): delete it to begin anew"
            ) from error


def bar_position() -> int:
    """The line of this process's progress bars, among runs side by side.

    Returns:
        int: ``position=`` for ``tqdm``; 0 outside of :func:`run_side_by_side`.

    Examples:
        >>> from torchrl_caiac.experiments import bar_position
        >>> bar_position()
        0
    """
    return int(os.environ.get(_POSITION, "0"))


def run_side_by_side(
    function: Callable[..., Any],
    jobs: Iterable[tuple[Any, ...]],
    *,
    processes: int = 2,
) -> Iterator[tuple[int, Any]]:
    """Runs jobs in processes of their own, in which torch has one thread.

    Jobs start in their order, and the next one when one has finished. When one raises,
    those not yet begun are left out and the error is raised when the running ones have
    ended. The processes end with this one, however it ends.

    Args:
        function (Callable): what a job does; picklable, as its results are.
        jobs (iterable of tuples): the arguments of each job.

    Keyword Args:
        processes (int): how many at a time. Defaults to 2.

    Yields:
        tuple[int, Any]: the number of a finished job and its result, in the order in
        which they finish.

    Examples:
        >>> from math import hypot
        >>> from torchrl_caiac.experiments import run_side_by_side
        >>> dict(run_side_by_side(hypot, [(3, 4), (5, 12)], processes=1))
        {0: 5.0, 1: 13.0}
    """
    if processes < 1:
        raise ValueError(f"processes is {processes}, wanted at least 1")
    # spawn: forked copies of torch's and OpenGL's threads may hang.
    context = multiprocessing.get_context("spawn")
    counter = context.Value("i", 0)
    pool = ProcessPoolExecutor(
        processes,
        mp_context=context,
        initializer=_start_worker,
        initargs=(counter,),
    )
    waiting = enumerate(jobs)
    running: dict[Any, int] = {}

    def start(count: int) -> None:
        # No more than there are processes: the pool cannot take a job back that it has
        # put aside for the next free process.
        for number, job in islice(waiting, count):
            running[pool.submit(_on_one_thread, function, job)] = number

    try:
        start(processes)
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            finished = [(running.pop(future), future.result()) for future in done]
            start(len(finished))
            yield from sorted(finished)
    finally:
        pool.shutdown(cancel_futures=True)


def end_with_parent() -> None:
    """Lets this process end as soon as the one that started it has ended.

    Called in a process of ``multiprocessing``: when its parent is killed it would wait
    for work for ever, or go on writing beside the parent's successor.

    Examples:
        >>> from torchrl_caiac.experiments import end_with_parent
        >>> end_with_parent()  # nothing, in a process that was not started so
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)  # at once: the main thread may be in the middle of a long job

    threading.Thread(target=watch, daemon=True).start()


def _on_one_thread(function: Callable[..., Any], job: tuple[Any, ...]) -> Any:
    # Before every job: the one before may have left more, as TorchRL's environments do.
    torch.set_num_threads(1)
    return function(*job)


def _start_worker(counter: Any) -> None:
    end_with_parent()
    with counter.get_lock():
        os.environ[_POSITION] = str(counter.value)
        counter.value += 1
