"""The command line ``caiac``, also ``python -m torchrl_caiac``."""

from __future__ import annotations

from torchrl_caiac.cli.main import main
from torchrl_caiac.cli.parser import make_parser

__all__ = ["main", "make_parser"]
