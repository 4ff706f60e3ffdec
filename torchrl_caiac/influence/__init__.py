"""Estimators of influence, the scores in a buffer, and the ground truth."""

from __future__ import annotations

from torchrl_caiac.influence.action_coverage import ActionCoverage, action_coverage
from torchrl_caiac.influence.attention import AttentionInfluence
from torchrl_caiac.influence.cai import CAI
from torchrl_caiac.influence.default_world_model import (
    default_world_model,
)
from torchrl_caiac.influence.distance import DistanceInfluence
from torchrl_caiac.influence.metrics import (
    EntityReport,
    best_threshold,
    influence_report,
    roc_auc,
)
from torchrl_caiac.influence.mixture_divergence import causal_action_influence
from torchrl_caiac.influence.motion import MotionInfluence
from torchrl_caiac.influence.residual import ResidualInfluence
from torchrl_caiac.influence.score_buffer import score_buffer
from torchrl_caiac.influence.score_buffer_ray import score_buffer_ray
from torchrl_caiac.influence.score_on_write import ScoreOnWrite
from torchrl_caiac.influence.score_record import score_file
from torchrl_caiac.influence.shards import ScoringProgress, scoring_progress
from torchrl_caiac.influence.thresholds import (
    ThresholdSuggestions,
    suggest_thresholds,
)
from torchrl_caiac.influence.truth import (
    SimulatorInfluence,
    TrueInfluence,
    oracle_score,
    true_influence,
)

__all__ = [
    "CAI",
    "ActionCoverage",
    "AttentionInfluence",
    "DistanceInfluence",
    "EntityReport",
    "MotionInfluence",
    "ResidualInfluence",
    "ScoreOnWrite",
    "ScoringProgress",
    "SimulatorInfluence",
    "ThresholdSuggestions",
    "TrueInfluence",
    "action_coverage",
    "best_threshold",
    "causal_action_influence",
    "default_world_model",
    "influence_report",
    "oracle_score",
    "roc_auc",
    "score_buffer",
    "score_buffer_ray",
    "score_file",
    "scoring_progress",
    "suggest_thresholds",
    "true_influence",
]
