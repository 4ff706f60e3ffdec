"""Replay-buffer transforms that create counterfactual samples."""

from __future__ import annotations

from torchrl_caiac.transforms.caiac import CAIACTransform
from torchrl_caiac.transforms.coda import CoDATransform
from torchrl_caiac.transforms.goals import HindsightGoal, WindowGoal
from torchrl_caiac.transforms.keys import TransformKeys
from torchrl_caiac.transforms.real_transitions import real_transitions

__all__ = [
    "CAIACTransform",
    "CoDATransform",
    "HindsightGoal",
    "TransformKeys",
    "WindowGoal",
    "real_transitions",
]
