"""Originals and counterfactuals as one folder of transitions."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tqdm.auto import tqdm

from torchrl_caiac._files import reserve
from torchrl_caiac._keys import path as path_of
from torchrl_caiac.augment.rewards import ends_at_goals, find_sparse_reward
from torchrl_caiac.augment.trajectories import (
    TrajectoryPlan,
    counterfactual_trajectories,
)
from torchrl_caiac.augment.transitions import counterfactual_transitions
from torchrl_caiac.data import action_bounds, load_transitions
from torchrl_caiac.data.action_bounds import write_action_bounds
from torchrl_caiac.data.digests import write_digests
from torchrl_caiac.data.write_transitions import check_free, whole_transitions
from torchrl_caiac.scored import ScoredDataset
from torchrl_caiac.trajectories import trajectory_index
from torchrl_caiac.transforms import TransformKeys

__all__ = ["augment_dataset", "needs_reward"]

_CHUNK = 1 << 14  # rows copied at a time
_KEYS = TransformKeys()


def augment_dataset(
    scored: ScoredDataset,
    path: str | os.PathLike[str],
    ratio: float = 0.5,
    *,
    kind: Literal["transitions", "trajectories"] = "transitions",
    reward: Literal["stored", "sparse"] | None = None,
    tolerance: float | None = None,
    originals: bool = True,
    seed: int = 0,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes originals and counterfactuals as one folder of transitions, and opens it.

    ``"transitions"`` are samples of a replay buffer with a
    :class:`~torchrl_caiac.transforms.CAIACTransform` and the thresholds of ``scored``;
    each is an episode of one step, cut off after it. ``"trajectories"`` are whole
    trajectories in which entities that are uninfluenced from beginning to end are those
    of other trajectories, at least as long. In each, at least one entity is swapped.

    Goals follow if the layout maps them. The result has ``("caiac",
    "counterfactual")``, bool ``[T, 1]``, and ``("caiac", "swapped")``, bool ``[T, N]``.
    Entries under ``"info"`` are left out, since they would not follow, and so are other
    entries that are neither part of the state nor of a transition.

    Args:
        scored (ScoredDataset): the dataset.
        path (path): the folder to write. It is written atomically.
        ratio (float): the share of counterfactual transitions (or trajectories) in
            originals and counterfactuals together, in (0, 1). Defaults to 0.5.

    Keyword Args:
        kind (str): ``"transitions"`` or ``"trajectories"``. Defaults to
            ``"transitions"``.
        reward (str, optional): the rewards of counterfactuals. ``"stored"``: those of
            the original transition; ``"sparse"``: recomputed, see
            :func:`~torchrl_caiac.augment.find_sparse_reward`. If the task ends where
            goals are reached, ``("next", "terminated")`` is recomputed too, and
            trajectories end there. It must be given if the data have rewards, and goals
            that the layout maps. Defaults to ``None``: ``"stored"``.
        tolerance (float, optional): that of sparse rewards. Defaults to ``None``: found
            in the data.
        originals (bool): whether the originals are written too. Defaults to ``True``.
        seed (int): the seed. The same seed gives the same bytes. Defaults to 0.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.

    Returns:
        TensorDict: the memory-mapped transitions.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        OSError: the disk has too little space, which is found before anything is
            written.
        ValueError: an argument is out of range; ``path`` is the scored dataset or what
            it was made from, or one of them is inside of the other; nothing can be
            swapped; the choice of rewards is missing; no sparse reward agrees with the
            stored ones, or the task ends in other rows than those that reach their
            goals.

    Examples:
        See :doc:`/cli`.
    """
    if not 0 < ratio < 1:
        raise ValueError(f"ratio must be between 0 and 1, got {ratio}")
    if kind not in ("transitions", "trajectories"):
        raise ValueError(f"kind must be 'transitions' or 'trajectories', got {kind!r}")
    check_target(path, scored)
    check_free(path, overwrite)
    options = _rewards(scored, reward, tolerance)
    generator = torch.Generator().manual_seed(seed)
    data = _kept(scored)
    index = trajectory_index(scored.data)
    before = len(data) if originals else 0
    first = _flagged(data[:1].to_tensordict(), scored).exclude(*_scores(scored))
    parts: Iterator[TensorDictBase]
    if kind == "trajectories":
        count = _count(ratio, len(index.ends))
        # Before the plan, which needs memory for each of them.
        _check_space(path, first, before + count * int(index.lengths.min()), ratio)
        plan = TrajectoryPlan(scored, count, generator)
        rows, number = plan.rows, count
        parts = counterfactual_trajectories(plan, data, **options)
        if "terminated_fn" in options:
            # Only the new ends say how long the trajectories are: make them twice.
            state = generator.get_state()
            rows = sum(len(part) for part in _ended(parts))
            generator.set_state(state)
            parts = _ended(counterfactual_trajectories(plan, data, **options))
    else:
        rows = number = _count(ratio, len(data))
        parts = _single_steps(
            counterfactual_transitions(scored, data, rows, generator, **options)
        )
    _check_space(path, first, before + rows, ratio)
    episode = _first_id(scored.data["episode"], number) if originals else 0
    bounds = action_bounds(scored.data)
    with whole_transitions(path, overwrite=overwrite) as folder:
        stored = first.expand(before + rows).memmap_like(folder)
        reserve(folder)
        _copy(data[:before], stored, scored)
        place = before
        with tqdm(total=number, disable=not progress, desc=kind, unit="") as bar:
            for part in parts:
                part = part.select(*first.keys(True, True))
                ids = torch.zeros_like(part["episode"]) + episode
                if kind == "transitions":
                    ids += torch.arange(len(part)).reshape(ids.shape)
                part["episode"] = ids
                stored[place : place + len(part)].update_(part)
                place += len(part)
                added = len(part) if kind == "transitions" else 1
                episode += added
                bar.update(added)
        source = {
            "scored": str(scored.path),
            "kind": kind,
            "ratio": ratio,
            "originals": originals,
            "seed": seed,
            "reward": repr(options["reward_fn"]) if options else "stored",
            "thresholds": scored.thresholds,
        }
        write_digests(folder, source=source)
        if bounds is not None:
            write_action_bounds(folder, *bounds)
    return load_transitions(Path(path))


