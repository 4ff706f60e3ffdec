"""Warns of scores with which an entity is swapped in all rows, or in none."""

from __future__ import annotations

import warnings

import torch

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.threshold_rule import DEFAULT_THRESHOLD

__all__ = ["UNKNOWN", "score_limits", "warn_of_one_side"]

#: Scores from here on are those of rows whose next states are not stored.
UNKNOWN = 1e29
_CHUNK = 1 << 20
_FEWEST_ROWS = 100


def score_limits(scores: torch.Tensor) -> tuple[list[float], list[float], int]:
    """Returns the lowest and the highest score of each entity.

    Args:
        scores (torch.Tensor): ``[T, N]``, NaN where a row is not scored; scores of rows
            whose next states are not stored do not count.

    Returns:
        tuple: the lowest scores, the highest ones (infinite without any), and the
        number of scored rows.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence.score_spread import score_limits
        >>> score_limits(torch.tensor([[1.0], [3.0], [float("nan")], [1e30]]))
        ([1.0], [3.0], 2)
    """
    low = torch.full(scores.shape[1:], torch.inf, device=scores.device)
    high = -low
    rows = torch.zeros((), dtype=torch.int64, device=scores.device)
    for part in scores.split(_CHUNK):
        unknown = part.isnan() | (part >= UNKNOWN)
        low = torch.minimum(low, part.masked_fill(unknown, torch.inf).amin(0))
        high = torch.maximum(high, part.masked_fill(unknown, -torch.inf).amax(0))
        rows += (~unknown).all(-1).sum()
    return low.tolist(), high.tolist(), int(rows)


def warn_of_one_side(scores: torch.Tensor, layout: EntityLayout) -> None:
    """Warns of entities whose scores lie all on one side of the default threshold.

    Args:
        scores (torch.Tensor): ``[T, N]``.
        layout (EntityLayout): the entities; fixed ones are not looked at.

    Examples:
        >>> import torch, warnings
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence.score_spread import warn_of_one_side
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     warn_of_one_side(torch.full((200, 1), 0.3), EntityLayout({"cup": [0]}))
        >>> print(caught[0].message)
        with the default threshold 0.05, nothing of 'cup' (all scores are 0.3) would be
        swapped. Choose thresholds with suggest_thresholds(rb, layout), or pass
        CAIACTransform(layout, threshold="auto")
    """
    low, high, rows = score_limits(scores)
    if rows < _FEWEST_ROWS:
        return
    nothing, everything = [], []
    for place, name in enumerate(layout.names):
        if name in layout.fixed:
            continue
        least, most = low[place], high[place]
        spread = (
            f"all scores are {least:.3g}"
            if least == most
            else f"its scores are {least:.3g} to {most:.3g}"
        )
        if least > DEFAULT_THRESHOLD:
            nothing.append(f"{name!r} ({spread})")
        elif most <= DEFAULT_THRESHOLD:
            everything.append(f"{name!r} ({spread})")
    found = []
    if nothing:
        found.append(f"nothing of {', '.join(nothing)} would be swapped")
    if everything:
        found.append(
            f"{', '.join(everything)} would be swapped in every row, which is right "
            "only if the agent never has an influence there"
        )
    if found:
        warnings.warn(
            f"with the default threshold {DEFAULT_THRESHOLD}, {'; '.join(found)}. "
            "Choose thresholds with suggest_thresholds(rb, layout), or pass "
            'CAIACTransform(layout, threshold="auto")',
            stacklevel=4,
        )
