"""Drawing donors and swapping entities: the parts that augmentations share.

Every function here is pure: random draws take a generator, and applying a draw
returns new tensors. A *window* is ``window`` consecutive rows of a flat batch,
``B`` is the number of windows, ``C`` the number of counterfactual windows (the last
ones of the batch), ``N`` the number of entities.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac._random import draw_numbers
from torchrl_caiac._torchrl import last_written, storage_data, storage_revision
from torchrl_caiac.entities import EntityLayout, _flatten

__all__ = [
    "BufferDonors",
    "DonorIndex",
    "SwapDraw",
    "TrajectoryIndex",
    "apply_swap",
    "call_reward",
    "draw_batch_donors",
    "draw_buffer_donors",
    "eligible_starts",
    "recompute_reward",
    "stored_reward",
    "trajectory_index",
    "uninfluenced",
]

RewardFn = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]

# Rows of the storage that are looked at together while an index is built.
_CHUNK = 1 << 20
# Far above any number of donors, so that the remainder is uniform for all purposes.
_RANDOM_BITS = 1 << 62


class SwapDraw(NamedTuple):
    """What was drawn for one batch: who swaps, and with whom.

    Attributes:
        donors (torch.Tensor): int64 ``[C, N]``, the first row of each entity's donor
            window, a row of the batch or of the donor storage. Meaningless where
            nothing is swapped.
        swapped (torch.Tensor): bool ``[C, N]``.
        no_donor (torch.Tensor): int64 ``[N]``, the windows whose entity should have
            been swapped and found no donor.
        goal_rows (torch.Tensor, optional): int64 ``[C, N]``, the row of the donor
            storage whose next state is the goal of the donor window.
    """

    donors: torch.Tensor
    swapped: torch.Tensor
    no_donor: torch.Tensor
    goal_rows: torch.Tensor | None = None


class TrajectoryIndex(NamedTuple):
    """Where the trajectories of a storage end, in the order of time.

    The row ``r`` of a storage is at position ``(r - oldest) % length``; positions
    count from the oldest row, so that no trajectory wraps around.

    Attributes:
        length (int): rows in the storage, ``T``.
        oldest (int): the oldest row, behind the write cursor of a full ring buffer.
        ends (torch.Tensor): int64 ``[E]``, ascending positions of last rows.
        left (torch.Tensor, optional): integer ``[T]``, how many rows of the same
            trajectory follow each row; saves searching for it.
    """

    length: int
    oldest: int
    ends: torch.Tensor
    left: torch.Tensor | None = None

    def position(self, rows: torch.Tensor) -> torch.Tensor:
        """The positions of rows ``[*]``, int64 ``[*]``."""
        return (rows - self.oldest) % self.length

    def rows(self, position: torch.Tensor) -> torch.Tensor:
        """The rows at positions ``[*]``, int64 ``[*]``."""
        return (position + self.oldest) % self.length

    def remaining(self, rows: torch.Tensor) -> torch.Tensor:
        """How many rows of the same trajectory follow each row, int64 ``[*]``."""
        if self.left is not None:
            return _pick(self.left, rows).long()
        position = self.position(rows)
        return _pick(self.ends, torch.searchsorted(self.ends, position)) - position


class DonorIndex(NamedTuple):
    """The rows of a storage at which donor windows may start, entity by entity.

    Attributes:
        starts (torch.Tensor): integer ``[M]``, the rows for the first entity, then
            for the second, and so on.
        offset (torch.Tensor): int64 ``[N]``, where an entity's rows begin.
        size (torch.Tensor): int64 ``[N]``, how many it has.
    """

    starts: torch.Tensor
    offset: torch.Tensor
    size: torch.Tensor


# --- drawing -------------------------------------------------------------------------


def uninfluenced(
    scores: torch.Tensor, threshold: float, window: int = 1
) -> torch.Tensor:
    """The entities that are uninfluenced in all rows of each window (eq. 3.3 and 1).

    Args:
        scores (torch.Tensor): ``[B * window, N]``; a row that was not scored (NaN) is
            not uninfluenced.
        threshold (float): the largest score of an uninfluenced entity, θ.
        window (int): rows a window. Defaults to 1.

    Returns:
        torch.Tensor: bool ``[B, N]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.donors import uninfluenced
        >>> uninfluenced(torch.tensor([[0.0], [0.01], [0.0], [0.2]]), 0.05, window=2)
        tensor([[ True],
                [False]])
    """
    return _window_max(scores, window) <= threshold


def _window_max(scores: torch.Tensor, window: int) -> torch.Tensor:
    """The largest score of each window, ``[B, ...]``, NaN where one is NaN."""
    if window == 1:
        return scores
    # Over the outermost dimension, which is several times as fast.
    return scores.unflatten(0, (-1, window)).transpose(0, 1).contiguous().amax(0)


def _wanted(
    free: torch.Tensor, swap_prob: float, generator: torch.Generator | None
) -> torch.Tensor:
    if swap_prob >= 1.0:
        return free
    chance = draw_numbers(
        torch.rand, free.shape, device=free.device, generator=generator
    )
    return free & (chance < swap_prob)


@lru_cache(maxsize=64)
def _window_starts(windows: int, window: int, device: torch.device) -> torch.Tensor:
    """The first row of each window, int64 ``[B]``; not to be written to."""
    return torch.arange(0, windows * window, window, device=device)


def draw_batch_donors(
    free: torch.Tensor,
    num_counterfactual: int,
    *,
    window: int = 1,
    swap_prob: float = 1.0,
    generator: torch.Generator | None = None,
) -> SwapDraw:
    """Draws donors among the windows of the batch itself.

    Each entity of each of the last windows draws one of the *other* windows in which
    it is free too, all with the same probability and independently of the other
    entities.

    Args:
        free (torch.Tensor): bool ``[B, N]``, the entities that may be swapped.
        num_counterfactual (int): how many windows become counterfactual, ``C``.

    Keyword Args:
        window (int): rows a window. Defaults to 1.
        swap_prob (float): probability of swapping a free entity. Defaults to 1.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        SwapDraw: the donors as rows of the batch.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.donors import draw_batch_donors
        >>> free = torch.tensor([[True, False], [False, True], [True, True]])
        >>> draw = draw_batch_donors(free, 1)
        >>> draw.donors, draw.swapped
        (tensor([[0, 1]]), tensor([[True, True]]))
    """
    windows, entities = free.shape
    first = windows - num_counterfactual
    wanted = _wanted(free[first:], swap_prob, generator).t()
    free = free.t()
    # rank[n, b]: how many free windows entity n has up to and including window b.
    rank = free.cumsum(1)
    total, own = rank[:, -1:], rank[:, first:]
    # At least two, of which a remainder can be taken: with fewer there is no donor.
    size = total.clamp_min(2)
    pick = draw_numbers(
        torch.randint, _RANDOM_BITS, own.shape, device=free.device, generator=generator
    )
    # Round the circle of free windows from the one behind the own, never back to it.
    place = (pick % (size - 1) + own) % size
    # listed[n, r]: the free window of rank r, from 1; those that are not free end up
    # at 0.
    starts = _window_starts(windows, window, free.device).expand(entities, -1)
    listed = rank.new_zeros(entities, windows + 2)
    listed.scatter_(1, rank * free, starts)
    swapped = wanted & (total > 1)
    return SwapDraw(
        listed[:, 1:].gather(1, place).t(), swapped.t(), (wanted ^ swapped).sum(1)
    )


def draw_buffer_donors(
    free: torch.Tensor,
    index: DonorIndex,
    *,
    swap_prob: float = 1.0,
    generator: torch.Generator | None = None,
) -> SwapDraw:
    """Draws donors among the eligible windows of a donor storage.

    Args:
        free (torch.Tensor): bool ``[C, N]``, the entities that may be swapped.
        index (DonorIndex): the eligible windows.

    Keyword Args:
        swap_prob (float): probability of swapping a free entity. Defaults to 1.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        SwapDraw: the donors as rows of the storage.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.donors import DonorIndex, draw_buffer_donors
        >>> index = DonorIndex(
        ...     torch.tensor([7]), torch.tensor([0, 1]), torch.tensor([1, 0])
        ... )
        >>> draw_buffer_donors(torch.ones(1, 2, dtype=torch.bool), index).swapped
        tensor([[ True, False]])
    """
    device = free.device
    wanted = _wanted(free, swap_prob, generator)
    size = index.size.to(device)
    pick = draw_numbers(
        torch.randint, _RANDOM_BITS, free.shape, device=device, generator=generator
    )
    pick = (pick % size.clamp_min(1) + index.offset.to(device)).clamp_max_(
        index.starts.shape[0] - 1
    )
    found = size > 0
    donors = _pick(index.starts, pick).to(device, torch.int64)
    swapped = wanted & found
    return SwapDraw(donors, swapped, (wanted ^ swapped).sum(0))


# --- what may be drawn from a storage ------------------------------------------------


def _plain(tensor: torch.Tensor) -> torch.Tensor:
    # Indexing a memory-mapped tensor as a plain one skips its Python dispatch.
    return tensor.as_subclass(torch.Tensor)


def _pick(source: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """``source[rows]`` for rows of any shape, several times as fast."""
    found = source.index_select(0, rows.to(source.device).reshape(-1))
    return found.view(*rows.shape, *source.shape[1:])


def _storage_td(storage: Any, what: str) -> TensorDictBase:
    if not isinstance(storage, TensorStorage) or storage.ndim != 1:
        raise TypeError(
            f"{what} needs a one-dimensional TensorStorage (LazyTensorStorage, "
            f"LazyMemmapStorage, ...), got {type(storage).__name__} with ndim "
            f"{getattr(storage, 'ndim', None)}"
        )
    return storage_data(storage, what)


def trajectory_index(
    storage: TensorStorage,
    *,
    trajectory_key: NestedKey = "episode",
    done_key: NestedKey = ("next", "done"),
) -> TrajectoryIndex:
    """Finds where the trajectories of a storage end.

    A trajectory ends where the id in ``trajectory_key`` changes; where the storage
    has no such leaf, at ``done_key``. The newest row, under the write cursor of a
    ring buffer, is always an end. The index takes 4 bytes a row.

    Args:
        storage (TensorStorage): one-dimensional, ``[T]``.

    Keyword Args:
        trajectory_key (NestedKey): trajectory ids ``[T]`` or ``[T, 1]``.
        done_key (NestedKey): the end flags ``[T]`` or ``[T, 1]`` used without ids.

    Returns:
        TrajectoryIndex: the ends.

    Raises:
        KeyError: the storage has neither leaf.
        ValueError: the storage is empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac.transforms.donors import trajectory_index
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(5))
        >>> _ = rb.extend(TensorDict({"episode": torch.tensor([0, 0, 1])}, [3]))
        >>> trajectory_index(rb.storage).ends
        tensor([1, 2])
    """
    data = _storage_td(storage, "the storage")
    length = len(storage)
    ids = data.get(trajectory_key, None)
    leaf = data.get(done_key, None) if ids is None else ids
    if leaf is None:
        raise KeyError(
            f"the storage has neither trajectory ids in {trajectory_key!r} nor end "
            f"flags in {done_key!r}, so windows cannot be told apart: name the leaf "
            "that it has by trajectory_key"
        )
    cursor = last_written(storage)
    full = length == storage.max_size
    oldest = (int(cursor) + 1) % length if full and cursor is not None else 0
    leaf = _plain(leaf)[:length].reshape(length)
    if oldest:
        leaf = leaf.roll(-oldest)
    last = torch.ones(length, dtype=torch.bool, device=leaf.device)
    last[:-1] = leaf[:-1].bool() if ids is None else leaf[1:] != leaf[:-1]
    ends = last.nonzero()[:, 0]
    dtype = torch.int32 if length < 1 << 31 else torch.int64
    left = ends.to(dtype).repeat_interleave(ends.diff(prepend=ends.new_tensor([-1])))
    left -= torch.arange(length, dtype=dtype, device=left.device)
    return TrajectoryIndex(length, oldest, ends, left.roll(oldest) if oldest else left)


def _scan(
    values: torch.Tensor,
    step: int,
    window: int,
    trajectories: TrajectoryIndex | None,
    what: str,
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Reads a leaf of the donors part by part, in the order of time.

    A part is the rows of ``step`` windows, so that parts overlap by ``window - 1``.
    """
    if window > 1 and trajectories is None:
        raise ValueError("windows of several rows need the trajectories of the storage")
    length = values.shape[0]
    oldest = 0 if trajectories is None else trajectories.oldest
    for begin in range(0, length - window + 1, step):
        end = min(begin + step + window - 1, length)
        rows = (torch.arange(begin, end, device=values.device) + oldest) % length
        part = values[rows]
        infinite = torch.isinf(part)
        if infinite.any():
            row = int(rows[infinite.flatten(1).any(1).nonzero()[0, 0]])
            raise ValueError(
                f"the {what} of the donors are infinite in row {row}: score the buffer "
                "anew with score_buffer(..., overwrite=True)"
            )
        yield rows, part


