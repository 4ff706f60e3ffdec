"""Scores every stored state once and keeps the scores beside the data."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.data import ReplayBuffer, TensorStorage
from torchrl.envs.transforms import Transform
from tqdm.auto import tqdm

from torchrl_caiac._torchrl import (
    add_revision,
    drop_memmap_leaf,
    drop_prefetched,
    forget_leaves,
    known_to_be_memmap,
    memmap_folder,
    storage_data,
)
from torchrl_caiac.data.trajectories import TrajectoryEnds, newest_row
from torchrl_caiac.entities import EntityLayout, _path

__all__ = ["MarkUnscored", "score_buffer", "score_file"]

_FORMAT = "torchrl_caiac.scores"
_VERSION = 1
_NAMED = 8  # rows named in an error
_SAMPLE = 4096  # states that an estimator may look at before it scores


class MarkUnscored(Transform):
    """Marks rows as not scored when they are written into a replay buffer.

    It writes NaN into the score leaf of everything that is written, whatever leaf the
    incoming rows hold: a score is good for one place in one trajectory, and an old one
    must never pass for a new one. :func:`score_buffer` appends it to the buffers that
    it scores. Append it yourself to a buffer that is written before it is scored again
    in this process (one loaded from disk). Sampling passes it untouched.

    Args:
        key (NestedKey): the score leaf.
        feature_shape (tuple of int): the shape of a row's scores: ``(N,)``, or
            ``(N + 1, N)`` for graphs.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac.influence.score_buffer import MarkUnscored
        >>> rb = ReplayBuffer(
        ...     storage=LazyTensorStorage(4),
        ...     transform=MarkUnscored(("caiac", "score"), (2,)),
        ... )
        >>> _ = rb.extend(TensorDict({"observation": torch.zeros(3, 5)}, [3]))
        >>> rb[:]["caiac", "score"].isnan().all()
        tensor(True)
    """

    def __init__(self, key: NestedKey, feature_shape: tuple[int, ...]) -> None:
        super().__init__()
        self.key = unravel_key(key)
        self.feature_shape = tuple(int(size) for size in feature_shape)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns a sample as it is."""
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = (*tensordict.batch_size, *self.feature_shape)
        unscored = torch.full(shape, torch.nan, device=tensordict.device)
        return tensordict.set(self.key, unscored)

    def extra_repr(self) -> str:
        """The settings, for ``repr``."""
        return f"key={self.key!r}, feature_shape={self.feature_shape}"


def score_file(folder: str | Path, key: NestedKey = ("caiac", "score")) -> Path:
    """The file beside a memmap storage that says how its scores were made.

    Args:
        folder (str or Path): the folder of the memmap tensordict.
        key (NestedKey): the score leaf. Defaults to ``("caiac", "score")``.

    Returns:
        Path: the file, whether it is there or not.

    Examples:
        >>> from torchrl_caiac.influence.score_buffer import score_file
        >>> score_file("data").name
        'caiac.score.json'
    """
    return Path(folder) / f"{'.'.join(_path(key))}.json"


