"""Mixtures of datasets in given shares and sizes, by whole trajectories."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, is_leaf_nontensor
from tensordict.utils import NestedKey

from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.minari_files import whole_folder
from torchrl_caiac.entities import _path

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
    trajectory_key: NestedKey = "episode",
    source_key: NestedKey = "source",
    source_trajectory_key: NestedKey = "source_episode",
    overwrite: bool = False,
) -> TensorDict:
    """Draws whole trajectories from several datasets, in given shares.

    The paper's Fetch-Push data are 30 % expert and 70 % random episodes, learnt from
    whole, to 20 % and to 10 % (A.3.1). All trajectories that a mixture can have are
    put in one random order in which every beginning keeps the shares as well as whole
    trajectories allow; ``trajectories`` and ``fraction`` say how much of the beginning
    is taken. So of two mixtures with the same sources, shares and seed, the smaller one
    is the beginning of the larger one. Rows keep their order within a trajectory.

    The rows' leaves are those of the sources, and:

    - ``trajectory_key``: renumbered 0, 1, ... in the order of the rows, int64;
    - ``source_key``: the position in ``sources`` that a row came from, int64 ``[]``;
    - ``source_trajectory_key``: the trajectory's id there.

    Args:
        sources (sequence of TensorDictBase): transitions ``[T]``, in memory or
            memory-mapped, with the same keys, dtypes and shapes behind ``T``. The rows
            of a trajectory lie one after another.

    Keyword Args:
        shares (sequence of float, optional): share of each source in the mixture's
            trajectories; positive, sum 1. Defaults to ``None``: whatever share each
            source's trajectories have among all.
        fraction (float): how much of the mixture is taken, in (0, 1]. Defaults to
            ``1.0``.
        trajectories (int, optional): trajectories of the whole mixture. Defaults to
            ``None``: the most of which no source's share is more than it has.
        seed (int): seed of the draw. Defaults to ``0``.
        path (str or Path, optional): folder for a memory-mapped result, which appears
            whole or not at all; it is filled leaf by leaf. Defaults to ``None``: in
            memory.
        trajectory_key (NestedKey): the trajectory ids, ``[T]`` or ``[T, 1]``. Defaults
            to ``"episode"``.
        source_key (NestedKey): see above. Defaults to ``"source"``.
        source_trajectory_key (NestedKey): see above. Defaults to ``"source_episode"``.
        overwrite (bool): replace what is at ``path``. Defaults to ``False``.

    Returns:
        TensorDict: the rows, ``[T']``, locked where memory-mapped.

    Raises:
        FileExistsError: there is something at ``path``.
        KeyError: a source lacks ``trajectory_key``.
        ValueError: sources differ in their leaves, have none, or have trajectories in
            pieces; ``shares``, ``fraction`` or ``trajectories`` are out of range or ask
            for more trajectories than there are.

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
    if path is not None and Path(path).exists() and not overwrite:
        raise FileExistsError(
            f"there is something at {path}: open it with load_transitions, or pass "
            "overwrite=True to replace it"
        )
    new = (source_key, source_trajectory_key)
    _check_sources(sources, new)
    runs = [
        _runs(source, trajectory_key, number) for number, source in enumerate(sources)
    ]
    picks = _draw_trajectories(
        [len(run.starts) for run in runs], shares, fraction, trajectories, seed
    )
    rows = _locate(runs, picks)
    logger.info(
        "mixed %d trajectories, %d rows; of each source: %s",
        len(picks),
        len(rows.number),
        np.bincount(picks[:, 0], minlength=len(sources)).tolist(),
    )
    # One row of the result, to be spread over its length without being read.
    one = sources[0][:1].clone()
    ids = one.get(trajectory_key)
    one.set(source_trajectory_key, ids.clone())
    one.set(trajectory_key, ids.long())
    one.set(source_key, torch.zeros(1, dtype=torch.long, device=ids.device))
    total = len(rows.number)
    keys = (trajectory_key, source_key, source_trajectory_key)
    if path is None:
        mixed = one.expand(total).apply(torch.empty_like)
        _fill(mixed, sources, rows, *keys)
        return mixed
    with whole_folder(path) as folder:
        _fill(one.cpu().expand(total).memmap_like(folder), sources, rows, *keys)
    return load_transitions(path, keys=keys)


@dataclasses.dataclass(frozen=True)
class _Runs:
    """The trajectories of a source: first rows `[E]` and lengths `[E]`."""

    starts: torch.Tensor
    lengths: torch.Tensor


@dataclasses.dataclass(frozen=True)
class _Rows:
    """Where the rows of a mixture come from, int64 `[T']` each, on the CPU."""

    number: torch.Tensor  # of the trajectory in the mixture
    source: torch.Tensor
    row: torch.Tensor  # in the source


def _draw_trajectories(
    counts: Sequence[int],
    shares: Sequence[float] | None,
    fraction: float,
    trajectories: int | None,
    seed: int,
) -> np.ndarray:
    """Draw the mixture's trajectories, pairs of source and trajectory in it `[E, 2]`.

    The j-th trajectory of a source with share p comes at the place (j + 1/2) / p: the
    method of Sainte-Laguë for seats in a parliament, in which nobody loses a seat when
    there are more of them.
    """
    if shares is None:
        parts = [count / sum(counts) for count in counts]
    else:
        parts = [float(share) for share in shares]
        if len(parts) != len(counts):
            raise ValueError(
                f"there are {len(parts)} shares {parts} for {len(counts)} sources: "
                "give one for each"
            )
        # NaN is no positive number either.
        if not all(part > 0 for part in parts) or not math.isclose(
            sum(parts), 1.0, abs_tol=1e-6
        ):
            raise ValueError(
                f"shares are {parts}, sum {sum(parts):g}; wanted positive numbers with "
                "sum 1: leave sources without a share out"
            )
    if not 0 < fraction <= 1:
        raise ValueError(f"fraction is {fraction}, wanted above 0 and at most 1")
    places = [
        (np.arange(count + 1) + 0.5) / part
        for count, part in zip(counts, parts, strict=True)
    ]
    end = min(place[-1] for place in places)
    order = np.concatenate([place[:-1] for place in places])
    who = np.repeat(np.arange(len(counts)), counts)
    # Each source's stream has its own seed: another source's size changes nothing.
    which = np.concatenate(
        [
            np.random.default_rng([seed, number]).permutation(count)
            for number, count in enumerate(counts)
        ]
    )
    # Rounding may be kind to the scarce source: not beyond what the shares give.
    limit = min(count / part for count, part in zip(counts, parts, strict=True))
    most = min(int((order < end).sum()), math.floor(limit + 1e-6))
    if trajectories is None:
        trajectories = most
    if not 1 <= trajectories <= most:
        raise ValueError(
            f"trajectories is {trajectories}, wanted 1 to {most}: the sources have "
            f"{list(counts)}, and the shares are {[round(part, 6) for part in parts]}"
        )
    taken = round(fraction * trajectories)
    if not taken:
        raise ValueError(
            f"fraction {fraction} of {trajectories} trajectories is not a single one: "
            "raise it"
        )
    first = np.argsort(order, kind="stable")[:taken]
    return np.stack([who[first], which[first]], 1)


def _locate(runs: Sequence[_Runs], picks: np.ndarray) -> _Rows:
    who, which = torch.from_numpy(picks).unbind(1)
    starts, lengths = torch.empty_like(who), torch.empty_like(who)
    for source, run in enumerate(runs):
        mine = who == source
        starts[mine] = run.starts[which[mine]]
        lengths[mine] = run.lengths[which[mine]]
    number = torch.arange(len(who)).repeat_interleave(lengths)
    step = torch.arange(len(number)) - (lengths.cumsum(0) - lengths)[number]
    return _Rows(number, who[number], starts[number] + step)


def _fill(
    mixed: TensorDictBase,
    sources: Sequence[TensorDictBase],
    rows: _Rows,
    trajectory_key: NestedKey,
    source_key: NestedKey,
    source_trajectory_key: NestedKey,
) -> None:
    shape = mixed.get(trajectory_key).shape
    mixed.get(trajectory_key).copy_(rows.number.view(shape))
    mixed.get(source_key).copy_(rows.source)
    keys = sources[0].keys(include_nested=True, leaves_only=True)
    for number, source in enumerate(sources):
        places = (rows.source == number).nonzero().squeeze(1)
        taken = rows.row[places]
        for key in keys:
            same = _path(key) == _path(trajectory_key)
            leaf, target = (
                source.get(key),
                mixed.get(source_trajectory_key if same else key),
            )
            target[places.to(target.device)] = leaf[taken.to(leaf.device)].to(
                target.device
            )


def _runs(source: TensorDictBase, trajectory_key: NestedKey, number: int) -> _Runs:
    ids = source.get(trajectory_key, None)
    if not isinstance(ids, torch.Tensor):
        found = sorted(map(str, source.keys(include_nested=True, leaves_only=True)))
        raise KeyError(
            f"source {number} has no tensor {trajectory_key!r} to tell trajectories "
            f"apart; it has {found}: give trajectory_key="
        )
    if ids.numel() != len(source):
        raise ValueError(
            f"{trajectory_key!r} of source {number} has the shape {tuple(ids.shape)}, "
            f"wanted {(len(source),)} or {(len(source), 1)}"
        )
    ids = ids.reshape(-1).cpu()
    begins = torch.ones(len(ids), dtype=torch.bool)
    begins[1:] = ids[1:] != ids[:-1]
    starts = begins.nonzero().squeeze(1)
    names, pieces = ids[starts].unique(return_counts=True)
    if (pieces > 1).any():
        raise ValueError(
            f"the rows of trajectory {names[pieces > 1][0].item()} of source {number} "
            "do not lie one after another: sort them, or give every piece an id of its "
            f"own in {trajectory_key!r}"
        )
    ends = torch.cat([starts[1:], torch.tensor([len(ids)])])
    return _Runs(starts, ends - starts)


def _check_sources(sources: Sequence[TensorDictBase], new: Sequence[NestedKey]) -> None:
    if isinstance(sources, TensorDictBase) or not len(sources):
        raise ValueError("sources must be a sequence of at least one tensordict")
    wanted = _structure(sources[0], 0)
    for number, source in enumerate(sources):
        if source.batch_dims != 1 or not len(source):
            raise ValueError(
                f"source {number} has the batch size {list(source.batch_size)}, wanted "
                "[T] with at least one row"
            )
        found = _structure(source, number)
        lacking = sorted(set(wanted) ^ set(found))
        if lacking:
            raise ValueError(
                f"only one of source 0 and source {number} has {lacking}: leave them "
                "out with exclude(), or add them"
            )
        differ = {key: (wanted[key], found[key]) for key in wanted}
        differ = {key: pair for key, pair in differ.items() if pair[0] != pair[1]}
        if differ:
            raise ValueError(
                f"leaves of source 0 and source {number} differ in dtype or shape "
                f"behind the batch dimension: {differ}"
            )
        for key in new:
            if source.get(key, None) is not None:
                raise ValueError(
                    f"source {number} already has {key!r}, which the mixture would "
                    "overwrite: rename it, or give source_key= and "
                    "source_trajectory_key="
                )


def _structure(
    rows: TensorDictBase, number: int
) -> dict[tuple[str, ...], tuple[torch.dtype, tuple[int, ...]]]:
    structure = {}
    for key, leaf in rows.items(True, True, is_leaf=is_leaf_nontensor):
        if not isinstance(leaf, torch.Tensor):
            raise ValueError(
                f"{key!r} of source {number} is no tensor: leave it out with exclude()"
            )
        structure[_path(key)] = (leaf.dtype, tuple(leaf.shape[1:]))
    return structure
