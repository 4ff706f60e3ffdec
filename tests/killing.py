"""Processes that are killed in the middle of their work."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def run_killed(work: Callable[..., Iterator[None]], *args: Any, **kwargs: Any) -> None:
    """Runs a generator to its first ``yield`` in a process that is then killed."""
    with running(work, *args, **kwargs):
        pass


@contextmanager
def running(
    work: Callable[..., Iterator[None]], *args: Any, **kwargs: Any
) -> Iterator[None]:
    """Runs a generator to its first ``yield`` in a process, killed after the block."""
    ready, done = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            steps = work(*args, **kwargs)
            next(steps)
            os.write(done, b"1")
            signal.pause()
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    os.close(done)
    os.read(ready, 1)  # empty if the process was killed before
    try:
        yield
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(ready)