def eligible_starts(
    scores: torch.Tensor,
    threshold: float,
    swappable: torch.Tensor,
    *,
    window: int = 1,
    trajectories: TrajectoryIndex | None = None,
) -> DonorIndex:
    """Finds the rows at which a window starts that an entity passes uninfluenced.

    All rows of such a window belong to one trajectory and have scores of at most
    ``threshold``; a row without a score (NaN) is never part of one. The index takes
    4 bytes for each pair of row and entity that is eligible.

    Args:
        scores (torch.Tensor): ``[T, N]``, NaN where a row was not scored.
        threshold (float): the largest score of an uninfluenced entity, θ.
        swappable (torch.Tensor): bool ``[N]``; other entities get no rows.

    Keyword Args:
        window (int): rows a window. Defaults to 1.
        trajectories (TrajectoryIndex, optional): needed for windows of several rows.

    Returns:
        DonorIndex: the rows of every entity.

    Raises:
        ValueError: a score is infinite.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.donors import eligible_starts
        >>> scores = torch.tensor([[0.0], [0.2], [float("nan")], [0.01]])
        >>> eligible_starts(scores, 0.05, torch.tensor([True])).starts
        tensor([0, 3], dtype=torch.int32)
    """
    length, entities = scores.shape
    device = scores.device
    dtype = torch.int32 if length < 1 << 31 else torch.int64
    found: list[list[torch.Tensor]] = [[] for _ in range(entities)]
    chosen = swappable.nonzero()[:, 0].tolist()
    for rows, part in _scan(scores, _CHUNK, window, trajectories, "scores"):
        free = part <= threshold
        if window > 1 and trajectories is not None:
            held = (~free).cumsum(0, dtype=torch.int32)
            before = torch.cat([torch.zeros_like(held[:1]), held])
            free = before[window:] == before[:-window]
            rows = rows[: free.shape[0]]
            free &= (trajectories.remaining(rows) >= window - 1).unsqueeze(-1)
        for entity in chosen:
            found[entity].append(rows[free[:, entity]].to(dtype))
    lists = [torch.cat(f) if f else torch.empty(0, dtype=dtype) for f in found]
    lists = [rows.to(device) for rows in lists]
    size = torch.tensor([rows.numel() for rows in lists], device=device)
    starts = torch.cat(lists)
    if not starts.numel():  # an index needs a row to point at
        starts = torch.zeros(1, dtype=dtype, device=device)
    return DonorIndex(starts, size.cumsum(0) - size, size)


