"""The transitions that a check reads: whole pieces of trajectories, in time order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac.trajectories import TrajectoryIndex

__all__ = ["Sample", "take_sample"]

_CHUNK = 16_384  # rows that are read at once
_PIECE = 1000  # rows of a trajectory that are kept together


@dataclass(frozen=True)
class Sample:
    """Rows of a dataset, of which those of a piece follow each other in time.

    Args:
        data (TensorDictBase): all transitions, ``[T]``.
        rows (torch.Tensor): the rows of the sample, int64 ``[n]``.
        piece (torch.Tensor): the number of the piece of each, int64 ``[n]``, ascending.
        place (torch.Tensor): its place in the piece, int64 ``[n]``.
        last (torch.Tensor): whether it is the last of its trajectory, bool ``[n]``.
    """

    data: TensorDictBase
    rows: torch.Tensor
    piece: torch.Tensor
    place: torch.Tensor
    last: torch.Tensor

    def __len__(self) -> int:
        return len(self.rows)

    def keep(self, mask: torch.Tensor) -> Sample:
        """Returns the sample without the rows where ``mask`` ``[n]`` is false."""
        if bool(mask.all()):
            return self
        return replace(
            self,
            rows=self.rows[mask],
            piece=self.piece[mask],
            place=self.place[mask],
            last=self.last[mask],
        )

    def at(self, rows: torch.Tensor) -> Sample:
        """Returns other rows ``[m]`` of the same data, each a piece of its own."""
        none = torch.zeros(len(rows), dtype=torch.bool)
        return Sample(
            self.data, rows, torch.arange(len(rows)), torch.zeros_like(rows), none
        )

    def raw(self, key: NestedKey) -> torch.Tensor:
        """Returns an entry of the rows as it is stored, ``[n, ...]`` on the CPU."""
        leaf = self.data.get(key).as_subclass(torch.Tensor)
        return leaf[self.rows.to(leaf.device)].cpu()

    def read(
        self, key: NestedKey, columns: Sequence[int] | None = None
    ) -> torch.Tensor:
        """Returns an entry of the rows as floating-point numbers, ``[n, W]``.

        Integers and booleans become float64, smaller floating-point types float32.
        """
        leaf = self.data.get(key).as_subclass(torch.Tensor)
        wide = leaf.dtype == torch.float64 or not leaf.is_floating_point()
        width = leaf[:1].numel() if columns is None else len(columns)
        dtype = torch.float64 if wide else torch.float32
        values = torch.empty(len(self), width, dtype=dtype)
        for start in range(0, len(self), _CHUNK):  # no second copy of a large entry
            rows = self.rows[start : start + _CHUNK]
            part = leaf[rows.to(leaf.device)].reshape(len(rows), -1)
            values[start : start + _CHUNK] = (
                part if columns is None else part[:, columns]
            )
        return values

    def following(self, steps: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns pairs of a row and the row ``steps`` later in the same piece.

        Args:
            steps (torch.Tensor): the number of steps of each row, int64 ``[n]``.

        Returns:
            tuple of torch.Tensor: positions in the sample, int64 ``[p]`` each.
        """
        here = torch.arange(len(self))
        there = here + steps
        inside = (steps > 0) & (there < len(self))
        here, there = here[inside], there[inside]
        same = (self.piece[there] == self.piece[here]) & (
            self.place[there] - self.place[here] == there - here
        )
        return here[same], there[same]


def take_sample(
    data: TensorDictBase, index: TrajectoryIndex | None, max_rows: int
) -> Sample:
    """Chooses whole trajectories, or pieces of them, evenly.

    Args:
        data (TensorDictBase): all transitions, ``[T]``.
        index (TrajectoryIndex, optional): the trajectories; ``None`` if they are not
            known. Each row is then a piece of its own.
        max_rows (int): the largest number of rows.

    Returns:
        Sample: the rows, the same in every call.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.check.sample import take_sample
        >>> from torchrl_caiac.trajectories import trajectory_index
        >>> td = TensorDict({"episode": torch.arange(12) // 3}, [12])
        >>> take_sample(td, trajectory_index(td), 6).rows
        tensor([0, 1, 2, 6, 7, 8])
    """
    if index is None:
        count = min(len(data), max_rows)
        rows = (torch.arange(count) * len(data)) // max(count, 1)
        none = torch.zeros(0, dtype=torch.long)
        return Sample(data, none, none, none, none.bool()).at(rows)
    starts, lengths = index.starts.cpu(), index.lengths.cpu()
    cap = int(lengths.max())
    if index.length > max_rows:
        cap = min(_PIECE, max(2, max_rows // 2))
    pieces = -(-lengths // cap)  # of each trajectory
    total = int(pieces.sum())
    count = total
    while True:
        chosen = (torch.arange(count) * total) // count
        trajectory = torch.searchsorted(pieces.cumsum(0), chosen, right=True)
        begin = (chosen - (pieces.cumsum(0) - pieces)[trajectory]) * cap
        size = (lengths[trajectory] - begin).clamp_max(cap)
        excess = int(size.sum()) - max_rows
        if excess <= 0 or count == 1:
            break
        count = max(1, min(count - 1, int(count * max_rows / int(size.sum()))))
    piece = torch.arange(count).repeat_interleave(size)
    place = torch.arange(len(piece)) - (size.cumsum(0) - size)[piece]
    first = starts[trajectory][piece].to(index.device)
    rows = index.later(first, (begin[piece] + place).to(index.device))
    return Sample(data, rows.cpu(), piece, place, index.is_last(rows).cpu())
