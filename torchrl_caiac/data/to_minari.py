"""Transitions as Minari datasets."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._keys import as_key, leaf_names
from torchrl_caiac._keys import path as path_of
from torchrl_caiac.data.action_bounds import action_bounds as stored_bounds
from torchrl_caiac.data.action_bounds import check_action_bounds
from torchrl_caiac.data.load_transitions import check_transitions
from torchrl_caiac.data.minari_files import free_dataset_path, publish_dataset
from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index

if TYPE_CHECKING:
    from gymnasium import Space
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer

__all__ = ["to_minari"]

_logger = logging.getLogger("torchrl_caiac.data.to_minari")

_Path = tuple[str, ...]
_FLAGS = ("terminated", "truncated")
# What "next" has besides states.
_SIGNALS = {("reward",), ("done",), *((flag,) for flag in _FLAGS)}


class _Leaves(NamedTuple):
    """The paths of the leaves, those of states as at the root."""

    states: tuple[_Path, ...]
    actions: tuple[_Path, ...]
    infos: tuple[_Path, ...]
    has_reward: bool


def to_minari(
    data: TensorDictBase,
    dataset_id: str,
    *,
    root: str | os.PathLike[str] | None = None,
    action_bounds: tuple[Any, Any] | None = None,
    exclude: Sequence[NestedKey] = (),
    trajectory_key: NestedKey = "episode",
    description: str = "",
    algorithm_name: str = "unknown",
    code: str = "unknown",
    overwrite: bool = False,
    progress: bool = True,
) -> MinariDataset:
    """Writes transitions as a Minari dataset.

    :func:`~torchrl_caiac.data.load_minari` with ``infos`` reads the same transitions
    from it, with the trajectories numbered from 0. The dataset has no environment, only
    the spaces of observations and actions: unbounded for numbers, but for the actions
    where their bounds are known.

    Minari stores the states of an episode once, so every next state must be the state
    of the next row. It needs an info for the last state, which transitions do not have:
    that of the row before is repeated. Images are stored without loss. If the data have
    no rewards, zeros are written, with a warning.

    Args:
        data (TensorDictBase): the transitions, ``[T]``: ``"observation"`` (a tensor or
            nested), ``"action"``, the same observation under ``"next"``, and
            ``("next", "terminated")`` and ``("next", "truncated")``; further entries of
            the state, such as goals, at the root and under ``"next"``; other entries
            under ``"info"``.
        dataset_id (str): the id of the dataset, such as ``"push/play-v0"``.

    Keyword Args:
        root (path, optional): the folder of all Minari datasets. Defaults to ``None``:
            ``MINARI_DATASETS_PATH``, or the default of Minari.
        action_bounds (tuple of sequences, optional): the lowest and the highest action.
            Defaults to ``None``: those that are stored with the data, see
            :func:`~torchrl_caiac.data.action_bounds`; unbounded if there are none.
        exclude (sequence of NestedKey): entries to leave out, such as ``"caiac"`` with
            all scores. Defaults to ``()``.
        trajectory_key (NestedKey): the key of the trajectory ids. Defaults to
            ``"episode"``.
        description (str): the content of the dataset. Defaults to ``""``.
        algorithm_name (str): the policy that acted. Defaults to ``"unknown"``.
        code (str): the code that made the data. Defaults to ``"unknown"``.
        overwrite (bool): whether to replace the dataset if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar over the episodes. Defaults to
            ``True``.

    Returns:
        MinariDataset: the dataset.

    Raises:
        FileExistsError: the dataset exists and ``overwrite`` is ``False``.
        KeyError: the data lack an entry of ``exclude``.
        OSError: the disk is full.
        ValueError: the data lack an entry; have one that Minari cannot hold; a next
            state is not the state of the next row; the last row of a trajectory is not
            an end.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data import episode_transitions, load_minari, to_minari
        >>> rows = episode_transitions(
        ...     np.zeros((4, 2)), np.zeros((3, 1)), rewards=np.ones(3), where="one"
        ... )
        >>> rows["episode"] = torch.zeros(3, dtype=torch.int64)
        >>> folder = tempfile.TemporaryDirectory()
        >>> dataset = to_minari(rows, "push/play-v0", root=folder.name, progress=False)
        >>> again = load_minari(dataset, f"{folder.name}/rows", progress=False)
        >>> (again == rows).all()
        True
        >>> folder.cleanup()
    """
    target = free_dataset_path(dataset_id, root, overwrite)
    check_transitions(data, keys=["action", trajectory_key])
    if action_bounds is None:
        action_bounds = stored_bounds(data)
    else:
        action_bounds = check_action_bounds(*action_bounds)
    leaves = _leaves(data, {path_of(as_key(key)) for key in exclude}, trajectory_key)
    if not leaves.has_reward:
        _logger.warning(
            "the data have no ('next', 'reward'), so %s gets rewards of 0", dataset_id
        )
    index = trajectory_index(data, trajectory_key=trajectory_key, done_key=None)
    return publish_dataset(
        dataset_id,
        _Episodes(data, leaves, index),
        target,
        None,
        code=code,
        requirements=(),
        progress=progress,
        description=description,
        algorithm_name=algorithm_name,
        spaces=(
            _space(data, leaves.states, ("observation",)),
            _space(data, leaves.actions, ("action",), action_bounds),
        ),
    )


def _leaves(
    data: TensorDictBase, left_out: set[_Path], trajectory_key: NestedKey
) -> _Leaves:
    paths = [path_of(key) for key in data.keys(True, True)]
    unknown = [key for key in left_out if not any(p[: len(key)] == key for p in paths)]
    if unknown:
        raise KeyError(
            f"the data have no {_names(unknown)}, they have {leaf_names(data)}: "
            "correct exclude="
        )
    paths = [
        path
        for path in paths
        if not any(path[: len(key)] == key for key in left_out)
        and path != path_of(as_key(trajectory_key))
    ]
    following = {path[1:] for path in paths if path[0] == "next"} - _SIGNALS
    states = [path for path in paths if path in following]
    found = _Leaves(
        tuple(states),
        tuple(path for path in paths if path[0] == "action"),
        tuple(path for path in paths if path[0] == "info"),
        ("next", "reward") in paths,
    )
    if not any(path[0] == "observation" for path in states):
        raise ValueError(
            "the data have no 'observation' that is also under 'next', they have "
            f"{leaf_names(data)}: rename the entries of the state"
        )
    missing = [("next", flag) for flag in _FLAGS if ("next", flag) not in paths]
    if missing:
        raise ValueError(
            f"the data lack {missing}, they have {leaf_names(data)}: add these flags, "
            "bool [T, 1]"
        )
    others = set(paths) - {*states, *found.actions, *found.infos}
    others -= {("next", *path) for path in {*states, *_SIGNALS}}
    if others:
        raise ValueError(
            f"Minari has no place for {_names(others)}: leave them out with exclude=, "
            "or move them under 'info'"
        )
    return found


def _space(
    data: TensorDictBase,
    paths: Sequence[_Path],
    root: _Path,
    bounds: tuple[torch.Tensor, torch.Tensor] | None = None,
) -> Space[Any]:
    """Returns the space of entries, as a dict if there are several."""
    import gymnasium

    if list(paths) == [root]:
        return _leaf_space(data, root, bounds)
    tree = _tree({path: _leaf_space(data, path, None) for path in paths})

    def nested(part: Any) -> Space[Any]:
        if not isinstance(part, dict):
            return part
        return gymnasium.spaces.Dict({key: nested(part[key]) for key in part})

    return nested(_as_minari(tree, root))


def _leaf_space(
    data: TensorDictBase,
    path: _Path,
    bounds: tuple[torch.Tensor, torch.Tensor] | None,
) -> Space[Any]:
    from gymnasium.spaces import Box, MultiBinary

    leaf = data[path]
    shape = tuple(leaf.shape[1:])
    if bounds is not None:
        low, high = (bound.numpy() for bound in bounds)
        if low.shape != shape:
            raise ValueError(
                f"action_bounds have shape {list(low.shape)}, but {path!r} has "
                f"{list(shape)}: give one bound for each number of an action"
            )
        return Box(low, high, shape, np.float32)
    if leaf.dtype == torch.bool and shape:
        return MultiBinary(list(shape))
    if leaf.dtype in (torch.float32, torch.float64):
        return Box(-np.inf, np.inf, shape, leaf[:0].numpy().dtype.type)
    if leaf.dtype in (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64):
        limits = torch.iinfo(leaf.dtype)
        return Box(limits.min, limits.max, shape, leaf[:0].numpy().dtype.type)
    raise ValueError(
        f"{path!r} has {leaf.dtype} {list(shape)}, which no space of Minari describes: "
        "convert it to float32 or an integer, or leave it out with exclude="
    )


class _Episodes:
    """The episodes as Minari's buffers, made one at a time."""

    def __init__(
        self, data: TensorDictBase, leaves: _Leaves, index: TrajectoryIndex
    ) -> None:
        self._data, self._leaves, self._index = data, leaves, index

    def __len__(self) -> int:
        return len(self._index.ends)

    def __iter__(self) -> Iterator[EpisodeBuffer]:
        from minari.data_collector import EpisodeBuffer

        first = 0
        for number, last in enumerate(self._index.ends.tolist()):
            places = torch.arange(first, last + 1)
            order = self._index.order
            rows = places if order is None else order[places].long()
            first = last + 1
            yield EpisodeBuffer(**self._episode(number, rows))

    def _episode(self, number: int, rows: torch.Tensor) -> dict[str, Any]:
        part, leaves = self._data[rows], self._leaves
        flags = {flag: part["next", flag].reshape(-1).bool() for flag in _FLAGS}
        if not (flags["terminated"] | flags["truncated"])[-1]:
            raise ValueError(
                f"trajectory {number} does not end at its last row {int(rows[-1])}: "
                "set ('next', 'truncated') there"
            )
        reward = part.get(("next", "reward"), torch.zeros(len(rows)))
        if reward.numel() != len(rows):
            raise ValueError(
                f"('next', 'reward') has shape {list(reward.shape)} in trajectory "
                f"{number}, expected one number a row: Minari stores no others"
            )
        infos = {path: _repeat(part[path]).numpy() for path in leaves.infos}
        return {
            "observations": _as_minari(
                _tree({p: self._states(part, p, rows) for p in leaves.states}),
                ("observation",),
            ),
            "actions": _as_minari(
                _tree({p: part[p].numpy() for p in leaves.actions}), ("action",)
            ),
            "rewards": reward.reshape(-1).numpy(),
            "terminations": flags["terminated"].numpy(),
            "truncations": flags["truncated"].numpy(),
            "infos": _tree(infos).get("info", {}),
        }

    def _states(self, part: TensorDictBase, path: _Path, rows: torch.Tensor) -> Any:
        """Returns all states of an episode, ``[L + 1, ...]``."""
        now, after = part[path], part[("next", *path)]
        differ = (now[1:] != after[:-1]).flatten(1).any(1).nonzero()
        if len(differ) or now.dtype != after.dtype:
            step = int(differ[0]) if len(differ) else 0
            raise ValueError(
                f"the next {_names([path])[0]!r} of row {int(rows[step])} is not that "
                f"of row {int(rows[min(step + 1, len(rows) - 1)])}, which follows it "
                "in its trajectory, and Minari stores every state once: give whole "
                "trajectories in the order of time"
            )
        return torch.cat([now, after[-1:]]).numpy()


def _names(paths: Iterable[_Path]) -> list[NestedKey]:
    return [path[0] if len(path) == 1 else path for path in sorted(paths)]


def _repeat(leaf: torch.Tensor) -> torch.Tensor:
    return torch.cat([leaf, leaf[-1:]])


def _tree(leaves: Mapping[_Path, Any]) -> dict[str, Any]:
    """Returns a nested mapping."""
    tree: dict[str, Any] = {}
    for path, value in leaves.items():
        inner = tree
        for name in path[:-1]:
            inner = inner.setdefault(name, {})
        inner[path[-1]] = value
    return tree


def _as_minari(tree: dict[str, Any], root: _Path) -> Any:
    """Returns what ``load_minari`` reads as this tree."""
    return tree[root[0]] if set(tree) == set(root) else tree
