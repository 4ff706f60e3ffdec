"""The parser of the command line, from which its documentation is made."""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torchrl_caiac
from torchrl_caiac.cli import augment, check, demo, inspect, report, score

__all__ = ["make_parser"]

_DESCRIPTION = """\
Causal data augmentation for offline robot learning: from your dataset to counterfactual
transitions. Exit codes: 0 done; 1 errors in the data, or a step failed; 2 a wrong
command line; 130 interrupted.
"""
_EPILOG = """\
example, on an OGBench file:
  caiac inspect cube-double-play-v0.npz
  caiac check cube-double-play-v0.npz --layout ogbench/cube-double
  caiac score cube-double-play-v0.npz --layout ogbench/cube-double --out scored
  caiac report scored
  caiac augment scored --out augmented.npz
"""
_COMMANDS = (inspect, check, score, report, augment, demo)


def make_parser() -> argparse.ArgumentParser:
    """Returns the parser of ``caiac``.

    Returns:
        argparse.ArgumentParser: the parser; ``run`` of its result is the function of
        the command.

    Examples:
        >>> from torchrl_caiac.cli import make_parser
        >>> make_parser().parse_args(["check", "a.npz", "--layout", "l.yaml"]).layout
        'l.yaml'
    """
    parser = argparse.ArgumentParser(
        prog="caiac",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--version", action="version", version=f"caiac {torchrl_caiac.__version__}"
    )
    parser.set_defaults(run=None)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for module in _COMMANDS:
        add: Callable[..., argparse.ArgumentParser] = module.add_parser
        command = add(commands, formatter_class=argparse.RawDescriptionHelpFormatter)
        output = command.add_argument_group("output")
        output.add_argument(
            "--json",
            action="store_true",
            help="write one JSON document to the standard output, and nothing else",
        )
        output.add_argument(
            "--debug",
            action="store_true",
            help="show tracebacks, log messages and what other packages print",
        )
    return parser
