"""Where entities are in a row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch

__all__ = ["Runs"]


class Runs(NamedTuple):
    """Where the entities are in a row of a leaf.

    Attributes:
        entity (torch.Tensor): the entity of each run of bytes, int64 ``[R]``.
        start (torch.Tensor): its first byte in the row, int64 ``[R]``.
        length (torch.Tensor): its bytes, int64 ``[R]``.
        owners (tuple of int): the entity of each column, -1 for nobody; empty if runs
            are those of some columns.
    """

    entity: torch.Tensor
    start: torch.Tensor
    length: torch.Tensor
    owners: tuple[int, ...]

    @classmethod
    def of(cls, owners: Sequence[int], itemsize: int) -> Runs:
        """Returns the runs of columns with these owners; -1 is nobody.

        Examples:
            >>> from torchrl_caiac._sampling import Runs
            >>> Runs.of([0, 0, -1, 1], itemsize=4).start
            tensor([ 0, 12])
        """
        pairs = [(owner, c) for c, owner in enumerate(owners) if owner >= 0]
        return cls.of_columns(pairs, itemsize)._replace(owners=tuple(owners))

    @classmethod
    def of_columns(cls, pairs: Sequence[tuple[int, int]], itemsize: int) -> Runs:
        """Returns the runs of pairs of an entity and one of its columns."""
        runs: list[list[int]] = []
        for owner, column in pairs:
            if runs and runs[-1][0] == owner and sum(runs[-1][1:]) == column * itemsize:
                runs[-1][2] += itemsize
            else:
                runs.append([owner, column * itemsize, itemsize])
        table = torch.tensor(runs, dtype=torch.int64, device="cpu").reshape(-1, 3)
        entity, start, length = table.t().contiguous().unbind()
        return cls(entity, start, length, ())
