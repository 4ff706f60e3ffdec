"""``caiac check``: what would make counterfactuals or scores wrong."""

from __future__ import annotations

import argparse
from typing import Any

from torchrl_caiac.check import check_dataset
from torchrl_caiac.cli.console import Console
from torchrl_caiac.cli.errors import FAILED, OK
from torchrl_caiac.cli.sources import add_data, add_layout, open_data, read_layout
from torchrl_caiac.data import action_bounds

__all__ = ["add_parser", "run"]

_EPILOG = """\
example:
  caiac check episodes.npz --layout layout.yaml
The exit code is 1 if there are errors, 0 if there are none or only warnings.
"""


def add_parser(commands: Any, **options: Any) -> argparse.ArgumentParser:
    """Adds the parser of the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "check",
        help="look for errors in a dataset and its layout",
        description="Looks for what would make counterfactuals or scores wrong: "
        "missing entries, next states that do not follow, wrong ends, columns that do "
        "not fit the layout, values that are not finite. Each finding has its effect, "
        "and what to do.",
        epilog=_EPILOG,
        **options,
    )
    add_data(parser)
    add_layout(parser)
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace, console: Console) -> int:
    """Runs the command."""
    layout = read_layout(args.layout, console)
    data = open_data(args, console)
    with console.step("checking"):
        report = check_dataset(
            data,
            layout,
            action_spec=action_bounds(data),
            variance_floor=layout.variance_floor or None,
        )
    console.text(str(report))
    console.document(report.to_dict())
    return OK if report.ok else FAILED
