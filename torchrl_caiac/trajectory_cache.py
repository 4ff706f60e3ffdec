"""The trajectories of a storage that is written to."""

from __future__ import annotations

import weakref
from collections import deque
from typing import Any, NamedTuple

import torch
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac._keys import path
from torchrl_caiac._torchrl import (
    is_in_order_of_time,
    last_written,
    storage_revision,
    storage_rows,
)
from torchrl_caiac.trajectories import (
    COLLECTOR_KEY,
    STEPS_KEY,
    TrajectoryIndex,
    end_flags,
    trajectory_index,
)

__all__ = ["TrajectoryCache", "TrajectoryTail", "record_writes", "written_tail"]

_MOST_WRITES = 4_096  # that are recorded


class _Writes:
    """Records which rows a writer writes: attached to a storage as buffers are.

    Args:
        storage (TensorStorage, optional): the storage; a copy has none.
    """

    def __init__(self, storage: TensorStorage | None = None) -> None:
        self._storage = None if storage is None else weakref.ref(storage)
        self._found: deque[tuple[int, int, int]] = deque(maxlen=_MOST_WRITES)

    def mark_update(self, index: int | torch.Tensor) -> None:
        """Records rows: writers call it after they have written them."""
        storage = None if self._storage is None else self._storage()
        if storage is None:
            return
        rows = torch.as_tensor(index)
        first, count = -1, 0
        if storage.ndim == 1 and rows.numel():
            rows = rows.reshape(-1)
            steps = torch.arange(len(rows), device=rows.device)
            if bool((rows == (rows[0] + steps) % storage.max_size).all()):
                first, count = int(rows[0]), len(rows)
        self._found.append((storage_revision(storage)[0], first, count))

    def since(self, before: int, now: int, size: int) -> tuple[int, int] | None:
        """Returns the rows written between two revisions, if all were in succession.

        Args:
            before (int): the earlier revision.
            now (int): the later one.
            size (int): the rows of the storage.

        Returns:
            tuple of int, optional: the first row, and how many; ``None`` if something
            else was written, or what is not known.
        """
        found = [write for write in self._found.copy() if before < write[0] <= now]
        if not found or [write[0] for write in found] != [*range(before + 1, now + 1)]:
            return None
        first, total = found[0][1], 0
        for _, start, count in found:
            if not count or start != (first + total) % size:
                return None
            total += count
        return first, total

    def __reduce__(self) -> tuple[Any, ...]:
        return _Writes, ()


_recorded: weakref.WeakKeyDictionary[TensorStorage, _Writes] = (
    weakref.WeakKeyDictionary()
)


def record_writes(storage: TensorStorage) -> None:
    """Has the rows recorded that are written to a storage, see :func:`written_tail`."""
    if storage not in _recorded:
        _recorded[storage] = _Writes(storage)
        storage.attach(_recorded[storage])


class TrajectoryTail(NamedTuple):
    """The trajectories of a storage after a write, of which only the last ones are new.

    Attributes:
        length (int): the number of rows in the storage.
        oldest (int): the oldest row.
        ends (torch.Tensor): int64 ``[E]``, as in
            :class:`~torchrl_caiac.trajectories.TrajectoryIndex`.
        start (int): the position of the first row of the first trajectory that was
            written to. Earlier trajectories are as before, except that the oldest rows
            may be gone.
    """

    length: int
    oldest: int
    ends: torch.Tensor
    start: int

    def rows(self, position: torch.Tensor) -> torch.Tensor:
        """Returns the rows at positions ``[*]``, int64 ``[*]``."""
        return (position + self.oldest) % self.length


