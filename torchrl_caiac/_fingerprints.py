"""Fingerprints of states, which tie a score to the state it was computed from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from functools import lru_cache

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey

from torchrl_caiac._keys import join, path
from torchrl_caiac._sampling import (
    MOST_LEAVES,
    is_native,
    plain,
    row_sums,
    state_matches,
)
from torchrl_caiac._torchrl import leaf_of

__all__ = [
    "fingerprint",
    "fingerprint_key",
    "hashed_leaves",
    "is_fingerprint_of",
    "leaf_weights",
    "matches",
    "rows_with_fingerprints",
    "settings_of",
    "state_hash",
    "state_leaves",
    "upper_half",
]

_MASK = (1 << 64) - 1
# The hash of the next state enters with this factor, so that it is no longer a hash of
# the same kind as that of the state.
_NEXT = 0x9E3779B97F4A7C15


def fingerprint_key(score_key: NestedKey) -> NestedKey:
    """Returns the key of the fingerprints, int64 ``[T]``, of some scores.

    Args:
        score_key (NestedKey): the key of the scores.

    Returns:
        NestedKey: the key beside it.

    Examples:
        >>> from torchrl_caiac._fingerprints import fingerprint_key
        >>> fingerprint_key(("caiac", "score"))
        ('caiac', 'score_fingerprint')
    """
    *parents, name = path(score_key)
    return join(*parents, f"{name}_fingerprint")


def state_hash(
    td: TensorDictBase, keys: Sequence[NestedKey], rows: slice | None = None
) -> torch.Tensor | None:
    """Returns a hash of the bits of a state.

    A change of a single value always changes the hash. A change of several values is
    missed with a probability of at most 2**-32.

    Args:
        td (TensorDictBase): the states, ``[B]``.
        keys (sequence of NestedKey): their entries.
        rows (slice, optional): the rows to hash. Defaults to all of them.

    Returns:
        torch.Tensor, optional: int64 ``[B]``; ``None`` if no entry is there.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac._fingerprints import state_hash
        >>> states = torch.tensor([[1.0, 2.0], [1.0, 2.5]])
        >>> td = TensorDict({"observation": states}, [2])
        >>> first, second = state_hash(td, ["observation"])
        >>> bool(first == second)
        False
    """
    total: torch.Tensor | None = None
    for number, leaf in enumerate(state_leaves(td, keys)):
        leaf = leaf if rows is None else leaf[rows]
        if _is_row_of_floats(leaf) and leaf.device.type == "cpu" and is_native(leaf):
            found = row_sums(leaf, _weights(leaf.shape[1], number, 1, leaf.device))
        else:
            found = _weighted(_lanes(leaf), number, 1)
        total = found if total is None else total + found
    return total


def fingerprint(
    state: torch.Tensor,
    after: torch.Tensor | None,
    names: Sequence[str],
    settings: int | torch.Tensor,
) -> torch.Tensor:
    """Returns the fingerprints of rows.

    Args:
        state (torch.Tensor): int64 ``[B]``, the hashes of their states.
        after (torch.Tensor, optional): int64 ``[B]``, those of their next states.
        names (sequence of str): the entities, in the order of the scores.
        settings (int or torch.Tensor): what else the scores depend on, 32 bits; one
            number, or int64 ``[B]``.

    Returns:
        torch.Tensor: int64 ``[B]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac._fingerprints import (
        ...     fingerprint, is_fingerprint_of, settings_of
        ... )
        >>> state, after = torch.tensor([5, 6]), torch.tensor([7, 8])
        >>> known = fingerprint(state, after, ("arm", "cup"), settings=3)
        >>> is_fingerprint_of(known, state, after.flip(0), ("arm", "cup"))
        tensor([False, False])
        >>> is_fingerprint_of(known, state, after, ("cup", "arm"))
        tensor([False, False])
        >>> settings_of(known, state, after)
        tensor([3, 3])
    """
    upper = upper_half(tuple(names)) << 32
    return _joint(state, after) + upper + (settings & 0xFFFFFFFF)


def matches(
    td: TensorDictBase,
    known: torch.Tensor,
    keys: Sequence[NestedKey],
    next_keys: Sequence[NestedKey],
    names: Sequence[str],
    rows: torch.Tensor | None = None,
) -> torch.Tensor:
    """Returns which rows still have the states of their fingerprints.

    Args:
        td (TensorDictBase): the rows, ``[T]``.
        known (torch.Tensor): their fingerprints, int64 ``[T]`` or ``[T, 1]``.
        keys (sequence of NestedKey): the entries of states.
        next_keys (sequence of NestedKey): the entries of next states.
        names (sequence of str): the entities, in the order of the scores.
        rows (torch.Tensor, optional): int64 ``[B]``, the rows to compare. Defaults to
            all of them.

    Returns:
        torch.Tensor: bool ``[B]``.
    """
    known = known.reshape(-1)
    found = _matched(td, known, keys, next_keys, names, rows)
    if found is not None:
        return found
    left = known if rows is None else known.index_select(0, rows)
    for entries, factor in ((keys, 1), (next_keys, _NEXT)):
        for number, leaf in enumerate(state_leaves(td, entries)):
            leaf = leaf if rows is None else leaf.index_select(0, rows)
            left = left - _weighted(_lanes(leaf), number, factor)
    return left >> 32 == upper_half(tuple(names))


def _matched(
    td: TensorDictBase,
    known: torch.Tensor,
    keys: Sequence[NestedKey],
    next_keys: Sequence[NestedKey],
    names: Sequence[str],
    rows: torch.Tensor | None,
) -> torch.Tensor | None:
    """Returns what :func:`matches` does, in C or CUDA; ``None`` if they need torch."""
    known = plain(known)
    numbers = (known,) if rows is None else (known, rows)
    if any(x.dtype is not torch.int64 or x.ndim != 1 for x in numbers):
        return None
    hashed = hashed_leaves(td, keys, next_keys, len(known))
    if hashed is None:
        return None
    leaves, weights = (list(part) for part in zip(*hashed, strict=True))
    if not is_native(numbers[-1], sources=[known, *leaves]):
        return None
    return state_matches(leaves, weights, known, upper_half(tuple(names)), rows)


def hashed_leaves(
    td: TensorDictBase,
    keys: Sequence[NestedKey],
    next_keys: Sequence[NestedKey],
    length: int,
) -> list[tuple[torch.Tensor, torch.Tensor]] | None:
    """Returns the leaves that are hashed, and their weights, for functions in C.

    Args:
        td (TensorDictBase): the rows, ``[T]``.
        keys (sequence of NestedKey): the entries of states.
        next_keys (sequence of NestedKey): the entries of next states.
        length (int): how many rows are needed.

    Returns:
        list of tuple, optional: float32 ``[T, L]`` and int64 ``[L]`` each; ``None`` if
        there is none, one of them is not float32 ``[T, L]`` or has fewer rows than
        needed, or there are more than the functions read.
    """
    found = []
    for entries, factor in ((keys, 1), (next_keys, _NEXT)):
        for number, leaf in enumerate(state_leaves(td, entries)):
            leaf = plain(leaf)
            if not _is_row_of_floats(leaf) or len(leaf) < length:
                return None
            weights = _weights(leaf.shape[1], number, factor, leaf.device)
            found.append((leaf, weights))
    return found if 0 < len(found) <= MOST_LEAVES else None


def _is_row_of_floats(leaf: torch.Tensor) -> bool:
    return leaf.dtype is torch.float32 and leaf.ndim == 2


def is_fingerprint_of(
    known: torch.Tensor,
    state: torch.Tensor,
    after: torch.Tensor | None,
    names: Sequence[str],
) -> torch.Tensor:
    """Returns which rows still have the states of their fingerprints, bool ``[B]``."""
    return (known.reshape(-1) - _joint(state, after)) >> 32 == upper_half(tuple(names))


def settings_of(
    known: torch.Tensor, state: torch.Tensor, after: torch.Tensor | None
) -> torch.Tensor:
    """Returns the settings of rows, int64 ``[B]``, meaningless where states differ."""
    return (known.reshape(-1) - _joint(state, after)) & 0xFFFFFFFF


def rows_with_fingerprints(
    td: TensorDictBase,
    known: torch.Tensor,
    keys: Sequence[NestedKey],
    next_keys: Sequence[NestedKey],
    names: Sequence[str],
    *,
    batch_size: int = 1 << 16,
) -> torch.Tensor:
    """Returns which rows of a storage still have the states of their fingerprints.

    Args:
        td (TensorDictBase): the rows, at least ``T``.
        known (torch.Tensor): the fingerprints, int64 ``[T]``.
        keys (sequence of NestedKey): the entries of states.
        next_keys (sequence of NestedKey): the entries of next states.
        names (sequence of str): the entities, in the order of the scores.

    Keyword Args:
        batch_size (int): rows that are read at a time. Defaults to 65,536.

    Returns:
        torch.Tensor: bool ``[T]``.
    """
    found = torch.zeros(len(known), dtype=torch.bool, device=known.device)
    for start in range(0, len(known), batch_size):
        rows = slice(start, min(start + batch_size, len(known)))
        found[rows] = matches(td[rows], known[rows], keys, next_keys, names)
    return found


@lru_cache(maxsize=256)
def upper_half(names: tuple[str, ...]) -> int:
    """Returns the upper half of a fingerprint less the hash of its states.

    So that no score is used for another entity. The lower half is the settings.

    Args:
        names (tuple of str): the entities, in the order of the scores.

    Returns:
        int: the number, at least 0.
    """
    digest = hashlib.sha256("\0".join(names).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1  # not negative


def _joint(state: torch.Tensor, after: torch.Tensor | None) -> torch.Tensor:
    if after is None:
        return state
    return torch.add(state, after, alpha=_signed(_NEXT))


def state_leaves(
    td: TensorDictBase, keys: Sequence[NestedKey]
) -> Iterator[torch.Tensor]:
    """Yields the tensors of a state, always in the same order."""
    for key in keys:
        value = leaf_of(td, key)
        if type(value) is torch.Tensor and value.numel():  # the usual case, quickly
            yield value
            continue
        if is_tensor_collection(value):
            names = sorted(value.keys(True, True), key=path)
            leaves = [value.get(name) for name in names]
        else:
            leaves = [value]
        for leaf in leaves:
            if isinstance(leaf, torch.Tensor) and leaf.numel():
                yield leaf.as_subclass(torch.Tensor)


def _lanes(leaf: torch.Tensor) -> torch.Tensor:
    """Returns the bits of a leaf ``[B, ...]`` as int64 ``[B, L]``.

    The bits of a value are in the lower halves of lanes, so that a change of the upper
    ones, such as that of the sign, reaches half of the bits of the hash.
    """
    if leaf.dtype is torch.float32 and leaf.ndim == 2 and leaf.is_contiguous():
        return leaf.view(torch.int32).long()  # the usual case, quickly
    flat = leaf if leaf.ndim == 2 else leaf.reshape(len(leaf), -1)
    if flat.is_complex():
        flat = torch.view_as_real(flat).flatten(1)
    if flat.is_floating_point():
        if flat.stride(-1) != 1:
            flat = flat.clone(memory_format=torch.contiguous_format)
        flat = flat.view(torch.int16 if flat.dtype.itemsize == 2 else torch.int32)
    return flat.long()


def _weighted(lanes: torch.Tensor, number: int, factor: int) -> torch.Tensor:
    """Returns the sums of lanes ``[B, L]`` with random weights, int64 ``[B]``."""
    weights = _weights(lanes.shape[1], number, factor, lanes.device)
    if lanes.device.type == "cpu":
        return torch.mv(lanes, weights)
    return (lanes * weights).sum(-1)  # integers have no products on other devices


def leaf_weights(width: int, number: int, device: torch.device) -> torch.Tensor:
    """Returns the weights of the values of a leaf in the hash of its state.

    Args:
        width (int): the values in a row.
        number (int): the place of the leaf in the state.
        device (torch.device): the device of the result.

    Returns:
        torch.Tensor: int64 ``[width]``; do not write to it.
    """
    return _weights(width, number, 1, device)


@lru_cache(maxsize=256)
def _weights(
    width: int, number: int, factor: int, device: torch.device
) -> torch.Tensor:
    """Returns odd random weights of the lanes of a leaf, int64 ``[width]``."""
    found = []
    seed = (number + 1) * 0xD1B54A32D192ED03 & _MASK
    for _ in range(width):  # SplitMix64, the same on every machine
        seed = (seed + _NEXT) & _MASK
        mixed = ((seed ^ (seed >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
        mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) & _MASK
        weight = (mixed ^ (mixed >> 31)) | 1
        found.append(_signed(weight * factor & _MASK))
    return torch.tensor(found, dtype=torch.int64, device=device)


def _signed(number: int) -> int:
    return number - (1 << 64) if number >> 63 else number
