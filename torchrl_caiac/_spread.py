"""Rows that are spread evenly over all."""

from __future__ import annotations

import torch

__all__ = ["spread_rows"]


def spread_rows(length: int, most: int) -> torch.Tensor:
    """Returns rows that are spread evenly, from the first to the last one.

    Args:
        length (int): the number of rows.
        most (int): how many to return, or all if there are fewer.

    Returns:
        torch.Tensor: int64 ``[min(length, most)]``, ascending.

    Examples:
        >>> from torchrl_caiac._spread import spread_rows
        >>> spread_rows(11, 3)
        tensor([ 0,  5, 10])
    """
    # float32 does not hold the numbers of rows from 16.7 million on
    count = min(length, most)
    return torch.linspace(0, length - 1, count, dtype=torch.float64).long()
