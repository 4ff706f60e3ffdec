"""The successful trajectories of a dataset, up to their first success."""

from __future__ import annotations

import math
from numbers import Real
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._checks import check_int
from torchrl_caiac._keys import get_leaf
from torchrl_caiac._keys import path as key_path
from torchrl_caiac.data.action_bounds import action_bounds
from torchrl_caiac.data.write_transitions import check_free, write_parts
from torchrl_caiac.trajectories import TrajectoryIndex, end_flags, trajectory_index

__all__ = ["select_successful"]

_CHUNK = 1 << 16  # rows that are written together


def select_successful(
    data: TensorDictBase,
    key: NestedKey = ("next", "success"),
    *,
    above: float | None = None,
    cut: bool = True,
    trajectories: int | None = None,
    path: str | Path | None = None,
    trajectory_key: NestedKey | None = "episode",
    done_key: NestedKey | None = ("next", "done"),
    overwrite: bool = False,
) -> TensorDict:
    """Returns the trajectories that succeed, up to their first success.

    Imitation learners copy every row that they get. Episodes that fail, and what a
    demonstrator does after it has succeeded, teach them what nobody wants.

    With ``cut``, the last row that is kept ends its trajectory: unless it did before,
    ``done_key`` and the entry ``"truncated"`` beside it, if present, become true there.

    Args:
        data (TensorDictBase): transitions ``[T]``, in memory or memory-mapped, in the
            order of time. For the trajectories see
            :func:`~torchrl_caiac.trajectories.trajectory_index`, for the data of a
            buffer :func:`~torchrl_caiac.data.from_replay_buffer`.
        key (NestedKey): what says that a transition succeeds, ``[T]`` or ``[T, 1]``: a
            flag, or with ``above`` a number such as the reward. Defaults to
            ``("next", "success")``.

    Keyword Args:
        above (float, optional): a transition succeeds where the entry is above this
            number. With rewards of -1, and 0 at the goal, that is ``-0.5``. Defaults to
            ``None``: the entry is a flag, bool, or 0 and 1.
        cut (bool): whether the rows after the first success are left out. Defaults to
            ``True``.
        trajectories (int, optional): how many successful trajectories to take, the
            first ones in the order of time. Defaults to all of them.
        path (str or Path, optional): the folder of a memory-mapped result, which has
            digests; see :func:`~torchrl_caiac.data.write_transitions`. Defaults to
            ``None``: in memory.
        trajectory_key (NestedKey, optional): the trajectory ids; ``None`` to use the
            end flags alone. Defaults to ``"episode"``.
        done_key (NestedKey, optional): the end flags; ``None`` to use the ids alone.
            Defaults to ``("next", "done")``.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.

    Returns:
        TensorDict: the rows, trajectory by trajectory, ``[T']``, with the entries of
        ``data``; locked if memory-mapped.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        KeyError: the data lack ``key``, or ids and end flags.
        TypeError: ``data`` is not a tensordict, or ``above`` is not a number.
        ValueError: no trajectory succeeds, or fewer than ``trajectories``; the entry is
            not a flag and ``above`` is missing; or a value or ``above`` is NaN.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.select_successful import select_successful
        >>> reward = torch.tensor([-1.0, -1.0, -1.0, 0.0, 0.0])
        >>> data = TensorDict(
        ...     {"episode": torch.tensor([0, 0, 1, 1, 1]), ("next", "reward"): reward},
        ...     [5],
        ... )
        >>> select_successful(data, ("next", "reward"), above=-0.5)["episode"]
        tensor([1, 1])
    """
    check_free(path, overwrite)
    if not isinstance(data, TensorDictBase):
        raise TypeError(
            f"data is a {type(data).__name__}, expected a TensorDict [T]: write the "
            "data of a buffer with from_replay_buffer, which sorts them by time"
        )
    if not data.batch_size.numel():
        raise ValueError(
            f"data has the batch size {list(data.batch_size)}, no transitions"
        )
    if trajectories is not None:
        check_int("trajectories", trajectories, 1)
    index = trajectory_index(data, trajectory_key=trajectory_key, done_key=done_key)
    successes = _successes(data, key, above)
    if not index.is_storage_order:
        rows = index.rows(torch.arange(len(data), device=index.device)).cpu()
        successes = successes[rows]
    lengths, ends = index.lengths.cpu(), index.ends.cpu()
    at = successes.nonzero()[:, 0]
    number = torch.searchsorted(ends, at)
    is_successful = torch.zeros(len(ends), dtype=torch.bool)
    is_successful[number] = True
    found = int(is_successful.sum())
    if found < (trajectories or 1):
        raise ValueError(
            f"{found} of {len(lengths)} trajectories succeed according to {key!r}"
            f"{'' if above is None else f' above {above:g}'}, wanted "
            f"{trajectories or 'at least one'}: collect more, or correct key or above"
        )
    if trajectories is not None:
        is_successful &= is_successful.cumsum(0) <= trajectories
    starts, last = ends + 1 - lengths, ends
    if cut:
        last = ends.scatter_reduce(0, number, at, "amin")
    chosen = _Chosen(
        starts[is_successful], (last + 1 - starts)[is_successful], index, data
    )
    step = len(chosen) if path is None else _CHUNK
    parts = (
        chosen.part(first, min(first + step, len(chosen)), done_key if cut else None)
        for first in range(0, len(chosen), step)
    )
    if path is None:
        return next(parts)
    like = data[:1].to_tensordict().expand(len(chosen))
    return write_parts(
        like, parts, path, overwrite=overwrite, action_bounds=action_bounds(data)
    )