@torch.no_grad()
def score_buffer(
    rb: ReplayBuffer,
    estimator: Callable[[TensorDictBase], torch.Tensor],
    batch_size: int = 4096,
    smoothing: int = 1,
    *,
    key: NestedKey = ("caiac", "score"),
    lookahead: int = 1,
    trajectory_key: NestedKey | None = "episode",
    done_key: NestedKey | None = ("next", "done"),
    overwrite: bool = False,
    progress: bool = True,
) -> None:
    r"""Writes the influence scores of every stored state into the storage.

    A trajectory of ``n`` stored rows has ``n + 1`` states: those of its rows, and the
    next state of its last row. With the estimator's scores :math:`r_0, \dots, r_n`, a
    window of :math:`w` states (``smoothing``) and :math:`L` (``lookahead``), row ``t``
    caches, for every entity,

    .. math:: \max_{t \le k \le \min(t + L, n)} \; \operatorname{mean} \big\{ r_m :
        k - \lfloor w / 2 \rfloor \le m \le k + \lfloor (w - 1) / 2 \rfloor, \;
        0 \le m \le n \big\}

    so smoothing is a centred box (with an even width its longer side is the past), the
    mean at the ends is over the states that there are, the state after the last row
    takes part in it as any other state, and nothing crosses from one trajectory to
    another. ``lookahead=0`` is the score of the row's own state, the paper's
    :math:`\mathcal{U}_s` (section 3.3). With ``lookahead=1`` a row below the threshold
    is uninfluenced in its state and in its next state.

    An estimator whose ``in_keys`` hold more than the state (attention reads the action)
    cannot score the state after the last row: for it :math:`r_n` is left out.

    The leaf is float32 ``[T, N]`` (``[T, N + 1, N]`` for graphs), NaN where a row is
    not scored. Chunks of ``batch_size`` rows are finished one by one; a call that was
    killed is taken up by the same call, which ends with the same bytes as one that ran
    through. Rows written later are marked unscored by a :class:`MarkUnscored` that is
    appended to the buffer; the next call scores them and the rows before and after that
    their windows reach. Memory does not grow with the number of rows or the length of
    the trajectories; time is linear in the rows.

    How the scores were made (a digest of the estimator's state, of its ``repr`` and its
    layout, ``smoothing``, ``lookahead`` and the keys) is kept on the storage object,
    or, for a memmap storage with a folder, in :func:`score_file`; scores made otherwise
    are never mixed. ``batch_size`` may change between calls: the scores then agree up
    to rounding. ``rb.dumps`` saves the scores, not that file.

    Nothing may be sampled or written while scores are made. Data in a folder: open it
    with :func:`torchrl_caiac.data.load_transitions`, which notices truncated files.

    Args:
        rb (ReplayBuffer): a buffer with a one-dimensional tensordict storage, full or
            not. Rows of a trajectory lie one after another.
        estimator (callable): maps states, a tensordict ``[n]``, to scores ``[n, N]``
            (or ``[n, N + 1, N]``), each row on its own; with the ``layout``
            (:class:`EntityLayout`) that it, or its ``model``, reads. Its ``in_keys``,
            where it has some, are the keys it is given, else those of the layout. Its
            method ``prepare(states, num_states, smoothing=...)``, where it has one, is
            called before it scores, with up to 4,096 states spread over the buffer and
            the number of rows.
        batch_size (int): states scored at once. Defaults to 4096.
        smoothing (int): width of the box in states. Defaults to 1: no smoothing.

    Keyword Args:
        key (NestedKey): the leaf to write. Defaults to ``("caiac", "score")``.
        lookahead (int): how many later states a row takes the maximum over. Defaults
            to 1.
        trajectory_key (NestedKey, optional): the trajectory ids; ``None`` to tell
            trajectories apart by ``done_key`` alone. Defaults to ``"episode"``.
        done_key (NestedKey, optional): the done flags; ``None`` to tell trajectories
            apart by ``trajectory_key`` alone. Defaults to ``("next", "done")``.
        overwrite (bool): first mark all rows unscored, whatever the leaf holds.
            Defaults to ``False``.
        progress (bool): show a progress bar over the rows. Defaults to ``True``.

    Raises:
        TypeError: ``rb`` is no replay buffer, its storage holds no tensordict, or the
            estimator has no layout.
        ValueError: the buffer is empty or its storage has several dimensions; an
            observation or a score is not finite; the estimator's output has another
            shape; the leaf or the score file is not this function's, or the scores were
            made otherwise.
        KeyError: the storage lacks a key.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence.score_buffer import score_buffer
        >>> class Height:
        ...     layout = EntityLayout({"arm": [0], "cup": [1]})
        ...     def __call__(self, td):
        ...         return td["observation"]
        >>> states = torch.tensor([[0.0, 5.0], [1.0, 4.0], [2.0, 3.0], [3.0, 2.0]])
        >>> rows = TensorDict(
        ...     {
        ...         "observation": states[:3],
        ...         "episode": torch.zeros(3, dtype=torch.int64),
        ...         "next": {
        ...             "observation": states[1:],
        ...             "done": torch.tensor([[False], [False], [True]]),
        ...         },
        ...     },
        ...     [3],
        ... )
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=2)
        >>> _ = rb.extend(rows)
        >>> score_buffer(rb, Height(), progress=False)
        >>> rb[:]["caiac", "score"]
        tensor([[1., 5.],
                [2., 4.],
                [3., 3.]])
    """
    _check_int("batch_size", batch_size, 1)
    _check_int("smoothing", smoothing, 1)
    _check_int("lookahead", lookahead, 0)
    key = unravel_key(key)
    storage, data = _open(rb)
    layout = getattr(estimator, "layout", None)
    if layout is None:  # an estimator over a model follows the model's
        layout = getattr(getattr(estimator, "model", None), "layout", None)
    if not isinstance(layout, EntityLayout):
        raise TypeError(
            f"the estimator, a {type(estimator).__name__}, has no `layout`: give it "
            "the EntityLayout that its scores follow"
        )
    scorer = _Scorer(
        data,
        estimator,
        layout,
        TrajectoryEnds(
            data,
            len(rb),
            newest=newest_row(rb),
            trajectory_key=trajectory_key,
            done_key=done_key,
        ),
        batch_size,
        smoothing,
        lookahead,
    )
    settings = {
        "estimator": _digest(estimator),
        "layout": _sha(json.dumps(layout.to_dict(), sort_keys=True)),
        "smoothing": smoothing,
        "lookahead": lookahead,
        "trajectory_key": _jsonable(trajectory_key),
        "done_key": _jsonable(done_key),
    }
    leaf = _leaf(storage, data, key)
    record = None if overwrite else _read_record(storage, data, key)
    if record is not None and record["state"] == "new":
        # Killed before the leaf was filled with NaN: what it holds means nothing.
        overwrite = True
    if leaf is not None and not overwrite:
        _check_leaf(leaf, key, data, layout)
        written = leaf[: len(rb)]
        if record is None and _all_nan(written, batch_size):
            # Made by a transform when rows were written; unwritten rows hold anything.
            overwrite = True
        elif record is None:
            raise ValueError(
                f"the storage holds scores in {key!r} without a record of how they "
                "were made (another program's, or loaded from another folder): call "
                "score_buffer(..., overwrite=True), or give another key"
            )
        if record is not None and record["settings"] != settings:
            differ = [k for k in settings if record["settings"].get(k) != settings[k]]
            if not _all_nan(written, batch_size):
                raise ValueError(
                    f"the scores in {key!r} were made with other settings: "
                    + ", ".join(
                        f"{k} was {_short(record['settings'].get(k))}, is "
                        f"{_short(settings[k])}"
                        for k in differ
                    )
                    + ". Call score_buffer(..., overwrite=True) to make them anew, or "
                    "give another key"
                )
    if leaf is None or overwrite:
        # The first block is scored before anything is written: an estimator or data
        # that do not fit leave the storage as it was.
        feature_shape = tuple(scorer.block(0)[0].shape[1:])
        _write_record(storage, data, key, settings, layout, "new")
        leaf = _new_leaf(storage, data, key, feature_shape)
        todo = list(range(scorer.num_blocks))
    else:
        feature_shape = tuple(leaf.shape[1:])
        todo = [c for c in range(scorer.num_blocks) if scorer.is_stale(c, leaf)]
        scorer.feature_shape = feature_shape
        for c in todo:
            # A row whose neighbours changed is as good as unscored, and has to be
            # found again if this call is killed.
            leaf[scorer.span(c)] = torch.nan
    _write_record(storage, data, key, settings, layout, "scored")
    _mark_later_rows(rb, key, feature_shape)
    total = len(rb)
    done = total - sum(len(scorer.rows(c)) for c in todo)
    with tqdm(
        total=total,
        initial=done,
        desc="scoring",
        unit="row",
        disable=not progress or not todo,
    ) as bar:
        for c in todo:
            scores = scorer.chunk(c)
            leaf[scorer.span(c)] = scores.to(leaf.device)
            bar.update(len(scores))
    add_revision(storage)
    # Samples drawn ahead lack the leaf, or hold it unscored.
    drop_prefetched(rb)


