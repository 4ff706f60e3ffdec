"""CoDA: swaps what no other entity influences, by a transformer's attention."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchrl.envs import Transform

from methods.base import Estimator, Method, Scoring
from torchrl_caiac import CoDATransform, EntityLayout
from torchrl_caiac.influence import AttentionInfluence

__all__ = ["CoDA"]


@dataclass
class CoDA(Method):
    """CoDA with the attention of a transformer world model as the graph.

    Args:
        threshold (float): entities are linked where the attention is above this.
    """

    label = "CoDA"
    models = ("transformer",)
    score_key = ("coda", "graph")
    threshold: float

    def estimator(self, scoring: Scoring) -> Estimator:
        """Returns the attention between all entities, and from the action."""
        return AttentionInfluence(scoring.model("transformer"))

    def transform(
        self, layout: EntityLayout, counterfactual_ratio: float = 0.5, **options: Any
    ) -> Transform | None:
        """Returns the transform."""
        return CoDATransform(
            layout,
            self.threshold,
            counterfactual_ratio,
            graph_key=self.score_key,
            rows="last",  # as CAIAC
            **options,
        )
