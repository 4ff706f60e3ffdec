"""LeRobot datasets as TorchRL transitions in memory-mapped files."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_caiac.data.digests import data_source, file_digest
from torchrl_caiac.data.episodes import episode_transitions
from torchrl_caiac.data.join_columns import columns_text, join_columns, joined_columns
from torchrl_caiac.data.lerobot_files import (
    LeRobotDescription,
    describe_lerobot,
    lerobot_episodes,
)
from torchrl_caiac.data.write_episodes import Part, write_episodes

__all__ = ["lerobot_tasks", "load_lerobot"]

_logger = logging.getLogger("torchrl_caiac.data.load_lerobot")

_OBSERVATION, _NEXT = "observation.", "next."
_REWARD, _TASK = "next.reward", "task_index"
_ENDS = ("next.done", "next.terminated", "next.truncated")
# Positions in the dataset: what "episode" and the order of rows say already.
_POSITIONS = {"timestamp", "frame_index", "episode_index", "index", _TASK}


class _Names(NamedTuple):
    """The features that are read."""

    observations: tuple[str, ...]
    is_flat: bool
    action: str
    following: tuple[str, ...]  # next.*, all but the flags of ends
    infos: tuple[str, ...]
    others: tuple[str, ...]  # the flags of ends and task_index, if they are there

    def all(self) -> list[str]:
        names = (*self.observations, self.action, *self.following, *self.infos)
        return [*dict.fromkeys(names + self.others)]

    def roles(self) -> dict[str, Any]:
        """Returns which features are what, JSON values."""
        return {
            role: list(names) if isinstance(names, tuple) else names
            for role, names in self._asdict().items()
        }


def load_lerobot(
    dataset: str | os.PathLike[str],
    path: str | Path,
    *,
    keys: Sequence[str] | None = None,
    action: str = "action",
    infos: Sequence[str] = (),
    exclude: Sequence[str] = (),
    download: bool = False,
    revision: str | None = None,
    action_bounds: tuple[Any, Any] | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes a LeRobot dataset as TorchRL transitions, and opens them.

    Versions 2 and 3 of the format are read, as LeRobot 0.1 to 0.4 write them. The
    transitions ``[T]`` have ``"action"``, ``"episode"`` (the number of the trajectory,
    int64 ``[T]``), ``"task"`` (the index of the frame's task, int64 ``[T]``, see
    :func:`lerobot_tasks`) and, under ``"next"``, ``"reward"`` and the other features
    ``next.*`` where the dataset has them, ``"terminated"``, ``"truncated"`` and
    ``"done"``, each ``[T, 1]``.

    The features ``observation.*`` are the leaves of a nested observation:
    ``observation.state`` becomes ``("observation", "state")``. With ``keys``, they are
    joined to one flat ``"observation"``. The columns of each are then logged, and
    stored as ``"columns"`` of :func:`~torchrl_caiac.data.digests.data_source`. Images,
    videos and texts are left out.

    LeRobot stores no next observations. The last frame of an episode therefore has
    none: its row is left out, with its reward and its ``next.done``. The last row of an
    episode counts as truncated.

    The package ``pyarrow`` reads the files. TorchRL's ``LeRobotExperienceReplay`` is
    not used, because it does not read local folders, does not store next observations,
    and does not check that episodes are whole.

    Args:
        dataset (str or path): the folder of the dataset, or its name on the Hugging
            Face Hub, such as ``"lerobot/pusht"``.
        path (str or Path): the folder to write. It is written atomically.

    Keyword Args:
        keys (sequence of str, optional): the features to join, in this order, such as
            ``["observation.state", "observation.environment_state"]``. Defaults to
            ``None``: a nested observation with all features ``observation.*``.
        action (str): the feature with the actions. Defaults to ``"action"``.
        infos (sequence of str): other features to keep under ``"info"``, unchanged.
            Defaults to ``()``.
        exclude (sequence of str): features ``observation.*`` or ``next.*`` to leave
            out. Defaults to ``()``.
        download (bool): whether to download a dataset of the Hub, without videos, into
            the Hub's cache. It needs the package ``huggingface_hub``. Defaults to
            ``False``.
        revision (str, optional): the revision to download. Defaults to ``None``: the
            newest.
        action_bounds (tuple of sequences, optional): the lowest and the highest action,
            see :func:`~torchrl_caiac.data.action_bounds`. Defaults to ``None``:
            unknown, as the format does not say.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar over the episodes. Defaults to
            ``True``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``. A second call with the same
        files and arguments opens the folder.

    Raises:
        FileExistsError: ``path`` exists, was not written by an equal call, and
            ``overwrite`` is ``False``.
        FileNotFoundError: the dataset, or one of its files, is not on this machine.
        ImportError: a package is missing.
        KeyError: the dataset lacks a feature; the message lists those that are there.
        OSError: the disk is full, or the dataset cannot be downloaded.
        UnreadableFileError: a file is damaged, or an episode is not whole.
        ValueError: an episode has one frame only, NaN, infinite or missing values; a
            feature has frames of different widths; the version is another one.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.data import lerobot_tasks, load_lerobot
        >>> folder = tempfile.TemporaryDirectory()
        >>> data = load_lerobot(
        ...     "tests/data/lerobot/v3.0", f"{folder.name}/data", progress=False
        ... )
        >>> data["observation", "environment_state"].shape
        torch.Size([18, 4])
        >>> lerobot_tasks(f"{folder.name}/data")
        {0: 'Push the cube to the left.', 1: 'Push the cube to the right.'}
        >>> folder.cleanup()
    """
    root = _find(dataset, download, revision)
    description = describe_lerobot(root)
    names = _names(description, keys, action, infos, exclude)
    columns = _announce(description, names, exclude)
    source = {
        "format": "lerobot",
        "dataset": root.name if Path(dataset).is_dir() else os.fspath(dataset),
        "sha256": _digests(root),
        "version": description.version,
        "tasks": {str(index): text for index, text in description.tasks.items()},
        "columns": columns,
        "features": names.roles(),
    }
    lengths = description.lengths.values()
    return write_episodes(
        _parts(description, names),
        path,
        source=source,
        action_bounds=action_bounds,
        overwrite=overwrite,
        progress=progress,
        rows=sum(lengths) - len(lengths),
        total=len(lengths),
        description=f"loading {root.name}",
    )