class _Scorer:
    """The scores of one chunk of rows after another.

    Raw scores are made in blocks of ``batch_size`` rows that start at its multiples, so
    that a state's raw score never depends on where a killed call began again; a chunk
    is a block's rows, and reads the blocks that its windows reach.
    """

    def __init__(
        self,
        data: TensorDictBase,
        estimator: Callable[[TensorDictBase], torch.Tensor],
        layout: EntityLayout,
        ends: TrajectoryEnds,
        batch_size: int,
        smoothing: int,
        lookahead: int,
    ) -> None:
        state_keys = list(layout.in_keys)
        in_keys = getattr(estimator, "in_keys", None)
        in_keys = [unravel_key(k) for k in in_keys] if in_keys else state_keys
        state_only = set(in_keys) <= set(state_keys)
        # Whether the state behind the last row of a trajectory takes part.
        self.final = state_only and (smoothing > 1 or lookahead > 0)
        layout.check(data[:1], next=self.final)
        self.states = _select(data, in_keys)
        self.next_states = (
            _select(data.get(layout.next_key), in_keys) if self.final else None
        )
        self.estimator = estimator
        self.layout = layout
        self.ends = ends
        self.batch_size = batch_size
        self.past = smoothing // 2
        self.future = (smoothing - 1) // 2
        self.lookahead = lookahead
        self.length = ends.length
        self.is_full = ends.length == data.shape[0]
        self.num_blocks = -(-self.length // batch_size)
        self.feature_shape: tuple[int, ...] | None = None
        self._device = _device(estimator)
        self._is_prepared = False
        self._blocks: dict[int, tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = {}

    def rows(self, c: int) -> range:
        """The rows of chunk ``c``."""
        start = c * self.batch_size
        return range(start, min(start + self.batch_size, self.length))

    def span(self, c: int) -> slice:
        """The same rows as a slice."""
        rows = self.rows(c)
        return slice(rows.start, rows.stop)

    def _reach(self, c: int, *, ring: bool) -> torch.Tensor:
        """The rows of a chunk and those that its windows reach."""
        rows = self.rows(c)
        start, stop = rows.start - self.past, rows.stop + self.future + self.lookahead
        if ring:
            return torch.arange(start, stop) % self.length
        return torch.arange(max(0, start), min(stop, self.length))

    def is_stale(self, c: int, leaf: torch.Tensor) -> bool:
        """Whether a chunk holds or reaches an unscored row."""
        # Trajectories do not matter here: where one was overwritten, what is left of
        # the other one has lost neighbours too.
        rows = self._reach(c, ring=self.is_full)
        return bool(leaf[rows.to(leaf.device)].isnan().any())

    def block(self, b: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Raw scores of a block's states, of their final states, and which have one."""
        if b in self._blocks:
            return self._blocks[b]
        span = self.span(b)
        rows = torch.arange(span.start, span.stop)
        state = self._evaluate(self.states[span], rows, "state")
        last = self.ends(rows)
        after = state
        if self.next_states is not None and bool(last.any()):
            after = torch.full_like(state, torch.nan)
            where = rows[last]
            after[last] = self._evaluate(
                self.next_states[where.to(self.next_states.device or "cpu")],
                where,
                "next state",
            )
        self._blocks[b] = state, after, last
        return self._blocks[b]

    def chunk(self, c: int) -> torch.Tensor:
        """The finished scores of a chunk, ``[rows, *feature_shape]`` float32."""
        rows = self._reach(c, ring=self.ends.wraps)
        blocks = rows // self.batch_size
        needed = blocks.unique().tolist()
        # No more blocks are kept than one chunk reaches.
        self._blocks = {b: v for b, v in self._blocks.items() if b in needed}
        parts = [self.block(b) for b in needed]
        shape = (len(rows), *parts[0][0].shape[1:])
        state, after = torch.empty(shape), torch.empty(shape)
        last = torch.empty(len(rows), dtype=torch.bool)
        for b, (block_state, block_after, block_last) in zip(
            needed, parts, strict=True
        ):
            here = blocks == b
            offset = rows[here] - b * self.batch_size
            state[here] = block_state[offset]
            after[here] = block_after[offset]
            last[here] = block_last[offset]
        # All states in order of time: those of the rows, and behind each last row the
        # state after it.
        ended = last.cumsum(0) - last.long()
        place = torch.arange(len(rows))
        trajectory = ended
        raw = state
        if self.final:
            place = place + ended
            size = len(rows) + int(last.sum())
            raw = torch.empty((size, *shape[1:]))
            raw[place] = state
            raw[place[last] + 1] = after[last]
            trajectory = torch.empty(size, dtype=torch.long)
            trajectory[place] = ended
            trajectory[place[last] + 1] = ended[last]
        smooth = _smooth(raw, trajectory, self.past, self.future)
        best = _max_ahead(smooth, trajectory, self.lookahead)
        own = self.rows(c)
        first = self.past if self.ends.wraps else min(self.past, own.start)
        return best[place[first : first + len(own)]]

    def _prepare(self) -> None:
        """Shows the estimator what is coming, the same in a call taken up again."""
        prepare = getattr(self.estimator, "prepare", None)
        if prepare is not None and not self._is_prepared:
            count = min(self.length, _SAMPLE)
            rows = torch.linspace(0, self.length - 1, count, dtype=torch.float64).long()
            sample = self.states[rows.to(self.states.device or "cpu")]
            if self._device is not None:
                sample = sample.to(self._device)
            prepare(sample, self.length, smoothing=self.past + self.future + 1)
        self._is_prepared = True

    def _evaluate(
        self, states: TensorDictBase, rows: torch.Tensor, what: str
    ) -> torch.Tensor:
        self._prepare()
        # A copy: the estimator may write into what it is given.
        states = states.clone()
        if self._device is not None:
            states = states.to(self._device)
        for name, value in states.items(include_nested=True, leaves_only=True):
            if value.is_floating_point():
                finite = value.isfinite().reshape(len(rows), -1).all(-1).cpu()
                if not bool(finite.all()):
                    raise ValueError(
                        f"{name!r} has NaN or infinite values in the {what} of the "
                        f"rows {_some(rows[~finite])}: remove or repair them"
                    )
        scores = self.estimator(states)
        if not isinstance(scores, torch.Tensor) or not scores.is_floating_point():
            raise ValueError(
                "the estimator must return a floating-point tensor, got "
                f"{getattr(scores, 'dtype', type(scores).__name__)}"
            )
        n = self.layout.num_entities
        expected = [(len(rows), n), (len(rows), n + 1, n)]
        if self.feature_shape is not None:
            expected = [(len(rows), *self.feature_shape)]
        if tuple(scores.shape) not in expected:
            raise ValueError(
                f"the estimator returned the shape {list(scores.shape)} for "
                f"{len(rows)} states, wanted "
                + " or ".join(str(list(shape)) for shape in expected)
                + f": the last dimension is the {n} entities of its layout"
            )
        scores = scores.detach().to("cpu", torch.float32)
        finite = scores.isfinite()
        if not bool(finite.all()):
            bad_rows = ~finite.reshape(len(rows), -1).all(-1)
            bad = ~finite.reshape(-1, n).all(0)
            names = [
                name
                for name, is_bad in zip(self.layout.names, bad.tolist(), strict=True)
                if is_bad
            ]
            raise ValueError(
                f"the estimator returned NaN or infinite scores for the entities "
                f"{names} in the {what} of the rows {_some(rows[bad_rows])}: the model "
                "has diverged, or the states are far outside of its data"
            )
        self.feature_shape = tuple(scores.shape[1:])
        return scores


def _smooth(
    raw: torch.Tensor, trajectory: torch.Tensor, past: int, future: int
) -> torch.Tensor:
    if not past and not future:
        return raw
    total = torch.zeros(raw.shape, dtype=torch.float64)
    count = torch.zeros(len(raw), dtype=torch.float64)
    for offset in range(-past, future + 1):
        here, there = _shifted(len(raw), offset)
        same = trajectory[here] == trajectory[there]
        total[here] += _rowwise(same, raw) * raw[there]
        count[here] += same
    return (total / _rowwise(count, raw)).float()


def _max_ahead(
    scores: torch.Tensor, trajectory: torch.Tensor, lookahead: int
) -> torch.Tensor:
    best = scores.clone()
    for offset in range(1, lookahead + 1):
        here, there = _shifted(len(scores), offset)
        same = _rowwise(trajectory[here] == trajectory[there], scores)
        best[here] = torch.where(
            same, torch.maximum(best[here], scores[there]), best[here]
        )
    return best


def _shifted(size: int, offset: int) -> tuple[slice, slice]:
    """Slices that lay each element beside the one ``offset`` behind it."""
    here = slice(min(size, max(0, -offset)), max(0, size - max(0, offset)))
    there = slice(min(size, max(0, offset)), max(0, size - max(0, -offset)))
    return here, there


def _rowwise(values: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return values.reshape(-1, *[1] * (like.ndim - 1))


# --- the storage -----------------------------------------------------------------


def _open(rb: ReplayBuffer) -> tuple[TensorStorage, TensorDictBase]:
    if not isinstance(rb, ReplayBuffer):
        raise TypeError(f"score_buffer scores a ReplayBuffer, got {type(rb).__name__}")
    storage = rb.storage
    data = storage_data(storage)
    if storage.ndim != 1:
        raise ValueError(
            f"the storage has ndim={storage.ndim}, wanted 1: store flat transitions, "
            "with trajectory ids"
        )
    known_to_be_memmap(data)
    return storage, data


def _leaf(
    storage: TensorStorage, data: TensorDictBase, key: NestedKey
) -> torch.Tensor | None:
    path = _path(key)
    for depth in range(1, len(path)):
        if isinstance(data.get(path[:depth], None), torch.Tensor):
            raise ValueError(
                f"{path[:depth]} is a tensor in the storage, so {key!r} cannot lie "
                "below it: give another key"
            )
    leaf = data.get(key, None)
    if leaf is not None and not isinstance(leaf, torch.Tensor):
        raise ValueError(
            f"{key!r} is a {type(leaf).__name__} in the storage: give another key"
        )
    return leaf


def _check_leaf(
    leaf: torch.Tensor, key: NestedKey, data: TensorDictBase, layout: EntityLayout
) -> None:
    n = layout.num_entities
    wanted = [(len(data), n), (len(data), n + 1, n)]
    if leaf.dtype != torch.float32 or tuple(leaf.shape) not in wanted:
        raise ValueError(
            f"{key!r} is {leaf.dtype} {list(leaf.shape)}, wanted torch.float32 "
            f"{list(wanted[0])} for the {n} entities {list(layout.names)}: it was made "
            "by something else or for another layout. Call "
            "score_buffer(..., overwrite=True) to replace it, or give another key"
        )


def _all_nan(leaf: torch.Tensor, batch_size: int) -> bool:
    return all(bool(part.isnan().all()) for part in leaf.split(batch_size))


def _new_leaf(
    storage: TensorStorage,
    data: TensorDictBase,
    key: NestedKey,
    feature_shape: tuple[int, ...],
) -> torch.Tensor:
    """The leaf, all NaN; made if it is not there, replaced if it does not fit."""
    shape = (len(data), *feature_shape)
    leaf = data.get(key, None)
    if leaf is not None and (tuple(leaf.shape) != shape or leaf.dtype != torch.float32):
        _remove_leaf(data, key)
        leaf = None
    if leaf is None:
        if data.is_memmap():
            leaf = data.make_memmap(key, shape=torch.Size(shape), dtype=torch.float32)
        else:
            if data.is_locked and data.is_shared():
                raise ValueError(
                    f"the storage is shared with other processes and has no {key!r}: "
                    "score the buffer before it is shared"
                )
            leaf = torch.empty(shape, dtype=torch.float32, device=data.device)
            with data.unlock_() if data.is_locked else contextlib.nullcontext():
                data.set(key, leaf)
            leaf = data.get(key)
    leaf.fill_(torch.nan)
    # The storage filters what is written by its list of keys, made before.
    forget_leaves(storage)
    return leaf


def _remove_leaf(data: TensorDictBase, key: NestedKey) -> None:
    path = _path(key)
    node = data if len(path) == 1 else data.get(path[:-1])
    if not data.is_memmap():
        with data.unlock_() if data.is_locked else contextlib.nullcontext():
            data.del_(key)
        return
    # A memmap tensordict has no way to drop a leaf, and unlocked it would stop being
    # one: it is taken out of the folder's list of leaves, the file, and the mapping.
    prefix = memmap_folder(node)
    if prefix is not None:
        meta = Path(prefix) / "meta.json"
        content = json.loads(meta.read_text(encoding="utf-8"))
        content.pop(path[-1], None)
        _write_json(meta, content)
    filename = getattr(node.get(path[-1]), "filename", None)
    if filename:
        Path(filename).unlink(missing_ok=True)
    drop_memmap_leaf(data, key)


def _mark_later_rows(
    rb: ReplayBuffer, key: NestedKey, feature_shape: tuple[int, ...]
) -> None:
    for transform in rb.transform:
        if isinstance(transform, MarkUnscored) and transform.key == key:
            transform.feature_shape = feature_shape
            return
    rb.append_transform(MarkUnscored(key, feature_shape))


# --- how the scores were made ----------------------------------------------------


def _read_record(
    storage: TensorStorage, data: TensorDictBase, key: NestedKey
) -> dict[str, Any] | None:
    prefix = memmap_folder(data)
    if prefix is None or not data.is_memmap():
        return getattr(storage, "caiac_scores", {}).get(key)
    path = score_file(prefix, key)
    if not path.exists():
        return None
    remedy = (
        "call score_buffer(..., overwrite=True) to make the scores anew, or delete the "
        "file together with the scores"
    )
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"the score file {path} is truncated or damaged ({error}): {remedy}"
        ) from error
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        raise ValueError(f"{path} is no score file of torchrl_caiac: {remedy}")
    if record.get("version") != _VERSION:
        raise ValueError(
            f"the score file {path} has version {record.get('version')!r}, this "
            f"package reads {_VERSION}: update torchrl_caiac, or {remedy}"
        )
    if record.get("state") not in ("new", "scored") or not isinstance(
        record.get("settings"), dict
    ):
        raise ValueError(f"the score file {path} is incomplete: {remedy}")
    return record


def _write_record(
    storage: TensorStorage,
    data: TensorDictBase,
    key: NestedKey,
    settings: dict[str, Any],
    layout: EntityLayout,
    state: str,
) -> None:
    record = {
        "format": _FORMAT,
        "version": _VERSION,
        "state": state,
        "key": _jsonable(key),
        "entities": list(layout.names),
        "fingerprint": _sha(json.dumps(settings, sort_keys=True)),
        "settings": settings,
    }
    prefix = memmap_folder(data)
    if prefix is None or not data.is_memmap():
        records = getattr(storage, "caiac_scores", {})
        storage.caiac_scores = {**records, key: record}
    else:
        _write_json(score_file(prefix, key), record)


def _write_json(path: Path, content: Any) -> None:
    handle, partial = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump(content, file, indent=2)
        os.replace(partial, path)
    except BaseException:
        Path(partial).unlink(missing_ok=True)
        raise


def _digest(estimator: Any) -> str:
    """A digest of what an estimator computes: its kind, settings and numbers."""
    digest = hashlib.sha256()
    kind = estimator if hasattr(estimator, "__qualname__") else type(estimator)
    digest.update(f"{kind.__module__}.{kind.__qualname__}".encode())
    # Settings that are no tensors; addresses differ between processes.
    digest.update(re.sub(r" at 0x[0-9a-fA-F]+", "", repr(estimator)).encode())
    state = estimator.state_dict() if hasattr(estimator, "state_dict") else {}
    for name in sorted(state):
        value = state[name]
        digest.update(name.encode())
        if isinstance(value, torch.Tensor):
            digest.update(f"{value.dtype}{list(value.shape)}".encode())
            flat = value.detach().cpu().contiguous().reshape(-1)
            digest.update(flat.view(torch.uint8).numpy().tobytes())
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


def _device(estimator: Any) -> torch.device | None:
    if not isinstance(estimator, nn.Module):
        return None
    for tensor in (*estimator.parameters(), *estimator.buffers()):
        return tensor.device
    return None


# --- small things ----------------------------------------------------------------


def _select(data: TensorDictBase, keys: list[NestedKey]) -> TensorDictBase:
    chosen = TensorDict({}, batch_size=data.batch_size, device=data.device)
    for key in keys:
        value = data.get(key, None)
        if value is None:
            found = sorted(map(str, data.keys(include_nested=True, leaves_only=True)))
            raise KeyError(
                f"the estimator reads {key!r}, which the storage lacks; it has {found}"
            )
        chosen.set(key, value)
    return chosen


def _check_int(name: str, value: int, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be an int of at least {least}, got {value!r}")


def _jsonable(key: NestedKey | None) -> Any:
    return list(key) if isinstance(key, tuple) else key


def _sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return f"{text[:8]}..." if len(text) == 64 else text


def _some(rows: torch.Tensor) -> str:
    named = rows[:_NAMED].tolist()
    more = len(rows) - len(named)
    return f"{named} and {more} more" if more else str(named)
