"""The errors of the command line, and their exit codes."""

from __future__ import annotations

__all__ = ["FAILED", "INTERRUPTED", "OK", "USAGE", "UsageError"]

#: Exit codes: done; errors in the data, or findings; a wrong command line; Ctrl-C.
OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130


class UsageError(ValueError):
    """What was typed is wrong: an option, a name, or a path that does not exist.

    Examples:
        >>> from torchrl_caiac.cli.errors import UsageError
        >>> str(UsageError("no such layout"))
        'no such layout'
    """
