"""Running jobs in separate processes."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for_any
from multiprocessing.reduction import ForkingPickler
from multiprocessing.util import Finalize
from typing import Any

import torch

__all__ = [
    "ThreadLock",
    "available_processors",
    "bar_position",
    "run_in_processes",
]

_POSITION = "TQDM_POSITION"
# Libraries read these when they are loaded, so they are set before a process starts.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# The result of ``setup`` in this process, or the error that it raised.
_worker: tuple[Any, ...] = ()
_setup_error: Exception | None = None


class ThreadLock:
    """A reentrant lock between the threads of one process.

    A forked process has its own, since no thread of it would release that of its
    parent.

    Examples:
        >>> from torchrl_caiac._processes import ThreadLock
        >>> lock = ThreadLock()
        >>> with lock, lock:
        ...     pass
    """

    def __init__(self) -> None:
        self._locks: dict[int, Any] = {}

    def __enter__(self) -> None:
        self._locks.setdefault(os.getpid(), threading.RLock()).acquire()

    def __exit__(self, *_: object) -> None:
        self._locks[os.getpid()].release()


def available_processors() -> int:
    """Returns the number of processors that this process may use.

    Returns:
        int: at least 1.

    Examples:
        >>> from torchrl_caiac._processes import available_processors
        >>> available_processors() >= 1
        True
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def bar_position() -> int:
    """Returns the line for the progress bars of this process.

    Returns:
        int: ``position=`` for ``tqdm``; 0 outside of :func:`run_in_processes`.

    Examples:
        >>> from torchrl_caiac._processes import bar_position
        >>> bar_position()
        0
    """
    return int(os.environ.get(_POSITION, "0"))


def run_in_processes(
    function: Callable[..., Any],
    jobs: Iterable[tuple[Any, ...]],
    *,
    processes: int = 2,
    setup: Callable[[], Any] | None = None,
) -> Iterator[tuple[int, Any]]:
    """Runs jobs in separate processes, in which torch has one thread.

    Jobs start in order; the next one starts when one has finished. If a job raises,
    jobs that have not started are cancelled, and the error is raised after the running
    jobs have ended, with the traceback of the worker process as its cause. The worker
    processes exit when this process exits, for whatever reason. They are started by
    ``spawn``, so a script needs the usual ``if __name__ == "__main__":``.

    Args:
        function (callable): runs one job; picklable, as are its results.
        jobs (iterable of tuple): the arguments of each job.

    Keyword Args:
        processes (int): the number of processes; with 0 the jobs run in this process,
            one after another. Defaults to 2.
        setup (callable, optional): called once in each process. The result is the first
            argument of ``function``; it is closed at the end if it has a ``close``
            method. Not called without jobs.

    Yields:
        tuple[int, Any]: the number of a finished job and its result, in the order in
        which jobs finish.

    Raises:
        ValueError: ``processes`` is negative.
        RuntimeError: a process ended in the middle of a job, for example for lack of
            memory; a job called ``sys.exit``, or returned what cannot be pickled; or an
            error that cannot be pickled, described with its traceback.
        TypeError: the arguments of a job cannot be pickled.
        Exception: whatever a job or ``setup`` raised.
        KeyboardInterrupt: the processes are ended at once, in the middle of their jobs.

    Examples:
        >>> from math import hypot
        >>> from torchrl_caiac._processes import run_in_processes
        >>> dict(run_in_processes(hypot, [(3, 4), (5, 12)], processes=1))
        {0: 5.0, 1: 13.0}
    """
    if processes < 0:
        raise ValueError(f"processes is {processes}, expected at least 0")
    if processes == 0:
        yield from _run_here(function, jobs, setup)
        return
    # spawn: forked copies of torch's and OpenGL's threads may hang.
    context = multiprocessing.get_context("spawn")
    stopped, stop = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(
        processes,
        mp_context=context,
        initializer=_start_worker,
        initargs=(context.Value("i", 0), stopped, setup),
    )
    waiting = enumerate(jobs)
    running: dict[Any, int] = {}

    def start(count: int) -> None:
        # Never more jobs than processes: the pool cannot cancel a job that it has
        # queued for the next free process.
        with _one_thread_in_new_processes():
            for number, job in islice(waiting, count):
                packed = _pack(function, job, number)
                running[pool.submit(_run_packed, number, packed)] = number

    try:
        start(processes)
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            finished = [
                (running.pop(future), pickle.loads(future.result())) for future in done
            ]
            start(len(finished))
            yield from sorted(finished)
    except KeyboardInterrupt:
        stop.close()  # jobs may take hours
        raise
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a process ended in the middle of a job, perhaps killed for lack of "
            "memory: files of finished jobs are kept, call again to resume"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)
        stop.close()
        stopped.close()


