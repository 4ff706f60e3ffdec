"""The leaves of a storage that contain the scores and their fingerprints."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import TensorStorage

from torchrl_caiac._fingerprints import (
    fingerprint_key,
    is_fingerprint_of,
    rows_with_fingerprints,
    settings_of,
    state_hash,
)
from torchrl_caiac._keys import path
from torchrl_caiac._torchrl import (
    forget_leaves,
    storage_data,
    storage_rows,
)
from torchrl_caiac.data.add_leaf import new_leaf, remove_leaf
from torchrl_caiac.entities import EntityLayout

__all__ = [
    "RowStates",
    "ScoreLeaves",
    "check_shape",
    "find_leaves",
    "new_leaves",
    "row_states",
    "valid_scores",
]

_CHUNK = 1 << 16


class RowStates(NamedTuple):
    """What is known about the scores of all rows of a storage, on the CPU.

    Attributes:
        valid (torch.Tensor): bool ``[T]``, which rows have a score of their state.
        moved (torch.Tensor): bool ``[T]``, which of them had other neighbours in their
            trajectory when they were scored.
        has_others (bool): whether a row has a score of its state with other settings.
    """

    valid: torch.Tensor
    moved: torch.Tensor
    has_others: bool


class ScoreLeaves(NamedTuple):
    """The scores of all rows of a storage, views of its leaves.

    Attributes:
        scores (torch.Tensor): float32 ``[capacity, *feature_shape]``, NaN where a row
            was not scored.
        fingerprints (torch.Tensor, optional): int64 ``[capacity]``; ``None`` for scores
            that :func:`~torchrl_caiac.influence.score_buffer` did not write.
    """

    scores: torch.Tensor
    fingerprints: torch.Tensor | None

    def all_nan(self, length: int) -> bool:
        """Returns whether none of the first ``length`` rows has a score."""
        parts = self.scores[:length].split(_CHUNK)
        return all(bool(part.isnan().all()) for part in parts)


def find_leaves(storage: TensorStorage, key: NestedKey) -> ScoreLeaves | None:
    """Returns the leaves of a storage's scores, ``None`` where there are none.

    Args:
        storage (TensorStorage): the storage.
        key (NestedKey): the score leaf.

    Returns:
        ScoreLeaves, optional: the leaves.

    Raises:
        ValueError: ``key`` is another entry, or below a tensor.
    """
    data = storage_rows(storage)
    parts = path(key)
    for depth in range(1, len(parts)):
        if isinstance(data.get(parts[:depth], None), torch.Tensor):
            raise ValueError(
                f"{parts[:depth]} is a tensor in the storage, so {key!r} cannot be "
                "below it: give another key"
            )
    leaf = data.get(key, None)
    if leaf is None:
        return None
    if not isinstance(leaf, torch.Tensor):
        raise ValueError(
            f"{key!r} is a {type(leaf).__name__} in the storage: give another key"
        )
    known = data.get(fingerprint_key(key), None)
    if known is not None and (known.dtype, known.numel()) != (torch.int64, len(data)):
        raise ValueError(
            f"{fingerprint_key(key)!r} is {known.dtype} {list(known.shape)}, expected "
            f"torch.int64 {[len(data)]}: it was written by something else. Remove it, "
            "or give another key"
        )
    return ScoreLeaves(
        leaf.as_subclass(torch.Tensor),
        None if known is None else known.as_subclass(torch.Tensor).reshape(-1),
    )


def check_shape(leaves: ScoreLeaves, key: NestedKey, layout: EntityLayout) -> None:
    """Raises if leaves cannot contain the scores of a layout's entities.

    Args:
        leaves (ScoreLeaves): the leaves.
        key (NestedKey): the score leaf.
        layout (EntityLayout): the ``N`` entities.

    Raises:
        ValueError: the scores are not float32, or their shape is neither
            ``[capacity, N]`` nor ``[capacity, N + 1, N]``.
    """
    leaf, n = leaves.scores, layout.num_entities
    expected = [(len(leaf), n), (len(leaf), n + 1, n)]
    if leaf.dtype != torch.float32 or tuple(leaf.shape) not in expected:
        raise ValueError(
            f"{key!r} is {leaf.dtype} {list(leaf.shape)}, expected torch.float32 "
            f"{list(expected[0])} for the {n} entities {list(layout.names)}: it was "
            "written by something else or for another layout. Call "
            "score_buffer(..., overwrite=True) to replace it, or give another key"
        )


def row_states(
    data: TensorDictBase,
    leaves: ScoreLeaves,
    layout: EntityLayout,
    length: int,
    settings: int,
    surroundings: Callable[[torch.Tensor], torch.Tensor] | None = None,
) -> RowStates:
    """Returns which rows have a valid score.

    Args:
        data (TensorDictBase): the rows of the storage, ``[capacity]``.
        leaves (ScoreLeaves): the leaves, with fingerprints.
        layout (EntityLayout): the entities.
        length (int): the number of rows in use, ``T``.
        settings (int): the settings of the scores, 32 bits.
        surroundings (callable, optional): maps rows to the surroundings that they have
            now, see :meth:`~torchrl_caiac.influence.scorer.Scorer.surroundings`; by
            default no row counts as moved.

    Returns:
        RowStates: the states.
    """
    scores, known = leaves
    assert known is not None
    keys = layout.in_keys
    next_keys = [layout.next(key) for key in keys]
    hashed = data.select(*keys, *next_keys, strict=False)
    valid = torch.zeros(length, dtype=torch.bool)
    moved = torch.zeros(length, dtype=torch.bool)
    has_others = False
    for start in range(0, length, _CHUNK):
        rows = slice(start, min(start + _CHUNK, length))
        part = hashed[rows]
        state, after = state_hash(part, keys), state_hash(part, next_keys)
        assert state is not None  # the layout was checked
        is_scored = is_fingerprint_of(known[rows], state, after, layout.names)
        is_scored &= ~scores[rows].flatten(1).isnan().any(1)
        # Surroundings differ in the lower 16 bits alone.
        differs = (settings_of(known[rows], state, after) ^ settings) & 0xFFFFFFFF
        is_own = differs >> 16 == 0
        has_others = has_others or bool((is_scored & ~is_own).any())
        valid[rows] = (is_scored & is_own).cpu()
        if surroundings is not None:
            now = surroundings(torch.arange(rows.start, rows.stop))
            moved[rows] = valid[rows] & (differs.cpu() != now)
    return RowStates(valid, moved, has_others)


def new_leaves(
    storage: TensorStorage, key: NestedKey, feature_shape: tuple[int, ...]
) -> ScoreLeaves:
    """Adds leaves in which no row is scored.

    Existing leaves are reused if their shape and dtype fit, and replaced otherwise.

    Args:
        storage (TensorStorage): the storage.
        key (NestedKey): the score leaf.
        feature_shape (tuple of int): the shape of the scores of a row.

    Returns:
        ScoreLeaves: the leaves: scores NaN, fingerprints 0.

    Raises:
        ValueError: the storage is shared between processes and lacks the leaves.
    """
    data = storage_data(storage)
    batch = data.batch_size[: storage.ndim]
    _new_leaf(data, fingerprint_key(key), batch, torch.int64).zero_()
    _new_leaf(data, key, torch.Size([*batch, *feature_shape]), torch.float32).fill_(
        torch.nan
    )
    # The storage filters what is written by a list of keys that it created earlier.
    forget_leaves(storage)
    rows = storage_rows(storage)
    return ScoreLeaves(
        rows.get(key).as_subclass(torch.Tensor),
        rows.get(fingerprint_key(key)).as_subclass(torch.Tensor),
    )


def _new_leaf(
    data: TensorDictBase, key: NestedKey, shape: torch.Size, dtype: torch.dtype
) -> torch.Tensor:
    leaf = data.get(key, None)
    if leaf is not None and (leaf.shape != shape or leaf.dtype != dtype):
        remove_leaf(data, key)
        leaf = None
    if leaf is None:
        if data.is_memmap():
            leaf = new_leaf(data, key, shape, dtype)
        else:
            if data.is_locked and data.is_shared():
                raise ValueError(
                    f"the storage is shared with other processes and has no {key!r}: "
                    "score the buffer before it is shared, or append ScoreOnWrite to "
                    "it before it is written to"
                )
            leaf = torch.empty(shape, dtype=dtype, device=data.device)
            with data.unlock_() if data.is_locked else contextlib.nullcontext():
                data.set(key, leaf)
            leaf = data.get(key)
    return leaf.as_subclass(torch.Tensor)


def valid_scores(
    data: TensorDictBase, key: NestedKey, layout: EntityLayout, length: int
) -> torch.Tensor:
    """Returns stored scores, NaN where they are those of other states.

    Args:
        data (TensorDictBase): the rows of a storage, at least ``T``.
        key (NestedKey): the scores.
        layout (EntityLayout): the entities.
        length (int): the number of rows that were written, ``T``.

    Returns:
        torch.Tensor: ``[T, ...]``, the stored tensor itself if all scores are valid.
    """
    scores = data.get(key).as_subclass(torch.Tensor)[:length]
    known = data.get(fingerprint_key(key), None)
    if known is None:
        return scores
    is_valid = rows_with_fingerprints(
        data,
        known.as_subclass(torch.Tensor)[:length],
        layout.in_keys,
        [layout.next(key) for key in layout.in_keys],
        layout.names,
    )
    if bool(is_valid.all()):
        return scores
    where = is_valid.view(-1, *(1,) * (scores.ndim - 1))
    return torch.where(where, scores, torch.nan)
