"""Where the scores of one entity split into uninfluenced and influenced rows."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["DEFAULT_THRESHOLD", "MOVES", "RESTS", "Confidence", "Split", "split_scores"]

Confidence = Literal[
    "two clear modes",
    "one mode: never influenced",
    "one mode: always influenced",
    "unclear",
]
#: The threshold of :class:`~torchrl_caiac.CAIACTransform`, in nats for CAI.
DEFAULT_THRESHOLD = 0.05
#: The motion of a row's entity; any other number: neither clearly.
MOVES, RESTS = 1, 0

_FEWEST_ROWS = 100  # from which a distribution is judged
_FEWEST_MOVES = 30  # rows that move, or rest, from which motion is judged
_FEWEST_WITH_ZEROS = 5  # the same where zeros are a mode, which needs no estimate
# How well scores must tell moving rows from resting ones: area under the ROC curve, and
# the balanced accuracy of the best threshold.
_AREA = 0.95
_ACCURACY = 0.9
# Scores of 0 and 1 have their own threshold. Rows at rest may score 1, if the agent
# is near, so that they only have to find the motion, and to tell something.
_RECALL = 0.95
_LEAST_AREA = 0.6
# The split of the scores alone is kept where its balanced accuracy is this near the
# best one: rows at rest whose entity could have been moved count as errors here, so
# that the best threshold for motion is too high.
_SLACK = 0.02
# Without motion: what both modes need. Shares of the rows, the ratio of their medians,
# and the rows within half a decade around the split, as a share of the smaller mode.
_LEAST_SHARE = 0.01
_CONTRAST = 10.0
_BETWEEN = 0.1
# Scores below this share of the largest ones are equally small.
_SMALLEST = 1e-4
# Zeros are a mode of their own if the positive scores are not spread further.
_SPREAD = 1e-3


class Split(NamedTuple):
    """The split of the scores of one entity.

    Attributes:
        threshold (float): the best split, whether it is clear or not; NaN if all scores
            are equal, or none is above 0.
        confidence (str): how clear it is.
        reason (str): why.
        area (float): the probability that a row in which the entity moves scores above
            one in which it rests; NaN if unknown.
    """

    threshold: float
    confidence: Confidence
    reason: str
    area: float


def split_scores(
    scores: NDArray[np.float64],
    motion: NDArray[np.int8] | None = None,
    why_unknown: str = "its positions are unknown",
    *,
    doubt: str | None = None,
) -> Split:
    """Splits the scores of one entity.

    The start is Otsu's split of the logarithms of scores, the one with the largest
    variance between both sides; or half the smallest positive score, if some are zero.
    If motion is known, the threshold is moved as little as needed to separate moving
    rows from resting ones almost as well as the best threshold.

    Args:
        scores (numpy.ndarray): finite, ``[n]``. Scores up to 0 count as 0.
        motion (numpy.ndarray, optional): int8 ``[n]``, :data:`MOVES` where the entity
            moves in the recorded transition, :data:`RESTS` where it does not.
        why_unknown (str): the reason why ``motion`` is ``None``.

    Keyword Args:
        doubt (str, optional): why scores of 0 do not mean that the entity is never
            influenced, where ``motion`` is ``None``. Defaults to ``None``: they do.

    Returns:
        Split: the threshold, and how clear it is.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.influence.threshold_rule import split_scores
        >>> rng = np.random.default_rng(0)
        >>> low, high = rng.normal(-6, 0.5, 900), rng.normal(-1, 0.5, 100)
        >>> split = split_scores(np.exp(np.concatenate([low, high])))
        >>> split.confidence, round(split.threshold, 2)
        ('two clear modes', 0.03)
    """
    area = float("nan")
    threshold = _start(scores)
    if len(scores) < _FEWEST_ROWS:
        reason = f"only {len(scores)} rows have scores, at least {_FEWEST_ROWS} needed"
        return Split(threshold, "unclear", reason, area)
    equal = ""
    if np.isnan(threshold):
        equal = f"all scores are {scores[0]:.3g}"
        if scores.max() <= 0:
            equal = "no score is above 0"
    if motion is None:
        if not equal:
            return _by_scores(scores, threshold, why_unknown)
        if scores.max() > 0:
            return Split(threshold, "unclear", f"{equal}, and {why_unknown}", area)
        if doubt is not None:
            reason = f"{equal}, but {doubt}, and {why_unknown}"
            return Split(threshold, "unclear", reason, area)
        return Split(threshold, "one mode: never influenced", equal, area)
    moves, rests = scores[motion == MOVES], scores[motion == RESTS]
    counts = f"{len(moves)} of {len(scores)} rows"
    if not (motion != RESTS).any():
        reason = f"it never moves in {len(scores)} rows"
        # The agent may have been able to move it in the rows of an upper mode.
        alone = None if equal else _by_scores(scores, threshold, reason)
        if alone is not None and _is_binary(scores):
            reason = f"the scores are 0 or 1, whose own threshold is 0.5; {reason}"
            return Split(threshold, "two clear modes", reason, area)
        if alone is not None and alone.confidence == "two clear modes":
            reason = (
                f"{alone.reason}: whether the agent could move it in the upper mode is "
                "not known, so give its threshold"
            )
            return Split(threshold, "unclear", reason, area)
        return Split(threshold, "one mode: never influenced", reason, area)
    if equal:
        reason = f"{equal}, but it moves in {counts}"
        return Split(threshold, "unclear", reason, area)
    fewest = _FEWEST_WITH_ZEROS if _has_zero_mode(scores) else _FEWEST_MOVES
    if len(rests) < fewest:
        low, high = np.quantile(scores, [0.05, 0.95])
        if not (motion == RESTS).any() and low > 0 and high < _CONTRAST * low:
            reason = f"it moves in {counts}, and its scores differ little"
            return Split(threshold, "one mode: always influenced", reason, area)
        reason = f"it moves in {counts}, too few rest for a comparison"
        return Split(threshold, "unclear", reason, area)
    if len(moves) < fewest:
        reason = f"it moves in {counts} only, at least {fewest} rows are needed"
        return Split(threshold, "unclear", reason, area)
    return _by_motion(np.sort(moves), np.sort(rests), scores, threshold)


def _start(scores: NDArray[np.float64]) -> float:
    """Returns the split of the scores alone, NaN if there is nothing to split."""
    positive = scores[scores > 0]
    if not len(positive) or scores.min() == scores.max():
        return float("nan")
    least = float(positive.min())
    if _has_zero_mode(scores):
        return least / 2
    floor = max(least, _SMALLEST * float(np.quantile(scores, 0.999)))
    logs = np.log10(np.maximum(scores, floor))
    if logs.min() == logs.max():
        return least / 2
    return float(10.0 ** _otsu(logs))


def _has_zero_mode(scores: NDArray[np.float64]) -> bool:
    """Returns whether some scores are 0 and all others are far from it."""
    if scores.min() != 0 or scores.max() == 0:
        return False
    positive = scores[scores > 0]
    return bool(positive.min() >= _SPREAD * np.median(positive))


def _is_binary(scores: NDArray[np.float64]) -> bool:
    """Returns whether the scores are 0 and 1, as those of a rule."""
    return bool(
        scores.min() == 0 and scores.max() == 1 and np.isin(scores, (0, 1)).all()
    )


def _otsu(values: NDArray[np.float64]) -> float:
    """Returns Otsu's split, in the middle of the gap; the values differ."""
    values = np.sort(values)
    below = np.arange(1, len(values))
    above = len(values) - below
    sums = np.cumsum(values)
    distance = sums[:-1] / below - (sums[-1] - sums[:-1]) / above
    between = below * above * distance**2
    between[values[1:] == values[:-1]] = -1
    best = int(between.argmax())
    return float((values[best] + values[best + 1]) / 2)


