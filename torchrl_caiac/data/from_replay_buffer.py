"""Replay buffers as transitions in memory-mapped files."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac._checks import check_local
from torchrl_caiac._keys import as_key, leaf_names, missing_key
from torchrl_caiac._keys import path as path_of
from torchrl_caiac._torchrl import storage_rows
from torchrl_caiac.data.action_bounds import action_bounds as stored_bounds
from torchrl_caiac.data.write_episodes import Part, write_episodes
from torchrl_caiac.data.write_transitions import check_entries
from torchrl_caiac.trajectories import (
    COLLECTOR_KEY,
    STEPS_KEY,
    end_flags,
    trajectory_index,
)

__all__ = ["from_replay_buffer"]

_logger = logging.getLogger("torchrl_caiac.data.from_replay_buffer")

_FLAGS = ("done", "terminated", "truncated")
# Hindsight changes them row by row.
_GOALS = ("achieved_goal", "desired_goal")
_CHUNK = 1 << 14  # rows that are read at a time
# torch cannot subtract unsigned integers of more than one byte, or write to some rows.
_WIDER = {torch.uint16: torch.int32, torch.uint32: torch.int64}


def from_replay_buffer(
    source: ReplayBuffer | TensorStorage | TensorDictBase,
    path: str | os.PathLike[str],
    *,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
    reward_key: NestedKey = "reward",
    trajectory_key: NestedKey | None = "episode",
    done_key: NestedKey | None = ("next", "done"),
    exclude: Sequence[NestedKey] = (),
    unknown_next: Literal["drop", "keep"] = "drop",
    action_bounds: tuple[Any, Any] | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes what a replay buffer or a TorchRL dataset has, and opens it.

    The transitions ``[T]`` are sorted by trajectory and time, see
    :func:`~torchrl_caiac.trajectories.trajectory_index`: the buffer may be a full ring,
    have several dimensions ``[T, *B]``, or interleave trajectories. They have

    - the entries that the source has both in the root and under ``"next"``, such as
      ``"observation"`` and goals, in float32 if they are floating-point numbers;
    - ``"action"``, ``"episode"`` (0, 1, ..., int64 ``[T]``) and, under ``"next"``,
      ``"reward"`` (where the source has it) and the end flags. The last row of a
      trajectory is done; it counts as truncated if the source has no flag for it. If
      the source has only ``done``, it counts as terminated, as in TorchRL;
    - the other entries of the root, unchanged, under ``"info"``.

    The rows of a trajectory must follow each other: the next observation of a row is
    the observation of the row after it, up to rounding. Goals may differ, as hindsight
    changes them row by row.

    Transforms of the buffer are not applied. A second call with the same data opens the
    folder.

    Some dataset classes of TorchRL do not have what they should:

    - ``MinariExperienceReplay`` 0.14.1 has zeros only. Data whose actions or
      observations are all zero are refused.
    - ``D4RLExperienceReplay`` and ``RobosetExperienceReplay`` have zeros as the next
      observation at the end of an episode, where it is unknown. Such rows are left out,
      the row before them becomes the last of its trajectory, and a warning says how
      many there are.

    Args:
        source (ReplayBuffer, TensorStorage or TensorDictBase): the buffer, also a
            dataset class of TorchRL, its storage, or transitions ``[T]``.
        path (path): the folder to write. It is written atomically.

    Keyword Args:
        observation_key (NestedKey): the observation, of which the zeros are checked.
            Defaults to ``"observation"``.
        action_key (NestedKey): the action. Defaults to ``"action"``.
        reward_key (NestedKey): the reward, under ``"next"``. Defaults to ``"reward"``.
        trajectory_key (NestedKey, optional): the trajectory ids; ``None`` if the end
            flags alone tell. Defaults to ``"episode"``; if this is missing, the ids of
            TorchRL's collectors are used, and without them the end flags.
        done_key (NestedKey, optional): the end flags. Defaults to ``("next", "done")``.
        exclude (sequence of NestedKey): entries to leave out, by their keys in the
            source, such as texts. Defaults to ``()``.
        unknown_next (str): ``"drop"`` to leave out rows whose next observation is all
            zeros, while their observation and that of the next row are not. ``"keep"``
            if these zeros are true. Defaults to ``"drop"``.
        action_bounds (tuple of sequence, optional): the lowest and the highest action,
            ``[A]`` each, see :func:`~torchrl_caiac.data.action_bounds`. Defaults to
            ``None``: those of the folder of ``source``, if any.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileExistsError: ``path`` exists, has other data, and ``overwrite`` is
            ``False``.
        KeyError: the source lacks a key, or an entry of ``exclude``.
        OSError: the disk is full.
        TypeError: ``source`` is none of the above, or has something else than
            tensordicts.
        ValueError: the source is empty; has rows that do not follow each other,
            transitions of several steps, padded trajectories, zeros only, NaN or
            infinite values, texts or objects; or its flags are contradictory.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac.data import from_replay_buffer
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(6, ndim=2))

        >>> steps = torch.arange(1.0, 7).view(2, 3, 1)  # of two environments
        >>> flags = torch.zeros(2, 3, 1, dtype=torch.bool)
        >>> _ = rb.extend(
        ...     TensorDict(
        ...         {
        ...             "observation": steps,
        ...             "action": steps,
        ...             "next": {"observation": steps + 1, "done": flags},
        ...         },
        ...         [2, 3],
        ...     )
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     data = from_replay_buffer(rb, f"{folder}/data", progress=False)

        ...     data["observation"].squeeze(-1).tolist(), data["episode"].tolist()
        ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0, 0, 0, 1, 1, 1])
    """
    if unknown_next not in ("drop", "keep"):
        raise ValueError(f"unknown_next is {unknown_next!r}, expected 'drop' or 'keep'")
    data = _rows(source)
    length = len(data) if isinstance(source, TensorDictBase) else len(_storage(source))
    if not length:
        raise ValueError("the source is empty: give data with at least one row")
    data, whole = _without(data, exclude), data
    check_entries(data, "the source")
    if trajectory_key is not None and not _has_ids(data, trajectory_key):
        trajectory_key = None  # else end flags are needed, and their lack is an error
    index = trajectory_index(source, trajectory_key=trajectory_key, done_key=done_key)
    keys = _Keys(
        data,
        as_key(observation_key),
        as_key(action_key),
        as_key(reward_key),
        ("next", "done") if done_key is None else as_key(done_key),
    )
    keys.check(data, length)
    order = index.rows(torch.arange(length, device=index.device)).cpu()
    ends = torch.zeros(length, dtype=torch.bool)
    ends[index.ends.cpu()] = True
    _check_order(data, keys.observation, order, ends)
    if unknown_next == "drop":
        unknown = _unknown(data, keys.observation, order, ends)
        if unknown.any():
            order, ends = _dropped(order, ends, unknown)
    if action_bounds is None:
        action_bounds = stored_bounds(whole)
    stops = (ends.nonzero().squeeze(-1) + 1).tolist()
    return write_episodes(
        _parts(data, keys, order, stops),
        path,
        action_bounds=action_bounds,
        overwrite=overwrite,
        progress=progress,
        rows=len(order),
        total=len(stops),
        description="writing trajectories",
    )


