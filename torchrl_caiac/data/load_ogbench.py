"""OGBench datasets as TorchRL transitions in memory-mapped files."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_caiac.data.digests import file_digest
from torchrl_caiac.data.episodes import episode_transitions
from torchrl_caiac.data.npz_streams import ArrayKind, NpzStreams
from torchrl_caiac.data.write_episodes import Part, write_episodes

__all__ = ["load_ogbench"]

_logger = logging.getLogger("torchrl_caiac.data.load_ogbench")

_ROOT = "~/.ogbench/data"  # where OGBench itself keeps them
_WHAT, _AGAIN = "OGBench dataset", "download or create the dataset again"
_NEEDED = ("observations", "actions", "terminals")
# Neither of these is an entry of "info".
_KNOWN = {*_NEEDED, "next_observations", "rewards", "valids"}
# Their robot takes actions [-1, 1] x 5, see ManipSpaceEnv.action_space of OGBench.
_MANIPULATION = ("cube-", "scene-", "puzzle-")
_MANIPULATION_BOUNDS = ([-1.0] * 5, [1.0] * 5)


class _Arrays(Protocol):
    kinds: dict[str, ArrayKind]

    def take(self, name: str, rows: int) -> NDArray[Any]: ...


class _Dataset(NamedTuple):
    """One split of a dataset: where its arrays are, and what they were made from."""

    name: str  # in error messages
    title: str  # such as "cube-double-play-v0"
    open: AbstractContextManager[_Arrays]
    source: dict[str, Any]


def load_ogbench(
    dataset: str | os.PathLike[str],
    path: str | Path,
    *,
    split: Literal["train", "val"] = "train",
    download: bool = False,
    root: str | os.PathLike[str] | None = None,
    exclude: Sequence[str] = (),
    action_bounds: tuple[Any, Any] | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes an OGBench dataset as TorchRL transitions, and opens them.

    The transitions ``[T]`` have ``"observation"``, ``"action"``, ``"episode"`` (the
    number of the trajectory, int64 ``[T]``) and, under ``"next"``, the observation
    after the action, ``"terminated"``, ``"truncated"`` and ``"done"`` (each
    ``[T, 1]``), and ``"reward"`` where the dataset has rewards. All other arrays, such
    as ``qpos``, ``qvel`` and ``button_states``, are kept under ``"info"``: row ``t``
    has the one of its state.

    OGBench's files have one row for each state. The last row of an episode, where
    ``terminals`` is 1, has no next state: it is only the next observation of the row
    before. Files with ``next_observations`` or ``valids``, as
    ``ogbench.make_env_and_datasets`` returns them, are read as well. No episode of
    OGBench ends by its task: the last row counts as truncated.

    The files are read one episode at a time, so that they may be larger than the
    memory. A second call with the same file and arguments opens the folder.

    Args:
        dataset (str or path): a file ``.npz``, or the name of a dataset, such as
            ``"cube-double-play-v0"``. Names with ``singletask`` or ``oraclerep`` need
            the package ``ogbench``, which computes the rewards or the goals from the
            simulator. These rewards are those of the state of the row, not of the next
            state; ``("info", "masks")`` is 0 where that state solves the task.
        path (str or Path): the folder to write. It is written atomically.

    Keyword Args:
        split ("train" or "val"): the training or the validation data. The file of the
            latter ends in ``-val.npz``; a file whose name ends so is read as it is.
            Defaults to ``"train"``.
        download (bool): whether to download a missing dataset into ``root``, which
            needs the package ``ogbench``. Defaults to ``False``.
        root (path, optional): the folder of OGBench's files. Defaults to ``None``:
            ``~/.ogbench/data``, as in OGBench.
        exclude (sequence of str): arrays to leave out, such as ``"qvel"``. Defaults to
            ``()``.
        action_bounds (tuple of sequences, optional): the lowest and the highest action,
            see :func:`~torchrl_caiac.data.action_bounds`. Defaults to ``None``: -1 and
            1 for the datasets ``cube-*``, ``scene-*`` and ``puzzle-*``, else unknown.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar over the episodes. Defaults to
            ``True``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileExistsError: ``path`` exists, was not written by an equal call, and
            ``overwrite`` is ``False``.
        FileNotFoundError: the dataset is not on this machine.
        ImportError: the package ``ogbench`` is needed and missing.
        KeyError: the file lacks an array that is needed or excluded.
        OSError: the disk is full, or the dataset cannot be downloaded.
        UnreadableFileError: the file is damaged, or has Python objects.
        ValueError: the arrays do not belong together; an episode has one state only,
            NaN, infinite values, texts or objects; actions are outside their bounds.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data import load_ogbench
        >>> folder = tempfile.TemporaryDirectory()
        >>> np.savez_compressed(
        ...     f"{folder.name}/point-v0.npz",
        ...     observations=np.zeros((6, 3), np.float32),
        ...     actions=np.zeros((6, 2), np.float32),
        ...     terminals=np.array([0, 0, 0, 1, 0, 1], bool),
        ...     qpos=np.zeros((6, 4), np.float32),
        ... )
        >>> data = load_ogbench(
        ...     f"{folder.name}/point-v0.npz", f"{folder.name}/data", progress=False
        ... )
        >>> data["episode"]
        MemoryMappedTensor([0, 0, 0, 1])
        >>> data["info", "qpos"].shape
        torch.Size([4, 4])
        >>> folder.cleanup()
    """
    if split not in ("train", "val"):
        raise ValueError(f"split is {split!r}, expected 'train' or 'val'")
    found = _find(dataset, split, root, download)
    with found.open as arrays:
        lengths, has_next = _check(arrays, found.name, exclude)
        assumed = action_bounds is None and _is_manipulation(found.title, arrays)
        if assumed:
            action_bounds = _MANIPULATION_BOUNDS
            _logger.info(
                "%s: the actions of this environment are in [-1, 1]; pass "
                "action_bounds= if yours are not",
                found.name,
            )
        return write_episodes(
            _episodes(arrays, lengths, has_next, found.name, exclude, assumed),
            path,
            source={**found.source, "exclude": sorted(exclude)},
            action_bounds=action_bounds,
            overwrite=overwrite,
            progress=progress,
            rows=sum(lengths) - (0 if has_next else len(lengths)),
            total=len(lengths),
            description=f"loading {found.title}",
        )


