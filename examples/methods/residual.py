"""CAIAC with motion that an entity alone does not explain."""

from __future__ import annotations

from dataclasses import dataclass

from methods.base import Estimator, Scoring
from methods.motion import Motion
from torchrl_caiac.influence import ResidualInfluence

__all__ = ["Residual"]


@dataclass
class Residual(Motion):
    """Swaps what moves as it would alone.

    Args:
        far (float, optional): the distance of the robot from which on a row shows what
            an entity does alone. Defaults to ``None``: in all rows.
        steps (int): gradient steps. Defaults to 2000.
    """

    label = "CAIAC by residual"
    fits_itself = True
    score_key = ("residual", "score")
    far: float | None = None
    steps: int = 2000

    def estimator(self, scoring: Scoring) -> Estimator:
        """Returns the residual, after fitting it to the rows."""
        estimator = ResidualInfluence(
            scoring.environment.layout, self.tolerance, far=self.far
        )
        return estimator.fit(
            scoring.environment.rows(), steps=self.steps, progress=scoring.progress
        )
