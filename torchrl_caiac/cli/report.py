"""``caiac report``: one page about a scored dataset."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from torchrl_caiac.cli.console import Console
from torchrl_caiac.cli.errors import OK, UsageError
from torchrl_caiac.cli.sources import scored_folder
from torchrl_caiac.scored import open_scored

__all__ = ["add_parser", "run"]

_EPILOG = """\
example:
  caiac report scored
"""


def add_parser(commands: Any, **options: Any) -> argparse.ArgumentParser:
    """Adds the parser of the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "report",
        help="write an HTML page about a scored dataset",
        description="Writes one HTML page, without links to other files: what the "
        "dataset is, warnings, influence along trajectories, scores with thresholds, "
        "what would be swapped, and example counterfactuals.",
        epilog=_EPILOG,
        **options,
    )
    parser.add_argument("folder", metavar="DIR", help="what `caiac score` wrote")
    parser.add_argument(
        "--out", metavar="FILE", help="the page; default: report.html in DIR"
    )
    parser.add_argument("--title", metavar="TEXT", help="the heading of the page")
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace FILE if it exists; report.html in DIR is always replaced",
    )
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace, console: Console) -> int:
    """Runs the command."""
    from torchrl_caiac.report import write_report

    folder = scored_folder(args.folder)
    out = Path(args.out) if args.out else folder / "report.html"
    if out.is_dir():
        raise UsageError(f"--out {out} is a folder: give the name of a file")
    if args.out and out.exists() and not args.overwrite:
        raise UsageError(f"{out} exists: give another name, or pass --overwrite")
    with console.step("reading the scored dataset"):
        scored = open_scored(folder)
    with console.step("writing the report"):
        written = write_report(scored, out, title=args.title, overwrite=True)
    console.text(f"written to {written}")
    console.document({"written": str(written)})
    return OK
