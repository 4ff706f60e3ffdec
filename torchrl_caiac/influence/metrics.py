"""How well influence scores agree with the ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
import torch

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["EntityReport", "best_threshold", "influence_report", "roc_auc"]


class EntityReport(TypedDict):
    """How well a score finds the influence on one entity.

    Attributes:
        auc (float): the area under the ROC curve, see :func:`roc_auc`.
        best_threshold (float): the threshold of :func:`best_threshold`.
        best_balanced_accuracy (float): the balanced accuracy at that threshold.
        true_positive_rate (float): the share of influenced states that score above θ;
            NaN where no state is influenced.
        false_positive_rate (float): the share of uninfluenced states that score above
            θ; NaN where every state is influenced.
        influenced (float): the share of influenced states.
        below_threshold (float): the share of states that score at most θ.
    """

    auc: float
    best_threshold: float
    best_balanced_accuracy: float
    true_positive_rate: float
    false_positive_rate: float
    influenced: float
    below_threshold: float


def roc_auc(score: ArrayLike | torch.Tensor, truth: ArrayLike | torch.Tensor) -> float:
    """Returns the area under the ROC curve of a score.

    Args:
        score (array_like or torch.Tensor): ``[S]``, finite; a higher score means more
            influence. Ties count half.
        truth (array_like or torch.Tensor): the ground truth, bool ``[S]``.

    Returns:
        float: the probability that an influenced state scores above an uninfluenced
        one; NaN if all states are influenced, or none is.

    Raises:
        ValueError: the inputs are empty, differ in shape or have another dtype, or a
            score is not finite.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.influence import roc_auc
        >>> roc_auc([0.1, 0.4, 0.35, 0.8], np.array([False, False, True, True]))
        0.75
    """
    values, mask = _checked(score, truth)
    positive, negative = values[mask], values[~mask]
    if not len(positive) or not len(negative):
        return float("nan")
    # Of each influenced state: the uninfluenced ones below it, and half of the equals.
    ordered = np.sort(negative)
    below = np.searchsorted(ordered, positive, "left").sum()
    wins = (below + np.searchsorted(ordered, positive, "right").sum()) / 2
    return float(wins / (len(positive) * len(negative)))


def best_threshold(
    score: ArrayLike | torch.Tensor, truth: ArrayLike | torch.Tensor
) -> tuple[float, float]:
    """Returns the threshold with the highest balanced accuracy.

    A state counts as influenced where its score is above the threshold. The balanced
    accuracy is the mean of the true positive rate and the true negative rate. Among
    equally good thresholds, the one in the middle of the widest gap between scores is
    returned.

    Args:
        score (array_like or torch.Tensor): ``[S]``, finite.
        truth (array_like or torch.Tensor): the ground truth, bool ``[S]``.

    Returns:
        tuple of float: the threshold and its balanced accuracy; ``(nan, nan)`` if all
        states are influenced, or none is.

    Raises:
        ValueError: the inputs are empty, differ in shape or have another dtype, or a
            score is not finite.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.influence import best_threshold
        >>> best_threshold([0.0, 0.1, 0.5, 0.6], np.array([False, False, True, True]))
        (0.3, 1.0)
    """
    values, mask = _checked(score, truth)
    positives = int(mask.sum())
    negatives = len(mask) - positives
    if not positives or not negatives:
        return float("nan"), float("nan")
    levels, inverse = np.unique(values, return_inverse=True)
    # A cut at level i: scores up to it count as uninfluenced. At the last level all do.
    false_negatives = np.cumsum(np.bincount(inverse, weights=mask))
    true_negatives = np.cumsum(np.bincount(inverse, weights=~mask))
    accuracy = ((1 - false_negatives / positives) + true_negatives / negatives) / 2
    gaps = np.append(np.diff(levels), 0.0)
    best = int(np.lexsort((gaps, accuracy))[-1])
    middle = (levels[best] + levels[min(best + 1, len(levels) - 1)]) / 2
    return float(middle), float(accuracy[best])


def influence_report(
    scores: ArrayLike | torch.Tensor,
    truth: ArrayLike | torch.Tensor,
    names: Sequence[str],
    threshold: float | Mapping[str, float],
) -> dict[str, EntityReport]:
    """Compares scores with the ground truth, entity by entity.

    Args:
        scores (array_like or torch.Tensor): ``[S, N]``, finite.
        truth (array_like or torch.Tensor): the ground truth of
            :func:`~torchrl_caiac.influence.true_influence`, bool ``[S, N]``.
        names (sequence of str): the ``N`` entities.
        threshold (float or mapping of str to float): θ. A score above it counts as
            influence. One number for all entities, or one for each; entities without
            one are left out of the report.

    Returns:
        dict of str to EntityReport: the report for each entity.

    Raises:
        ValueError: the shapes do not fit the names, ``truth`` is not bool, or a score
            is not finite.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.influence import influence_report
        >>> truth = np.array([[True, False], [False, False]])
        >>> report = influence_report(
        ...     [[0.9, 0.1], [0.0, 0.0]], truth, ["kettle", "microwave"], 0.3
        ... )
        >>> report["kettle"]["auc"], report["microwave"]["below_threshold"]
        (1.0, 1.0)
    """
    values, mask = _array(scores).astype(np.float64), _array(truth)
    shape = (len(values), len(names))
    if values.shape != shape or mask.shape != shape:
        raise ValueError(
            f"scores and truth have the shapes {values.shape} and {mask.shape}, "
            f"expected [S, {len(names)}] for the entities {tuple(names)}"
        )
    report: dict[str, EntityReport] = {}
    for i, name in enumerate(names):
        if isinstance(threshold, Mapping):
            if name not in threshold:
                continue
            theta = threshold[name]
        else:
            theta = threshold
        score, own = _checked(values[:, i], mask[:, i])
        above = score > theta
        best, accuracy = best_threshold(score, own)
        report[name] = EntityReport(
            auc=roc_auc(score, own),
            best_threshold=best,
            best_balanced_accuracy=accuracy,
            true_positive_rate=_share(above, own),
            false_positive_rate=_share(above, ~own),
            influenced=float(own.mean()),
            below_threshold=float(1 - above.mean()),
        )
    return report


def _array(values: Any) -> NDArray[Any]:
    is_tensor = isinstance(values, torch.Tensor)
    return np.asarray(values.detach().cpu() if is_tensor else values)


def _checked(score: Any, truth: Any) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    values, mask = _array(score).astype(np.float64), _array(truth)
    if values.ndim != 1 or mask.shape != values.shape:
        raise ValueError(
            f"score and truth have the shapes {values.shape} and {mask.shape}, "
            "expected the same shape [S]"
        )
    if mask.dtype != np.bool_:
        raise ValueError(f"truth has dtype {mask.dtype}, expected bool")
    if not len(values):
        raise ValueError("score is empty: give at least one state")
    bad = int((~np.isfinite(values)).sum())
    if bad:
        raise ValueError(
            f"score is NaN (not scored) or infinite in {bad} rows: score them with "
            "score_buffer, or drop them"
        )
    return values, mask


def _share(above: NDArray[np.bool_], among: NDArray[np.bool_]) -> float:
    return float(above[among].mean()) if among.any() else float("nan")