class BufferDonors:
    """A replay buffer whose windows donate entities.

    The index of eligible windows is built at the first draw and again only after the
    buffer was written to, as told by the storage's own revision. Rows are read leaf
    by leaf, and of each leaf only what an entity needs.

    Args:
        donors (ReplayBuffer or TensorStorage): the donors, with the same entities as
            the batch and scores in ``score_key``.
        layout (EntityLayout): the entities.

    Keyword Args:
        threshold (float): the largest score of an uninfluenced entity.
        window (int): rows a window.
        score_key (NestedKey): the scores, ``[T, N]``.
        trajectory_key (NestedKey): the trajectory ids, ``[T]``.
        done_key (NestedKey): the end flags, read where there are no ids.
        goals (WindowGoal, optional): draws the goals of donor windows.
    """

    _what: ClassVar[str] = "scores"
    _key_argument: ClassVar[str] = "score_key"

    def __init__(
        self,
        donors: ReplayBuffer | TensorStorage,
        layout: EntityLayout,
        *,
        threshold: float,
        window: int,
        score_key: NestedKey,
        trajectory_key: NestedKey,
        done_key: NestedKey,
        goals: Any | None = None,
    ) -> None:
        if not isinstance(donors, (ReplayBuffer, TensorStorage)):
            raise TypeError(
                "donors is a ReplayBuffer (or its storage), or None to draw from the "
                f"batch; got {type(donors).__name__}"
            )
        self.donors = donors
        self.layout = layout
        self.threshold = threshold
        self.window = window
        self.score_key = score_key
        self.trajectory_key = trajectory_key
        self.done_key = done_key
        self.goals = goals
        self._built: tuple[Any, Any, TrajectoryIndex | None] | None = None

    @property
    def feature_shape(self) -> tuple[int, ...]:
        """The shape of one row's scores, ``(N,)``."""
        return (len(self.layout),)

    @property
    def storage(self) -> TensorStorage:
        """The storage of the donors."""
        if isinstance(self.donors, TensorStorage):
            return self.donors
        return self.donors.storage

    @property
    def data(self) -> TensorDictBase:
        """The storage's own tensordict, which may be longer than its content."""
        return _storage_td(self.storage, "the donor buffer")

    def _eligible(
        self, scores: torch.Tensor, trajectories: TrajectoryIndex | None
    ) -> Any:
        return eligible_starts(
            scores,
            self.threshold,
            ~self.layout.fixed_mask.to(scores.device),
            window=self.window,
            trajectories=trajectories,
        )

    def _choose(self, free: torch.Tensor, index: Any, **kwargs: Any) -> SwapDraw:
        return draw_buffer_donors(free, index, **kwargs)

    def index(self) -> tuple[Any, TrajectoryIndex | None]:
        """The eligible windows, and the trajectories where they are needed.

        Raises:
            KeyError: the donors have no scores.
            ValueError: the buffer is empty, or its scores have the wrong width.
        """
        storage = self.storage
        data = self.data
        revision = storage_revision(storage)
        if self._built is None or self._built[0] != revision:
            length = len(storage)
            scores = data.get(self.score_key, None)
            if scores is None:
                raise KeyError(
                    f"the donor buffer has no {self._what} in {self.score_key!r}: call "
                    f"score_buffer on it, or name their key by {self._key_argument}"
                )
            wanted = (scores.shape[0], *self.feature_shape)
            if tuple(scores.shape) != wanted:
                raise ValueError(
                    f"the donor buffer's {self.score_key!r} has shape "
                    f"{list(scores.shape)}, wanted {list(wanted)} for the entities "
                    f"{list(self.layout.names)}: its layout is another one"
                )
            trajectories = None
            if self.window > 1 or self.goals is not None:
                trajectories = trajectory_index(
                    storage,
                    trajectory_key=self.trajectory_key,
                    done_key=self.done_key,
                )
            eligible = self._eligible(_plain(scores)[:length], trajectories)
            self._built = (revision, eligible, trajectories)
        return self._built[1], self._built[2]

    def draw(
        self,
        free: torch.Tensor,
        *,
        swap_prob: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> SwapDraw:
        """Draws donors, and the goals of donor windows.

        Args:
            free (torch.Tensor): bool ``[C, N]``, the entities that may be swapped.

        Keyword Args:
            swap_prob (float): probability of swapping a free entity. Defaults to 1.
            generator (torch.Generator, optional): source of randomness.

        Returns:
            SwapDraw: donors and goals as rows of the donor storage.
        """
        index, trajectories = self.index()
        draw = self._choose(free, index, swap_prob=swap_prob, generator=generator)
        if self.goals is None or trajectories is None:
            return draw
        last = (draw.donors + self.window - 1) % trajectories.length
        rows = self.goals.draw_rows(last, trajectories, generator=generator)
        return draw._replace(goal_rows=rows)

    def apply(self, td: TensorDictBase, draw: SwapDraw) -> TensorDictBase:
        """Applies what :meth:`draw` returned, see :func:`apply_swap`."""
        _, trajectories = self.index()
        wraps = trajectories is not None and trajectories.oldest > 0
        return apply_swap(
            td,
            self.layout,
            draw,
            window=self.window,
            donors=self.data,
            num_donor_rows=len(self.storage) if wraps else None,
            goals=self.goals,
        )

    def refresh(self) -> None:
        """Has the index built anew: needed only after writing to raw tensors."""
        self._built = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_built": None}


class StorageCache:
    """Keeps what was derived from a storage until the storage changes.

    Args:
        build (callable): makes the value from a storage.
    """

    def __init__(self, build: Callable[[TensorStorage], TrajectoryIndex]) -> None:
        self._build = build
        self._built: tuple[Any, tuple[Any, ...], TrajectoryIndex] | None = None

    def get(self, storage: TensorStorage) -> TrajectoryIndex:
        """The value for the storage as it is now."""
        built = self._built
        revision = storage_revision(storage)
        if built is None or built[0]() is not storage or built[1] != revision:
            built = (weakref.ref(storage), revision, self._build(storage))
            self._built = built
        return built[2]


# --- applying ------------------------------------------------------------------------


class _Leaf(NamedTuple):
    key: NestedKey
    value: torch.Tensor
    # Nested layouts: the one entity; flat ones: the entity of each column, N for none.
    entity: int | torch.Tensor
    is_desired: bool = False


def goal_columns(layout: EntityLayout) -> list[int]:
    """The observation column that each goal column of a flat layout mirrors."""
    mirrored = {
        goal: observed
        for name, columns in layout.goal.items()
        for goal, observed in zip(columns, layout.achieved[name], strict=True)
    }
    return [mirrored[column] for column in range(layout.goal_width)]


def _column_entity(
    layout: EntityLayout, what: str, width: int, device: torch.device
) -> torch.Tensor:
    known = layout._tensors.get(((what, width), device))
    if known is not None:
        return known
    owner = (
        layout.column_entity(width) if what == "state" else layout.goal_column_entity()
    )
    owner = torch.where(owner < 0, len(layout), owner)
    return layout._index_tensor((what, width), owner.tolist(), device)


def _leaves(td: TensorDictBase, layout: EntityLayout) -> list[_Leaf]:
    """The leaves that follow a swap, as they are in the batch."""
    found: list[_Leaf] = []
    if not layout.is_flat:
        for number, name in enumerate(layout.names):
            if name in layout.fixed:
                continue
            keys = [(layout.keys[name], False), (layout.next(layout.keys[name]), False)]
            achieved, desired = layout.achieved.get(name), layout.goal.get(name)
            for key, is_desired in ((achieved, False), (desired, True)):
                if key is not None:
                    keys += [(key, is_desired), (layout.next(key), is_desired)]
            for position, (key, is_desired) in enumerate(keys):
                value = td.get(key, None)
                if value is None:
                    if position < 2:
                        layout.check(td, next=True)
                    continue
                found += _entity_leaves(key, value, number, is_desired)
        return found
    state, after = layout.observation_key, layout.next(layout.observation_key)
    for key in (state, after):
        value = td.get(key, None)
        if value is None or not isinstance(value, torch.Tensor):
            layout.check(td, next=True)
        if value.ndim != 2:
            raise ValueError(
                f"{key!r} has shape {list(value.shape)}, wanted [{td.shape[0]}, D]: "
                "the columns of a flat layout are those of a vector"
            )
        owner = _column_entity(layout, "state", value.shape[-1], value.device)
        found.append(_Leaf(key, value, owner))
    width = layout.goal_width
    for key, is_desired in (
        (layout.achieved_goal_key, False),
        (layout.next(layout.achieved_goal_key), False),
        (layout.desired_goal_key, True),
        (layout.next(layout.desired_goal_key), True),
    ):
        value = td.get(key, None)
        if value is None:
            continue
        if not layout.goal:
            if is_desired:
                continue
            raise ValueError(
                f"the batch has {key!r}, which must follow the swapped entities, but "
                "the layout does not say whose columns these are: give "
                "EntityLayout(..., goal=..., achieved=...)"
            )
        if value.ndim != 2 or value.shape[-1] != width:
            raise ValueError(
                f"{key!r} has shape {list(value.shape)}, but the layout's goal has "
                f"{width} columns: correct `goal`, or the data"
            )
        owner = _column_entity(layout, "goal", width, value.device)
        found.append(_Leaf(key, value, owner, is_desired))
    return found


def _entity_leaves(
    key: NestedKey, value: Any, entity: int, is_desired: bool
) -> list[_Leaf]:
    if isinstance(value, torch.Tensor):
        return [_Leaf(key, value, entity, is_desired)]
    path = (key,) if isinstance(key, str) else tuple(key)
    found: list[_Leaf] = []
    for name in tuple(value.keys()):
        below = value.get(name)
        if not isinstance(below, torch.Tensor) and not isinstance(
            below, TensorDictBase
        ):
            raise TypeError(
                f"{(*path, name)!r} is a {type(below).__name__}, but an entity is made "
                "of tensors: leave it out of the entity's sub-tensordict"
            )
        found += _entity_leaves((*path, name), below, entity, is_desired)
    return found


def _donor_leaf(donors: TensorDictBase, leaf: _Leaf) -> torch.Tensor:
    source = donors.get(leaf.key, None)
    if source is None:
        hint = (
            "give goals=WindowGoal(...), which draws them from the donors, or add "
            "the leaf to it"
            if leaf.is_desired
            else "its layout is another one"
        )
        raise KeyError(
            f"the donor buffer has no {leaf.key!r}, which the batch has: {hint}"
        )
    own = leaf.value
    if (
        not isinstance(source, torch.Tensor)
        or source.shape[1:] != own.shape[1:]
        or source.dtype != own.dtype
    ):
        found = (
            f"{list(source.shape[1:])} {source.dtype}"
            if isinstance(source, torch.Tensor)
            else type(source).__name__
        )
        raise ValueError(
            f"the donor buffer's {leaf.key!r} has rows of {found}, those of the batch "
            f"are {list(own.shape[1:])} {own.dtype}: donors need the same layout"
        )
    return _plain(source)


def apply_swap(
    td: TensorDictBase,
    layout: EntityLayout,
    draw: SwapDraw,
    *,
    window: int = 1,
    donors: TensorDictBase | None = None,
    num_donor_rows: int | None = None,
    goals: Any | None = None,
) -> TensorDictBase:
    """Replaces entities by those of their donors (the inner loop of Algorithm 1).

    The states, next states, achieved goals and desired goals of the last ``C``
    windows follow the swap; all else, and all other rows, stay.

    Args:
        td (TensorDictBase): the batch, ``[B * window]``. It is not changed.
        layout (EntityLayout): the entities.
        draw (SwapDraw): what was drawn.

    Keyword Args:
        window (int): rows a window. Defaults to 1.
        donors (TensorDictBase, optional): what ``draw.donors`` are rows of, a
            storage's data; the batch itself by default.
        num_donor_rows (int, optional): rows in use in ``donors``, after which windows
            go on at row 0 (the ring of a full buffer).
        goals (WindowGoal, optional): reads the desired goals at ``draw.goal_rows``.

    Returns:
        TensorDictBase: a shallow copy with new leaves where something may have been
        swapped.

    Raises:
        KeyError: a leaf is missing in the batch or in the donors.
        ValueError: a leaf has the wrong width, or the donors' leaf another shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms.donors import SwapDraw, apply_swap
        >>> state = torch.tensor([[0.0, 1.0], [2.0, 3.0]])
        >>> td = TensorDict(
        ...     {"observation": state, ("next", "observation"): state + 10}, [2]
        ... )
        >>> draw = SwapDraw(
        ...     donors=torch.tensor([[0, 0]]),
        ...     swapped=torch.tensor([[False, True]]),
        ...     no_donor=torch.tensor([0, 0]),
        ... )
        >>> out = apply_swap(td, EntityLayout({"arm": [0], "cup": [1]}), draw)
        >>> out["observation"], out["next", "observation"]
        (tensor([[0., 1.],
                [2., 1.]]), tensor([[10., 11.],
                [12., 11.]]))
    """
    out = td.copy()
    leaves = _leaves(td, layout)
    changed = draw.swapped.shape[0]
    if not changed:
        return out
    first = td.shape[0] - changed * window
    if donors is None:
        starts = _window_starts(len(td) // window, window, draw.swapped.device)
        own = starts[-changed:].unsqueeze(-1)
    else:
        own = draw.donors.new_zeros(changed, 1)
    # Where nothing is swapped, a row of the batch is its own donor; one more entity,
    # which never swaps, owns the columns that no entity owns.
    rows = torch.cat([torch.where(draw.swapped, draw.donors, own), own], -1)
    # Leaves of the same columns share their index and mask.
    index: dict[int, torch.Tensor] = {}
    masks: dict[tuple[int, int], torch.Tensor] = {}
    for leaf in leaves:
        known = id(leaf.entity)
        if donors is not None and leaf.is_desired and goals is not None:
            values = goals.donor_goals(
                donors, draw.goal_rows, leaf.entity, leaf.key
            ).unsqueeze(1)
        else:
            source = leaf.value if donors is None else _donor_leaf(donors, leaf)
            if known not in index:
                index[known] = _window_index(
                    layout, rows, leaf, window, len(source), num_donor_rows
                ).to(source.device)
            values = _take(source, index[known], leaf.entity)
        if donors is not None:
            kind = known, leaf.value.ndim
            if kind not in masks:
                masks[kind] = _swapped_values(draw.swapped, leaf)
            tail = leaf.value[first:].unflatten(0, (changed, window))
            values = values.to(tail.device).view(changed, -1, *tail.shape[2:])
            values = torch.where(masks[kind], values, tail).flatten(0, 1)
        out.set(leaf.key, torch.cat([leaf.value[:first], values]))
    return out


def _window_index(
    layout: EntityLayout,
    rows: torch.Tensor,
    leaf: _Leaf,
    window: int,
    length: int,
    num_rows: int | None,
) -> torch.Tensor:
    """Where the values of each donor window lie in a leaf of ``length`` rows.

    Returns rows ``[C * window]`` for one entity's leaf; for columns, places
    ``[C * window * D]`` in the leaf laid out as one vector.
    """
    if isinstance(leaf.entity, int):
        shape: tuple[int, ...] = (window,)
        stride, place = 1, rows[:, leaf.entity]
    else:
        stride = leaf.value.shape[-1]
        shape = (window, stride)
        place = rows.gather(1, leaf.entity.to(rows.device).expand(rows.shape[0], -1))
    if length * stride < 1 << 31:  # half as much to write and to read
        place = place.int()
    inside = layout._index_tensor(
        ("inside", *shape), range(window * stride), rows.device, place.dtype
    )
    place = torch.add(inside.view(shape), place.unsqueeze(1), alpha=stride).flatten()
    return place if num_rows is None else place % (num_rows * stride)


def _swapped_values(swapped: torch.Tensor, leaf: _Leaf) -> torch.Tensor:
    """Which values of a leaf are swapped, to broadcast with ``[C, window, ...]``."""
    if isinstance(leaf.entity, int):
        return swapped[:, leaf.entity].view(-1, *(1,) * leaf.value.ndim)
    owner = leaf.entity.expand(swapped.shape[0], -1)
    return F.pad(swapped, (0, 1)).gather(1, owner).unsqueeze(1)


def _take(
    source: torch.Tensor, index: torch.Tensor, entity: int | torch.Tensor
) -> torch.Tensor:
    """Reads the rows, or the places of columns, that :func:`_window_index` returns.

    Returns ``[C * window, ...]``.
    """
    if isinstance(entity, int):
        return source.index_select(0, index)
    if source.is_contiguous():
        found = source.view(-1).index_select(0, index)
    else:  # flattening would copy all of it
        found = source.take(index.long())
    return found.view(-1, entity.shape[0])


def _goal_vectors(
    td: TensorDictBase, layout: EntityLayout, first: int
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """The next achieved and the desired goals of the rows from ``first`` on."""
    if layout.is_flat:
        desired = td.get(layout.desired_goal_key, None)
        achieved = td.get(layout.next(layout.achieved_goal_key), None)
        if achieved is None and layout.achieved:
            achieved = layout.achieved_goal(td, next=True)
        return (
            None if achieved is None else achieved[first:],
            None if desired is None else desired[first:],
        )
    achieved_parts: list[torch.Tensor] = []
    desired_parts: list[torch.Tensor] = []
    for name in layout.names:
        key = layout.goal.get(name)
        if key is None:
            continue
        for parts, where in (
            (
                achieved_parts,
                layout.achieved.get(name) and layout.next(layout.achieved[name]),
            ),
            (desired_parts, key),
        ):
            value = None if where is None else td.get(where, None)
            if value is None:
                return None, None
            value = value[first:]
            if isinstance(value, torch.Tensor):
                parts.append(value.reshape(len(value), -1))
            else:
                parts.append(_flatten(value, 1))
    if not desired_parts:
        return None, None
    return torch.cat(achieved_parts, -1), torch.cat(desired_parts, -1)


def recompute_reward(
    td: TensorDictBase,
    layout: EntityLayout,
    reward_fn: RewardFn,
    num_rows: int,
    *,
    reward_key: NestedKey = ("next", "reward"),
) -> torch.Tensor:
    """Computes the rewards of the last rows from their *next* achieved goals.

    Args:
        td (TensorDictBase): the batch after swapping, ``[R]``.
        layout (EntityLayout): the entities. A nested layout's goals are laid side by
            side, flattened, in layout order.
        reward_fn (callable): ``(next_achieved [C, G], desired [C, G])`` to rewards
            ``[C]`` or ``[C, 1]``.
        num_rows (int): how many rows get a new reward, ``C``.

    Keyword Args:
        reward_key (NestedKey): the rewards ``[R]`` or ``[R, 1]``.

    Returns:
        torch.Tensor: all rewards, shape and dtype as before.

    Raises:
        KeyError: goals or rewards are missing.
        ValueError: the function returned another number of rewards.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms.donors import recompute_reward
        >>> layout = EntityLayout(
        ...     {"cup": [0]}, goal={"cup": [0]}, achieved={"cup": [0]}
        ... )
        >>> td = TensorDict(
        ...     {
        ...         "desired_goal": torch.ones(2, 1),
        ...         "next": {
        ...             "observation": torch.tensor([[0.0], [3.0]]),
        ...             "reward": torch.zeros(2, 1),
        ...         },
        ...     },
        ...     [2],
        ... )
        >>> recompute_reward(td, layout, lambda a, d: -(a - d).norm(dim=-1), 1)
        tensor([[ 0.],
                [-2.]])
    """
    reward = stored_reward(td, reward_key)
    first = reward.shape[0] - num_rows
    achieved, desired = _goal_vectors(td, layout, first)
    if achieved is None or desired is None:
        what = "next achieved goals" if achieved is None else "desired goals"
        raise KeyError(
            f"reward_fn is given, but the batch has no {what}: the layout looks under "
            f"{layout.desired_goal_key!r} and {layout.achieved_goal_key!r} (or its "
            "`goal` and `achieved` keys)"
        )
    new = call_reward(reward_fn, achieved, desired, reward[first:])
    return torch.cat([reward[:first], new])


def stored_reward(td: TensorDictBase, reward_key: NestedKey) -> torch.Tensor:
    """The rewards of a batch.

    Args:
        td (TensorDictBase): the batch ``[B]``.
        reward_key (NestedKey): the rewards.

    Returns:
        torch.Tensor: ``[B]`` or ``[B, 1]``.

    Raises:
        KeyError: there are none.
        ValueError: there is not one for each row.
    """
    reward = td.get(reward_key, None)
    if reward is None:
        raise KeyError(
            f"reward_fn is given, but the batch has no {reward_key!r}: name the "
            "rewards by reward_key"
        )
    if reward.numel() != td.shape[0]:
        raise ValueError(
            f"{reward_key!r} has shape {list(reward.shape)}, wanted "
            f"[{td.shape[0]}, 1]: one reward for each row"
        )
    return reward


def call_reward(
    reward_fn: RewardFn,
    achieved: torch.Tensor,
    desired: torch.Tensor,
    like: torch.Tensor,
) -> torch.Tensor:
    """Calls a reward function, and gives its rewards the shape of stored ones.

    Args:
        reward_fn (callable): ``(next_achieved [B, G], desired [B, G])`` to rewards
            ``[B]`` or ``[B, 1]``.
        achieved (torch.Tensor): ``[B, G]``, the next achieved goals.
        desired (torch.Tensor): ``[B, G]``.
        like (torch.Tensor): rewards ``[B]`` or ``[B, 1]``.

    Returns:
        torch.Tensor: the rewards, shape, dtype and device of ``like``.

    Raises:
        ValueError: the function returned another number of rewards.
    """
    new = reward_fn(achieved, desired)
    rows = achieved.shape[0]
    shape = tuple(new.shape) if isinstance(new, torch.Tensor) else None
    if shape not in ((rows,), (rows, 1)):
        found = type(new).__name__ if shape is None else list(shape)
        raise ValueError(
            f"reward_fn returned {found} for goals {list(achieved.shape)}, wanted "
            f"[{rows}] or [{rows}, 1]"
        )
    return new.reshape(like.shape).to(like)


def _number(name: str, value: Any, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name} is a number, got {value!r}")
    if not 0 <= value <= high or not math.isfinite(value):
        limits = f"in [0, {high:g}]" if math.isfinite(high) else "finite, at least 0"
        raise ValueError(f"{name} is {limits}, got {value!r}")
    return float(value)
