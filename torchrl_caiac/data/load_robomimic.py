"""robomimic and LIBERO datasets as TorchRL transitions in memory-mapped files."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from tensordict import TensorDict

from torchrl_caiac.data.digests import file_digest
from torchrl_caiac.data.episodes import episode_transitions
from torchrl_caiac.data.hdf5_files import open_hdf5, reading_hdf5
from torchrl_caiac.data.join_columns import columns_text, join_columns, joined_columns
from torchrl_caiac.data.minari_checks import check_hdf5_group
from torchrl_caiac.data.robomimic_settings import (
    controller_bounds,
    environment_settings,
)
from torchrl_caiac.data.write_episodes import Part, write_episodes

__all__ = ["load_robomimic"]

_logger = logging.getLogger("torchrl_caiac.data.load_robomimic")

# LIBERO writes this attribute, and the observation *after* each action.
_LIBERO = "bddl_file_name"


class _Options(NamedTuple):
    keys: tuple[str, ...] | None
    images: tuple[str, ...]
    infos: tuple[str, ...]
    exclude: tuple[str, ...]
    is_after: bool


def load_robomimic(
    file: str | Path,
    path: str | Path,
    *,
    keys: Sequence[str] | None = None,
    images: Sequence[str] = (),
    infos: Sequence[str] = (),
    exclude: Sequence[str] = (),
    mask: str | None = None,
    observed: Literal["before", "after"] | None = None,
    action_bounds: tuple[Any, Any] | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes a robomimic or LIBERO dataset as TorchRL transitions, and opens them.

    The transitions ``[T]`` have ``"action"``, ``"episode"`` (the number of the
    demonstration, int64 ``[T]``) and, under ``"next"``, ``"reward"`` (where the file
    has rewards), ``"terminated"``, ``"truncated"`` and ``"done"``, each ``[T, 1]``. The
    entries of ``data/demo_*/obs`` are the leaves of a nested observation, such as
    ``("observation", "object")``; with ``keys``, they are joined to one flat
    ``"observation"``. The columns of each are then logged, and stored as ``"columns"``
    of :func:`~torchrl_caiac.data.digests.data_source`.

    The next observations are those of ``next_obs``. Without it, and unless there is one
    observation more than actions, the last action of each demonstration has no next
    observation, and its row is left out.

    robosuite's environments do not end after a success, so the last row of a
    demonstration counts as truncated. ``infos=["dones"]`` keeps the file's ``dones``.

    The package ``h5py`` is needed, robomimic and robosuite are not. A second call with
    the same file and arguments opens the folder.

    Args:
        file (str or Path): the HDF5 file, with ``data/demo_*/obs``.
        path (str or Path): the folder to write. It is written atomically.

    Keyword Args:
        keys (sequence of str, optional): the entries of ``obs`` to join, in this order,
            ``[L, D]`` each. Defaults to ``None``: a nested observation with all
            entries but the images.
        images (sequence of str): the images to keep in the nested observation. All
            entries with more than one dimension a row are images. Defaults to ``()``.
        infos (sequence of str): other entries of a demonstration to keep under
            ``"info"``, unchanged, such as ``"states"``, ``"dones"`` or
            ``"datagen_info"``. Defaults to ``()``.
        exclude (sequence of str): entries of ``obs`` to leave out of the nested
            observation. Defaults to ``()``.
        mask (str, optional): the filter key of the demonstrations to take, such as
            ``"train"`` for ``mask/train``. Defaults to ``None``: all.
        observed ("before" or "after", optional): whether row ``t`` of ``obs`` is the
            state before or after action ``t``. ``"after"``: the first action of each
            demonstration has no observation, and is left out. Defaults to ``None``:
            ``"after"`` for files of LIBERO, which have the attribute
            ``bddl_file_name``, and ``"before"`` for others.
        action_bounds (tuple of sequences, optional): the lowest and the highest action,
            see :func:`~torchrl_caiac.data.action_bounds`. Defaults to ``None``: -1 and
            1 if the attribute ``env_args`` says that robosuite's controllers take
            inputs from -1 to 1, and all actions are; else unknown.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar over the demonstrations.
            Defaults to ``True``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileExistsError: ``path`` exists, was not written by an equal call, and
            ``overwrite`` is ``False``.
        FileNotFoundError: there is no such file.
        ImportError: the package ``h5py`` is missing.
        KeyError: the file or a demonstration lacks an entry; the message lists what is
            there.
        OSError: the disk is full.
        UnreadableFileError: the file is damaged.
        ValueError: a demonstration has one row only and no ``next_obs``, or arrays of
            different lengths, or NaN, infinite values, texts or objects; the options
            contradict each other.

    Examples:
        >>> import tempfile, h5py
        >>> import numpy as np
        >>> from torchrl_caiac.data import load_robomimic
        >>> folder = tempfile.TemporaryDirectory()
        >>> with h5py.File(f"{folder.name}/lift.hdf5", "w") as stored:
        ...     for demo in ("demo_0", "demo_1"):
        ...         stored[f"data/{demo}/actions"] = np.zeros((4, 7))
        ...         stored[f"data/{demo}/obs/object"] = np.zeros((4, 10))
        ...         stored[f"data/{demo}/obs/robot0_eef_pos"] = np.zeros((4, 3))
        >>> data = load_robomimic(
        ...     f"{folder.name}/lift.hdf5", f"{folder.name}/data", progress=False
        ... )
        >>> data["observation", "object"].shape
        torch.Size([6, 10])
        >>> flat = load_robomimic(
        ...     f"{folder.name}/lift.hdf5",
        ...     f"{folder.name}/flat",
        ...     keys=["object", "robot0_eef_pos"],
        ...     progress=False,
        ... )
        >>> flat["observation"].shape
        torch.Size([6, 13])
        >>> folder.cleanup()
    """
    if observed not in (None, "before", "after"):
        raise ValueError(
            f"observed is {observed!r}, expected 'before', 'after' or None"
        )
    if keys is not None and len(set(keys)) != len(keys):
        raise ValueError(f"keys={list(keys)} names an entry twice: name it once")
    if keys is not None and (not keys or images or exclude):
        raise ValueError(
            f"keys={list(keys)} joins entries to a flat observation, so it must have "
            "at least one, and images= and exclude= do not apply: leave these out"
        )
    file = Path(file)
    with open_hdf5(file) as stored:
        with reading_hdf5(file):
            data = stored.get("data")
            demos = _demos(stored, file, mask)
            is_after = observed == "after" or (
                observed is None and _LIBERO in data.attrs
            )
            options = _Options(
                None if keys is None else tuple(keys),
                tuple(images),
                tuple(infos),
                tuple(exclude),
                is_after,
            )
            columns = _announce(data[demos[0]], f"{demos[0]} of {file}", options)
            settings = environment_settings(data)
            if action_bounds is None:
                action_bounds = controller_bounds(data, demos, file)
        source = {
            "format": "robomimic",
            "dataset": file.name,
            "sha256": file_digest(file),
            "env_name": settings.get("env_name"),
            "mask": mask,
            "columns": columns,
            **{name: value for name, value in options._asdict().items() if value},
        }
        return write_episodes(
            _parts(data, demos, file, options),
            path,
            source=source,
            action_bounds=action_bounds,
            overwrite=overwrite,
            progress=progress,
            total=len(demos),
            description=f"loading {file.name}",
        )


