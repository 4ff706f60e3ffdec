"""CAIAC with a rule of distance instead of scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from methods.base import Estimator, Scoring
from methods.caiac import CAIAC

__all__ = ["DistanceAction"]


@dataclass
class DistanceAction(CAIAC):
    """Swaps what is far from the robot.

    Args:
        threshold (float): between 0 and 1. Defaults to 0.5.
    """

    label = "CAIAC by distance"
    models = ()
    score_key = ("distance", "action")
    threshold: float = 0.5

    def scoring_options(self, scoring: Scoring) -> dict[str, Any]:
        """Returns options without smoothing."""
        return {**super().scoring_options(scoring), "smoothing": 1}

    def estimator(self, scoring: Scoring) -> Estimator:
        """Returns the rule for the action alone."""
        return scoring.environment.distance_rule(action_only=True)
