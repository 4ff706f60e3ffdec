"""Checks of the values of each batch that a transform augments."""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import TensorStorage

from torchrl_caiac._fingerprints import (
    fingerprint_key,
    is_fingerprint_of,
    matches,
    state_hash,
    state_leaves,
)
from torchrl_caiac._keys import missing_key
from torchrl_caiac._sampling import all_finite, is_native
from torchrl_caiac._torchrl import (
    leaf_of,
    member_storages,
    sampling_buffer,
    storage_rows,
)
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.score_record import check_scored_layout
from torchrl_caiac.trajectories import COLLECTOR_KEY, STEPS_KEY, end_flags
from torchrl_caiac.transforms.checks import LateCheck, LateValue
from torchrl_caiac.transforms.keys import TransformKeys

__all__ = ["BatchCheck", "CheckedScores"]

# The mean distance of a state from the next state of the row before it, in the largest
# steps of the batch, up to which both may be recordings of one state.
_NOISE = 0.5
# Differences up to this share of the largest value of a column are rounding.
_ROUNDING = 1e-6
# The share of states that differ from the next state before them from which on both are
# taken for separate recordings.
_MOST = 0.5


class CheckedScores(NamedTuple):
    """The scores of a batch that may be used.

    Attributes:
        scores (torch.Tensor): ``[B * window, ...]``, NaN where they may not be used.
        unscored (torch.Tensor, optional): int64, the number of such rows, if counted.
        is_valid (torch.Tensor, optional): bool ``[B]`` or ``[B * window]``, the rows
            with the scores of their states; on accelerators, where it is not read at
            once.
        crosses (torch.Tensor, optional): bool ``[B, window - 1]``, the steps of windows
            that are not steps of a trajectory; on accelerators.
        differs (torch.Tensor, optional): bool, with lookahead whether rows are others
            than the buffer drew; on accelerators.
    """

    scores: torch.Tensor
    unscored: torch.Tensor | None = None
    is_valid: torch.Tensor | None = None
    crosses: torch.Tensor | None = None
    differs: torch.Tensor | None = None