def _storage(source: Any) -> Any:
    return source.storage if isinstance(source, ReplayBuffer) else source


def _rows(source: Any) -> TensorDictBase:
    if isinstance(source, TensorDictBase):
        return source
    check_local("source", source)
    if not isinstance(source, (ReplayBuffer, TensorStorage)):
        raise TypeError(
            f"the source is a {type(source).__name__}, expected a replay buffer, its "
            "storage, or transitions [T]"
        )
    data = storage_rows(_storage(source), "the storage of the source")
    if data.batch_dims > 1 or data.get("mask", None) is not None:
        raise ValueError(
            f"the source has the batch size {list(data.batch_size)} and the entries "
            f"{leaf_names(data)}, as split and padded trajectories have: create the "
            "dataset with split_trajs=False"
        )
    return data


def _without(data: TensorDictBase, exclude: Sequence[NestedKey]) -> TensorDictBase:
    for key in exclude:
        if data.get(as_key(key), None) is None:
            raise missing_key(
                data, key, "the source lacks the entry", "correct exclude="
            )
    return data.exclude(*map(as_key, exclude)) if exclude else data


def _has_ids(data: TensorDictBase, key: NestedKey) -> bool:
    return any(data.get(name, None) is not None for name in (key, COLLECTOR_KEY))


