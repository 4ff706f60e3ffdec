"""The index of the trajectories in a storage: which transition follows which."""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac._keys import missing_key
from torchrl_caiac._torchrl import last_written, storage_data, storage_revision

__all__ = ["TrajectoryCache", "TrajectoryIndex", "trajectory_index"]

# The key of the trajectory ids of TorchRL's collectors.
_COLLECTOR_KEY: NestedKey = ("collector", "traj_ids")
_CHUNK = 1 << 20


class TrajectoryIndex(NamedTuple):
    """The trajectories of a storage, in the order of time.

    The row ``r`` has the position ``(r - oldest) % length``. Positions count from the
    oldest row, so that no trajectory wraps around. The index takes 4 bytes for each
    row.

    Attributes:
        length (int): the number of rows in the storage, ``T``.
        oldest (int): the oldest row: in a full ring, the one after the newest.
        ends (torch.Tensor): int64 ``[E]``, the positions of the last row of each
            trajectory, ascending.
        left (torch.Tensor): integer ``[T]``, the number of rows of the same trajectory
            after each row.
    """

    length: int
    oldest: int
    ends: torch.Tensor
    left: torch.Tensor

    @property
    def device(self) -> torch.device:
        """The device of the index."""
        return self.ends.device

    @property
    def lengths(self) -> torch.Tensor:
        """The number of rows of each trajectory, int64 ``[E]``."""
        return self.ends.diff(prepend=self.ends.new_tensor([-1]))

    @property
    def starts(self) -> torch.Tensor:
        """The first row of each trajectory, int64 ``[E]``."""
        return self.rows(self.ends - self.lengths + 1)

    @property
    def wraps(self) -> bool:
        """Whether a trajectory continues from the last row to the first."""
        return self.oldest > 0 and bool(self.left[self.length - 1] > 0)

    def position(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns the positions of rows ``[*]``, int64 ``[*]``."""
        return (rows - self.oldest) % self.length

    def rows(self, position: torch.Tensor) -> torch.Tensor:
        """Returns the rows at positions ``[*]``, int64 ``[*]``."""
        return (position + self.oldest) % self.length

    def remaining(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns the number of later rows in each row's trajectory, int64 ``[*]``."""
        found = self.left.index_select(0, rows.to(self.device).reshape(-1))
        return found.view(rows.shape).long()

    def is_last(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns whether rows ``[*]`` are the last of a trajectory, bool ``[*]``."""
        return self.remaining(rows) == 0

    def later(self, rows: torch.Tensor, steps: torch.Tensor | int) -> torch.Tensor:
        """Returns the rows that are ``steps`` later, int64 ``[*]``.

        The number of steps must be at most :meth:`remaining`.
        """
        return (rows + steps) % self.length

    def numbers(self) -> torch.Tensor:
        """Returns the trajectory of each row, 0, 1, ... by time, int64 ``[T]``."""
        counts = torch.arange(len(self.ends), device=self.device)
        return counts.repeat_interleave(self.lengths).roll(self.oldest)


def trajectory_index(
    source: ReplayBuffer | TensorStorage | TensorDictBase,
    *,
    trajectory_key: NestedKey | None = "episode",
    done_key: NestedKey | None = ("next", "done"),
) -> TrajectoryIndex:
    """Finds the trajectories of stored transitions.

    The transitions of a trajectory are consecutive. A trajectory ends where the id in
    ``trajectory_key`` changes, where ``done_key`` is set, at the row that was written
    last, and at the end of the storage. In a full ring, a trajectory continues from the
    last row to the first. If the data lack ``trajectory_key``, the ids of TorchRL's
    collectors in ``("collector", "traj_ids")`` are used. Data with ids may lack
    ``done_key``.

    Args:
        source (ReplayBuffer, TensorStorage or TensorDictBase): the transitions
            ``[T]``.

    Keyword Args:
        trajectory_key (NestedKey, optional): the key of the trajectory ids, ``[T]`` or
            ``[T, 1]``; ``None`` to use ``done_key`` alone. Defaults to ``"episode"``.
        done_key (NestedKey, optional): the key of the end flags, ``[T]`` or ``[T, 1]``;
            ``None`` to use ``trajectory_key`` alone. Defaults to ``("next", "done")``.

    Returns:
        TrajectoryIndex: the trajectories.

    Raises:
        KeyError: the data lack the ids or the end flags.
        TypeError: the storage does not contain a tensordict, or an entry is not a
            tensor.
        ValueError: the storage is empty or has several dimensions, an entry does not
            have one value for each row, or both keys are ``None``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.trajectories import trajectory_index
        >>> index = trajectory_index(
        ...     TensorDict({"episode": torch.tensor([0, 0, 0, 1])}, [4])
        ... )
        >>> index.ends, index.remaining(torch.tensor([0, 2]))
        (tensor([2, 3]), tensor([2, 0]))
    """
    newest = None
    if isinstance(source, TensorDictBase):
        data, length = source, len(source)
    else:
        storage = source.storage if isinstance(source, ReplayBuffer) else source
        data, length = storage_data(storage), len(storage)
        if storage.ndim != 1:
            raise ValueError(
                f"the storage has ndim={storage.ndim}, expected 1: store flat "
                "transitions, with trajectory ids"
            )
        newest = last_written(source)
    ids, done = _leaves(data, length, trajectory_key, done_key)
    # Only in a full ring does a trajectory continue from the last row to the first.
    is_ring = length == data.shape[0] and newest is not None and newest < length - 1
    oldest = newest + 1 if is_ring and newest is not None else 0
    leaf = done if ids is None else ids
    assert leaf is not None  # _leaves returns at least one
    last = torch.zeros(length, dtype=torch.bool, device=leaf.device)
    if ids is not None:
        ids = ids.roll(-oldest) if oldest else ids
        last[:-1] = ids[1:] != ids[:-1]
    if done is not None:
        last |= done.roll(-oldest) if oldest else done
    last[-1] = True
    if newest is not None and newest < length:
        last[(newest - oldest) % length] = True
    ends = last.nonzero()[:, 0]
    dtype = torch.int32 if length < 1 << 31 else torch.int64
    left = ends.to(dtype).repeat_interleave(ends.diff(prepend=ends.new_tensor([-1])))
    for start in range(0, length, _CHUNK):
        part = left[start : start + _CHUNK]
        part -= torch.arange(start, start + len(part), dtype=dtype, device=left.device)
    return TrajectoryIndex(length, oldest, ends, left.roll(oldest) if oldest else left)


class TrajectoryCache:
    """Caches the index of a storage until the storage is written to.

    Keyword Args:
        trajectory_key (NestedKey, optional): see :func:`trajectory_index`.
        done_key (NestedKey, optional): see :func:`trajectory_index`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> from torchrl_caiac.trajectories import TrajectoryCache
        >>> cache = TrajectoryCache(trajectory_key="episode", done_key=None)
        >>> storage = LazyTensorStorage(4)
        >>> storage.set(range(2), TensorDict({"episode": torch.zeros(2)}, [2]))
        >>> cache.get(storage) is cache.get(storage)
        True
    """

    def __init__(
        self, *, trajectory_key: NestedKey | None, done_key: NestedKey | None
    ) -> None:
        self.trajectory_key = trajectory_key
        self.done_key = done_key
        self._built: tuple[Any, tuple[Any, ...], TrajectoryIndex] | None = None

    def get(self, storage: TensorStorage) -> TrajectoryIndex:
        """Returns the index of the storage as it is now.

        Args:
            storage (TensorStorage): the storage.

        Returns:
            TrajectoryIndex: see :func:`trajectory_index`, also for what is raised.
        """
        built, revision = self._built, storage_revision(storage)
        if built is None or built[0]() is not storage or built[1] != revision:
            index = trajectory_index(
                storage, trajectory_key=self.trajectory_key, done_key=self.done_key
            )
            self._built = built = (weakref.ref(storage), revision, index)
        return built[2]

    def __reduce__(self) -> tuple[Any, ...]:
        return _new_cache, (self.trajectory_key, self.done_key)


def _new_cache(
    trajectory_key: NestedKey | None, done_key: NestedKey | None
) -> TrajectoryCache:
    return TrajectoryCache(trajectory_key=trajectory_key, done_key=done_key)


def _leaves(
    data: TensorDictBase,
    length: int,
    trajectory_key: NestedKey | None,
    done_key: NestedKey | None,
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Returns the ids and the end flags ``[T]``, ``None`` if unused or missing."""
    if trajectory_key is None and done_key is None:
        raise ValueError(
            "trajectory_key and done_key are both None: give at least one of them, "
            "since it marks where trajectories end"
        )
    ids = done = None
    if trajectory_key is not None:
        ids = data.get(trajectory_key, None)
        if ids is None:
            ids = data.get(_COLLECTOR_KEY, None)
        if ids is None:
            raise missing_key(
                data,
                trajectory_key,
                "the transitions lack the trajectory ids",
                "pass trajectory_key= with the key of the ids, or trajectory_key=None "
                "to use the end flags alone, which is correct only if the transitions "
                "of each trajectory are consecutive (transforms take it as "
                "keys=TransformKeys(trajectory=...))",
            )
    if done_key is not None:
        done = data.get(done_key, None)
        if done is None and ids is None:
            raise missing_key(
                data,
                done_key,
                "the transitions lack the end flags",
                "pass done_key= with the key of the flags",
            )
    return (
        None if ids is None else _flat(ids, length, trajectory_key),
        None if done is None else _flat(done, length, done_key).bool(),
    )


def _flat(leaf: torch.Tensor, length: int, key: NestedKey | None) -> torch.Tensor:
    if not isinstance(leaf, torch.Tensor):
        raise TypeError(f"{key!r} is a {type(leaf).__name__}, expected a tensor")
    if leaf.numel() != leaf.shape[0]:
        raise ValueError(
            f"{key!r} has shape {list(leaf.shape)}, expected [T] or [T, 1]: one value "
            "for each transition"
        )
    # As a plain tensor, because memory-mapped ones have a slow Python dispatch.
    return leaf.as_subclass(torch.Tensor)[:length].reshape(length)