def _parts(
    data: Any, demos: Sequence[str], file: Path, options: _Options
) -> Iterator[Part]:
    for name in demos:
        where = f"{name} of {file}"
        with reading_hdf5(file):
            demo = data[name]
        yield Part(_transitions(demo, file, where, options), where)


def _demos(stored: Any, file: Path, mask: str | None) -> list[str]:
    """Returns the names of the demonstrations, in the order of their numbers."""
    data = stored.get("data")
    names = [] if data is None else [n for n in data if re.fullmatch(r"demo_\d+", n)]
    if not names:
        found = sorted(stored) if data is None else [f"data/{name}" for name in data]
        raise KeyError(
            f"{file} has no data/demo_*, it has {found[:20]}: it is not a robomimic "
            "dataset; use from_arrays for other arrays"
        )
    if mask is not None:
        masks = sorted(stored.get("mask", ()))
        if mask not in masks:
            raise KeyError(
                f"{file} has no mask/{mask}, it has the masks {masks}: correct mask="
            )
        wanted = [
            name.decode() if isinstance(name, bytes) else str(name)
            for name in stored["mask"][mask][()]
        ]
        missing = sorted(set(wanted) - set(names))
        if missing or not wanted:
            raise KeyError(
                f"mask/{mask} of {file} has {missing or 'no demonstrations'}"
                f"{', which are not in data' if missing else ''}: give another mask="
            )
        names = wanted
    return sorted(set(names), key=lambda name: int(name.removeprefix("demo_")))