def written_tail(
    before: TrajectoryIndex | TrajectoryTail,
    revision: tuple[Any, ...],
    source: ReplayBuffer | TensorStorage,
    *,
    trajectory_key: NestedKey | None,
    done_key: NestedKey | None,
) -> TrajectoryTail | None:
    """Returns the trajectories after rows were added, or have replaced the oldest ones.

    It reads the rows of the trajectories that were written to, and the last row of each
    other one.

    Args:
        before (TrajectoryIndex or TrajectoryTail): the trajectories before.
        revision (tuple): what
            :func:`~torchrl_caiac._torchrl.storage_revision` returned then.
        source (ReplayBuffer or TensorStorage): the buffer, or its storage.

    Keyword Args:
        trajectory_key (NestedKey, optional): see
            :func:`~torchrl_caiac.trajectories.trajectory_index`.
        done_key (NestedKey, optional): the same.

    Returns:
        TrajectoryTail, optional: ``None`` if anything else was written, or nothing is
        recorded; if trajectories are interleaved; and if more than half of the rows
        belong to trajectories that were written to. Then all have to be read.
    """
    storage = source.storage if isinstance(source, ReplayBuffer) else source
    writes = _recorded.get(storage)
    is_interleaved = getattr(before, "order", None) is not None
    if writes is None or is_interleaved or storage.ndim > 1:
        return None
    data, length = storage_rows(storage), len(storage)
    size = data.shape[0]
    found = writes.since(revision[0], storage_revision(storage)[0], size)
    if found is None or not is_in_order_of_time(source):
        return None
    first, count = found
    newest = last_written(source)
    dropped = before.length + count - length
    if (
        count >= size
        or length != min(before.length + count, size)
        or first != (before.oldest or before.length) % size
        or newest != (first + count - 1) % size
    ):
        return None
    oldest = (first + count) % size if length == size else 0
    kept = before.ends[:-1] - dropped
    kept = kept[kept >= 0]
    start = int(kept[-1]) + 1 if len(kept) else 0
    if 2 * (length - start) > length:
        return None
    parts = () if done_key is None else path(done_key)[:-1]
    flags = (done_key, (*parts, "terminated"), (*parts, "truncated"))
    keys = [trajectory_key, COLLECTOR_KEY] if trajectory_key is not None else []
    keys += [*flags, STEPS_KEY] if done_key is not None else []
    leaves = data.select(*keys, strict=False)
    position = torch.arange(start, length, device=kept.device)
    written = leaves[(position + oldest) % length]
    index = trajectory_index(written, trajectory_key=trajectory_key, done_key=done_key)
    if not index.is_storage_order:
        return None
    if trajectory_key is not None:
        # Earlier rows with the id of a later trajectory would be a part of it.
        others = leaves[(kept + oldest) % length]
        has_key = written.get(trajectory_key, None) is not None
        name = trajectory_key if has_key else COLLECTOR_KEY
        ids = others.get(name).reshape(-1)
        done = None if done_key is None else end_flags(others, done_key)
        if done is not None:
            ids = ids[~done]
        if bool(torch.isin(written.get(name).reshape(-1)[index.ends], ids).any()):
            return None
    return TrajectoryTail(length, oldest, torch.cat([kept, index.ends + start]), start)


class TrajectoryCache:
    """Caches the index of a storage until the storage is written to.

    If rows were added at the end, or have replaced the oldest ones, only the
    trajectories that were written to are read again.

    Keyword Args:
        trajectory_key (NestedKey, optional): see
            :func:`~torchrl_caiac.trajectories.trajectory_index`.
        done_key (NestedKey, optional): the same.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> from torchrl_caiac.trajectory_cache import TrajectoryCache
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
            TrajectoryIndex: see :func:`~torchrl_caiac.trajectories.trajectory_index`,
            also for what is raised.
        """
        built, revision = self._built, storage_revision(storage)
        is_known = built is not None and built[0]() is storage
        if built is not None and is_known and built[1] == revision:
            return built[2]
        keys = {"trajectory_key": self.trajectory_key, "done_key": self.done_key}
        tail = None
        if built is not None and is_known:
            tail = written_tail(built[2], built[1], storage, **keys)
        if built is not None and tail is not None:
            index = _with_tail(built[2], tail)
        else:
            record_writes(storage)
            index = trajectory_index(storage, **keys)
        self._built = weakref.ref(storage), revision, index
        if storage_revision(storage) != revision:
            self._built = None  # written to meanwhile, by another thread
        return index

    def __reduce__(self) -> tuple[Any, ...]:
        return _new_cache, (self.trajectory_key, self.done_key)


def _new_cache(
    trajectory_key: NestedKey | None, done_key: NestedKey | None
) -> TrajectoryCache:
    return TrajectoryCache(trajectory_key=trajectory_key, done_key=done_key)


def _with_tail(index: TrajectoryIndex, tail: TrajectoryTail) -> TrajectoryIndex:
    """Returns the index after a write; the one before may be in use."""
    left = index.left.new_empty(tail.length)
    left[: index.length] = index.left
    position = torch.arange(tail.start, tail.length, device=left.device)
    end = tail.ends[torch.searchsorted(tail.ends, position)]
    left[tail.rows(position)] = (end - position).to(left.dtype)
    return TrajectoryIndex(tail.length, tail.oldest, tail.ends, left)
