"""Mixtures of datasets, by whole trajectories, with given shares and sizes."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import permutations
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._files import reserve
from torchrl_caiac._fingerprints import fingerprint, state_hash
from torchrl_caiac._keys import as_key, get_leaf
from torchrl_caiac._keys import path as key_path
from torchrl_caiac._torchrl import memmap_folder
from torchrl_caiac.data.action_bounds import action_bounds, write_action_bounds
from torchrl_caiac.data.digests import data_digest, has_digests, write_digests
from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.write_transitions import (
    check_entries,
    check_free,
    whole_transitions,
)
from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index

__all__ = ["mix_trajectories"]

logger = logging.getLogger("torchrl_caiac.data.mix_trajectories")


def mix_trajectories(
    sources: Sequence[TensorDictBase],
    *,
    shares: Sequence[float] | None = None,
    fraction: float = 1.0,
    trajectories: int | None = None,
    seed: int = 0,
    path: str | Path | None = None,
    trajectory_key: NestedKey | list[NestedKey] = "episode",
    exclude: Sequence[NestedKey] = (),
    done_key: NestedKey | None = ("next", "done"),
    source_key: NestedKey = "source",
    source_trajectory_key: NestedKey = "source_episode",
    overwrite: bool = False,
) -> TensorDict:
    """Draws whole trajectories from several datasets, with given shares.

    For example, the Fetch-Push data of the paper are 30 % expert and 70 % random
    episodes, of which learners use 100 %, 20 % or 10 % (A.3.1).

    All trajectories that a mixture can have are put in one random order, in which every
    prefix has the given shares as exactly as whole trajectories allow. The mixture is a
    prefix of this order, whose length is ``fraction * trajectories``. Hence, of two
    mixtures with the same sources, shares and seed, the smaller one is a prefix of the
    larger one. The rows of a trajectory become consecutive, in the order of time.

    The result has the leaves of the sources, and:

    - ``trajectory_key``: new trajectory ids 0, 1, ... in the order of the rows, int64;
    - ``source_key``: the position in ``sources`` of the dataset that a row comes from,
      int64 ``[T']``;
    - ``source_trajectory_key``: the trajectory id in that dataset.

    A folder also has digests of the leaves, and the bounds of the action space where
    all sources have the same.

    Args:
        sources (sequence of TensorDictBase): transitions ``[T]``, in memory or
            memory-mapped, as from any of the loaders, with the same keys, dtypes and
            shapes after ``T``, except for the trajectory ids and what ``exclude``
            names. For the trajectories see
            :func:`~torchrl_caiac.trajectories.trajectory_index`.

    Keyword Args:
        shares (sequence of float, optional): the share of each source in the
            trajectories of the mixture; positive, sum 1. Defaults to ``None``: the
            share of each source in all trajectories.
        fraction (float): the part of the mixture to take, in (0, 1]. Defaults to
            ``1.0``.
        trajectories (int, optional): the number of trajectories of the whole mixture.
            Defaults to ``None``: the largest number that the sources allow.
        seed (int): the seed of the draw. Defaults to ``0``.
        path (str or Path, optional): the folder of a memory-mapped result. It is
            written leaf by leaf and atomically. Defaults to ``None``: in memory.
        trajectory_key (NestedKey or list of NestedKey): the key of the trajectory ids,
            ``[T]`` or ``[T, 1]``; a list has one for each source, and the mixture has
            the first one. Defaults to ``"episode"``.
        exclude (sequence of NestedKey): entries to leave out of all sources that have
            them, such as ``("info", "qpos")`` or ``"caiac"``. Defaults to ``()``.
        done_key (NestedKey, optional): the end flags, which end a trajectory too where
            the data have them; ``None`` to use the ids alone. Defaults to
            ``("next", "done")``.
        source_key (NestedKey): see above. Defaults to ``"source"``.
        source_trajectory_key (NestedKey): see above. Defaults to ``"source_episode"``.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.

    Returns:
        TensorDict: the rows, ``[T']``, locked if memory-mapped.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        KeyError: a source lacks ``trajectory_key``, or all lack one of ``exclude``.
        OSError: the disk is full.
        ValueError: the sources have different leaves or none; ``shares``, ``fraction``
            or ``trajectories`` are out of range or need more trajectories than the
            sources have.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data import mix_trajectories
        >>> def episodes(count, length):
        ...     ids = torch.arange(count).repeat_interleave(length)
        ...     return TensorDict({"action": torch.rand(len(ids), 4), "episode": ids},
        ...                       [len(ids)])
        >>> expert, random = episodes(30, 5), episodes(100, 5)
        >>> rows = mix_trajectories([expert, random], shares=[0.3, 0.7], fraction=0.2)
        >>> len(rows), (rows["source"] == 0).float().mean()  # 20 trajectories
        (100, tensor(0.3000))
    """
    check_free(path, overwrite)
    id_keys = _id_keys(trajectory_key, sources)
    leaves = _check_sources(
        sources, (source_key, source_trajectory_key), id_keys, exclude
    )
    trajectory_key = id_keys[0]
    indices = [
        _index(source, key, done_key, number)
        for number, (source, key) in enumerate(zip(sources, id_keys, strict=True))
    ]
    picks = _draw_trajectories(
        [len(index.ends) for index in indices], shares, fraction, trajectories, seed
    )
    rows = _locate(indices, picks)
    logger.info(
        "mixed %d trajectories with %d rows; trajectories of each source: %s",
        len(picks),
        len(rows.number),
        np.bincount(picks[:, 0], minlength=len(sources)).tolist(),
    )
    # One row of the result, expanded to allocate all of them.
    one = sources[0].select(*leaves, trajectory_key)[:1].clone()
    ids = one.get(trajectory_key)
    one.set(source_trajectory_key, _common_ids(sources, id_keys)[:1])
    one.set(trajectory_key, ids.long())
    one.set(source_key, torch.zeros(1, dtype=torch.long, device=ids.device))
    check_entries(one, "the mixture")  # the new keys too
    total = len(rows.number)
    keys = (trajectory_key, source_key, source_trajectory_key)
    fill = (sources, rows, leaves, id_keys)
    if path is None:
        mixed = one.expand(total).apply(torch.empty_like)
        _fill(mixed, *fill, *keys)
        return mixed
    with whole_transitions(path, keys=keys, overwrite=overwrite) as folder:
        stored = one.cpu().expand(total).memmap_like(folder)
        reserve(folder)
        _fill(stored, *fill, *keys)
        _write_origin(folder, sources)
    return load_transitions(path, keys=keys)


def _write_origin(folder: Path, sources: Sequence[TensorDictBase]) -> None:
    """Writes digests of the leaves and the sources, and the bounds of the actions."""
    found = [memmap_folder(source) for source in sources]
    digests = [
        data_digest(place) if place and has_digests(place) else None for place in found
    ]
    write_digests(folder, source={"mixed": digests})
    bounds = [action_bounds(source) for source in sources]
    known = [pair for pair in bounds if pair is not None]
    if len(known) == len(bounds) and all(
        torch.equal(torch.stack(pair), torch.stack(known[0])) for pair in known
    ):
        write_action_bounds(folder, *known[0])
    elif known:
        logger.warning("the sources have different action spaces: no bounds are stored")


@dataclasses.dataclass(frozen=True)
class _Rows:
    """The origin of the rows of a mixture, int64 ``[T']`` each, on the CPU."""

    number: torch.Tensor  # the trajectory in the mixture
    source: torch.Tensor
    row: torch.Tensor  # the row in the source


def _draw_trajectories(
    counts: Sequence[int],
    shares: Sequence[float] | None,
    fraction: float,
    trajectories: int | None,
    seed: int,
) -> np.ndarray:
    """Draws the trajectories of a mixture, pairs of source and trajectory ``[E, 2]``.

    The j-th trajectory of a source with share p is at the position (j + 1/2) / p. This
    is the method of Sainte-Laguë for seats in a parliament: no party loses a seat when
    the number of seats grows.
    """
    if shares is None:
        parts = [count / sum(counts) for count in counts]
    else:
        parts = [float(share) for share in shares]
        if len(parts) != len(counts):
            raise ValueError(
                f"there are {len(parts)} shares {parts} for {len(counts)} sources: "
                "give one share for each source"
            )
        # Written so that NaN fails too.
        if not all(part > 0 for part in parts) or not math.isclose(
            sum(parts), 1.0, abs_tol=1e-6
        ):
            raise ValueError(
                f"shares are {parts}, sum {sum(parts):g}; expected positive numbers "
                "with sum 1: leave out sources without a share"
            )
    if not 0 < fraction <= 1:
        raise ValueError(f"fraction is {fraction}, expected above 0 and at most 1")
    places = [
        (np.arange(count + 1) + 0.5) / part
        for count, part in zip(counts, parts, strict=True)
    ]
    end = min(place[-1] for place in places)
    order = np.concatenate([place[:-1] for place in places])
    source = np.repeat(np.arange(len(counts)), counts)
    # Each source has a seed of its own, so the size of another changes nothing.
    trajectory = np.concatenate(
        [
            np.random.default_rng([seed, number]).permutation(count)
            for number, count in enumerate(counts)
        ]
    )
    # Rounding must not take more of a source than its share allows.
    limit = min(count / part for count, part in zip(counts, parts, strict=True))
    most = min(int((order < end).sum()), math.floor(limit + 1e-6))
    if trajectories is None:
        trajectories = most
    if not 1 <= trajectories <= most:
        raise ValueError(
            f"trajectories is {trajectories}, expected 1 to {most}: the sources have "
            f"{list(counts)}, and the shares are {[round(part, 6) for part in parts]}"
        )
    taken = round(fraction * trajectories)
    if not taken:
        raise ValueError(
            f"fraction {fraction} of {trajectories} trajectories is less than one "
            "trajectory: raise it"
        )
    first = np.argsort(order, kind="stable")[:taken]
    return np.stack([source[first], trajectory[first]], 1)


def _locate(indices: Sequence[TrajectoryIndex], picks: np.ndarray) -> _Rows:
    source, trajectory = torch.from_numpy(picks).unbind(1)
    starts, lengths = torch.empty_like(source), torch.empty_like(source)
    for position, index in enumerate(indices):
        own = source == position
        lengths[own] = index.lengths.cpu()[trajectory[own]]
        starts[own] = (index.ends - index.lengths + 1).cpu()[trajectory[own]]
    number = torch.arange(len(source)).repeat_interleave(lengths)
    place = torch.arange(len(number)) - (lengths.cumsum(0) - lengths)[number]
    place += starts[number]
    rows, row_source = torch.empty_like(place), source[number]
    for position, index in enumerate(indices):
        own = row_source == position
        rows[own] = index.rows(place[own].to(index.device)).cpu()
    return _Rows(number, row_source, rows)


def _fill(
    mixed: TensorDictBase,
    sources: Sequence[TensorDictBase],
    rows: _Rows,
    leaves: Sequence[NestedKey],
    id_keys: Sequence[NestedKey],
    trajectory_key: NestedKey,
    source_key: NestedKey,
    source_trajectory_key: NestedKey,
) -> None:
    shape = mixed.get(trajectory_key).shape
    mixed.get(trajectory_key).copy_(rows.number.view(shape))
    mixed.get(source_key).copy_(rows.source)
    for number, (source, id_key) in enumerate(zip(sources, id_keys, strict=True)):
        places = (rows.source == number).nonzero().squeeze(1)
        taken = rows.row[places]
        pairs = [(key, key) for key in leaves] + [(id_key, source_trajectory_key)]
        for key, target_key in pairs:
            leaf, target = source.get(key), mixed.get(target_key)
            values = leaf[taken.to(leaf.device)].to(target.device, target.dtype)
            values = values.reshape(len(values), *target.shape[1:])
            target[places.to(target.device)] = values


def _common_ids(
    sources: Sequence[TensorDictBase], keys: Sequence[NestedKey]
) -> torch.Tensor:
    """Returns ids in the type and shape that those of all sources fit in."""
    ids = [source.get(key) for source, key in zip(sources, keys, strict=True)]
    kinds = {(leaf.dtype, leaf.shape[1:]) for leaf in ids}
    first = ids[0][:1].clone()
    return first if len(kinds) == 1 else first.reshape(1).long()


def _id_keys(
    given: NestedKey | list[NestedKey], sources: Sequence[TensorDictBase]
) -> list[NestedKey]:
    if not isinstance(given, list):
        return [given] * len(sources)
    if len(given) != len(sources):
        raise ValueError(
            f"trajectory_key is a list of {len(given)} keys for {len(sources)} "
            "sources: give one key, or one for each source"
        )
    return given


def _index(
    source: TensorDictBase,
    trajectory_key: NestedKey,
    done_key: NestedKey | None,
    number: int,
) -> TrajectoryIndex:
    try:
        return trajectory_index(
            source, trajectory_key=trajectory_key, done_key=done_key
        )
    except ValueError as error:
        raise ValueError(f"source {number}: {error}") from error


def _check_sources(
    sources: Sequence[TensorDictBase],
    new: Sequence[NestedKey],
    id_keys: Sequence[NestedKey],
    exclude: Sequence[NestedKey],
) -> list[NestedKey]:
    """Returns the keys of the leaves that all sources have, but for the ids."""
    if isinstance(sources, TensorDictBase) or not len(sources):
        raise ValueError(
            f"sources must be a sequence of at least one tensordict, got "
            f"{type(sources).__name__} of length {len(sources)}"
        )
    for number, source in enumerate(sources):
        if source.batch_dims != 1 or not len(source):
            raise ValueError(
                f"source {number} has batch size {list(source.batch_size)}, expected "
                "[T] with at least one row"
            )
        get_leaf(
            source,
            id_keys[number],
            f"source {number} lacks the trajectory ids",
            "pass trajectory_key=, a list if the sources have different keys",
        )
    left_out = [key_path(as_key(key)) for key in exclude]
    for key in left_out:
        if all(source.get(key, None) is None for source in sources):
            raise KeyError(f"no source has {key}, which exclude names: correct it")
    structures = [
        _structure(source, number, {key_path(as_key(id_key)), *left_out})
        for number, (source, id_key) in enumerate(zip(sources, id_keys, strict=True))
    ]
    expected = structures[0]
    for number, (source, found) in enumerate(zip(sources, structures, strict=True)):
        lacking = sorted(set(expected) ^ set(found))
        if lacking:
            names = [key[0] if len(key) == 1 else key for key in lacking]
            raise ValueError(
                f"only one of source 0 and source {number} has {lacking}: leave them "
                f"out with exclude={names}, or add them with add_leaf"
            )
        differ = {key: (expected[key], found[key]) for key in expected}
        differ = {key: pair for key, pair in differ.items() if pair[0] != pair[1]}
        if differ:
            names = [key[0] if len(key) == 1 else key for key in differ]
            raise ValueError(
                f"leaves of source 0 and source {number} differ in dtype or in the "
                f"shape after the batch dimension: {differ}; convert them, or leave "
                f"them out with exclude={names}"
            )
        for key in new:
            taken = source.get(key, None) is not None
            if taken and key_path(as_key(key)) not in left_out:
                raise ValueError(
                    f"source {number} already has {key!r}, which the mixture would "
                    "overwrite: rename it, leave it out with exclude=, or pass "
                    "source_key= and source_trajectory_key="
                )
    _check_scores(sources, expected)
    return [key[0] if len(key) == 1 else key for key in expected]


def _check_scores(
    sources: Sequence[TensorDictBase], leaves: Iterable[tuple[str, ...]]
) -> None:
    """Raises if sources have scores of different settings, by their fingerprints."""
    for key in leaves:
        if not key[-1].endswith("_fingerprint"):
            continue
        found = [_settings(source, key) for source in sources]
        known = [(number, one) for number, one in enumerate(found) if one is not None]
        for number, settings in known[1:]:
            first, other = known[0]
            if settings != other:
                scores = (*key[:-1], key[-1].removesuffix("_fingerprint"))
                names = [one[0] if len(one) == 1 else one for one in (scores, key)]
                raise ValueError(
                    f"{scores} of source {first} and source {number} were computed "
                    "with other settings, such as another estimator: score the mixture "
                    f"with one, and leave these scores out with exclude={names}"
                )


# Rows of which the settings of scores are compared, evenly spaced.
_LOOKED_AT = 64
# Entries of a nested state of which all orders are tried.
_MOST_ENTRIES = 5


def _settings(source: TensorDictBase, key: tuple[str, ...]) -> int | None:
    """Returns what scores depend on; ``None`` if their states cannot be told.

    The layout is not known: a state is one entry, or all entries of a nested one.
    Fingerprints less the hash of the state are alike in all rows if it is the right
    one.
    """
    count = min(_LOOKED_AT, len(source))
    rows = source[torch.arange(count) * len(source) // count]
    known = rows.get(key)
    for entries in _possible_states(rows):
        state = state_hash(rows, entries)
        after = state_hash(rows, [("next", *entry) for entry in entries])
        if state is None or after is None or len((state + after).unique()) < 2:
            continue  # where all rows are alike, any state seems to be right
        # Without the lower 16 bits, which are the surroundings of a row.
        rest = known.reshape(-1) - fingerprint(state, after, (), 0)
        found = (rest >> 16).unique()
        if len(found) == 1:
            return int(found)
    return None


def _possible_states(rows: TensorDictBase) -> Iterator[Sequence[tuple[str, ...]]]:
    keys = [key_path(key) for key in rows.keys(True, True)]
    groups: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for key in keys:
        if key[0] != "next" and ("next", *key) in keys:
            yield [key]
            groups.setdefault(key[:-1], []).append(key)
    for group in groups.values():
        if 1 < len(group) <= _MOST_ENTRIES:
            yield from permutations(group)


def _structure(
    rows: TensorDictBase, number: int, left_out: set[tuple[str, ...]]
) -> dict[tuple[str, ...], tuple[torch.dtype, tuple[int, ...]]]:
    kept = rows.exclude(*left_out)
    check_entries(kept, f"source {number}")
    return {
        key_path(key): (leaf.dtype, tuple(leaf.shape[1:]))
        for key, leaf in kept.items(include_nested=True, leaves_only=True)
    }