def _run_here(
    function: Callable[..., Any],
    jobs: Iterable[tuple[Any, ...]],
    setup: Callable[[], Any] | None,
) -> Iterator[tuple[int, Any]]:
    made: tuple[Any, ...] = ()
    try:
        for number, job in enumerate(jobs):
            if setup is not None and not made:
                with _no_exit("setup"):
                    made = (setup(),)
            with _no_exit(f"job {number}"):
                result = function(*made, *job)
            yield number, result
    finally:
        for value in made:
            _close(value)


@contextmanager
def _one_thread_in_new_processes() -> Iterator[None]:
    previous = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _pack(function: Callable[..., Any], job: tuple[Any, ...], number: int) -> bytes:
    # By ourselves: the pool's error would not name the job.
    try:
        return bytes(ForkingPickler.dumps((function, job)))
    except Exception as error:  # __reduce__ of any class may raise anything
        raise TypeError(
            f"job {number} cannot be sent to a process, its function or arguments "
            f"cannot be pickled ({error})"
        ) from error


@contextmanager
def _no_exit(what: str) -> Iterator[None]:
    """Raises an error where a job asks to exit, which would end the whole program."""
    try:
        yield
    except SystemExit as error:
        raise RuntimeError(
            f"{what} called sys.exit({error.code!r}): raise an error instead"
        ) from error


def _run_packed(number: int, packed: bytes) -> bytes:
    """Runs one job in a process; arguments and result are our own pickles."""
    function, job = pickle.loads(packed)
    with _no_exit(f"job {number}"):
        result = _run_job(function, job)
    try:
        return bytes(ForkingPickler.dumps(result))
    except Exception as error:  # __reduce__ of any class may raise anything
        raise RuntimeError(
            f"job {number} returned a {type(result).__name__} that cannot be pickled "
            f"({error}): return other values, or write them to a file"
        ) from error


def _run_job(function: Callable[..., Any], job: tuple[Any, ...]) -> Any:
    # Before every job: the previous one may have raised it, as TorchRL's envs do.
    torch.set_num_threads(1)
    try:
        if _setup_error is not None:
            raise _setup_error
        return function(*_worker, *job)
    except Exception as error:
        if _can_be_pickled(error):
            raise
        # The pool would break, and report the end of a process instead of the error.
        raise RuntimeError(f"{type(error).__name__}: {error}") from error


def _can_be_pickled(error: Exception) -> bool:
    try:
        pickle.loads(pickle.dumps(error))  # as the pool does; our own bytes
    except Exception:  # __reduce__ and __init__ of any class may raise anything
        return False
    return True


def _start_worker(
    counter: Any, stopped: Connection, setup: Callable[[], Any] | None
) -> None:
    global _worker, _setup_error
    _end_with_parent(stopped)
    with counter.get_lock():
        os.environ[_POSITION] = str(counter.value)
        counter.value += 1
    torch.set_num_threads(1)
    if setup is None:
        return
    try:
        with _no_exit("setup"):
            made = setup()
    except Exception as error:  # raised here, it would break the pool without a reason
        _setup_error = error
        return
    Finalize(None, _close, (made,), exitpriority=0)
    _worker = (made,)


def _end_with_parent(stopped: Connection) -> None:
    """Makes this process exit as soon as its parent process has ended or is stopped.

    Otherwise a process whose parent was killed would wait for jobs forever, or write to
    the same files as the next run.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        wait_for_any([parent.sentinel, stopped])
        os._exit(1)  # at once: the main thread may be in the middle of a long job

    threading.Thread(target=watch, daemon=True).start()


def _close(value: Any) -> None:
    close = getattr(value, "close", None)
    if close is not None:
        close()
