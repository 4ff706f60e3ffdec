"""Suggested thresholds next to the best ones by the ground truth."""

from __future__ import annotations

import math
from typing import Any

import torch

from torchrl_caiac import EntityLayout
from torchrl_caiac.influence import (
    ThresholdSuggestions,
    best_threshold,
    influence_report,
)

__all__ = ["COLUMNS", "compare_thresholds"]

#: The columns of the table of :func:`compare_thresholds`.
COLUMNS = (
    "estimator",
    "entity",
    "confidence",
    "auc",
    "influenced",
    "suggested",
    "suggested_accuracy",
    "best",
    "best_accuracy",
    "loss",
    "free",
)


def compare_thresholds(
    found: ThresholdSuggestions,
    scores: torch.Tensor,
    truth: torch.Tensor,
    layout: EntityLayout,
    *,
    estimator: str,
) -> list[dict[str, Any]]:
    """Compares suggestions with the thresholds of the highest balanced accuracy.

    Args:
        found (ThresholdSuggestions): from scores of training data.
        scores (torch.Tensor): those of held-out states, ``[S, N]``.
        truth (torch.Tensor): what the action moves there, bool ``[S, N]``.
        layout (EntityLayout): the entities.

    Keyword Args:
        estimator (str): the name of the estimator.

    Returns:
        list of dict: one row for each entity that is not fixed, in the columns
        :data:`COLUMNS`. ``"suggested"`` is the split, also where it is unclear and so
        not used. ``"loss"`` is the difference of both balanced accuracies. Without both
        kinds of states there is no accuracy, and it is the share of states that the
        suggestion gets wrong, if it is not unclear.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from shared.thresholds import compare_thresholds
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence import suggest_thresholds
        >>> layout = EntityLayout({"cup": [0]})
        >>> score = torch.linspace(0.001, 0.002, 400).view(400, 1)
        >>> score[::4] *= 300
        >>> found = suggest_thresholds(TensorDict({"s": score}, [400]), layout,
        ...     score_key="s")
        >>> row, = compare_thresholds(found, score, score > 0.1, layout, estimator="x")
        >>> row["confidence"], row["best_accuracy"], row["loss"]
        ('two clear modes', 1.0, 0.0)
    """
    limits = {
        name: found.splits.get(name, threshold)
        if found.confidence[name] == "unclear"
        else threshold
        for name, threshold in found.thresholds.items()
    }
    report = influence_report(scores, truth, layout.names, limits)
    rows = []
    for name, threshold in limits.items():
        own = report[name]
        column = layout.index(name)
        best, best_accuracy = best_threshold(scores[:, column], truth[:, column])
        accuracy = (own["true_positive_rate"] + 1 - own["false_positive_rate"]) / 2
        loss = best_accuracy - accuracy
        if math.isnan(loss) and found.confidence[name] != "unclear":
            wrong = own["false_positive_rate"]
            if math.isnan(wrong):
                wrong = 1 - own["true_positive_rate"]
            loss = wrong
        rows.append(
            {
                "estimator": estimator,
                "entity": name,
                "confidence": found.confidence[name],
                "auc": own["auc"],
                "influenced": own["influenced"],
                "suggested": threshold,
                "suggested_accuracy": accuracy,
                "best": best,
                "best_accuracy": best_accuracy,
                "loss": loss,
                "free": found.free[name],
            }
        )
    return rows
