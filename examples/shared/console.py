"""The console of a script: one line per stage. All other output goes to a log file."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import torch
from omegaconf import DictConfig
from tqdm.auto import tqdm

from torchrl_caiac._files import claim_folder
from torchrl_caiac._processes import bar_position

__all__ = ["Console", "log_in_process", "progress", "progress_bar", "start"]

_TERMINAL = "EXAMPLES_TERMINAL"  # set where processes may draw bars on the terminal
_FORMAT = "%(asctime)s %(name)s: %(message)s"


def progress() -> bool:
    """Returns whether progress bars are shown: only on a terminal."""
    return sys.stderr is not None and sys.stderr.isatty()


def progress_bar(**options: Any) -> tqdm:
    """Returns a progress bar of a run, also in a separate process."""
    file: TextIO | None = None
    if not progress() and _TERMINAL in os.environ:
        file = Path("/dev/tty").open("w")  # noqa: SIM115 - closed with the process
    return tqdm(
        file=file,
        disable=file is None and not progress(),
        position=bar_position(),
        mininterval=1,
        **options,
    )


def log_in_process() -> None:
    """Sends log messages of a process to its standard error, which is the log file."""
    logging.basicConfig(format=_FORMAT, level=logging.INFO)


class Console:
    """Prints stages and results, and sends all other output to ``<folder>/log.txt``.

    Standard output and error of this process and of those that it starts are redirected
    until the context ends. Progress bars appear on a terminal only.

    Args:
        folder (path): where the log file is written.
        stages (int): how many stages follow. Defaults to 1.
    """

    def __init__(self, folder: str | os.PathLike[str], stages: int = 1) -> None:
        self.log = Path(folder) / "log.txt"
        self.stages = stages
        self.seconds: dict[str, float] = {}

    def __enter__(self) -> Console:
        """Redirects the output."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.log.open("a", buffering=1)
        sys.stdout.flush()
        sys.stderr.flush()
        self._saved = os.dup(1), os.dup(2), sys.stdout, sys.stderr
        self._screen = os.fdopen(os.dup(1), "w", buffering=1)
        self._is_terminal = self._screen.isatty()
        if sys.stderr.isatty():
            os.environ[_TERMINAL] = "1"
            sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
        else:
            sys.stderr = self._file
        sys.stdout = self._file
        os.dup2(self._file.fileno(), 1)
        os.dup2(self._file.fileno(), 2)
        logging.basicConfig(
            stream=self._file, format=_FORMAT, level=logging.INFO, force=True
        )
        logging.captureWarnings(True)
        return self

    def __exit__(self, *_: object) -> None:
        """Restores the output."""
        sys.stdout.flush()
        out, err, sys.stdout, sys.stderr = self._saved
        os.dup2(out, 1)
        os.dup2(err, 2)
        os.close(out)
        os.close(err)
        os.environ.pop(_TERMINAL, None)
        logging.captureWarnings(False)
        logging.basicConfig(handlers=[logging.NullHandler()], force=True)
        self._screen.close()
        self._file.close()

    def print(self, text: str) -> None:
        """Prints a line."""
        self._screen.write(f"{text}\n")
        self._screen.flush()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Prints the name of a stage, and the seconds that it took."""
        title = f"[{len(self.seconds) + 1}/{self.stages}] {name} ..."
        logging.getLogger(__name__).info("%s", title)
        self._screen.write(title)
        self._screen.flush()
        begin = time.perf_counter()
        try:
            yield
        except KeyboardInterrupt:
            self._screen.write(" interrupted, run again to resume\n")
            self._screen.flush()
            raise
        except BaseException:
            logging.getLogger(__name__).exception("%s failed", name)
            self._screen.write(f" failed, see {self.log}\n")
            self._screen.flush()
            raise
        self.seconds[name] = time.perf_counter() - begin
        # Bars may have covered the line.
        again = f"\r\x1b[2K{title}" if self._is_terminal else ""
        self._screen.write(f"{again} {self.seconds[name]:.0f} s\n")
        self._screen.flush()


@contextmanager
def start(
    cfg: DictConfig, *, folder: Path | None = None, stages: int = 1
) -> Iterator[Console]:
    """Starts a script: locks its output folder, and opens its console there.

    Args:
        cfg (DictConfig): the configuration.

    Keyword Args:
        folder (path, optional): what the script writes. Defaults to ``cfg.out``.
        stages (int): how many stages follow. Defaults to 1.

    Yields:
        Console: of the script.
    """
    folder = Path(cfg.out) if folder is None else folder
    torch.set_num_threads(1)
    with claim_folder(folder), Console(folder, stages) as console:
        yield console
