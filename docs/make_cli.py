"""Writes the reference of the command line in ``cli.md``, from its parser.

``python docs/make_cli.py`` after a change of an option. A test compares both.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from torchrl_caiac._files import whole_file
from torchrl_caiac.cli import make_parser

PAGE = Path(__file__).parent / "cli.md"
MARK = "<!-- From here on: written by make_cli.py. -->\n"


def reference() -> str:
    """Returns the reference of all commands, in Markdown."""
    parser = make_parser()
    (commands,) = (
        action
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    parts = []
    for name, command in commands.choices.items():
        parts += [f"## `caiac {name}`\n", f"{command.description}\n"]
        parts += [f"```text\n{command.epilog.strip()}\n```\n"]
        parts += ["| argument | meaning |\n| --- | --- |"]
        parts += [f"{row}" for row in _rows(command)]
        parts += [""]
    return "\n".join(parts).rstrip() + "\n"


def _rows(command: argparse.ArgumentParser) -> Iterator[str]:
    for action in command._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        name = ", ".join(action.option_strings) or str(action.metavar)
        if action.choices:
            name += f" {{{','.join(action.choices)}}}"
        elif action.option_strings and action.nargs != 0:
            name += f" {action.metavar}"
        text = str(action.help) % {"default": action.default}
        required = " Required." if action.required and action.option_strings else ""
        yield f"| `{name}` | {text}.{required} |"


def page(text: str) -> str:
    """Returns the page with a new reference, and what was written by hand before it."""
    return text[: text.index(MARK) + len(MARK)] + "\n" + reference()


if __name__ == "__main__":
    with whole_file(PAGE) as partial:
        partial.write_text(page(PAGE.read_text()))
