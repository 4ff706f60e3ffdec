"""CoDA-action: CAIAC with the attention paid to the action as scores."""

from __future__ import annotations

from dataclasses import dataclass

from methods.base import Estimator, Scoring
from methods.caiac import CAIAC
from torchrl_caiac.influence import AttentionInfluence

__all__ = ["CoDAAction"]


@dataclass
class CoDAAction(CAIAC):
    """Swaps what the action does not influence, by a transformer's attention."""

    label = "CoDA-action"
    models = ("transformer",)
    score_key = ("coda", "action")

    def estimator(self, scoring: Scoring) -> Estimator:
        """Returns the attention that entities pay to the action."""
        return AttentionInfluence(scoring.model("transformer"), action_only=True)