class BatchCheck:
    """Raises if the values of a batch are invalid.

    Scores must be those of the states that they come with, scores and observations must
    be finite, and windows must be successive rows of a trajectory. On a CUDA device
    nothing waits for the result: an error is raised at a later batch.

    Args:
        layout (EntityLayout): the entities.

    Keyword Args:
        score_key (NestedKey): the scores.
        window (int): rows in a window.
        keys (TransformKeys): trajectory ids and end flags.
        scores_name (str): the name of the scores in error messages.
        unscored (str): ``"raise"``, or ``"keep"`` to count rows without valid scores.
    """

    def __init__(
        self,
        layout: EntityLayout,
        *,
        score_key: NestedKey,
        window: int,
        keys: TransformKeys,
        scores_name: str,
        unscored: Literal["raise", "keep"],
    ) -> None:
        self.layout = layout
        self.score_key = score_key
        self.window = window
        self.keys = keys
        self.scores_name = scores_name
        self.unscored: Literal["raise", "keep"] = unscored
        self._fingerprint_key = fingerprint_key(score_key)
        self._keys = layout.in_keys
        self._next_keys = [layout.next(key) for key in layout.in_keys]
        self._late = LateCheck()
        self._seen: Any = None  # the storage whose record was compared

    def before(self, td: TensorDictBase, scores: torch.Tensor) -> CheckedScores:
        """Checks a batch before it is swapped.

        Args:
            td (TensorDictBase): the batch, ``[B * window]``.
            scores (torch.Tensor): its scores, ``[B * window, ...]``.

        Returns:
            CheckedScores: what may be used.

        Raises:
            KeyError: windows have neither trajectory ids nor end flags.
            ValueError: a score is missing, infinite or that of another state or layout;
                or the rows of a window do not follow each other.
        """
        self._check_layout()
        known = leaf_of(td, self._fingerprint_key)
        is_valid = crosses = None
        if self.window == 1:
            if known is not None:
                is_valid = matches(
                    td, known, self._keys, self._next_keys, self.layout.names
                )
        else:
            crosses = self._crossings(td)
            is_valid = self._follows(td, known)
            if is_valid is None:
                gaps, is_valid = self._gaps(td, known)
                crosses = crosses | gaps
        if not LateCheck.needed(scores.device) and crosses is not None:
            if bool(crosses.any()):
                self._explain_windows(td, crosses)
            crosses = None
        if self.unscored == "keep":
            return self._kept(scores, is_valid, crosses)
        if LateCheck.needed(scores.device):
            return CheckedScores(scores, None, is_valid, crosses)
        if known is None:
            # A sum is finite if all its terms are.
            if not math.isfinite(scores.sum().item()):
                self._explain_scores(scores)
        elif is_valid is not None and not torch.equal(
            is_valid, _true(len(is_valid))
        ):  # score_buffer has checked its scores
            self._explain_scores(scores)
            self._explain_fingerprints(is_valid)
        return CheckedScores(scores)

    def after(
        self, td: TensorDictBase, checked: CheckedScores, states: Sequence[NestedKey]
    ) -> None:
        """Checks a batch after it was swapped.

        Args:
            td (TensorDictBase): the batch after swapping.
            checked (CheckedScores): from :meth:`before`.
            states (sequence of NestedKey): the floating-point leaves of its states.

        Raises:
            ValueError: a value is not finite; on a CUDA device, also what
                :meth:`before` raises elsewhere.
        """
        leaves = [leaf_of(td, key) for key in states]
        if not LateCheck.needed(checked.scores.device):
            if not all(map(_is_finite, leaves)):
                self.explain_states(td, states)
            return
        found = self._late.found()
        if found:
            # The newest batch is likely to have the same fault.
            if checked.crosses is not None and bool(checked.crosses.any()):
                self._explain_windows(td, checked.crosses)
            if self.unscored == "raise":
                self._explain_scores(checked.scores)
            self.explain_states(td, states)
            names = [self.score_key, "fingerprints", "the windows", "the rows", *states]
            raise ValueError(
                f"{[names[place] for place in found]} were invalid in an earlier "
                f"batch: {self.scores_name} or observations are NaN or infinite, "
                f"{self.scores_name} are those of other states or, with lookahead, of "
                "other rows than the buffer drew, or windows cross a trajectory's "
                "end. On a CUDA device errors are late; sample the same "
                "data on the CPU to find the rows"
            )
        is_valid, crosses, differs = checked[2:]
        self._late.look(
            [
                LateValue(
                    checked.scores,
                    "infinite" if self.unscored == "keep" else "not finite",
                ),
                None if is_valid is None else LateValue(is_valid, "false"),
                None if crosses is None else LateValue(crosses, "true"),
                None if differs is None else LateValue(differs, "true"),
                *map(LateValue, leaves),
            ]
        )

    # --- scores ----------------------------------------------------------------------

    def _kept(
        self,
        scores: torch.Tensor,
        is_valid: torch.Tensor | None,
        crosses: torch.Tensor | None,
    ) -> CheckedScores:
        if not LateCheck.needed(scores.device) and bool(scores.isinf().any()):
            self._explain_scores(scores.masked_fill(scores.isnan(), 0))
        if is_valid is not None:
            where = is_valid.view(-1, *(1,) * (scores.ndim - 1))
            scores = torch.where(where, scores, math.nan)
        unscored = scores.isnan().flatten(1).any(1).sum()
        return CheckedScores(scores, unscored, None, crosses)

    def _explain_scores(self, scores: torch.Tensor) -> None:
        nan, infinite = scores.isnan(), scores.isinf()
        if nan.any():
            rows = int(nan.flatten(1).any(1).sum())
            raise ValueError(
                f"{self.score_key!r} is NaN (not scored) in {rows} of "
                f"{scores.shape[0]} rows for {self._entities(nan)}: call score_buffer "
                "on the replay buffer after extending it, or pass unscored='keep'"
            )
        if infinite.any():
            raise ValueError(
                f"{self.score_key!r} is infinite for {self._entities(infinite)}: check "
                "the influence measure, then call score_buffer(..., overwrite=True)"
            )

    def _check_layout(self) -> None:
        """Compares the layout with that of the scores, once for each storage."""
        buffer = sampling_buffer()
        storage = None if buffer is None else buffer.storage
        if storage is None or (self._seen is not None and self._seen() is storage):
            return
        members = member_storages(storage)
        for one in members:
            if isinstance(one, TensorStorage) and len(one):
                data = storage_rows(one, "the buffer")
                check_scored_layout(one, data, self.score_key, self.layout)
        if all(map(len, members)):  # an empty one is compared when it has rows
            self._seen = weakref.ref(storage)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_seen": None}

    def _explain_fingerprints(self, is_valid: torch.Tensor) -> None:
        rows = int((~is_valid).sum())
        raise ValueError(
            f"{rows} of {len(is_valid)} rows have {self.scores_name} in "
            f"{self.score_key!r} of other states than their own: call score_buffer on "
            "the replay buffer after writing to it, or pass unscored='keep'. If all "
            "rows are named, another transform may have changed the state before: "
            "append this one first. Or the scores are not those of the entities "
            f"{list(self.layout.names)} in this order: use the layout of the estimator"
        )

    def _entities(self, bad: torch.Tensor) -> list[str]:
        """Returns the entities that have a bad score, ``[*, N]``."""
        columns = bad.reshape(-1, bad.shape[-1]).any(0).nonzero()[:, 0]
        return [self.layout.names[column] for column in columns.tolist()]

    # --- windows ---------------------------------------------------------------------

    def _crossings(self, td: TensorDictBase) -> torch.Tensor:
        """Returns where a window leaves its trajectory, bool ``[B, window - 1]``."""
        if leaf_of(td, STEPS_KEY) is not None:
            raise ValueError(
                f"the batch has {STEPS_KEY!r}, so that its next states are several "
                f"steps later, but windows of {self.window} rows are single steps: "
                "sample windows from data without MultiStepTransform"
            )
        found = None
        ids = None
        if self.keys.trajectory is not None:
            ids = leaf_of(td, self.keys.trajectory)
            if ids is None:
                ids = td.get(COLLECTOR_KEY, None)
            if ids is not None:
                _check_size(ids, self.keys.trajectory, td)
                ids = ids.reshape(-1, self.window)
                found = ids[:, 1:] != ids[:, :-1]
        if self.keys.done is not None:
            done = end_flags(td, self.keys.done)
            if done is not None:
                ended = done.reshape(-1, self.window)[:, :-1].bool()
                found = ended if found is None else found | ended
        if found is None:
            raise missing_key(
                td,
                [key for key in (self.keys.trajectory, self.keys.done) if key],
                "the batch lacks trajectory ids and end flags,",
                "name the one that it has with keys=TransformKeys(trajectory=..., "
                "done=...), since a window must not leave its trajectory",
            )
        return found

    def _follows(
        self, td: TensorDictBase, known: torch.Tensor | None
    ) -> torch.Tensor | None:
        """Returns all true, bool ``[B]``, if states are the next states before them.

        The fast way, for the usual case; ``None`` if another way has to decide, among
        them whenever a fingerprint does not fit.
        """
        keys, window = self.layout.in_keys, self.window
        pairs = list(
            zip(state_leaves(td, keys), state_leaves(td, self._next_keys), strict=False)
        )
        if not pairs or LateCheck.needed(pairs[0][0].device):
            return None
        for here, there in pairs:
            if (here.shape, here.dtype) != (there.shape, there.dtype):
                return None
            if _is_pairs(here) and _is_pairs(there):  # half as many comparisons
                here, there = here.view(torch.int64), there.view(torch.int64)
            if not torch.equal(
                here.unflatten(0, (-1, window))[:, 1:],
                there.unflatten(0, (-1, window))[:, :-1],
            ):
                return None
        if known is None:
            return pairs[0][0].new_ones(len(td), dtype=torch.bool)
        state = state_hash(td, keys)
        last = state_hash(td, self._next_keys, slice(window - 1, None, window))
        assert state is not None and last is not None  # there are leaves
        after = torch.cat([state.view(-1, window)[:, 1:], last.unsqueeze(1)], 1)
        is_valid = is_fingerprint_of(known, state, after.flatten(), self.layout.names)
        return is_valid if bool(is_valid.all()) else None

    def _gaps(
        self, td: TensorDictBase, known: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Finds where a row is not the one after the row before it.

        A row follows another one if its state is the other's next state. Both may be
        separate, noisy recordings: where most of them differ, they are compared by
        distance.

        Returns:
            tuple of torch.Tensor: bool ``[B, window - 1]``; and bool ``[B * window]``,
            the rows with the states of their fingerprints.
        """
        state = state_hash(td, self.layout.in_keys)
        after = state_hash(td, self._next_keys)
        assert state is not None and after is not None  # the planner found the leaves
        is_valid = None
        if known is not None:
            is_valid = is_fingerprint_of(known, state, after, self.layout.names)
        state, after = state.view(-1, self.window), after.view(-1, self.window)
        exact = state[:, 1:] == after[:, :-1]
        # A sampler that pads windows repeats rows.
        repeats = (state[:, 1:] == state[:, :-1]) & (after[:, 1:] == after[:, :-1])
        here = self.layout.read(td).double()
        there = self.layout.read(td, next=True).double()
        largest = (there - here).abs().amax(0)
        magnitude = torch.maximum(here.abs().amax(0), there.abs().amax(0))
        size = largest.clamp_min(1e-6 * magnitude).clamp_min(1e-12)
        here = here.view(-1, self.window, here.shape[-1])[:, 1:]
        there = there.view(-1, self.window, there.shape[-1])[:, :-1]
        distance = (here - there).abs()
        # A state that was computed twice differs by rounding.
        is_same = exact | (distance <= _ROUNDING * magnitude).all(-1)
        is_near = (distance / size).mean(-1) <= _NOISE
        is_noisy = is_near & ((~is_same).double().mean() > _MOST)
        return ~exact & (repeats | ~(is_same | is_noisy)), is_valid

    def _explain_windows(self, td: TensorDictBase, crosses: torch.Tensor) -> None:
        window = int(crosses.any(1).nonzero()[0, 0])
        where = f"window {window} of {self.window} rows"
        if bool(self._crossings(td).any()):
            raise ValueError(
                f"{where} crosses a trajectory's end "
                f"according to {self.keys.trajectory!r} or {self.keys.done!r}: use "
                f"SliceSampler with slice_len={self.window}, strict_length=True and "
                "trajectories of at least this length. If end flags do not end a "
                "trajectory in these data, pass keys=TransformKeys(done=None)"
            )
        step = int(crosses[window].nonzero()[0, 0])
        raise ValueError(
            f"the rows of {where} do not follow each other: the state of row "
            f"{step + 1} is not the next state of row {step}. Use SliceSampler with "
            f"slice_len={self.window}, strict_length=True and no padding; see "
            "check_dataset if the stored rows are out of order"
        )

    # --- states ----------------------------------------------------------------------

    def explain_states(self, td: TensorDictBase, states: Sequence[NestedKey]) -> None:
        """Raises if a value of a state is not finite.

        Args:
            td (TensorDictBase): the batch after swapping.
            states (sequence of NestedKey): the floating-point leaves of its states.

        Raises:
            ValueError: it names the leaf and the row.
        """
        for key in states:
            bad = ~td.get(key).isfinite()
            if bad.any():
                row = int(bad.flatten(1).any(1).nonzero()[0, 0])
                raise ValueError(
                    f"{key!r} is not finite (NaN or infinite) in {int(bad.sum())} "
                    f"values, first in row {row} of the batch: clean the data, or "
                    "the donors' data"
                )


def _is_pairs(leaf: torch.Tensor) -> bool:
    """Returns whether the values of a leaf ``[B, ...]`` are pairs of 32 bits."""
    return (
        leaf.dtype is torch.float32
        and leaf.ndim > 1
        and not leaf.shape[-1] % 2
        and leaf.is_contiguous()
        and not leaf.storage_offset() % 2
    )


@lru_cache(maxsize=16)
def _true(rows: int) -> torch.Tensor:
    """Returns all true, to compare with, which is faster than ``all``."""
    return torch.ones(rows, dtype=torch.bool, device="cpu")


def _check_size(leaf: torch.Tensor, key: NestedKey | None, td: TensorDictBase) -> None:
    if leaf.numel() != len(td):
        raise ValueError(
            f"{key!r} has shape {list(leaf.shape)}, expected [{len(td)}] or "
            f"[{len(td)}, 1]: one value for each row"
        )


def _is_finite(leaf: torch.Tensor) -> bool:
    if leaf.dtype is torch.float32 and is_native(leaf):
        return all_finite([leaf])
    # A sum is finite if all its terms are.
    return math.isfinite(leaf.sum().item())
