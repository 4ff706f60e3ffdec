"""Scoring in several processes: of this command, or of ``torchrun``."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from torch import distributed as dist
from torch import nn
from tqdm.auto import tqdm

from torchrl_caiac._processes import run_in_processes
from torchrl_caiac.cli.errors import UsageError
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.influence.shards import scoring_progress

__all__ = ["Ranks", "ranks_of_torchrun", "score_in_workers"]

# torchrun sets all of them; a cluster may set one or two for other purposes.
_VARIABLES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")
_FAILED = "failed"
# Fitting a world model takes hours at most. A rank that ends is noticed at once.
_LONGEST = timedelta(days=7)


@dataclass(frozen=True)
class Ranks:
    """The processes that ``torchrun`` has started.

    Args:
        rank (int): the number of this one.
        world_size (int): how many there are.
        local_rank (int): the number of this one on its machine.
    """

    rank: int
    world_size: int
    local_rank: int

    @property
    def shard(self) -> tuple[int, int]:
        """The argument of :func:`~torchrl_caiac.influence.score_buffer`."""
        return self.rank, self.world_size

    @contextmanager
    def connected(self) -> Iterator[None]:
        """Context manager in which the processes can send to each other.

        If the first process raises, the others end with an error too.
        """
        dist.init_process_group(
            "gloo", rank=self.rank, world_size=self.world_size, timeout=_LONGEST
        )
        try:
            yield
        finally:
            dist.destroy_process_group()

    def send(self, value: Any) -> None:
        """Sends a value from the first process to the others."""
        dist.broadcast_object_list([value], src=0)

    def send_failure(self, error: BaseException) -> None:
        """Tells the others that the first process has failed."""
        self.send((_FAILED, f"{type(error).__name__}: {error}"))

    def receive(self) -> Any:
        """Returns what the first process sends.

        Raises:
            RuntimeError: it has failed.
        """
        values: list[Any] = [None]
        try:
            dist.broadcast_object_list(values, src=0)
        except RuntimeError as error:
            raise RuntimeError(
                "rank 0 has ended before scoring began: see its message, and repeat "
                "the call"
            ) from error
        if isinstance(values[0], tuple) and values[0][0] == _FAILED:
            raise RuntimeError(f"rank 0 has failed: {values[0][1]}")
        return values[0]

    def on_device(self, estimator: Any) -> Any:
        """Moves an estimator to the GPU of this process, if there is one."""
        if isinstance(estimator, nn.Module) and torch.cuda.is_available():
            return estimator.to(f"cuda:{self.local_rank}")
        return estimator


def ranks_of_torchrun() -> Ranks | None:
    """Returns the processes that ``torchrun`` has started, ``None`` without it.

    Raises:
        UsageError: what it sets is not readable.
    """
    if any(name not in os.environ for name in _VARIABLES):
        return None
    try:
        numbers = [int(os.environ[name]) for name in _VARIABLES[:3]]
    except ValueError:
        found = {name: os.environ[name] for name in _VARIABLES[:3]}
        raise UsageError(
            f"the environment has {found}, expected the integers of torchrun: unset "
            "them, or start with torchrun"
        ) from None
    return Ranks(*numbers) if numbers[1] > 1 else None


def score_in_workers(
    folder: Path, estimator: Any, workers: int, arguments: dict[str, Any]
) -> None:
    """Scores a folder of transitions in processes on this machine.

    Args:
        folder (Path): the folder.
        estimator (callable): the estimator; picklable.
        workers (int): the number of processes, each with one thread.
        arguments (dict): further ones of
            :func:`~torchrl_caiac.influence.score_buffer`. Its ``progress`` shows the
            progress of all processes.

    Raises:
        RuntimeError: a process was killed.
    """
    hidden = {**arguments, "progress": False}
    jobs = [(folder, estimator, (i, workers), hidden) for i in range(workers)]
    try:
        with _bar(folder, show=arguments["progress"]):
            for _ in run_in_processes(_score, jobs, processes=workers):
                pass
    except RuntimeError as error:
        if "ended in the middle" not in str(error):
            raise
        raise RuntimeError(
            f"a process that scored {folder} was killed, perhaps for lack of memory: "
            "what is scored is kept, repeat the same call to resume, with fewer "
            "--workers if memory is short"
        ) from error


def _score(
    folder: Path, estimator: Any, shard: tuple[int, int], arguments: dict[str, Any]
) -> None:
    rb = offline_buffer(load_transitions(folder))
    score_buffer(rb, estimator, shard=shard, **arguments)


@contextmanager
def _bar(folder: Path, *, show: bool) -> Iterator[None]:
    """Shows a progress bar of all processes."""
    ended = threading.Event()

    def watch() -> None:
        with tqdm(desc="scoring", unit="row", disable=not show) as bar:
            while not ended.wait(0.5):
                found = scoring_progress(folder)
                if found is not None:
                    bar.n, bar.total = found
                    bar.refresh()
            if bar.total:
                bar.n = bar.total
                bar.refresh()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