def _by_motion(
    moves: NDArray[np.float64],
    rests: NDArray[np.float64],
    scores: NDArray[np.float64],
    start: float,
) -> Split:
    """Splits scores by sorted scores of moving and of resting rows."""
    levels = np.append(np.unique(np.quantile(scores, np.linspace(0, 1, 2001))), start)
    missed = np.searchsorted(moves, levels, "right") / len(moves)
    kept = np.searchsorted(rests, levels, "right") / len(rests)
    accuracy = (1 - missed + kept) / 2
    best = float(accuracy.max())
    good = np.flatnonzero(accuracy >= best - _SLACK)
    is_kept = len(levels) - 1 in good
    place = len(levels) - 1
    if not is_kept:
        # The nearest one by ratio; a level of 0 is the farthest.
        logs = np.log(np.maximum(levels[good], 1e-300))
        place = int(good[np.abs(logs - np.log(max(start, 1e-300))).argmin()])
    # Ties count half.
    wins = np.searchsorted(rests, moves, "left") + np.searchsorted(
        rests, moves, "right"
    )
    area = float(wins.mean() / 2 / len(rests))
    threshold = float(levels[place])
    text = (
        f"rows in which it moves ({len(moves)}) score above those in which it rests "
        f"({len(rests)}) with probability {area:.3f}"
    )
    found = float((moves > 0).mean())
    if _is_binary(scores) and found >= _RECALL and area >= _LEAST_AREA:
        reason = (
            f"the scores are 0 or 1, whose own threshold is 0.5; {text}, and "
            f"{100 * found:.1f} % of the rows in which it moves score 1"
        )
        return Split(start, "two clear modes", reason, area)
    if area < _AREA or best < _ACCURACY:
        reason = (
            f"{text}, at least {_AREA} needed: the estimator misses influence, or the "
            "entity moves by itself"
            if area < _AREA
            else f"{text}, but no threshold separates both"
        )
        return Split(threshold, "unclear", reason, area)
    how = "the scores' own split" if is_kept else "moved from the scores' own split"
    reason = (
        f"{text}; the threshold ({how}) separates both with balanced accuracy "
        f"{float(accuracy[place]):.3f}"
    )
    return Split(threshold, "two clear modes", reason, area)


def _times(ratio: float) -> str:
    return f"{ratio:.3g} times" if math.isfinite(ratio) else "far above"


def _by_scores(
    scores: NDArray[np.float64], threshold: float, why_unknown: str
) -> Split:
    """Judges the split of the scores alone."""
    if scores.min() < 0:
        reason = f"some scores are negative, and {why_unknown}"
        return Split(threshold, "unclear", reason, float("nan"))
    low, high = scores[scores <= threshold], scores[scores > threshold]
    share = min(len(low), len(high)) / len(scores)
    near = (scores > threshold / 10**0.25) & (scores <= threshold * 10**0.25)
    middle = float(np.median(low))
    contrast = float(np.median(high)) / middle if middle else float("inf")
    between = near.mean() / share
    modes = (
        f"the scores alone ({why_unknown}) have {100 * share:.3g} % of the rows in the "
        f"smaller mode, whose median is {_times(contrast)} that of the other, and "
        f"{100 * between:.3g} % as many rows between both modes"
    )
    is_clear = (
        share >= _LEAST_SHARE
        and share * len(scores) >= _FEWEST_MOVES
        and contrast >= _CONTRAST
        and between <= _BETWEEN
    )
    if is_clear:
        return Split(threshold, "two clear modes", modes, float("nan"))
    reason = f"{modes}: give the layout positions, to compare the scores with motion"
    return Split(threshold, "unclear", reason, float("nan"))
