"""The console of the command line: results, progress and errors, nothing else."""

from __future__ import annotations

import json
import logging
import os
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, Any, TextIO

import torchrl_caiac
from torchrl_caiac._files import plain

__all__ = ["Console"]

_PACKAGE = Path(torchrl_caiac.__file__).parent
_LOGGER = logging.getLogger("torchrl_caiac")


class Console:
    """Context manager through which a command writes.

    Results go to the standard output; progress, warnings and errors to the standard
    error. What other packages print does not appear, and neither do their log messages
    and warnings. Progress bars appear on a terminal only; elsewhere each step is a
    line.

    Keyword Args:
        as_json (bool): write one JSON document as the result, and no text. Defaults to
            ``False``.
        debug (bool): show tracebacks, log messages and what other packages print.
            Defaults to ``False``.

    Examples:
        >>> from torchrl_caiac.cli.console import Console
        >>> with Console(as_json=True) as console:
        ...     print("not shown")
        ...     console.text("not shown either")
        ...     console.document({"rows": 3})
        {
         "rows": 3
        }
    """

    def __init__(self, *, as_json: bool = False, debug: bool = False) -> None:
        self.as_json, self.debug = as_json, debug
        self.is_quiet = False
        self.warnings: list[str] = []
        self._out, self._err = sys.stdout, sys.stderr
        self._is_terminal = False

    @property
    def progress(self) -> bool:
        """Whether progress bars are shown."""
        return self._is_terminal

    @property
    def streams(self) -> tuple[TextIO, TextIO]:
        """The standard output and error, for another process that writes to them."""
        return self._out, self._err

    def __enter__(self) -> Console:
        """Takes over the standard output and error, log messages and warnings."""
        with ExitStack() as stack:
            self._redirect(stack)
            handler = _Handler(self)
            level = _LOGGER.level, _LOGGER.propagate
            _LOGGER.addHandler(handler)
            _LOGGER.setLevel(logging.INFO if self.debug else logging.WARNING)
            _LOGGER.propagate = False
            stack.callback(self._restore_logger, handler, *level)
            shown = warnings.showwarning
            warnings.showwarning = self._show_warning
            stack.callback(setattr, warnings, "showwarning", shown)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Gives everything back."""
        self._stack.close()

    # --- what a command writes -------------------------------------------------------

    def text(self, text: str = "") -> None:
        """Writes a text for people to the standard output, unless it gets JSON."""
        if not self.as_json:
            self._write(self._out, f"{text}\n")

    def document(self, value: Any) -> None:
        """Writes the result as JSON, if JSON was asked for."""
        if self.as_json:
            text = json.dumps(plain(value), indent=1, allow_nan=False)
            self._write(self._out, f"{text}\n")

    def note(self, text: str) -> None:
        """Writes a line about what is done to the standard error."""
        self._write(self._err, f"{text}\n")

    def warn(self, text: str) -> None:
        """Writes a warning, once."""
        text = " ".join(text.split())
        if text not in self.warnings:
            self.warnings.append(text)
            self._write(self._err, f"warning: {text}\n")

    def error(self, text: str) -> None:
        """Writes an error as one line; with JSON, as a document too."""
        text = " ".join(text.split())
        self._write(self._err, f"error: {text}\n")
        self.document({"error": text})

    def trace(self) -> None:
        """Writes the traceback of the current exception, in debug mode."""
        if self.debug:
            self._write(self._err, traceback.format_exc())

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Writes the name of a step, and the seconds that it took if it took some."""
        begin = time.perf_counter()
        self.note(f"{name} ...")
        yield
        seconds = time.perf_counter() - begin
        if seconds >= 1:
            self.note(f"{name}: {seconds:.0f} s")

    # --- redirection -----------------------------------------------------------------

    def be_quiet(self) -> None:
        """Writes nothing from now on but errors, as another process writes the rest."""
        self.is_quiet, self.as_json, self._is_terminal = True, False, False

    def _write(self, stream: TextIO, text: str) -> None:
        if self.is_quiet and not text.startswith("error: "):
            return
        stream.write(text)
        stream.flush()

    def _redirect(self, stack: ExitStack) -> None:
        self._out, self._err = sys.stdout, sys.stderr
        out, err = sys.stdout, sys.stderr
        stack.callback(setattr, sys, "stdout", out)
        stack.callback(setattr, sys, "stderr", err)
        stack.callback(setattr, self, "_out", out)
        stack.callback(setattr, self, "_err", err)
        self._is_terminal = err.isatty()
        if self.debug:
            # Nothing else on the standard output, where the result is expected.
            sys.stdout = err
            return
        noise = stack.enter_context(tempfile.TemporaryFile("w+"))  # noqa: SIM115
        # Libraries in C write to the descriptors themselves.
        for number, name in ((1, "_out"), (2, "_err")):
            stream = getattr(self, name)
            if _descriptor(stream) != number:
                continue  # replaced, for example by a test
            stream.flush()
            saved = os.dup(number)
            stack.callback(os.close, saved)
            stack.callback(os.dup2, saved, number)
            os.dup2(noise.fileno(), number)
            copy = stack.enter_context(
                os.fdopen(
                    os.dup(saved),
                    "w",
                    encoding=stream.encoding,
                    errors="backslashreplace",
                )
            )
            setattr(self, name, copy)
        sys.stdout = noise
        sys.stderr = _BarsOnly(self._err, noise) if self._is_terminal else noise

    def _show_warning(
        self,
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if Path(filename).is_relative_to(_PACKAGE):
            self.warn(str(message))
        else:
            text = warnings.formatwarning(message, category, filename, lineno, line)
            sys.stderr.write(text)

    @staticmethod
    def _restore_logger(handler: logging.Handler, level: int, propagate: bool) -> None:
        _LOGGER.removeHandler(handler)
        _LOGGER.setLevel(level)
        _LOGGER.propagate = propagate


class _Handler(logging.Handler):
    """Shows the warnings of this package, and in debug mode all of its messages."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        """Shows a message."""
        if record.levelno >= logging.WARNING:
            self._console.warn(record.getMessage())
        else:
            self._console.note(record.getMessage())


class _BarsOnly:
    """A standard error that shows the progress bars of tqdm, and nothing else."""

    def __init__(self, terminal: TextIO, noise: IO[str]) -> None:
        self._terminal, self._noise = terminal, noise
        self.encoding = terminal.encoding

    def write(self, text: str) -> int:
        """Writes to the terminal what tqdm writes: it begins with a return."""
        is_bar = text.startswith("\r") or not text.replace("\x1b[A", "").strip("\n")
        (self._terminal if is_bar else self._noise).write(text)
        return len(text)

    def flush(self) -> None:
        """Flushes the terminal."""
        self._terminal.flush()

    def isatty(self) -> bool:
        """Returns that this is a terminal."""
        return True

    def fileno(self) -> int:
        """Returns the descriptor of the terminal, from which tqdm reads its width."""
        return self._terminal.fileno()


def _descriptor(stream: Any) -> int | None:
    try:
        return int(stream.fileno())
    except (AttributeError, OSError, ValueError):
        return None
