"""How columns of states move, with the action and with each other."""

from __future__ import annotations

import torch

__all__ = [
    "EXPLAINED_BY_ACTION",
    "explained_shares",
    "motion_correlations",
    "moving_columns",
    "position_columns",
]

#: The share of a robot's motion that the action explains, at least.
EXPLAINED_BY_ACTION = 0.6
_VELOCITY = 0.9  # correlation of a position's change with its velocity
_MOVES = 1e-3  # of a column's range: a change above it counts as motion
_JITTER = 5e-3  # of the median range: a column with a smaller one does not move


def moving_columns(now: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    """Returns where columns change by more than a thousandth of their range.

    Args:
        now (torch.Tensor): the columns, ``[T, D]``.
        change (torch.Tensor): their changes, finite ``[T, D]``.

    Returns:
        torch.Tensor: bool ``[T, D]``. A column whose range is far smaller than that of
        the others does not move.
    """
    known = now.isfinite()
    low = torch.where(known, now, torch.inf).amin(0)
    high = torch.where(known, now, -torch.inf).amax(0)
    span = torch.nan_to_num(high - low, 0.0, 0.0, 0.0)
    positive = span[span > 0]
    # What is far smaller than everything else is jitter, not motion.
    usual = positive.median() if len(positive) else span.new_zeros(())
    return (change.abs() > _MOVES * span) & (span > _JITTER * usual)


def explained_shares(change: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Returns the share of each change's variance that the action explains, ``[D]``."""
    action = torch.nan_to_num(action - action.mean(0), 0.0, 0.0, 0.0)
    change = change - change.mean(0)
    total = change.square().sum(0)
    cause = torch.linalg.pinv(action) @ change
    rest = (change - action @ cause).square().sum(0)
    return torch.where(total > 0, 1 - rest / total.clamp(min=1e-300), 0.0).clamp(0, 1)


def motion_correlations(moving: torch.Tensor) -> torch.Tensor:
    """Returns the correlations of "moves now" between columns, ``[D, D]``."""
    x = moving.double()
    x = x - x.mean(0)
    scale = x.norm(dim=0)
    product = x.T @ x
    return product / (scale.unsqueeze(0) * scale.unsqueeze(1)).clamp(min=1e-12)


def position_columns(now: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    """Returns which columns are positions, by their velocities.

    A velocity is a column, before or after a transition, that has a correlation above
    0.9 with the change of another column, the position. What is itself the velocity of
    a column, and has an acceleration, is no position.

    Args:
        now (torch.Tensor): the columns, float64 ``[T, D]``.
        change (torch.Tensor): their changes, ``[T, D]``.

    Returns:
        torch.Tensor: whether column ``j`` is the velocity of the position ``i``, bool
        ``[D, D]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac._column_motion import position_columns
        >>> speed = torch.tensor([1.0, -2.0, 0.5, 3.0, 0.0]).double()
        >>> place = 0.1 * speed.cumsum(0)
        >>> states = torch.stack([place[:-1], speed[:-1]], -1)
        >>> change = torch.stack([place.diff(), speed.diff()], -1)
        >>> position_columns(states, change).tolist()
        [[False, True], [False, False]]
    """
    now = torch.nan_to_num(now, 0.0, 0.0, 0.0)
    moved = _normalised(change)
    found = torch.maximum(
        moved.T @ _normalised(now), moved.T @ _normalised(now + change)
    )
    is_velocity_of = found > _VELOCITY
    is_velocity_of.fill_diagonal_(False)
    return is_velocity_of & ~is_velocity_of.any(0).unsqueeze(1)


def _normalised(x: torch.Tensor) -> torch.Tensor:
    x = x - x.mean(0)
    norm = x.norm(dim=0)
    return torch.where(norm > 0, x / norm.clamp(min=1e-300), 0.0)
