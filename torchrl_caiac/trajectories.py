"""The index of the trajectories in a storage: which transition follows which."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac._checks import check_local
from torchrl_caiac._keys import missing_key, path
from torchrl_caiac._torchrl import (
    is_in_order_of_time,
    last_written,
    storage_rows,
)

__all__ = [
    "COLLECTOR_KEY",
    "STEPS_KEY",
    "TrajectoryIndex",
    "end_flag_keys",
    "end_flags",
    "flat_rows",
    "trajectory_index",
]

#: The key of the trajectory ids of TorchRL's collectors.
COLLECTOR_KEY: NestedKey = ("collector", "traj_ids")
# The end flags that data without ``("next", "done")`` may have instead.
_PARTS_OF_DONE = ("terminated", "truncated")
#: TorchRL's MultiStepTransform: the steps from a row's state to its next state.
STEPS_KEY: NestedKey = "steps_to_next_obs"
_CHUNK = 1 << 20


class TrajectoryIndex(NamedTuple):
    """The trajectories of a storage, in the order of time.

    Each row has a position. The rows of a trajectory are at consecutive positions, in
    the order of time, wherever they lie in the storage. The index takes 4 bytes for
    each row if trajectories lie one after another. If they are interleaved, it takes
    12, and up to 70 while it is built.

    The rows of a storage with several dimensions, ``[T, *B]``, are counted in the order
    of its flattened data: row ``t * B + b`` is step ``t`` of the environment ``b``.

    Attributes:
        length (int): the number of rows in the storage, ``T``.
        oldest (int): the oldest row: in a full ring, the one after the newest.
        ends (torch.Tensor): int64 ``[E]``, the positions of the last row of each
            trajectory, ascending.
        left (torch.Tensor): integer ``[T]``, the number of rows of the same trajectory
            after each row.
        order (torch.Tensor, optional): integer ``[T]``, the row at each position;
            ``None`` if this is ``(position + oldest) % length``.
        place (torch.Tensor, optional): integer ``[T]``, the position of each row.
    """

    length: int
    oldest: int
    ends: torch.Tensor
    left: torch.Tensor
    order: torch.Tensor | None = None
    place: torch.Tensor | None = None

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
    def is_storage_order(self) -> bool:
        """Whether positions are rows, so that no row needs to be looked up."""
        return self.order is None and self.oldest == 0

    def position(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns the positions of rows ``[*]``, int64 ``[*]``."""
        if self.place is not None:
            return _picked(self.place, rows)
        return (rows - self.oldest) % self.length if self.oldest else rows

    def rows(self, position: torch.Tensor) -> torch.Tensor:
        """Returns the rows at positions ``[*]``, int64 ``[*]``."""
        if self.order is not None:
            return _picked(self.order, position)
        return (position + self.oldest) % self.length if self.oldest else position

    def remaining(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns the number of later rows in each row's trajectory, int64 ``[*]``."""
        return _picked(self.left, rows)

    def is_last(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns whether rows ``[*]`` are the last of a trajectory, bool ``[*]``."""
        return self.remaining(rows) == 0

    def later(self, rows: torch.Tensor, steps: torch.Tensor | int) -> torch.Tensor:
        """Returns the rows that are ``steps`` later, int64 ``[*]``.

        The number of steps must be at most :meth:`remaining`.
        """
        if self.order is None and self.oldest:
            return (rows + steps) % self.length
        return self.rows((self.position(rows) + steps).clamp_max(self.length - 1))

    def ahead(self, rows: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
        """Returns the rows that are ``steps`` later, or the trajectory's last ones.

        Args:
            rows (torch.Tensor): int64 ``[*]``.
            steps (torch.Tensor): int64 ``[*]``, at least 0.

        Returns:
            torch.Tensor: int64 ``[*]``.
        """
        return self.later(rows, torch.minimum(steps, self.remaining(rows)))

    def numbers(self) -> torch.Tensor:
        """Returns the trajectory of each row, 0, 1, ... by time, int64 ``[T]``."""
        counts = torch.arange(len(self.ends), device=self.device)
        found = counts.repeat_interleave(self.lengths)
        if self.place is not None:
            return _picked(found, self.place)
        return found.roll(self.oldest)


def trajectory_index(
    source: ReplayBuffer | TensorStorage | TensorDictBase,
    *,
    trajectory_key: NestedKey | None = "episode",
    done_key: NestedKey | None = ("next", "done"),
) -> TrajectoryIndex:
    """Finds the trajectories of stored transitions.

    The transitions with the same id in ``trajectory_key`` are one trajectory, in the
    order of time, wherever they lie: parallel environments may be interleaved. A
    trajectory also ends where ``done_key`` is set, at the row that was written last,
    and at the end of the storage; a later transition with the same id begins another
    one. In a full ring, time begins after the row that was written last. In a storage
    with several dimensions, ``[T, *B]``, the first one is time, and the others are
    environments, whose transitions never belong to the same trajectory.

    If the data lack ``trajectory_key``, the ids of TorchRL's collectors in
    ``("collector", "traj_ids")`` are used. If they lack ``("next", "done")``,
    ``("next", "terminated")`` and ``("next", "truncated")`` are used, if present. Data
    with ids may lack all of these. Without ids (``trajectory_key=None``), the
    transitions of a trajectory are consecutive.

    Transitions of :class:`~torchrl.envs.MultiStepTransform` have the end flags of the
    state ``steps_to_next_obs`` later: only the last of them ends the trajectory.

    Args:
        source (ReplayBuffer, TensorStorage or TensorDictBase): the transitions
            ``[T]``, or a buffer or storage of ``[T, *B]``.

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
        ValueError: the storage is empty, or its rows are not in the order of time; an
            entry does not have one value for each row; or both keys are ``None``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.trajectories import trajectory_index
        >>> index = trajectory_index(
        ...     TensorDict({"episode": torch.tensor([0, 1, 0, 1, 0])}, [5])
        ... )
        >>> rows = torch.arange(3)
        >>> index.remaining(rows), index.later(rows, 1)
        (tensor([2, 1, 1]), tensor([2, 3, 4]))
    """
    newest, streams = None, 1
    check_local("source", source)
    if isinstance(source, TensorDictBase):
        if source.batch_dims != 1:
            raise ValueError(
                f"the data have the batch size {list(source.batch_size)}, expected "
                "[T]: flatten them with reshape(-1), and give each environment its own "
                "trajectory ids"
            )
        data, length = source, len(source)
    else:
        storage = source.storage if isinstance(source, ReplayBuffer) else source
        data, length = storage_rows(storage), len(storage)
        if length and not is_in_order_of_time(source):
            raise ValueError(
                "the buffer's writer replaces rows at any place, so that its rows are "
                "not in the order of time: use a round-robin writer"
            )
        newest = last_written(source)
        streams = storage.shape[1:].numel() if storage.ndim > 1 else 1
    ids, done = _leaves(data, length, trajectory_key, done_key)
    steps = length // streams
    # Only in a full ring does time begin after the row that was written last.
    is_ring = length == data.shape[0] and newest is not None and newest < steps - 1
    oldest = newest + 1 if is_ring and newest is not None else 0
    # Whether each row, in the order of environment and time, is the last of a piece,
    # that is of consecutive rows of one trajectory; and whether its trajectory ends.
    leaf = done if ids is None else ids
    assert leaf is not None  # _leaves returns at least one
    ended = torch.zeros(length, dtype=torch.bool, device=leaf.device)
    if done is not None:
        ended |= _in_time(done, streams, oldest)
    ended.view(streams, steps)[:, -1] = True
    if newest is not None and newest < steps:
        ended.view(streams, steps)[:, (newest - oldest) % steps] = True
    last = ended
    if ids is not None:
        ids = _in_time(ids, streams, oldest)
        last = ended.clone()
        last[:-1] |= ids[1:] != ids[:-1]
    ends = last.nonzero()[:, 0]
    is_final = ended[ends]
    del last, ended  # to need little more memory than the index
    pieces = None if ids is None else _joined(ids[ends], is_final, ends, steps)
    if pieces is None and streams == 1:
        return _index(length, oldest, ends)
    if pieces is None:
        place = torch.arange(length, device=ends.device)
    else:
        starts, lengths, ends = pieces
        place = _ranges(starts, lengths)
    # From places in the order of environment and time to rows of the storage.
    row = (place % steps + oldest) % steps * streams
    row += torch.div(place, steps, rounding_mode="floor")
    return _ordered(row, ends, oldest * streams)


def end_flag_keys(data: TensorDictBase, done_key: NestedKey | None) -> list[NestedKey]:
    """Returns the keys of the flags that end a trajectory.

    Args:
        data (TensorDictBase): transitions ``[T]``.
        done_key (NestedKey, optional): the end flags, ``None`` for none. If the data
            lack them, they are ``"terminated"`` and ``"truncated"`` beside this key.

    Returns:
        list of NestedKey: those that the data have.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.trajectories import end_flag_keys
        >>> data = TensorDict({"next": {"truncated": torch.zeros(2, 1)}}, [2])
        >>> end_flag_keys(data, ("next", "done"))
        [('next', 'truncated')]
    """
    if done_key is None:
        return []
    if data.get(done_key, None) is not None:
        return [done_key]
    parts = [(*path(done_key)[:-1], name) for name in _PARTS_OF_DONE]
    return [key for key in parts if data.get(key, None) is not None]


def end_flags(
    data: TensorDictBase, done_key: NestedKey, length: int | None = None
) -> torch.Tensor | None:
    """Returns where a trajectory ends.

    Args:
        data (TensorDictBase): transitions ``[T]``.
        done_key (NestedKey): the end flags. If the data lack them, ``"terminated"`` and
            ``"truncated"`` beside this key are used.
        length (int, optional): the number of rows to read. Defaults to all.

    Returns:
        torch.Tensor, optional: bool ``[length]``; ``None`` if the data have no flags.

    Raises:
        TypeError: an entry is not a tensor.
        ValueError: an entry does not have one value for each row.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.trajectories import end_flags
        >>> flags = {"truncated": torch.tensor([[False], [True]])}
        >>> end_flags(TensorDict({"next": flags}, [2]), ("next", "done"))
        tensor([False,  True])
    """
    length = len(data) if length is None else length
    done: torch.Tensor | None = None
    for key in end_flag_keys(data, done_key):
        flags = _flat(data.get(key), length, key).bool()
        done = flags if done is None else done | flags
    steps = data.get(STEPS_KEY, None)
    if done is not None and steps is not None:
        done = done & (_flat(steps, length, STEPS_KEY) == 1)
    return done


def flat_rows(
    index: torch.Tensor | tuple[torch.Tensor, ...], storage: TensorStorage
) -> torch.Tensor:
    """Returns the rows that a sampler drew, as :class:`TrajectoryIndex` counts them.

    Args:
        index (torch.Tensor or tuple of torch.Tensor): rows ``[B]``, or the coordinates
            in each dimension of the storage, ``[B]`` each or ``[B, ndim]``.
        storage (TensorStorage): the sampled storage.

    Returns:
        torch.Tensor: int64 ``[B]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> from torchrl_caiac.trajectories import flat_rows
        >>> storage = LazyTensorStorage(12, ndim=2)
        >>> storage.set(range(2), TensorDict({"a": torch.zeros(2, 3)}, [2, 3]))
        >>> flat_rows((torch.tensor([1, 0]), torch.tensor([2, 1])), storage)
        tensor([5, 1])
    """
    if isinstance(index, torch.Tensor):
        if storage.ndim == 1 or index.ndim == 1:
            return index.reshape(-1)
        index = index.unbind(-1)
    if len(index) == 1:
        return index[0].reshape(-1)
    rows = torch.zeros_like(index[0])
    for coordinate, size in zip(index, storage.shape, strict=True):
        rows = rows * size + coordinate
    return rows.reshape(-1)


def _picked(source: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """Returns ``source[where]``, int64, in the shape of ``where``."""
    found = source.index_select(0, where.to(source.device).reshape(-1))
    return found.view(where.shape).long()


def _in_time(leaf: torch.Tensor, streams: int, oldest: int) -> torch.Tensor:
    """Returns the values of rows ``[T]`` in the order of environment and time."""
    if streams > 1:
        leaf = leaf.view(-1, streams).t()
        return (leaf.roll(-oldest, 1) if oldest else leaf).reshape(-1)
    return leaf.roll(-oldest) if oldest else leaf


def _index(length: int, oldest: int, ends: torch.Tensor) -> TrajectoryIndex:
    """Returns the index of trajectories that lie one after another."""
    left = torch.empty(length, dtype=_dtype(length), device=ends.device)
    for start in range(0, length, _CHUNK):  # in parts, to need no memory but the index
        position = torch.arange(start, min(start + _CHUNK, length), device=ends.device)
        end = ends[torch.searchsorted(ends, position)]
        left[(position + oldest) % length] = (end - position).to(left.dtype)
    return TrajectoryIndex(length, oldest, ends, left)


def _ordered(row: torch.Tensor, ends: torch.Tensor, oldest: int) -> TrajectoryIndex:
    """Returns the index of trajectories with these rows, ``[T]``, by position."""
    length = len(row)
    order = row.to(_dtype(length))
    place = torch.empty_like(order)
    place[row] = torch.arange(length, dtype=order.dtype, device=order.device)
    left = _index(length, 0, ends).left.index_select(0, place)
    return TrajectoryIndex(length, oldest, ends, left, order, place)


def _dtype(length: int) -> torch.dtype:
    return torch.int32 if length < 1 << 31 else torch.int64


def _joined(
    ids: torch.Tensor, is_final: torch.Tensor, ends: torch.Tensor, steps: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None:
    """Joins pieces of the same trajectory.

    Args:
        ids (torch.Tensor): ``[P]``, the id of each piece, in the order of environment
            and time.
        is_final (torch.Tensor): bool ``[P]``, whether its trajectory ends with it.
        ends (torch.Tensor): int64 ``[P]``, the place of its last row.
        steps (int): the rows of each environment.

    Returns:
        tuple of torch.Tensor, optional: the places of the first rows of the pieces and
        their lengths, trajectory by trajectory, ``[P]``, and the positions of the ends
        of trajectories, ``[E]``; ``None`` if every piece is a whole trajectory.
    """
    count = len(ids)
    # Pieces of an id in the order of time, and ids by environment.
    by_id = ids.argsort(stable=True)
    if count > 1 and len(ends) and int(ends[-1]) + 1 > steps:
        stream = torch.div(ends, steps, rounding_mode="floor")
        by_id = by_id[stream[by_id].argsort(stable=True)]
        same = stream[by_id][1:] == stream[by_id][:-1]
    else:
        same = torch.ones(count - 1, dtype=torch.bool, device=ids.device)
    same &= (ids[by_id][1:] == ids[by_id][:-1]) & ~is_final[by_id][:-1]
    if not bool(same.any()):
        return None
    begins = torch.cat([same.new_ones(1), ~same])
    number = begins.cumsum(0) - 1
    # Trajectories in the order of their first rows.
    first = by_id[begins]
    rank = torch.empty_like(first)
    rank[first.argsort()] = torch.arange(len(first), device=first.device)
    order = by_id[rank[number].argsort(stable=True)]
    lengths = ends.diff(prepend=ends.new_tensor([-1]))
    starts = ends - lengths + 1
    sizes = torch.zeros(len(first), dtype=torch.long, device=ids.device)
    sizes.index_add_(0, rank[number], lengths[by_id])
    return starts[order], lengths[order], sizes.cumsum(0) - 1


def _ranges(starts: torch.Tensor, lengths: torch.Tensor) -> torch.Tensor:
    """Returns consecutive numbers from each start, int64 ``[sum(lengths)]``."""
    shift = starts - (lengths.cumsum(0) - lengths)
    total = int(lengths.sum())
    return shift.repeat_interleave(lengths) + torch.arange(total, device=starts.device)


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
    ids = None
    if trajectory_key is not None:
        ids = data.get(trajectory_key, None)
        if ids is None:
            ids = data.get(COLLECTOR_KEY, None)
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
        ids = _flat(ids, length, trajectory_key)
    done = None if done_key is None else end_flags(data, done_key, length)
    if done_key is not None and done is None and ids is None:
        raise missing_key(
            data,
            done_key,
            "the transitions lack the end flags",
            "pass done_key= with the key of the flags",
        )
    return ids, done


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