def lerobot_tasks(path: str | os.PathLike[str]) -> dict[int, str]:
    """Returns the texts of the tasks of transitions that ``load_lerobot`` wrote.

    Args:
        path (path): the folder of the transitions.

    Returns:
        dict of int to str: the texts by the numbers in ``"task"``.

    Raises:
        FileNotFoundError: the folder has no digests.
        KeyError: it was not written by :func:`load_lerobot`.
        UnreadableFileError: the digests are damaged.

    Examples:
        See :func:`load_lerobot`.
    """
    source = data_source(path) or {}
    if not isinstance(source.get("tasks"), dict):
        raise KeyError(
            f"{path} was written from {source.get('format', 'something else')!r}, "
            "which has no tasks: give a folder that load_lerobot wrote"
        )
    return {int(index): text for index, text in source["tasks"].items()}


def _find(
    dataset: str | os.PathLike[str], download: bool, revision: str | None
) -> Path:
    folder, name = Path(dataset), os.fspath(dataset)
    if folder.is_dir():
        return folder
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name) or not download:
        raise FileNotFoundError(
            f"there is no folder {name}: give the folder of a LeRobot dataset, or its "
            "name on the Hub, such as 'lerobot/pusht', with download=True"
        )
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise ImportError(
            f"{name!r} can be downloaded with the package huggingface_hub: install it "
            "with pip install huggingface_hub, or give a folder"
        ) from error
    patterns = ["meta/*", "data/*"]  # also those in folders below; no videos
    try:
        return Path(
            snapshot_download(
                name, repo_type="dataset", revision=revision, allow_patterns=patterns
            )
        )
    except Exception as error:  # those of the package and of its HTTP client
        raise OSError(
            f"{name!r} could not be downloaded ({error}): correct the name, connect to "
            "the network, or give a folder"
        ) from error


def _digests(root: Path) -> dict[str, str]:
    files = [*(root / "data").rglob("*.parquet")]
    for pattern in ("info.json", "tasks.*", "episodes.jsonl", "episodes/**/*.parquet"):
        files += (root / "meta").glob(pattern)
    return {
        file.relative_to(root).as_posix(): file_digest(file) for file in sorted(files)
    }


