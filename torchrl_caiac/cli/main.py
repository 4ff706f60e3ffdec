"""Runs a command of the command line."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from torchrl_caiac.check import DatasetError
from torchrl_caiac.cli.console import Console
from torchrl_caiac.cli.errors import FAILED, INTERRUPTED, OK, USAGE, UsageError
from torchrl_caiac.cli.parser import make_parser

__all__ = ["main"]

# What the package raises about data, files and arguments. Others are its own mistakes.
_EXPECTED = (OSError, ValueError, KeyError, TypeError, ImportError, RuntimeError)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs ``caiac`` with arguments.

    Args:
        arguments (sequence of str, optional): what follows ``caiac`` on the command
            line. Defaults to ``None``: those of this process.

    Returns:
        int: the exit code. 0: done; 1: the data have errors, or a step failed; 2: the
        command line is wrong; 130: interrupted.

    Examples:
        >>> from torchrl_caiac.cli.main import main
        >>> main(["--version"])  # doctest: +ELLIPSIS
        caiac ...
        0
    """
    parser = make_parser()
    try:
        args = parser.parse_args(arguments)
    except SystemExit as stop:  # of --help, or of a wrong command line
        return stop.code if isinstance(stop.code, int) else USAGE
    if args.run is None:
        parser.print_help(sys.stderr)
        return USAGE
    try:
        with Console(as_json=args.json, debug=args.debug) as console:
            return _run(args, console)
    except BrokenPipeError:
        # Whoever read the output, such as `head`, has enough. Python flushes once
        # more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK


def _run(args: object, console: Console) -> int:
    try:
        code: int = args.run(args, console)  # type: ignore[attr-defined]
        return code
    except BrokenPipeError:
        raise
    except UsageError as error:
        console.trace()
        console.error(str(error))
        return USAGE
    except DatasetError as error:
        console.trace()
        console.error(_dataset_error(error))
    except KeyboardInterrupt:
        console.trace()
        console.note("interrupted: run the same command again to resume")
        return INTERRUPTED
    except _EXPECTED as error:
        console.trace()
        console.error(_message(error))
    except Exception as error:
        console.trace()
        console.error(
            f"{type(error).__name__}: {error}; this is a mistake of torchrl_caiac "
            "itself, please report it with the output of --debug"
        )
    return FAILED


def _dataset_error(error: DatasetError) -> str:
    found = error.report.errors
    return (
        f"the dataset has {len(found)} error{'s' if len(found) > 1 else ''}: "
        + "; ".join(f"{f.message} ({f.code}; to do: {f.remedy})" for f in found)
        + ". `caiac check` shows all findings"
    )


def _message(error: BaseException) -> str:
    # str() of a KeyError is the repr of its message.
    if isinstance(error, KeyError) and error.args:
        return str(error.args[0])
    return str(error) or type(error).__name__