def check_target(path: str | os.PathLike[str], scored: ScoredDataset) -> None:
    """Raises if a result would replace the dataset that it is made from.

    Args:
        path (path): the file or folder to write.
        scored (ScoredDataset): the dataset.

    Raises:
        ValueError: ``path`` is the scored dataset or the file or folder that it was
            made from, or one of them is inside of the other.

    Examples:
        See :doc:`/cli`.
    """
    target = Path(path).resolve()
    places = {"the scored dataset": scored.path}
    source = scored.source.get("source")
    if isinstance(source, str) and Path(source).exists():
        places["the data that were scored"] = Path(source)
    for what, place in places.items():
        place = place.resolve()
        if target == place:
            raise ValueError(f"{path} is {what}: write elsewhere")
        if target.is_relative_to(place) or place.is_relative_to(target):
            inside = target.is_relative_to(place)
            text = f"is inside of {place}," if inside else f"contains {place},"
            raise ValueError(f"{path} {text} {what}: write elsewhere")


def needs_reward(scored: ScoredDataset) -> bool:
    """Returns whether rewards must be chosen, since goals follow a swap.

    Args:
        scored (ScoredDataset): the dataset.

    Returns:
        bool: whether there are rewards, and goals that the layout maps.
    """
    data, layout = scored.data, scored.layout
    keys = [layout.desired_goal_key] if layout.is_flat else list(layout.goal.values())
    has_goals = any(key and data.get(key, None) is not None for key in keys)
    has_rewards = data.get(_KEYS.reward, None) is not None
    return bool(layout.goal) and has_goals and has_rewards


def _count(ratio: float, originals: int) -> int:
    """Returns the number of counterfactuals, at least one."""
    return max(1, round(ratio / (1 - ratio) * originals))


def _check_space(
    path: str | os.PathLike[str], first: TensorDictBase, rows: int, ratio: float
) -> None:
    """Raises if a disk has too little space for ``rows`` rows such as ``first``."""
    folder = Path(path).absolute().parent
    while not folder.exists():
        folder = folder.parent
    size = rows * sum(x.numel() * x.element_size() for x in first.values(True, True))
    free = shutil.disk_usage(folder).free
    if size > free:
        raise OSError(
            errno.ENOSPC,
            f"{rows} transitions at the ratio {ratio} need {size / 1e9:.1f} GB, and "
            f"the disk of {folder} has {free / 1e9:.1f} GB left: lower the ratio, or "
            "write to another disk",
        )


def _first_id(ids: torch.Tensor, number: int) -> int:
    """Returns the first of ``number`` trajectory ids that the originals do not have."""
    first = int(ids.max()) + 1
    if ids.is_floating_point():
        largest = int(2 / torch.finfo(ids.dtype).eps)  # the next integer is rounded
    else:
        largest = torch.iinfo(ids.dtype).max
    if first + number - 1 > largest:
        raise ValueError(
            f"'episode' has ids up to {first - 1}, and its type {ids.dtype} "
            f"cannot hold the {number} ids that follow: number the trajectories from "
            "0, or leave out the originals"
        )
    return first


