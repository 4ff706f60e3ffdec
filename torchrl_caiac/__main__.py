"""The command line: ``python -m torchrl_caiac`` is the same as ``caiac``."""

from __future__ import annotations

import sys

from torchrl_caiac.cli import main

if __name__ == "__main__":
    sys.exit(main())
