"""CAIAC with motion in the recording instead of a model's scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from methods.base import Estimator, Scoring
from methods.caiac import CAIAC
from torchrl_caiac.influence import MotionInfluence

__all__ = ["Motion"]


@dataclass
class Motion(CAIAC):
    """Swaps what does not move.

    Args:
        tolerance (float): smaller changes of a position are no motion. Defaults to
            1e-3.
        threshold (float): between 0 and 1. Defaults to 0.5.
    """

    label = "CAIAC by motion"
    models = ()
    score_key = ("motion", "score")
    tolerance: float = 1e-3
    threshold: float = 0.5

    def scoring_options(self, scoring: Scoring) -> dict[str, Any]:
        """Returns options without smoothing."""
        return {**super().scoring_options(scoring), "smoothing": 1}

    def estimator(self, scoring: Scoring) -> Estimator:
        """Returns the motion of the positions."""
        return MotionInfluence(scoring.environment.layout, self.tolerance)