def _names(
    description: LeRobotDescription,
    keys: Sequence[str] | None,
    action: str,
    infos: Sequence[str],
    exclude: Sequence[str],
) -> _Names:
    there = description.shapes
    if keys is not None and not keys:
        raise ValueError("keys is empty: name at least one feature, or leave it out")
    if keys is not None and len(set(keys)) != len(keys):
        raise ValueError(f"keys={list(keys)} names a feature twice: name it once")
    asked = {"keys": keys or (), "action": (action,), "infos": infos}
    for option, wanted in {**asked, "exclude": exclude}.items():
        known = {*there, *description.others} if option == "exclude" else there
        missing = [name for name in wanted if name not in known]
        if missing:
            raise KeyError(
                f"{description.root} has no feature {missing} of numbers, it has "
                f"{sorted(there)}: correct {option}="
            )
    observations = keys
    if observations is None:
        # A dataset may also have one feature with the name "observation".
        observations = [
            name
            for name in there
            if f"{name}.".startswith(_OBSERVATION) and name not in exclude
        ]
    if not observations:
        raise KeyError(
            f"{description.root} has no feature observation.* of numbers, it has "
            f"{sorted(there)}: name the features with keys="
        )
    following = [
        name for name in there if name.startswith(_NEXT) and name not in exclude
    ]
    own = [name for name in following if f"{name}.".startswith("next.observation.")]
    if own:
        raise ValueError(
            f"{description.root} has next observations of its own, {own}, which are "
            "not read: pass exclude= to take those of the next frames"
        )
    others = [name for name in (*_ENDS, _TASK) if name in there]
    return _Names(
        tuple(observations),
        keys is not None,
        action,
        tuple(name for name in following if name not in _ENDS),
        tuple(infos),
        tuple(others),
    )


def _announce(
    description: LeRobotDescription, names: _Names, exclude: Sequence[str]
) -> dict[str, list[int]] | None:
    """Logs what is left out or joined, and returns the columns of what is joined."""
    _logger.info(
        "%s has no next observations: the last frame of each episode is left out",
        description.root,
    )
    read = {*names.all(), *exclude, *_POSITIONS}
    unread = [name for name in description.shapes if name not in read]
    left_out = [*description.others, *unread]
    if left_out:
        _logger.info("the features %s are left out", left_out)
    if not names.is_flat:
        return None
    shapes = description.shapes
    columns = joined_columns(
        {key: np.empty((0, *shapes[key])) for key in names.observations}
    )
    _logger.info("the columns of the observation: %s", columns_text(columns))
    return columns


def _parts(description: LeRobotDescription, names: _Names) -> Iterator[Part]:
    has_warned = False
    for number, file, frames in lerobot_episodes(description, names.all()):
        where = f"episode {number} of {file}"
        if len(frames[names.action]) < 2:
            raise ValueError(
                f"{where} has one frame only, so its action has no next observation: "
                "remove the episode"
            )
        early = [name for name in _ENDS if name in frames and frames[name][:-1].any()]
        if early and not has_warned:
            has_warned = True
            _logger.warning(
                "%s of %s is true before the last frame, but the episode goes on: it "
                "is taken as one trajectory until its last frame",
                early,
                where,
            )
        yield Part(_transitions(frames, names, description, where), where)


def _transitions(
    frames: Mapping[str, NDArray[Any]],
    names: _Names,
    description: LeRobotDescription,
    where: str,
) -> TensorDict:
    states: Any = {name: frames[name] for name in names.observations}
    states = join_columns(states, where) if names.is_flat else _nested(states, where)
    rows = episode_transitions(
        {"observation": states},
        frames[names.action][:-1],
        where=where,
        # They may be integers.
        rewards=frames[_REWARD][:-1].astype(float)
        if _REWARD in names.following
        else None,
        info=_nested({name: frames[name] for name in names.infos}, where),
        leave_out="leave it out with exclude=",
    )
    for name in names.following:
        if name != _REWARD:
            leaf = torch.from_numpy(np.array(frames[name][:-1]))
            key = ("next", *name.removeprefix(_NEXT).split("."))
            rows[key] = leaf.float() if leaf.is_floating_point() else leaf
    if _TASK in frames:
        task = np.array(frames[_TASK][:-1], np.int64).reshape(-1)
        unknown = sorted(set(task.tolist()) - set(description.tasks))
        if unknown:
            raise ValueError(
                f"{_TASK!r} of {where} is {unknown}, but meta lists the tasks "
                f"{sorted(description.tasks)}: correct the dataset"
            )
        rows["task"] = torch.from_numpy(task)
    return rows


def _nested(features: Mapping[str, NDArray[Any]], where: str) -> Any:
    """Returns features such as ``observation.a.b`` as ``{"a": {"b": ...}}``."""
    if set(features) == {_OBSERVATION.removesuffix(".")}:
        return features["observation"]
    result: dict[str, Any] = {}
    for name, array in features.items():
        *above, last = name.removeprefix(_OBSERVATION).split(".")
        inner = result
        for part in above:
            inner = inner.setdefault(part, {})
            if not isinstance(inner, dict):
                break
        if not isinstance(inner, dict) or last in inner:
            raise ValueError(
                f"{name!r} in {where} is both a feature and the beginning of another "
                "one: name what you need in keys="
            )
        inner[last] = array
    return result