def _scores(scored: ScoredDataset) -> list[Any]:
    """Returns the keys that only the transform reads."""
    kept = {path_of(_KEYS.counterfactual), path_of(_KEYS.swapped)}
    return [
        key
        for key in scored.data.keys(True, True)
        if path_of(key)[0] == path_of(scored.score_key)[0] and path_of(key) not in kept
    ]


def _kept(scored: ScoredDataset) -> TensorDictBase:
    """Returns the transitions with the entries that follow a swap, and the scores."""
    layout = scored.layout
    states = [layout.in_keys, layout.desired_goal_key, layout.achieved_goal_key]
    states += [*layout.goal.values(), *layout.achieved.values()]
    roots = {"action", "episode", "observation"}
    for key in _keys(states):
        roots.add(path_of(key)[0])
    known = {"reward", "done", "terminated", "truncated"}
    kept = [
        key
        for key in scored.data.keys(True, True)
        if path_of(key)[0] in roots
        or path_of(key)[0] == path_of(scored.score_key)[0]
        or (path_of(key)[0] == "next" and path_of(key)[1] in roots | known)
    ]
    return scored.data.select(*kept)


def _keys(values: list[Any]) -> Iterator[Any]:
    """Yields the keys among keys, lists of keys, columns and ``None``."""
    for value in values:
        if isinstance(value, list):
            yield from value
        elif value is not None and all(isinstance(part, str) for part in value):
            yield value


def _copy(data: TensorDictBase, stored: TensorDictBase, scored: ScoredDataset) -> None:
    """Writes originals to the first rows of the result."""
    keys = list(stored.keys(True, True))
    for begin in range(0, len(data), _CHUNK):
        part = _flagged(data[begin : begin + _CHUNK].to_tensordict(), scored)
        stored[begin : begin + len(part)].update_(part.select(*keys))


def _flagged(rows: TensorDictBase, scored: ScoredDataset) -> TensorDictBase:
    shape = (len(rows), len(scored.layout))
    rows[_KEYS.counterfactual] = torch.zeros(shape[0], 1, dtype=torch.bool)
    rows[_KEYS.swapped] = torch.zeros(shape, dtype=torch.bool)
    return rows


def _single_steps(parts: Iterator[TensorDictBase]) -> Iterator[TensorDictBase]:
    """Makes each row an episode of one step."""
    for part in parts:
        after = part["next"]
        after["done"] = torch.ones_like(after["done"])
        terminated = after.get("terminated", None)
        truncated = after.get("truncated", None)
        if terminated is not None:
            after["truncated"] = (terminated == 0).to(terminated.dtype)
        elif truncated is not None:
            after["truncated"] = torch.ones_like(truncated)
        yield part


def _rewards(
    scored: ScoredDataset, reward: str | None, tolerance: float | None
) -> dict[str, Any]:
    if reward not in (None, "stored", "sparse"):
        raise ValueError(f"reward must be 'stored' or 'sparse', got {reward!r}")
    if tolerance is not None and reward != "sparse":
        raise ValueError("a tolerance is given, but not the sparse reward that has it")
    if reward is None and needs_reward(scored):
        raise ValueError(
            "the data have goals and rewards: say whether counterfactuals keep the "
            "'stored' rewards, or get 'sparse' ones of their new goals"
        )
    if reward != "sparse":
        return {}
    if not scored.layout.goal:
        raise ValueError("sparse rewards need goals, and the layout has none")
    rule = find_sparse_reward(scored.data, scored.layout, tolerance)
    if not ends_at_goals(rule, scored.data, scored.layout):
        return {"reward_fn": rule}
    return {"reward_fn": rule, "terminated_fn": rule.is_reached}


def _ended(parts: Iterator[TensorDictBase]) -> Iterator[TensorDictBase]:
    """Cuts trajectories after the first row that ends the task, and closes others."""
    for part in parts:
        ends = part[_KEYS.terminated].reshape(-1).nonzero()[:, 0]
        part = part[: int(ends[0]) + 1] if len(ends) else part
        after, last = part["next"], slice(len(part) - 1, len(part))
        after["done"][last] = True
        if after.get("truncated", None) is not None:
            after["truncated"][last] = ~after["terminated"][last]
        yield part