def _announce(demo: Any, where: str, options: _Options) -> dict[str, list[int]] | None:
    """Logs what is left out or joined, and returns the columns of what is joined."""
    observations = _group(demo, "obs", where)
    seen = [item for item in observations.values() if getattr(item, "shape", None)]
    rows = {len(item) for item in seen} - {len(demo.get("actions", ())) + 1}
    if "next_obs" not in demo and rows:
        _logger.info(
            "%s has no next_obs: the %s row of each demonstration is left out, because "
            "its action has no %sobservation",
            where,
            "first" if options.is_after else "last",
            "" if options.is_after else "next ",
        )
    if options.keys is not None:
        columns = joined_columns(_selected(observations, options, where))
        _logger.info(
            "the columns of the observation of %s: %s", where, columns_text(columns)
        )
        return columns
    left_out = [name for name in _images(observations) if name not in options.images]
    if left_out:
        _logger.info(
            "the images %s of %s are left out; pass images= to keep some",
            left_out,
            where,
        )
    return None


def _group(demo: Any, name: str, where: str) -> Any:
    group = demo.get(name)
    if not hasattr(group, "keys") or not len(group):
        raise KeyError(
            f"{where} has no {name}/*, it has {sorted(demo)}: "
            "write the observations with robomimic's dataset_states_to_obs.py"
        )
    return group


def _images(observations: Any) -> list[str]:
    return [
        name
        for name, item in observations.items()
        if len(getattr(item, "shape", None) or ()) > 2
    ]


def _selected(observations: Any, options: _Options, where: str) -> dict[str, Any]:
    """Returns the arrays of the observation, not read yet."""
    there = sorted(observations)
    asked = {"keys": options.keys or (), "images": options.images}
    asked["exclude"] = options.exclude
    for name, wanted in asked.items():
        missing = [key for key in wanted if key not in there]
        if missing:
            raise KeyError(
                f"{observations.name} of {where} has no {missing}, it has {there}: "
                f"correct {name}="
            )
    if options.keys is not None:
        return {key: observations[key] for key in options.keys}
    images = set(_images(observations)) - set(options.images)
    kept = [key for key in there if key not in images | set(options.exclude)]
    if not kept:
        raise KeyError(
            f"{where} has nothing but images or excluded entries in {there}: name some "
            "in images=, or correct exclude="
        )
    return {key: observations[key] for key in kept}


def _transitions(demo: Any, file: Path, where: str, options: _Options) -> TensorDict:
    with reading_hdf5(file):
        check_hdf5_group(demo, file)
        states = _states(_group(demo, "obs", where), options, where)
        has_next = "next_obs" in demo
        after = (
            _states(_group(demo, "next_obs", where), options, where)
            if has_next
            else None
        )
        for name in ("actions", *options.infos):
            if name not in demo:
                raise KeyError(
                    f"{where} has no {name!r}, it has {sorted(demo)}: correct the file"
                    f"{' or infos=' if name in options.infos else ''}"
                )
        actions = _read(demo["actions"])
        # LIBERO stores them as uint8.
        rewards = demo["rewards"][()].astype(float) if "rewards" in demo else None
        infos = {name: _read(demo[name]) for name in options.infos}
    if has_next and options.is_after:
        raise ValueError(
            f"{where} has next_obs, so its observations are those before the actions: "
            "leave out observed="
        )
    length = _rows(states)
    # One state more than actions is the last one, as in episode_transitions.
    if not has_next and length != len(actions) + 1:
        if len(actions) != length:
            raise ValueError(
                f"{where} has {len(actions)} actions and {length} observations, "
                "expected as many: remove the demonstration"
            )
        if length < 2:
            raise ValueError(
                f"{where} has one row only and no next_obs, so its action has no next "
                "observation: remove the demonstration, or select others with mask="
            )
        part = slice(1, None) if options.is_after else slice(None, -1)
        actions, infos = actions[part], _cut(infos, part)
        rewards = None if rewards is None else rewards[part]
    return episode_transitions(
        {"observation": states},
        actions,
        where=where,
        rewards=rewards,
        next_observations=None if after is None else {"observation": after},
        info=infos,
        remove="remove the demonstration, or select others with mask=",
        leave_out="leave it out",
    )


def _states(observations: Any, options: _Options, where: str) -> Any:
    arrays = {
        key: _read(item)
        for key, item in _selected(observations, options, where).items()
    }
    if options.keys is not None:
        return join_columns(arrays, where)
    # One number a row is a column, as everywhere in TorchRL.
    return {
        key: array[:, None] if np.ndim(array) == 1 else array
        for key, array in arrays.items()
    }


def _rows(states: Any) -> int:
    while isinstance(states, dict):
        states = next(iter(states.values()))
    return len(states)


def _read(item: Any) -> Any:
    if hasattr(item, "keys"):
        return {name: _read(item[name]) for name in item}
    return item[()]


def _cut(tree: Mapping[str, Any], rows: slice) -> dict[str, Any]:
    return {
        key: _cut(value, rows) if isinstance(value, Mapping) else value[rows]
        for key, value in tree.items()
    }