def _find(
    dataset: str | os.PathLike[str],
    split: str,
    root: str | os.PathLike[str] | None,
    download: bool,
) -> _Dataset:
    if os.fspath(dataset).endswith(".npz"):
        file = Path(dataset)
        if split == "val" and not file.stem.endswith("-val"):
            file = file.with_name(f"{file.stem}-val.npz")
        return _of_file(file, file.stem.removesuffix("-val"))
    name, folder = os.fspath(dataset), Path(_ROOT if root is None else root)
    if os.sep in name or Path(name).exists():
        raise ValueError(
            f"{name} is neither a file .npz nor the name of a dataset: give one of them"
        )
    folder = folder.expanduser()
    if {"singletask", "oraclerep"} & set(name.split("-")):
        return _computed(name, split, folder, download)
    file = folder / f"{name}{'-val' if split == 'val' else ''}.npz"
    if not file.exists():
        _download(name, file, download)
    return _of_file(file, name)


def _of_file(file: Path, title: str) -> _Dataset:
    if not file.exists():
        raise FileNotFoundError(
            f"there is no file {file}: give another one, or the other split="
        )
    source = {"format": "ogbench", "dataset": file.name, "sha256": file_digest(file)}
    return _Dataset(str(file), title, NpzStreams(file, _WHAT, _AGAIN), source)


def _download(name: str, file: Path, download: bool) -> None:
    """Downloads both splits of a dataset with OGBench's own function."""
    if not download:
        raise FileNotFoundError(
            f"the dataset {name!r} is not at {file}: pass download=True, or give its "
            "file or its folder root="
        )
    ogbench = _ogbench(name)
    try:
        ogbench.download_datasets([name], str(file.parent))
    except OSError as error:
        raise OSError(
            f"{name!r} could not be downloaded ({error}): correct the name, connect to "
            f"the network, or put {file.name} into {file.parent}"
        ) from error


def _ogbench(name: str) -> Any:
    try:
        import ogbench
    except ImportError as error:
        raise ImportError(
            f"{name!r} needs the package ogbench: install it with "
            "pip install 'torchrl-caiac[ogbench]', or give the file .npz"
        ) from error
    return ogbench


def _computed(name: str, split: str, folder: Path, download: bool) -> _Dataset:
    """Computes rewards or goals of a dataset with OGBench."""
    parts = [
        part for part in name.split("-") if part not in ("singletask", "oraclerep")
    ]
    plain = "-".join(part for part in parts if not part.startswith("task"))
    for ending in ("", "-val"):  # OGBench reads both
        file = folder / f"{plain}{ending}.npz"
        if not file.exists():
            _download(plain, file, download)
        with NpzStreams(file, _WHAT, _AGAIN):  # OGBench checks nothing
            pass
    env, *splits = _ogbench(name).make_env_and_datasets(
        name, str(folder), add_info=True
    )
    env.close()
    file = folder / f"{plain}{'-val' if split == 'val' else ''}.npz"
    source = {"format": "ogbench", "dataset": name, "sha256": file_digest(file)}
    arrays: _Arrays = _InMemory(splits[split == "val"])
    return _Dataset(f"{name} ({split})", name, nullcontext(arrays), source)


