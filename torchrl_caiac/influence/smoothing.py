"""Means, maxima and gaps of scores along trajectories."""

from __future__ import annotations

import torch

__all__ = ["fill_between", "max_ahead", "smooth"]


def smooth(
    scores: torch.Tensor, trajectory: torch.Tensor, past: int, future: int
) -> torch.Tensor:
    """Returns the mean over a window of states of the same trajectory.

    Args:
        scores (torch.Tensor): ``[S, ...]``, in the order of time.
        trajectory (torch.Tensor): the trajectory of each state, integer ``[S]``.
        past (int): the number of earlier states in the window.
        future (int): the number of later states in the window.

    Returns:
        torch.Tensor: float32 ``[S, ...]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence.smoothing import smooth
        >>> smooth(torch.tensor([0.0, 2.0, 9.0]), torch.tensor([0, 0, 1]), 1, 1)
        tensor([1., 1., 9.])
    """
    if not past and not future:
        return scores
    total = torch.zeros(scores.shape, dtype=torch.float64)
    count = torch.zeros(len(scores), dtype=torch.float64)
    for offset in range(-past, future + 1):
        here, there = _shifted(len(scores), offset)
        same = trajectory[here] == trajectory[there]
        total[here] += _rowwise(same, scores) * scores[there]
        count[here] += same
    return (total / _rowwise(count, scores)).float()


def max_ahead(
    scores: torch.Tensor, trajectory: torch.Tensor, lookahead: int
) -> torch.Tensor:
    """Returns the maximum over each state and later ones of the same trajectory.

    Args:
        scores (torch.Tensor): ``[S, ...]``, in the order of time.
        trajectory (torch.Tensor): the trajectory of each state, integer ``[S]``.
        lookahead (int): the number of later states to include.

    Returns:
        torch.Tensor: ``[S, ...]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence.smoothing import max_ahead
        >>> max_ahead(torch.tensor([0.0, 2.0, 9.0]), torch.tensor([0, 0, 1]), 1)
        tensor([2., 2., 9.])
    """
    best = scores.clone()
    for offset in range(1, lookahead + 1):
        here, there = _shifted(len(scores), offset)
        same = _rowwise(trajectory[here] == trajectory[there], scores)
        best[here] = torch.where(
            same, torch.maximum(best[here], scores[there]), best[here]
        )
    return best


def fill_between(
    scores: torch.Tensor, trajectory: torch.Tensor, scored: torch.Tensor
) -> torch.Tensor:
    """Fills states that were not scored from the scored states around them.

    Args:
        scores (torch.Tensor): ``[S, ...]``, in the order of time.
        trajectory (torch.Tensor): the trajectory of each state, integer ``[S]``.
        scored (torch.Tensor): which states were scored, bool ``[S]``.

    Returns:
        torch.Tensor: ``[S, ...]``; a state that was not scored has the larger score of
        the scored states before and after it in its trajectory, or the score of the
        only one.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence.smoothing import fill_between
        >>> scores = torch.tensor([1.0, torch.nan, 3.0, torch.nan])
        >>> fill_between(scores, torch.zeros(4), ~scores.isnan())
        tensor([1., 3., 3., 3.])
    """
    size = len(scores)
    place = torch.arange(size)
    before = place.where(scored, -1).cummax(0).values
    after = place.where(scored, size).flip(0).cummin(0).values.flip(0)
    has_before = before >= 0
    before = before.clamp(min=0)
    has_before &= trajectory[before] == trajectory
    has_after = after < size
    after = after.clamp(max=size - 1)
    has_after &= trajectory[after] == trajectory
    first, second = before.where(has_before, after), after.where(has_after, before)
    return torch.maximum(scores[first], scores[second])


def _shifted(size: int, offset: int) -> tuple[slice, slice]:
    """Slices that pair each element with the one ``offset`` later."""
    here = slice(min(size, max(0, -offset)), max(0, size - max(0, offset)))
    there = slice(min(size, max(0, offset)), max(0, size - max(0, -offset)))
    return here, there


def _rowwise(values: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return values.reshape(-1, *[1] * (like.ndim - 1))
