"""Goals that are drawn for sampled transitions and windows."""

from __future__ import annotations

from torchrl_caiac.transforms.goals.hindsight import HindsightGoal
from torchrl_caiac.transforms.goals.window import WindowGoal

__all__ = ["HindsightGoal", "WindowGoal"]