class _Chosen:
    """The rows that are kept, trajectory by trajectory.

    Args:
        starts (torch.Tensor): int64 ``[E]``, the positions of their first rows.
        sizes (torch.Tensor): int64 ``[E]``, how many of each are kept.
        index (TrajectoryIndex): the trajectories.
        data (TensorDictBase): the transitions.
    """

    def __init__(
        self,
        starts: torch.Tensor,
        sizes: torch.Tensor,
        index: TrajectoryIndex,
        data: TensorDictBase,
    ) -> None:
        self.stops = sizes.cumsum(0)
        self.shift = starts - (self.stops - sizes)
        self.index, self.data = index, data

    def __len__(self) -> int:
        return int(self.stops[-1])

    def part(self, first: int, stop: int, done_key: NestedKey | None) -> TensorDict:
        """Returns some of the rows, with ``done_key`` set in the last ones."""
        place = torch.arange(first, stop)
        number = torch.searchsorted(self.stops, place, right=True)
        position = (place + self.shift[number]).to(self.index.device)
        rows = self.index.rows(position).to(self.data.device or "cpu")
        found = self.data[rows].to_tensordict()
        if done_key is not None:
            _end(found, place + 1 == self.stops[number], done_key)
        return found


def _successes(
    data: TensorDictBase, key: NestedKey, above: float | None
) -> torch.Tensor:
    """Returns which rows succeed, bool ``[T]``."""
    leaf = get_leaf(
        data, key, "the transitions lack", "name the one they have with key="
    )
    if leaf.numel() != len(data):
        raise ValueError(
            f"{key!r} has shape {list(leaf.shape)}, expected [T] or [T, 1]: one value "
            "for each transition"
        )
    leaf = leaf.as_subclass(torch.Tensor).reshape(-1).cpu()
    if above is not None:
        if isinstance(above, bool) or not isinstance(above, Real):
            raise TypeError(f"above must be a number, got {above!r}")
        unknown = leaf.isnan() | math.isnan(above)
        if bool(unknown.any()):
            raise ValueError(
                f"{key!r} in row {int(unknown.nonzero()[0])} is "
                f"{leaf[unknown][0].item()}, above is {above}, so that its success is "
                "unknown: correct the data or above"
            )
        return leaf > above
    if leaf.dtype is not torch.bool and not bool(((leaf == 0) | (leaf == 1)).all()):
        raise ValueError(
            f"{key!r} has values from {leaf.min():g} to {leaf.max():g}, expected a "
            "flag, bool or 0 and 1: pass above=, the number that a successful "
            "transition exceeds"
        )
    return leaf.bool()


def _end(rows: TensorDict, last: torch.Tensor, done_key: NestedKey) -> None:
    """Sets the end flags of the last row of each trajectory, bool ``[n]``."""
    done = end_flags(rows, done_key)
    if done is not None:  # what ended its trajectory before is not truncated
        last = last & ~done.cpu()
    for key in (done_key, _beside(done_key, "truncated")):
        flags = rows.get(key, None)
        if flags is not None:
            where = last.view(-1, *(1,) * (flags.ndim - 1)).to(flags.device)
            rows.set(
                key,
                flags | where if flags.dtype is torch.bool else flags.where(~where, 1),
            )


def _beside(key: NestedKey, name: str) -> NestedKey:
    parents = key_path(key)[:-1]
    return (*parents, name) if parents else name
