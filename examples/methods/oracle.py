"""CAIAC with the ground truth of the simulator as scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from methods.base import Estimator, Scoring
from methods.caiac import CAIAC

__all__ = ["Oracle"]


@dataclass
class Oracle(CAIAC):
    """Scores of 1 where the action can move an entity, else 0.

    Args:
        num_actions (int): the number of actions simulated in each state.
        every (int): the simulator is queried in every ``every``-th row of a trajectory.
            Defaults to 1.
        batch_size (int): rows between two saves. Defaults to 10,000.
        threshold (float): between 0 and 1. Defaults to 0.5.
    """

    label = "with counterfactuals (ground truth)"
    models = ()
    env_settings = ("truth",)
    score_key = ("oracle", "score")
    threshold: float = 0.5
    num_actions: int = 16
    every: int = 1
    batch_size: int = 10_000

    def estimator(self, scoring: Scoring) -> Estimator:
        """Returns the simulator."""
        return scoring.environment.simulator(self.num_actions)

    def scoring_options(self, scoring: Scoring) -> dict[str, Any]:
        """Returns options without smoothing, for some rows only."""
        return {
            "batch_size": self.batch_size,
            "lookahead": 0,
            "every": self.every,
        }
