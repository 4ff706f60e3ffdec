"""Influence later in the trajectory: which entities a row's action is meant for."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, StorageEnsemble, TensorStorage

from torchrl_caiac._fingerprints import fingerprint_key
from torchrl_caiac._keys import get_leaf
from torchrl_caiac._processes import ThreadLock
from torchrl_caiac._sampling import is_native, plain, rows_equal
from torchrl_caiac._torchrl import (
    leaf_of,
    sampled_rows,
    storage_revision,
    storage_rows,
    writes_paused,
)
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.score_leaf import valid_scores
from torchrl_caiac.influence.score_record import read_record
from torchrl_caiac.trajectories import (
    STEPS_KEY,
    TrajectoryIndex,
    flat_rows,
    trajectory_index,
)
from torchrl_caiac.trajectory_cache import (
    TrajectoryTail,
    record_writes,
    written_tail,
)
from torchrl_caiac.transforms.checks import LateCheck
from torchrl_caiac.transforms.goals.window import WindowGoal
from torchrl_caiac.transforms.indexing import pick_rows
from torchrl_caiac.transforms.keys import TransformKeys

__all__ = [
    "BUILDING",
    "NEVER",
    "Lookahead",
    "LookaheadArgument",
    "check_lookahead",
    "hold_entities",
    "locked_entities",
    "steps_to_influence",
]

LookaheadArgument = int | Literal["next", "goal"] | None

#: The number of steps of an entity that is not influenced any more in its trajectory.
NEVER = 2**31 - 1

# The most steps that a table has; NEVER is one more.
_MOST = torch.iinfo(torch.int16).max - 1

# Scores that are compared with the threshold together.
_CHUNK = 1 << 20
# Batches may be prefetched by several threads. It is taken before the buffer's lock.
BUILDING = ThreadLock()
if hasattr(os, "register_at_fork"):
    # No thread of a forked process would release the lock of a buffer.
    os.register_at_fork(before=BUILDING.__enter__, after_in_parent=BUILDING.__exit__)


def check_lookahead(lookahead: object) -> LookaheadArgument:
    """Returns a valid lookahead, or raises.

    Args:
        lookahead (object): the argument of a transform.

    Returns:
        int, str or None: the lookahead.

    Raises:
        TypeError: it is neither an int, ``"next"``, ``"goal"`` nor ``None``.
        ValueError: it is negative.

    Examples:
        >>> from torchrl_caiac.transforms.lookahead import check_lookahead
        >>> check_lookahead("next")
        'next'
    """
    if lookahead is None:
        return None
    if isinstance(lookahead, str):
        if lookahead == "next":
            return "next"
        if lookahead == "goal":
            return "goal"
    if isinstance(lookahead, bool) or not isinstance(lookahead, int):
        raise TypeError(
            "lookahead must be a number of steps, 'next', 'goal' or None, got "
            f"{lookahead!r}"
        )
    if lookahead < 0:
        raise ValueError(f"lookahead is {lookahead}, expected at least 0")
    return lookahead


def steps_to_influence(
    influenced: torch.Tensor, trajectories: TrajectoryIndex
) -> torch.Tensor:
    """Returns the number of steps to the next row in which each entity is influenced.

    Args:
        influenced (torch.Tensor): bool ``[T, N]``, in the order of the storage.
        trajectories (TrajectoryIndex): the trajectories of the same rows.

    Returns:
        torch.Tensor: int32 ``[T, N]``, 0 where the entity is influenced in the row
        itself, :data:`NEVER` where it is influenced in no later row of the trajectory.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.trajectories import trajectory_index
        >>> from torchrl_caiac.transforms.lookahead import steps_to_influence
        >>> index = trajectory_index(TensorDict({"episode": torch.zeros(4)}, [4]))
        >>> influenced = torch.tensor([[False], [False], [True], [False]])
        >>> steps_to_influence(influenced, index).flatten().tolist()
        [2, 1, 0, 2147483647]
    """
    length, device = trajectories.length, influenced.device
    rows = trajectories.rows(torch.arange(length, device=trajectories.device))
    left = trajectories.remaining(rows).to(device)
    rows = rows.to(device)
    steps = torch.empty(influenced.shape, dtype=torch.int32, device=device)
    return steps.index_copy_(0, rows, _steps(influenced[rows], left))


def _steps(influenced: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
    """Returns the steps of whole trajectories in the order of time, int32 ``[n, N]``.

    Args:
        influenced (torch.Tensor): bool ``[n, N]``.
        left (torch.Tensor): integer ``[n]``, the later rows of each row's trajectory.
    """
    device = influenced.device
    position = torch.arange(len(left), dtype=torch.int32, device=device)
    last = position + left.to(torch.int32)
    steps = torch.empty(influenced.shape, dtype=torch.int32, device=device)
    for entity in range(influenced.shape[1]):
        later = position.where(influenced[:, entity], NEVER).flip(0)
        later = later.cummin(0).values.flip(0)
        steps[:, entity] = (later - position).where(later <= last, NEVER)
    return steps


def locked_entities(
    steps: torch.Tensor,
    rule: int | Literal["next"] | torch.Tensor,
    competing: torch.Tensor,
) -> torch.Tensor:
    """Returns the entities that must stay, since the action is meant for them.

    Args:
        steps (torch.Tensor): from :func:`steps_to_influence`, ``[T, N]``.
        rule (int, str or torch.Tensor): a number of steps: what is influenced within
            it. ``"next"``: what is influenced now, or else what is influenced next. The
            steps to the goal of each row, ``[T, 1]``: that, and what is influenced
            before the goal.
        competing (torch.Tensor): bool ``[N]``, the entities that can be the next one.

    Returns:
        torch.Tensor: bool ``[T, N]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.lookahead import NEVER, locked_entities
        >>> steps = torch.tensor([[4, 9], [0, 5], [NEVER, NEVER]])
        >>> locked_entities(steps, "next", torch.tensor([True, True]))
        tensor([[ True, False],
                [ True, False],
                [False, False]])
        >>> locked_entities(steps, 4, torch.tensor([True, True]))
        tensor([[ True, False],
                [ True, False],
                [False, False]])
    """
    if isinstance(rule, int):
        return steps <= rule
    never = min(NEVER, torch.iinfo(steps.dtype).max)
    first = steps.where(competing, never).amin(-1, keepdim=True)
    locked = (steps == 0) | ((steps == first) & (first < never))
    if isinstance(rule, torch.Tensor):
        locked |= steps <= rule.clamp(max=never - 1)
    return locked


def hold_entities(scores: torch.Tensor, locked: torch.Tensor) -> torch.Tensor:
    """Returns scores in which locked entities count as influenced.

    Args:
        scores (torch.Tensor): ``[n, N]``, or graphs ``[n, N + 1, N]``; they are not
            changed.
        locked (torch.Tensor): bool ``[n, N]``.

    Returns:
        torch.Tensor: floating point, NaN for locked entities, or in graphs for the
        action's link to them. NaN counts as influence with any threshold.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.lookahead import hold_entities
        >>> hold_entities(torch.zeros(1, 2), torch.tensor([[True, False]]))
        tensor([[nan, 0.]])
    """
    if not scores.is_floating_point():
        scores = scores.float()
    if scores.ndim == 2:
        return scores.masked_fill(locked, torch.nan)
    held = scores.clone()
    held[:, -1].masked_fill_(locked, torch.nan)
    return held


class _Built(NamedTuple):
    """A table, and what it was built from.

    Attributes:
        revision (tuple): the revision of the storage.
        trajectories (TrajectoryIndex or TrajectoryTail): the trajectories.
        table (torch.Tensor): ``[capacity, N]``.
        own (int): the later states in each score.
        competing (torch.Tensor): bool ``[N]``.
    """

    revision: tuple[Any, ...]
    trajectories: TrajectoryIndex | TrajectoryTail
    table: torch.Tensor
    own: int
    competing: torch.Tensor


class Lookahead:
    """The entities that stored rows lock, computed when their buffer is first sampled.

    The table has one byte for each row and entity, or two with the rule ``"goal"``.
    After rows were added at the end, or have replaced the oldest ones, it is computed
    again for the trajectories that were written to; after any other write, for all. A
    row whose score is missing, or that of another state, counts as influenced.

    Args:
        rule (int or str): see :func:`locked_entities`; with ``"goal"`` batches have the
            steps to their goals.
        layout (EntityLayout): the entities.

    Keyword Args:
        score_key (NestedKey): the scores.
        keys (TransformKeys): trajectory ids and end flags.
        free (callable): maps the scores of single rows, ``[n, ...]``, to bool
            ``[n, N]``, the entities that may be swapped in these rows.
        competing (callable): returns the entities that can be the next one, ``[N]``.
    """

    def __init__(
        self,
        rule: int | Literal["next", "goal"],
        layout: EntityLayout,
        *,
        score_key: NestedKey,
        keys: TransformKeys,
        free: Callable[[torch.Tensor], torch.Tensor],
        competing: Callable[[], torch.Tensor],
    ) -> None:
        self.rule: int | Literal["next", "goal"] = rule
        self.layout = layout
        self.score_key = score_key
        self.keys = keys
        self._free = free
        self._competing = competing
        self.refresh()

    def refresh(self) -> None:
        """Drops the tables, so that they are built again."""
        self._tables: weakref.WeakKeyDictionary[Any, _Built] = (
            weakref.WeakKeyDictionary()
        )
        self._seen = threading.local()  # the revision at the last batch of a thread

    def table(self, source: ReplayBuffer | TensorStorage) -> torch.Tensor:
        """Returns what each row of a buffer locks.

        Args:
            source (ReplayBuffer or TensorStorage): the buffer, or its storage.

        Returns:
            torch.Tensor: bool ``[T, N]``; with the rule ``"goal"`` the steps to the
            next influence, int16 ``[T, N]``.

        Raises:
            KeyError: the scores, or trajectory ids and end flags, are missing.
            TypeError: the storage does not contain a tensordict.
            ValueError: the scores look further ahead than the rule.
        """
        with BUILDING, writes_paused(source):
            return self._table(source).clone()

    def _table(self, source: ReplayBuffer | TensorStorage) -> torch.Tensor:
        """Returns the table, which the next write may change, within the lock."""
        storage = source.storage if isinstance(source, ReplayBuffer) else source
        data = storage_rows(storage, "the storage of the buffer that samples")
        revision = storage_revision(storage)
        built = self._tables.pop(storage, None)  # of which an error leaves nothing
        if built is None or built.revision != revision:
            built = self._build(source, storage, data, built)._replace(
                revision=revision
            )
        self._tables[storage] = built
        return built.table[: len(storage)]

    def _build(
        self,
        source: ReplayBuffer | TensorStorage,
        storage: TensorStorage,
        data: TensorDictBase,
        before: _Built | None,
    ) -> _Built:
        if data.get(self.score_key, None) is None:
            raise KeyError(
                f"lookahead={self.rule!r} reads {self.score_key!r} of all rows of the "
                "storage, which lacks them: store them with score_buffer, or leave out "
                "lookahead"
            )
        record = read_record(storage, data, self.score_key)
        own = 0 if record is None else int(record["settings"]["lookahead"])
        if isinstance(self.rule, int) and self.rule < own:
            raise ValueError(
                f"lookahead is {self.rule}, but the scores in {self.score_key!r} "
                f"contain those of {own} later states: pass at least lookahead={own}, "
                "or score with score_buffer(..., lookahead=0)"
            )
        competing = self._competes = self._competing().to(
            data.get(self.score_key).device
        )
        keys = {"trajectory_key": self.keys.trajectory, "done_key": self.keys.done}
        is_same = before is not None and before.own == own
        if before is not None and is_same and torch.equal(before.competing, competing):
            tail = written_tail(before.trajectories, before.revision, source, **keys)
            if tail is not None:
                built = before._replace(trajectories=tail)
                position = torch.arange(tail.start, tail.length)
                scores = self._scores(data, tail.rows(position))
                self._fill(built, scores, tail.start)
                return built
        record_writes(storage)
        scores = valid_scores(data, self.score_key, self.layout, len(storage))
        table = torch.empty(
            len(data),  # later rows have their place
            len(self.layout),
            dtype=torch.int16 if self.rule == "goal" else torch.bool,
            device=scores.device,
        )
        built = _Built((), trajectory_index(source, **keys), table, own, competing)
        self._fill(built, scores, None)
        return built

    def _scores(self, data: TensorDictBase, rows: torch.Tensor) -> torch.Tensor:
        """Returns the scores of rows, as :func:`valid_scores` does."""
        states = self.layout.in_keys
        part = data.select(
            self.score_key,
            fingerprint_key(self.score_key),
            *states,
            *(self.layout.next(key) for key in states),
            strict=False,
        )[rows.to(data.device or "cpu")]
        return valid_scores(part, self.score_key, self.layout, len(rows))

    def _fill(self, built: _Built, scores: torch.Tensor, first: int | None) -> None:
        """Fills the table, of whole trajectories at a time, as no others depend on one.

        Args:
            built (_Built): the table, and the trajectories.
            scores (torch.Tensor): the scores, by row, or in the order of time.
            first (int, optional): the position of the first ones in the order of time,
                where to begin.
        """
        index, table = built.trajectories, built.table
        size = max(1, _CHUNK // scores[0].numel())
        ends, start = index.ends.cpu(), first or 0
        while start < index.length:
            at = torch.searchsorted(ends, min(start + size, index.length) - 1)
            stop = int(ends[at]) + 1
            position = torch.arange(start, stop, device=index.ends.device)
            end = index.ends[torch.searchsorted(index.ends, position)]
            rows = index.rows(position).to(table.device)
            own = rows if first is None else (position - first).to(table.device)
            parts = own.split(size)  # of a long trajectory
            influenced = torch.cat([~self._free(scores[part]) for part in parts])
            steps = _steps(influenced, (end - position).to(table.device))
            steps += built.own * ((steps > 0) & (steps < NEVER))
            if self.rule == "goal":
                steps = steps.clamp(max=_MOST).where(steps < NEVER, _MOST + 1)
                table[rows] = steps.to(table.dtype)
            else:
                table[rows] = locked_entities(steps, self.rule, built.competing)
            start = stop

    def sampled(
        self, batch: TensorDictBase
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Returns what the rows of a batch lock that a buffer is sampling.

        Args:
            batch (TensorDictBase): the batch, ``[B]``.

        Returns:
            tuple of torch.Tensor: as of :meth:`locked`.

        Raises:
            RuntimeError: no buffer is sampling it; and as :meth:`locked`.
        """
        found = sampled_rows()
        if found is None:
            raise RuntimeError(
                f"lookahead={self.rule!r} reads the trajectories of the buffer that "
                "samples, but this batch is not sampled from a buffer: get it by "
                "rb.sample() of the buffer that the transform is appended to"
            )
        return self.locked(*found, batch)

    def locked(
        self, source: ReplayBuffer, index: Any, drawn: Any, batch: TensorDictBase
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Returns what the rows of a batch lock.

        Other threads may write to the buffer after the batch was drawn. A row that was
        replaced in between locks every entity, since its trajectory is unknown.

        Args:
            source (ReplayBuffer): the buffer that samples.
            index (torch.Tensor or tuple): the rows that it drew.
            drawn (TensorDictBase): what it read there, ``[B]``.
            batch (TensorDictBase): the batch, ``[B]``. Its scores, and fingerprints if
                there are any, are compared with those that were drawn.

        Returns:
            tuple of torch.Tensor: bool ``[B, N]``; and on an accelerator, which is not
            waited for, bool ``[]``, whether the batch consists of other rows, if that
            is not known.

        Raises:
            KeyError: the batch lacks the steps to its goals, with the rule ``"goal"``.
            RuntimeError: the batch does not consist of these rows, or those of several
                buffers; or its scores or trajectory ids were changed. With the rule
                ``"goal"`` also: no :class:`~torchrl_caiac.transforms.WindowGoal` of the
                buffer has the same keys.
            ValueError: next states are several steps later, with the rule ``"goal"``.
        """
        storage = source.storage
        if isinstance(storage, StorageEnsemble):
            raise RuntimeError(
                f"lookahead={self.rule!r} reads the trajectories of one buffer, but a "
                f"{type(source).__name__} samples: join the data in one buffer, sample "
                "the buffers one by one, or leave out lookahead"
            )
        rows = flat_rows(index, storage)
        own = (self.score_key, fingerprint_key(self.score_key))
        device = leaf_of(batch, self.score_key).device
        late = LateCheck.needed(device)
        same = len(rows) == len(batch)
        differing = _differing(batch, drawn, own) if same else None
        differs = None if differing is None else differing.any()
        if not same or (differs is not None and not late and bool(differs)):
            raise RuntimeError(
                "the batch does not have the rows that the buffer drew, so that the "
                "trajectories of its rows are unknown: append this transform before "
                "others that select, repeat or reorder rows, or leave out lookahead"
            )
        with BUILDING, writes_paused(source):  # no write between table and rows
            found = pick_rows(self._table(source), rows).to(device)
            keys = own if self.keys.trajectory is None else (*own, self.keys.trajectory)
            replaced = _differing(batch, storage_rows(storage), keys, rows)
            revision = storage_revision(storage)
        last = getattr(self._seen, "last", None)
        self._seen.last = weakref.ref(storage), revision
        if last is not None and last[0]() is storage and last[1] == revision:
            # Nothing was written since this thread drew, so that no row was replaced.
            if replaced is not None:
                other = replaced.any()
                differs = other if differs is None else differs | other
            if differs is not None and not late and bool(differs):
                raise RuntimeError(
                    f"{self.score_key!r}, or the trajectory ids, of the batch are not "
                    "those of the storage: append this transform before those that "
                    "change them in place, or leave out lookahead"
                )
        if self.rule == "goal":
            competing = self._competes.to(device)
            found = locked_entities(found, self._goal_steps(source, batch), competing)
        if replaced is not None:
            found = found | replaced.unsqueeze(-1)
        return found, differs if late else None

    def _goal_steps(self, source: ReplayBuffer, batch: TensorDictBase) -> torch.Tensor:
        """Returns the steps to the goals that the buffer drew for a batch."""
        remedy = "append WindowGoal before this transform, or use lookahead='next'"
        drawing = [
            part for part in source.transform.modules() if isinstance(part, WindowGoal)
        ]
        if not any(part.keys == self.keys for part in drawing):
            raise RuntimeError(
                "lookahead='goal' needs goals that the buffer draws: "
                + ("pass the same keys= to WindowGoal" if drawing else remedy)
            )
        if batch.get(STEPS_KEY, None) is not None:
            raise ValueError(
                f"the batch has {STEPS_KEY!r}, so that its goals are several steps "
                "after the row that they are of, but lookahead='goal' counts single "
                "steps: leave out MultiStepTransform, or use a number of steps"
            )
        what = "lookahead='goal' needs the steps to the goal of each row, but there is"
        return get_leaf(batch, self.keys.goal_steps, what, remedy)

    def __getstate__(self) -> dict[str, Any]:
        left_out = ("_tables", "_seen")
        return {k: value for k, value in self.__dict__.items() if k not in left_out}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.refresh()


def _differing(
    batch: TensorDictBase,
    data: TensorDictBase,
    keys: tuple[NestedKey, ...],
    rows: torch.Tensor | None = None,
) -> torch.Tensor | None:
    """Returns which rows of a batch have other values than rows of the data.

    Args:
        batch (TensorDictBase): the batch, ``[B]``.
        data (TensorDictBase): the data.
        keys (tuple of NestedKey): the leaves, which may be missing.
        rows (torch.Tensor, optional): ``[B]``. Defaults to the first ``B``.

    Returns:
        torch.Tensor, optional: bool ``[B]``; ``None`` if it is known that none has.
    """
    differ: torch.Tensor | None = None
    for key in keys:
        leaf, found = leaf_of(batch, key), leaf_of(data, key)
        if leaf is None or found is None or leaf is found:
            continue
        found = plain(found)
        if rows is not None:
            if (
                leaf.device.type == "cpu"
                and (leaf.dtype, leaf.shape[1:]) == (found.dtype, found.shape[1:])
                and (rows.dtype, rows.shape) == (torch.int64, leaf.shape[:1])
                and is_native(leaf, rows, sources=[found])
                and rows_equal(leaf, found, rows)
            ):
                continue
            found = pick_rows(found, rows)
        other = found.to(leaf).nan_to_num() != leaf.nan_to_num()
        other = other.reshape(len(batch), -1).any(-1)
        differ = other if differ is None else differ | other
    return differ
