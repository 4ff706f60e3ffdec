"""``caiac inspect``: what is in a dataset, and a proposal of a layout."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from torchrl_caiac.cli.console import Console
from torchrl_caiac.cli.errors import OK, UsageError
from torchrl_caiac.cli.sources import add_data, format_name, open_data
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.inspection import inspect_dataset

__all__ = ["add_parser", "run"]

_EPILOG = """\
example:
  caiac inspect episodes.npz --write-layout layout.yaml
"""


def add_parser(commands: Any, **options: Any) -> argparse.ArgumentParser:
    """Adds the parser of the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "inspect",
        help="show what is in a dataset, and propose a layout",
        description="Shows the entries, episodes, ranges and action bounds of a "
        "dataset, and what moves when; proposes a layout, by grouping the columns that "
        "move together; and names the ready layouts that fit.",
        epilog=_EPILOG,
        **options,
    )
    add_data(parser)
    parser.add_argument(
        "--write-layout",
        metavar="FILE",
        help="write the proposed layout to a .json or .yaml file",
    )
    parser.set_defaults(run=run)
    return parser


def _yaml(layout: EntityLayout) -> str:
    """Returns a layout in the form in which people write it."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "layout.yaml"
        layout.save(file)
        return file.read_text(encoding="utf-8").rstrip()


def run(args: argparse.Namespace, console: Console) -> int:
    """Runs the command."""
    file = None if args.write_layout is None else Path(args.write_layout)
    if file is not None and file.exists():
        raise UsageError(f"{file} exists: give another file, or remove it")
    if file is not None and file.suffix.lower() not in (".json", ".yaml", ".yml"):
        raise UsageError(f"--write-layout {file}: expected a .json or .yaml file")
    data = open_data(args, console)
    from torchrl_caiac.layouts import matching_layouts

    with console.step("looking at the columns"):
        found = inspect_dataset(data, layouts=matching_layouts(data))
    recognised = format_name(args.data, args.format)
    document = {"format": recognised, **found.to_dict()}
    console.text(f"format: {recognised}")
    console.text(str(found))
    if found.proposal is not None:
        console.text(
            "\nproposed layout (rename its entities; add what the notes name, and what "
            "is noise, as variance_floor; check it):"
        )
        console.text(_yaml(found.proposal))
        if file is not None:
            found.proposal.save(file)
            document["written"] = str(file)
            console.text(f"\nwritten to {file}")
    elif file is not None:
        console.warn(f"nothing is written to {file}: no layout is proposed")
    console.document(document)
    return OK
