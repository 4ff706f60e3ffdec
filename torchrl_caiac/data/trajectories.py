"""Where trajectories end in a replay buffer's storage."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer

from torchrl_caiac._torchrl import last_written

__all__ = ["TrajectoryEnds", "newest_row"]


def newest_row(rb: ReplayBuffer) -> int | None:
    """The row that was written last.

    Args:
        rb (ReplayBuffer): the buffer.

    Returns:
        int or None: the row, ``None`` when neither the storage nor the writer knows it
        (a buffer over a finished dataset).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac.data.trajectories import newest_row
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(4))
        >>> _ = rb.extend(TensorDict({"a": torch.zeros(6)}, [6])[:3])
        >>> newest_row(rb)
        2
    """
    return last_written(rb)


class TrajectoryEnds:
    """Tells which rows of a storage are the last stored ones of their trajectories.

    Rows of a trajectory lie one after another. A row is the last one where the
    trajectory's id changes behind it, where it is done, where it was written last (what
    follows in a full ring is the oldest row), and at the end of the rows; only a full
    ring goes on from its last row to its first.

    Args:
        data (TensorDictBase): the storage's rows, ``[capacity]``.
        length (int): how many of them are filled, ``T``.

    Keyword Args:
        newest (int, optional): the row written last, see :func:`newest_row`.
        trajectory_key (NestedKey, optional): the trajectory ids, ``[capacity]`` or
            ``[capacity, 1]``. ``None``: told by ``done_key`` alone.
        done_key (NestedKey, optional): the done flags, bool ``[capacity, 1]``.
            ``None``: told by ``trajectory_key`` alone.

    Raises:
        KeyError: a key is missing.
        ValueError: both keys are ``None``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.trajectories import TrajectoryEnds
        >>> td = TensorDict({"episode": torch.tensor([0, 0, 1, 1, 1])}, [5])
        >>> ends = TrajectoryEnds(td, 5, done_key=None)
        >>> ends(torch.arange(5))
        tensor([False,  True, False, False,  True])
    """

    def __init__(
        self,
        data: TensorDictBase,
        length: int,
        *,
        newest: int | None = None,
        trajectory_key: NestedKey | None = "episode",
        done_key: NestedKey | None = ("next", "done"),
    ) -> None:
        if trajectory_key is None and done_key is None:
            raise ValueError(
                "trajectory_key and done_key are both None: one of them must tell "
                "where trajectories end"
            )
        self.length = length
        self.newest = newest if newest is not None and newest < length else None
        self._ids = self._leaf(data, trajectory_key, "trajectory_key", "done_key")
        self._done = self._leaf(data, done_key, "done_key", "trajectory_key")
        self._ring = (
            length == data.shape[0]
            and self.newest is not None
            and self.newest != length - 1
        )
        self.wraps: bool = self._ring and not bool(self(torch.tensor([length - 1])))

    @staticmethod
    def _leaf(
        data: TensorDictBase, key: NestedKey | None, argument: str, other: str
    ) -> torch.Tensor | None:
        if key is None:
            return None
        leaf = data.get(key, None)
        if not isinstance(leaf, torch.Tensor):
            found = sorted(map(str, data.keys(include_nested=True, leaves_only=True)))
            raise KeyError(
                f"the storage has no tensor {key!r} to tell trajectories apart; it has "
                f"{found}: give {argument}=, or {argument}=None to rely on {other} "
                "alone"
            )
        return leaf

    def __call__(self, rows: torch.Tensor) -> torch.Tensor:
        """Which of some rows are the last ones of their trajectories.

        Args:
            rows (torch.Tensor): int64 ``[n]``, on the CPU, each below ``length``.

        Returns:
            torch.Tensor: bool ``[n]``, on the CPU.
        """
        last = torch.zeros(len(rows), dtype=torch.bool)
        if not self._ring:
            last |= rows == self.length - 1
        if self.newest is not None:
            last |= rows == self.newest
        if self._ids is not None:
            here, after = (
                self._ids[r.to(self._ids.device)].reshape(len(rows), -1)
                for r in (rows, (rows + 1) % self.length)
            )
            last |= (here != after).any(-1).cpu()
        if self._done is not None:
            done = self._done[rows.to(self._done.device)].reshape(len(rows), -1)
            last |= done.bool().any(-1).cpu()
        return last
