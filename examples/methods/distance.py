"""CoDA with entities that are close to each other as the graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from methods.base import Estimator, Scoring
from methods.coda import CoDA

__all__ = ["Distance"]


@dataclass
class Distance(CoDA):
    """Links entities that are close, and the action with what is close to the robot.

    Args:
        threshold (float): between 0 and 1. Defaults to 0.5.
    """

    label = "CoDA by distance"
    models = ()
    score_key = ("distance", "graph")
    threshold: float = 0.5

    def scoring_options(self, scoring: Scoring) -> dict[str, Any]:
        """Returns options without smoothing."""
        return {**super().scoring_options(scoring), "smoothing": 1}

    def estimator(self, scoring: Scoring) -> Estimator:
        """Returns the rule between all entities."""
        return scoring.environment.distance_rule(action_only=False)
