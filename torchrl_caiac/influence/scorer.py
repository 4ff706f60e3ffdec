"""Computes the scores of a storage, chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import nn

from torchrl_caiac._fingerprints import fingerprint, state_hash
from torchrl_caiac._kernels import UsedKernels, only_kernels
from torchrl_caiac._keys import as_key, missing_key, path
from torchrl_caiac._spread import spread_rows
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.smoothing import fill_between, max_ahead, smooth
from torchrl_caiac.trajectories import TrajectoryIndex

__all__ = [
    "Scorer",
    "layout_of",
    "reads_state",
    "reads_state_only",
    "to_device_of",
]

_NAMED = 8  # rows that an error names
_SAMPLE = 4096  # states that are passed to the estimator's prepare()


class _Block(NamedTuple):
    """The raw scores of a block of positions.

    Attributes:
        state (torch.Tensor): the scores of the states, ``[n, *feature_shape]``, NaN
            where they were not computed.
        after (torch.Tensor): the same of the states after them.
        last (torch.Tensor): bool ``[n]``, which rows are the last of a trajectory.
        fingerprints (torch.Tensor): int64 ``[n]``, of what was scored.
    """

    state: torch.Tensor
    after: torch.Tensor
    last: torch.Tensor
    fingerprints: torch.Tensor


class Scorer:
    """Computes the scores of a storage, one chunk of rows at a time.

    Rows are counted by their positions in the index of trajectories, in which the rows
    of a trajectory are consecutive. The estimator is called on blocks of ``batch_size``
    positions that start at multiples of ``batch_size``. So the raw score of a state
    does not depend on where an interrupted call resumed. A chunk consists of the rows
    of one block; all blocks that its windows reach are read.

    Args:
        data (TensorDictBase): the rows of the storage, ``[capacity]``.
        estimator (callable): see :func:`~torchrl_caiac.influence.score_buffer`.
        layout (EntityLayout): the entities.
        index (TrajectoryIndex): the trajectories of the rows.

    Keyword Args:
        batch_size (int): rows in a block.
        smoothing (int): see :func:`~torchrl_caiac.influence.score_buffer`.
        lookahead (int): the same.
        every (int): the same.
        settings (int): the settings in the fingerprints, 32 bits.
        is_prepared (bool): whether the estimator was prepared. Defaults to ``False``.

    Attributes:
        batch_size (int): rows in a block.
        num_chunks (int): the number of chunks.
        feature_shape (tuple of int, optional): the shape of the scores of a row,
            ``None`` until it is known.
        is_prepared (bool): whether the estimator was prepared.
        kernels (dict, optional): what computes the linear layers of the estimator.
            ``None`` until the first states have been scored: all others are then
            scored by the kernels that these have used.
    """

    def __init__(
        self,
        data: TensorDictBase,
        estimator: Callable[[TensorDictBase], torch.Tensor],
        layout: EntityLayout,
        index: TrajectoryIndex,
        *,
        batch_size: int,
        smoothing: int,
        lookahead: int,
        every: int,
        settings: int,
        is_prepared: bool = False,
    ) -> None:
        state_keys = list(layout.in_keys)
        in_keys = _in_keys(estimator, layout)
        # Whether the state after the last row of a trajectory is scored. Scores of
        # every few states do without it where the data lack it.
        after = [layout.next(key) for key in layout.in_keys]
        self._final = reads_state_only(estimator, layout) and (
            smoothing > 1
            or lookahead > 0
            or (every > 1 and all(data.get(key, None) is not None for key in after))
        )
        layout.check(data[:1], next=self._final)
        self._states = _select(data, in_keys)
        self._next_states = (
            _select(data.get(layout.next_key), in_keys) if self._final else None
        )
        self._hashed = data.select(
            *state_keys, *(layout.next(key) for key in state_keys), strict=False
        )
        self._keys = state_keys
        self._next_keys = [layout.next(key) for key in state_keys]
        self._settings = settings
        self._estimator = estimator
        self._layout = layout
        self._index = index
        self.batch_size = batch_size
        self._past = smoothing // 2
        self._future = (smoothing - 1) // 2
        self._lookahead = lookahead
        self._every = every
        self.is_prepared = is_prepared
        self._blocks: dict[int, _Block] = {}
        self.num_chunks = -(-index.length // batch_size)
        self.feature_shape: tuple[int, ...] | None = None
        self.kernels: dict[str, Any] | None = None

    def span(self, c: int) -> slice:
        """Returns the positions of chunk ``c``."""
        start = c * self.batch_size
        return slice(start, min(start + self.batch_size, self._index.length))

    def rows(self, c: int) -> torch.Tensor:
        """Returns the rows of chunk ``c``, int64 ``[n]``."""
        span = self.span(c)
        return self._index.rows(torch.arange(span.start, span.stop)).cpu()

    @property
    def reach(self) -> tuple[int, int]:
        """The number of earlier and of later states that a score depends on."""
        gap = self._every - 1
        return self._past + gap, self._future + self._lookahead + gap

    def block(self, b: int) -> _Block:
        """Returns the raw scores of a block, computed once.

        Args:
            b (int): the number of the block.

        Returns:
            _Block: its scores and fingerprints.
        """
        if b not in self._blocks:
            span = self.span(b)
            self._blocks[b] = self._read(torch.arange(span.start, span.stop))
        return self._blocks[b]

    def chunk(self, c: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the final scores of chunk ``c``.

        Args:
            c (int): the number of the chunk.

        Returns:
            tuple of torch.Tensor: the scores, float32 ``[n, *feature_shape]``, and the
            fingerprints, int64 ``[n]``, of its rows.
        """
        span = self.span(c)
        start, stop = self._around(span.start, span.stop)
        needed = range(start // self.batch_size, -(-stop // self.batch_size))
        # Keep no more blocks than one chunk reaches.
        self._blocks = {b: v for b, v in self._blocks.items() if b in needed}
        parts = [self.block(b) for b in needed]
        first = start - needed[0] * self.batch_size
        whole = _Block(
            *(
                torch.cat(leaves)[first : first + stop - start]
                for leaves in zip(*parts, strict=True)
            )
        )
        inside = slice(span.start - start, span.stop - start)
        return self._final_scores(whole)[inside], whole.fingerprints[inside]

    def some(self, position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the final scores of some rows, from no more states than they need.

        Args:
            position (torch.Tensor): int64 ``[n]``, ascending, within one chunk.

        Returns:
            tuple of torch.Tensor: as from :meth:`chunk`.
        """
        start, stop = self._around(int(position[0]), int(position[-1]) + 1)
        before, after = self.reach
        marks = torch.zeros(stop - start + 1, dtype=torch.long)
        low = (position - before).clamp_min(start) - start
        high = (position + after + 1).clamp_max(stop) - start
        marks.index_add_(0, low, torch.ones_like(low))
        marks.index_add_(0, high, -torch.ones_like(high))
        is_needed = marks.cumsum(0)[:-1] > 0
        part = self._read(torch.arange(start, stop), is_needed)
        here = position - start
        return self._final_scores(part)[here], part.fingerprints[here]

    def _around(self, start: int, stop: int) -> tuple[int, int]:
        before, after = self.reach
        return max(0, start - before), min(stop + after, self._index.length)

    def _read(
        self, position: torch.Tensor, is_needed: torch.Tensor | None = None
    ) -> _Block:
        """Returns the raw scores at consecutive positions, NaN where not needed."""
        rows = self._index.rows(position.to(self._index.device)).cpu()
        last = self._index.is_last(rows).cpu()
        # Before the scores: a state that is overwritten in between is found later.
        fingerprints = self._fingerprints(rows)
        number = torch.zeros_like(position)  # every state is scored
        if self._every > 1:
            number = self._number(position)
        state = self._scores(
            self._states, rows, _both(number % self._every == 0, is_needed), "state"
        )
        after = state
        if self._next_states is not None and bool(last.any()):
            is_scored = last & ((number + 1) % self._every == 0)
            after = self._scores(
                self._next_states, rows, _both(is_scored, is_needed), "next state"
            )
        return _Block(state, after, last, fingerprints)

    def _fingerprints(self, rows: torch.Tensor) -> torch.Tensor:
        part = _taken(self._hashed, rows)
        state = state_hash(part, self._keys)
        assert state is not None  # layout.check found the state
        after = state_hash(part, self._next_keys)
        settings = self.surroundings(rows) ^ self._settings
        names = self._layout.names
        return fingerprint(state, after, names, settings.to(state.device)).cpu()

    def surroundings(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns what the scores of rows depend on besides states: what is around.

        Args:
            rows (torch.Tensor): int64 ``[n]``.

        Returns:
            torch.Tensor: int64 ``[n]``, 16 bits that depend on how many of the earlier
            and later states that a score depends on are in the trajectory, and on the
            row's place among the states that are scored; 0 if no state is missing.
        """
        index, (before, after) = self._index, self.reach
        found = torch.zeros_like(rows)
        if after > self._final:  # the state after a row is always there
            left = index.remaining(rows.to(index.device)).cpu() + int(self._final)
            found += (after - left).clamp_min(0) * 0x85EB
        if before:
            number = self._number(index.position(rows.to(index.device)).cpu())
            found += (before - number).clamp_min(0) * 0x9E37
            found += number % self._every * 0xC2B3
        return found & 0xFFFF

    def _final_scores(self, block: _Block) -> torch.Tensor:
        """Returns scores after smoothing and lookahead, ``[n, *feature_shape]``."""
        state, after, last, _ = block
        # All states in the order of time: the state of each row, and after the last
        # row of a trajectory its next state.
        ended = last.cumsum(0) - last.long()
        place = torch.arange(len(last))
        trajectory = ended
        raw = state
        if self._final:
            place = place + ended
            size = len(last) + int(last.sum())
            raw = torch.empty((size, *state.shape[1:]))
            raw[place] = state
            raw[place[last] + 1] = after[last]
            trajectory = torch.empty(size, dtype=torch.long)
            trajectory[place] = ended
            trajectory[place[last] + 1] = ended[last]
        if self._every > 1:
            raw = fill_between(raw, trajectory, ~raw.flatten(1).isnan().any(1))
        smoothed = smooth(raw, trajectory, self._past, self._future)
        return max_ahead(smoothed, trajectory, self._lookahead)[place]

    def _number(self, position: torch.Tensor) -> torch.Tensor:
        """Counts the rows of the same trajectory before each one, int64 ``[n]``."""
        index = self._index
        position = position.to(index.device)
        number = torch.searchsorted(index.ends, position)
        start = index.ends[number] - index.lengths[number] + 1
        return (position - start).cpu()

    def _scores(
        self,
        states: TensorDictBase,
        rows: torch.Tensor,
        needed: torch.Tensor,
        what: str,
    ) -> torch.Tensor:
        """Returns the raw scores of some of a block's rows, NaN in the others."""
        if bool(needed.all()):
            return self._evaluate(_taken(states, rows), rows, what)
        chosen = rows[needed]
        found = None
        if len(chosen):
            found = self._evaluate(_taken(states, chosen), chosen, what)
        assert self.feature_shape is not None  # the first row is always scored
        scores = torch.full((len(rows), *self.feature_shape), torch.nan)
        if found is not None:
            scores[needed] = found
        return scores

    def _prepared(self) -> Callable[[TensorDictBase], torch.Tensor]:
        """Returns the estimator, prepared with a sample that is always the same."""
        prepare = getattr(self._estimator, "prepare", None)
        if prepare is not None and not self.is_prepared:
            length = self._index.length
            rows = spread_rows(length, _SAMPLE)
            sample = self._states[rows.to(self._states.device or "cpu")]
            sample = to_device_of(self._estimator, sample)
            prepare(sample, length, smoothing=self._past + self._future + 1)
        self.is_prepared = True
        return self._estimator

    def _evaluate(
        self, states: TensorDictBase, rows: torch.Tensor, what: str
    ) -> torch.Tensor:
        """Returns the estimator's scores of states ``[n]``, after checking them."""
        # A copy: the estimator may write into its input.
        states = to_device_of(self._estimator, states.clone())
        for name, value in states.items(include_nested=True, leaves_only=True):
            if value.is_floating_point():
                finite = value.isfinite().reshape(len(rows), -1).all(-1).cpu()
                if not bool(finite.all()):
                    raise ValueError(
                        f"{name!r} has NaN or infinite values in the {what} of the "
                        f"rows {_some(rows[~finite])}: remove or repair them"
                    )
        if self.kernels is None:
            used = UsedKernels()
            scores = self._prepared()(states)
            self.kernels = used.state()
        else:
            with only_kernels(self.kernels):
                scores = self._prepared()(states)
        self._check_shape(scores, len(rows))
        scores = scores.detach().to("cpu", torch.float32)
        self._check_finite(scores, rows, what)
        self.feature_shape = tuple(scores.shape[1:])
        return scores

    def _check_shape(self, scores: Any, count: int) -> None:
        if not isinstance(scores, torch.Tensor) or not scores.is_floating_point():
            raise ValueError(
                "the estimator must return a floating-point tensor, got "
                f"{getattr(scores, 'dtype', type(scores).__name__)}"
            )
        n = self._layout.num_entities
        expected = [(count, n), (count, n + 1, n)]
        if self.feature_shape is not None:
            expected = [(count, *self.feature_shape)]
        if tuple(scores.shape) not in expected:
            raise ValueError(
                f"the estimator returned the shape {list(scores.shape)} for {count} "
                "states, expected "
                + " or ".join(str(list(shape)) for shape in expected)
                + f": the last dimension is the {n} entities of its layout"
            )

    def _check_finite(
        self, scores: torch.Tensor, rows: torch.Tensor, what: str
    ) -> None:
        finite = scores.isfinite()
        if bool(finite.all()):
            return
        names = self._layout.names
        bad_rows = ~finite.reshape(len(rows), -1).all(-1)
        bad = (~finite.reshape(-1, len(names)).all(0)).tolist()
        bad_names = [name for name, is_bad in zip(names, bad, strict=True) if is_bad]
        raise ValueError(
            f"the estimator returned NaN or infinite scores for the entities "
            f"{bad_names} in the {what} of the rows {_some(rows[bad_rows])}: the model "
            "has diverged, or the states are far outside of its data"
        )


def _select(data: TensorDictBase, keys: list[NestedKey]) -> TensorDictBase:
    chosen = TensorDict({}, batch_size=data.batch_size, device=data.device)
    for key in keys:
        value = data.get(key, None)
        if value is None:
            raise missing_key(
                data,
                key,
                "the storage lacks what the estimator reads,",
                "add it, or name the key that has it in the estimator",
            )
        chosen.set(key, value)
    return chosen


def _taken(states: TensorDictBase, rows: torch.Tensor) -> TensorDictBase:
    """Returns rows of states; consecutive ones as a view, which reads them faster."""
    first, last = int(rows[0]), int(rows[-1])
    if last - first == len(rows) - 1 and bool((rows.diff() == 1).all()):
        return states[first : last + 1]
    return states[rows.to(states.device or "cpu")]


def _both(first: torch.Tensor, second: torch.Tensor | None) -> torch.Tensor:
    return first if second is None else first & second


def layout_of(estimator: Any) -> EntityLayout:
    """Returns the layout that an estimator's scores follow.

    Args:
        estimator (callable): it, or its ``model``, has a ``layout``.

    Returns:
        EntityLayout: the layout.

    Raises:
        TypeError: there is none.
    """
    layout = getattr(estimator, "layout", None)
    if layout is None:
        layout = getattr(getattr(estimator, "model", None), "layout", None)
    if not isinstance(layout, EntityLayout):
        raise TypeError(
            f"the estimator, a {type(estimator).__name__}, has no `layout`: give it "
            "the EntityLayout that its scores follow"
        )
    return layout


def reads_state_only(estimator: Any, layout: EntityLayout) -> bool:
    """Returns whether an estimator reads nothing but the state, or parts of it."""
    return all(
        any(_is_below(key, state) for state in layout.in_keys)
        for key in _in_keys(estimator, layout)
    )


def reads_state(estimator: Any, layout: EntityLayout) -> bool:
    """Returns whether an estimator reads the state, the next one, or parts of them."""
    states = [*layout.in_keys, *map(layout.next, layout.in_keys)]
    return any(
        _is_below(key, state) or _is_below(state, key)
        for key in _in_keys(estimator, layout)
        for state in states
    )


def _is_below(key: NestedKey, other: NestedKey) -> bool:
    """Returns whether a key is that of an entry, or of a part of it."""
    parts = path(other)
    return path(key)[: len(parts)] == parts


def to_device_of(estimator: Any, states: TensorDictBase) -> TensorDictBase:
    """Returns states on the device of an estimator, if it is a module with one."""
    if isinstance(estimator, nn.Module):
        for tensor in (*estimator.parameters(), *estimator.buffers()):
            return states.to(tensor.device)
    return states


def _in_keys(estimator: Any, layout: EntityLayout) -> list[NestedKey]:
    in_keys = getattr(estimator, "in_keys", None)
    return [as_key(key) for key in in_keys] if in_keys else list(layout.in_keys)


def _some(rows: torch.Tensor) -> str:
    named = rows[:_NAMED].tolist()
    more = len(rows) - len(named)
    return f"{named} and {more} more" if more else str(named)
