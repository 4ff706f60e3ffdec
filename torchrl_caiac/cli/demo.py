"""``caiac demo``: the motivating experiment in the kitchen."""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Any

import torchrl_caiac
from torchrl_caiac.cli.console import Console
from torchrl_caiac.cli.errors import FAILED, OK, UsageError

__all__ = ["add_parser", "run"]

_EPILOG = """\
examples:
  caiac demo --quick
  caiac demo
It needs pip install 'torchrl-caiac[examples]'. An interrupted demo resumes.
"""
_NEEDED = ("hydra", "gymnasium_robotics", "mujoco", "minari", "matplotlib")


def add_parser(commands: Any, **options: Any) -> argparse.ArgumentParser:
    """Adds the parser of the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "demo",
        help="run the motivating experiment in the kitchen",
        description="Collects demonstrations in the Franka kitchen, fits a world "
        "model, computes scores, and trains and evaluates policies with and without "
        "counterfactuals: the same as `make demo`. It takes about three minutes on two "
        "cores. --quick is a smoke test of the same steps, whose numbers mean nothing.",
        epilog=_EPILOG,
        **options,
    )
    parser.add_argument("--quick", action="store_true", help="a smoke test")
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="the folder to write; default: outputs",
    )
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace, console: Console) -> int:
    """Runs the command."""
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(
            f"the demo needs {', '.join(missing)}: pip install "
            "'torchrl-caiac[examples]'"
        )
    command = [sys.executable, str(_folder() / "study.py"), "study=demo"]
    command += ["size=quick"] if args.quick else []
    command += [f"root={Path(args.out).resolve()}"] if args.out else []
    # The study writes its own stages, and their output to log.txt. With JSON, they are
    # progress, and go to the standard error.
    streams = console.streams
    done = subprocess.run(
        command,
        stdout=streams[1] if args.json else streams[0],
        stderr=streams[1],
        check=False,
    )
    if done.returncode:
        console.error(f"the demo ended with exit code {done.returncode}")
        return FAILED
    size = "_quick" if args.quick else ""
    out = Path(args.out or "outputs") / "studies" / f"demo{size}"
    console.document({"written": str(out)})
    return OK


def _folder() -> Path:
    """Returns the folder of the examples: of the wheel, or of the repository."""
    spec = importlib.util.find_spec("torchrl_caiac_examples")
    if spec is not None and spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    folder = Path(torchrl_caiac.__file__).parents[1] / "examples"
    if not (folder / "study.py").exists():
        raise UsageError(
            "the examples are not installed: install torchrl-caiac from a wheel, or "
            "run the demo in a clone of the repository"
        )
    return folder
