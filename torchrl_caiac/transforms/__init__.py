"""Replay-buffer transforms that make counterfactual samples."""

from __future__ import annotations

from torchrl_caiac.transforms.caiac import CAIACTransform
from torchrl_caiac.transforms.coda import CoDATransform
from torchrl_caiac.transforms.hindsight_goal import HindsightGoal
from torchrl_caiac.transforms.window_goal import WindowGoal

__all__ = ["CAIACTransform", "CoDATransform", "HindsightGoal", "WindowGoal"]
