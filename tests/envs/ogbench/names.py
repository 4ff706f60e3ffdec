"""What the tests of OGBench's environments have in common."""

from __future__ import annotations

#: One environment of each kind.
NAMES = ("cube-double", "scene", "puzzle-3x3")
#: The number of transitions of an episode in the tests' files.
STEPS = 60