class _Keys:
    """Which entries of the source become which entries of the transitions."""

    def __init__(
        self,
        data: TensorDictBase,
        observation: NestedKey,
        action: NestedKey,
        reward: NestedKey,
        done: NestedKey,
    ) -> None:
        self.observation, self.action = observation, action
        self.reward: NestedKey = ("next", *path_of(reward))
        self.done = done
        flags = {(*path_of(done)[1:-1], name) for name in _FLAGS}
        not_states = {path_of(reward), *flags}
        leaves = {path_of(key) for key in data.keys(True, True)}
        following = {key[1:] for key in leaves if key[0] == "next"} - not_states
        root = {key for key in leaves if key[0] != "next"}
        # An info is no part of a state, even if both states have one.
        states = {key for key in root & following if key[0] != "info"}
        own = path_of(action)
        leaves = {k for k in root if k[: len(own)] != own}
        self.states = sorted(states & leaves)
        self.infos = sorted(leaves - states - not_states)

    def check(self, data: TensorDictBase, length: int) -> None:
        """Raises if the data lack entries or have zeros only."""
        wanted: list[NestedKey] = [
            self.observation,
            ("next", *path_of(self.observation)),
            self.action,
        ]
        for key in wanted:
            if data.get(key, None) is None:
                raise missing_key(
                    data,
                    key,
                    "the source lacks",
                    "pass observation_key= or action_key=",
                )
        steps = data.get(STEPS_KEY, None)
        if steps is not None and not (steps[:length] == 1).all():
            raise ValueError(
                "the source has transitions of several steps (MultiStepTransform), "
                "whose next state is not the one after the action: give a buffer "
                "without this transform"
            )
        for key in (self.observation, self.action):
            if not any(_nonzero(part).any() for part in _chunks(data, key, length)):
                raise ValueError(
                    f"{key!r} of the source is zero in all of {length} rows, so the "
                    "data were not loaded (MinariExperienceReplay 0.14.1 gives such "
                    "data: use load_minari); if the zeros are true, these data tell "
                    "nothing about influence"
                )


def _chunks(data: TensorDictBase, key: NestedKey, length: int) -> Iterator[Any]:
    value = data.get(key)
    for start in range(0, length, _CHUNK):
        yield value[start : min(start + _CHUNK, length)]


def _nonzero(value: Any) -> torch.Tensor:
    """Returns which rows have a number other than zero, bool ``[T]``, on the CPU."""
    if isinstance(value, TensorDictBase):
        found = torch.zeros(len(value), dtype=torch.bool)
        for leaf in value.values(True, True):
            found |= _nonzero(leaf)
        return found
    return (value.as_subclass(torch.Tensor) != 0).reshape(len(value), -1).any(1).cpu()


def _check_order(
    data: TensorDictBase, key: NestedKey, order: torch.Tensor, ends: torch.Tensor
) -> None:
    """Raises if the observation after a row is not that of the row that follows."""
    next_key: NestedKey = ("next", *path_of(key))
    before = (~ends[:-1]).nonzero().squeeze(-1)  # places by time
    for start in range(0, len(before), _CHUNK):
        places = before[start : start + _CHUNK]
        rows, following = order[places], order[places + 1]
        after = _taken(data.select(next_key), rows).get(next_key)
        now = _taken(data.select(key), following).get(key)
        # Zeros are what some datasets have where the next observation is unknown.
        wrong = _differs(after, now) & _nonzero(after)
        if wrong.any():
            found = int(wrong.nonzero()[0])
            raise ValueError(
                f"row {int(following[found])} of the source does not follow row "
                f"{int(rows[found])}, although both are in one trajectory: the next "
                f"{key!r} of the one is not the {key!r} of the other; give the rows of "
                "each trajectory in the order of time and without gaps, and what does "
                "not belong together different ids or an end flag (trajectory_key=, "
                "done_key=)"
            )


def _differs(after: Any, now: Any) -> torch.Tensor:
    """Returns which rows differ by more than rounding, bool ``[T]``, on the CPU."""
    if isinstance(after, TensorDictBase):
        wrong = torch.zeros(len(after), dtype=torch.bool)
        for name, leaf in after.items(True, True):
            value = now.get(name, None)
            if value is not None and path_of(name)[-1] not in _GOALS:
                wrong |= _differs(leaf, value)
        return wrong
    after, now = _plain(after), _plain(now)
    wrong = torch.zeros(len(after), dtype=torch.bool)
    if after.shape != now.shape:
        return wrong  # the writer says so
    rows = (after != now).reshape(len(after), -1).any(1).nonzero().squeeze(-1)
    if not len(rows):
        return wrong
    kinds = [x.dtype for x in (after, now) if x.is_floating_point()]
    rounding = max([2 * torch.finfo(kind).eps for kind in kinds] + [1e-6])
    a, b = after[rows].double(), now[rows].double()
    far = (a - b).abs() > rounding * (0.1 + a.abs() + b.abs())
    wrong[rows] = far.reshape(len(rows), -1).any(1)  # NaN has an error of its own
    return wrong


