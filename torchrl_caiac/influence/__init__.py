"""Which entities an action can influence: estimators, and their cached scores."""

from __future__ import annotations

from torchrl_caiac.influence.attention import AttentionInfluence
from torchrl_caiac.influence.cai import CAI, causal_action_influence
from torchrl_caiac.influence.comparison import (
    Candidate,
    compare_influence,
    paper_candidates,
    publish_comparison,
    swap_shares,
)
from torchrl_caiac.influence.distance import DistanceInfluence
from torchrl_caiac.influence.score_buffer import MarkUnscored, score_buffer
from torchrl_caiac.influence.truth import (
    SimulatorInfluence,
    TrueInfluence,
    best_threshold,
    influence_report,
    oracle_score,
    roc_auc,
    true_influence,
)

__all__ = [
    "CAI",
    "AttentionInfluence",
    "Candidate",
    "DistanceInfluence",
    "MarkUnscored",
    "SimulatorInfluence",
    "TrueInfluence",
    "best_threshold",
    "causal_action_influence",
    "compare_influence",
    "influence_report",
    "oracle_score",
    "paper_candidates",
    "publish_comparison",
    "roc_auc",
    "score_buffer",
    "swap_shares",
    "true_influence",
]