class _InMemory:
    """Arrays that are taken in order, as those of :class:`NpzStreams`."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._arrays = arrays
        self.kinds = {
            name: ArrayKind(array.dtype, array.shape) for name, array in arrays.items()
        }
        self._next = dict.fromkeys(arrays, 0)

    def take(self, name: str, rows: int) -> NDArray[Any]:
        first = self._next[name]
        self._next[name] = first + rows
        return self._arrays[name][first : first + rows]


def _check(
    arrays: _Arrays, name: str, exclude: Sequence[str]
) -> tuple[list[int], bool]:
    """Returns the rows of each episode, and whether each has a next observation."""
    kinds = arrays.kinds
    missing = [key for key in _NEEDED if key not in kinds]
    if missing:
        raise KeyError(
            f"{name} lacks {missing}, it has {sorted(kinds)}: it is not an OGBench "
            "dataset; use from_arrays for other arrays"
        )
    unknown = sorted(set(exclude) - set(kinds))
    if unknown or set(exclude) & set(_NEEDED):
        wrong = unknown or sorted(set(exclude) & set(_NEEDED))
        raise KeyError(
            f"exclude has {wrong}, expected some of {sorted(set(kinds) - set(_NEEDED))}"
            f" of {name}: correct exclude="
        )
    used = {key: kind for key, kind in kinds.items() if key not in exclude}
    rows = {key: kind.shape[:1] for key, kind in used.items()}
    if len(set(rows.values())) != 1 or () in rows.values():
        sizes = {key: list(kind.shape) for key, kind in used.items()}
        raise ValueError(
            f"the arrays of {name} have different numbers of rows, {sizes}: leave out "
            "those that have no row for each state with exclude="
        )
    (total,) = rows["observations"]
    ends = _flags(arrays, "terminals", total, name)
    if "valids" in used:
        ends = ~_flags(arrays, "valids", total, name)
    if not total or not ends[-1]:
        key = "valids" if "valids" in used else "terminals"
        raise ValueError(
            f"{key!r} of {name} does not end the last of its {total} rows, so the last "
            f"episode is not whole: {_AGAIN}, or remove that episode"
        )
    stops = np.flatnonzero(ends) + 1
    lengths = np.diff(stops, prepend=0)
    has_next = "next_observations" in used
    short = np.flatnonzero(lengths < 2)
    if len(short) and not has_next:
        number = int(short[0])
        row = int(stops[number]) - 1
        raise ValueError(
            f"episode {number} of {name} has one row only (row {row}, by "
            "'terminals'), so its action has no next state: remove the episode; or, if "
            "the arrays are those of compact_dataset=True, keep 'valids' too"
        )
    return lengths.tolist(), has_next


def _flags(arrays: _Arrays, key: str, total: int, name: str) -> NDArray[np.bool_]:
    array = arrays.take(key, total)
    flags = np.asarray(array, dtype=bool) if array.dtype.kind in "biuf" else array
    if array.shape != (total,) or not np.array_equal(flags, array):
        raise ValueError(
            f"{key!r} of {name} has shape {list(array.shape)} and type {array.dtype}, "
            f"expected one flag (0 or 1) for each of the {total} rows: convert it"
        )
    return flags


def _episodes(
    arrays: _Arrays,
    lengths: Sequence[int],
    has_next: bool,
    name: str,
    exclude: Sequence[str],
    check_range: bool,
) -> Iterator[Part]:
    names = [
        key for key in arrays.kinds if key not in ("terminals", "valids", *exclude)
    ]
    for number, length in enumerate(lengths):
        where = f"episode {number} of {name}"
        part = {key: arrays.take(key, length) for key in names}
        info = {key: value for key, value in part.items() if key not in _KNOWN}
        # Without next observations, the last action has none, and is left out.
        steps = length if has_next else length - 1
        rows = episode_transitions(
            part["observations"],
            part["actions"][:steps],
            where=where,
            rewards=part["rewards"][:steps] if "rewards" in part else None,
            next_observations=part["next_observations"] if has_next else None,
            info=info,
            leave_out="leave it out with exclude=",
        )
        if check_range:
            _check_range(rows, where)
        yield Part(rows, where)


def _is_manipulation(title: str, arrays: _Arrays) -> bool:
    shape = arrays.kinds["actions"].shape
    return title.startswith(_MANIPULATION) and shape[1:] == (
        len(_MANIPULATION_BOUNDS[0]),
    )


def _check_range(episode: TensorDict, where: str) -> None:
    most = float(episode["action"].abs().max())
    if most > 1:
        raise ValueError(
            f"'actions' of {where} go to {most:.4g}, but those of OGBench's robot are "
            "in [-1, 1]: pass action_bounds="
        )