def _unknown(
    data: TensorDictBase, key: NestedKey, order: torch.Tensor, ends: torch.Tensor
) -> torch.Tensor:
    """Returns which rows, by time, have no true next observation, bool ``[T]``."""
    length = len(order)
    following: NestedKey = ("next", *path_of(key))
    now = torch.cat([_nonzero(part) for part in _chunks(data, key, length)])[order]
    after = [_nonzero(part) for part in _chunks(data, following, length)]
    unknown = now & ~torch.cat(after)[order]
    # The next row has zeros, too: they are true.
    unknown[:-1] &= ends[:-1] | now[1:]
    return unknown


def _dropped(
    order: torch.Tensor, ends: torch.Tensor, unknown: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    kept = ~unknown
    ends = ends.clone()
    ends[:-1] |= unknown[1:]
    inside = int((unknown & ~ends).sum())
    _logger.warning(
        "%d of %d rows have a next observation of zeros, as D4RLExperienceReplay and "
        "RobosetExperienceReplay write where it is unknown: they are left out%s. Pass "
        "unknown_next='keep' if the zeros are true",
        int(unknown.sum()),
        len(order),
        f", and {inside} trajectories are cut there" if inside else "",
    )
    if not kept.any():
        raise ValueError(
            "no row of the source has a next observation other than zeros: give data "
            "with the next observations"
        )
    return order[kept], ends[kept]


def _parts(
    data: TensorDictBase, keys: _Keys, order: torch.Tensor, stops: Sequence[int]
) -> Iterator[Part]:
    start = 0
    for number, stop in enumerate(stops):
        for first in range(start, stop, _CHUNK):
            after = min(first + _CHUNK, stop)
            where = f"trajectory {number} of the source"
            rows = _taken(data, order[first:after])
            is_end = after == stop
            yield Part(_transitions(rows, keys, where, is_end), where, is_end)
        start = stop


def _taken(data: TensorDictBase, rows: torch.Tensor) -> TensorDictBase:
    first, last = int(rows[0]), int(rows[-1])
    if last - first == len(rows) - 1 and bool((rows.diff() == 1).all()):
        return data[first : last + 1]
    device = next(iter(data.values(True, True))).device
    return data[rows.to(device)]


def _transitions(
    rows: TensorDictBase, keys: _Keys, where: str, ends: bool
) -> TensorDict:
    length = len(rows)
    td = TensorDict({"action": _cast(rows.get(keys.action))}, [length])
    for key in keys.states:
        td[key] = _cast(rows.get(key))
        td[("next", *key)] = _cast(rows.get(("next", *key)))
    for key in keys.infos:
        name = key if key[0] == "info" else ("info", *key)
        td[name] = _plain(rows.get(key))
    if rows.get(keys.reward, None) is not None:
        reward = _one_each(rows.get(keys.reward), keys.reward, where)
        td["next", "reward"] = _plain(reward).float()
    terminated, truncated = _flags(rows, keys.done, where)
    early = (terminated | truncated)[: -1 if ends else None]
    if early.any():
        raise ValueError(
            f"a row of {where} is terminated or truncated, but {keys.done!r} is not "
            "set there: correct the flags, or pass done_key="
        )
    if ends:
        truncated[-1] |= ~terminated[-1]
    td["next", "terminated"], td["next", "truncated"] = terminated, truncated
    td["next", "done"] = terminated | truncated
    return td


def _flags(
    rows: TensorDictBase, done_key: NestedKey, where: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns which rows are terminated and truncated, bool ``[L, 1]`` each."""
    found = []
    for name in _FLAGS[1:]:
        key = (*path_of(done_key)[:-1], name)
        value = rows.get(key, None)
        found.append(
            None if value is None else _plain(_one_each(value, key, where)).bool()
        )
    terminated, truncated = found
    none = torch.zeros(len(rows), 1, dtype=torch.bool)
    if terminated is None:
        done = end_flags(rows, done_key)
        terminated = none if done is None else done.cpu()[:, None]
        terminated = terminated if truncated is None else terminated & ~truncated
    return terminated.clone(), none.clone() if truncated is None else truncated.clone()


def _plain(value: torch.Tensor) -> torch.Tensor:
    value = value.detach().as_subclass(torch.Tensor).cpu()
    return value.to(_WIDER.get(value.dtype, value.dtype))


def _cast(value: Any) -> Any:
    if isinstance(value, TensorDictBase):  # nested actions
        return value.apply(_cast)
    value = _plain(value)
    return value.float() if value.is_floating_point() else value


def _one_each(value: torch.Tensor, key: NestedKey, where: str) -> torch.Tensor:
    if value.numel() != len(value):
        raise ValueError(
            f"{key!r} of {where} has shape {list(value.shape)}, expected one number "
            "for each row"
        )
    return value.reshape(-1, 1)
