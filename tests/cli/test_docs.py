"""The page about the command line, against its parser."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path
from types import ModuleType

import pytest

from torchrl_caiac.cli import make_parser

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "cli.md"


def make_cli() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "make_cli", ROOT / "docs" / "make_cli.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_is_that_of_the_parser() -> None:
    text = PAGE.read_text()
    assert make_cli().page(text) == text, "run: python docs/make_cli.py"


def calls() -> list[str]:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    lines = [line for page in pages for line in page.read_text().splitlines()]
    found = [re.match(r"\s*(?:\$ )?caiac (\w.*)", line) for line in lines]
    return sorted({match[1].split(" #")[0] for match in found if match})


@pytest.mark.parametrize("call", calls())
def test_calls_in_the_documentation_are_understood(call: str) -> None:
    assert make_parser().parse_args(shlex.split(call)).run is not None
