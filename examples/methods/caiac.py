"""CAIAC: swaps what the action does not influence, by CAI's scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchrl.envs import Transform

from methods.base import Estimator, Method, Scoring
from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.influence import CAI

__all__ = ["CAIAC"]


@dataclass
class CAIAC(Method):
    """CAIAC with a learned world model.

    Args:
        threshold (float): an entity is swapped where its score is at most this.
    """

    label = "with counterfactuals (CAIAC)"
    models = ("world_model",)
    score_key = ("caiac", "score")
    threshold: float

    def estimator(self, scoring: Scoring) -> Estimator:
        """Returns CAI of the Gaussian world model."""
        model = scoring.model("world_model")
        return CAI(
            model,
            num_actions=scoring.settings.num_actions,
            action_spec=scoring.environment.action_spec,
        )

    def transform(
        self, layout: EntityLayout, counterfactual_ratio: float = 0.5, **options: Any
    ) -> Transform | None:
        """Returns the transform."""
        return CAIACTransform(
            layout,
            self.threshold,
            counterfactual_ratio,
            score_key=self.score_key,
            # Batches are in random order: the last rows are as good as others, and the
            # draws are those of the published runs.
            rows="last",
            **options,
        )
