"""Files of arrays, ``.npz`` or HDF5, as TorchRL transitions."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tensordict import TensorDict

from torchrl_caiac._files import UnreadableFileError
from torchrl_caiac.data.from_arrays import from_arrays
from torchrl_caiac.data.hdf5_files import open_hdf5, reading_hdf5
from torchrl_caiac.data.minari_checks import check_hdf5_group
from torchrl_caiac.data.npz_streams import NpzStreams

__all__ = ["load_array_file"]

_logger = logging.getLogger("torchrl_caiac.data.load_array_file")

_AGAIN = "download or create the file again"
_NEEDED = ("observations", "actions")
# The arguments of from_arrays, and other names that are in use.
_ARGUMENTS = {
    name: name
    for name in (
        *_NEEDED,
        "rewards",
        "next_observations",
        "terminals",
        "timeouts",
        "dones",
        "episode_lengths",
        "episode_ids",
        "achieved_goals",
        "desired_goals",
        "next_achieved_goals",
    )
}
_ARGUMENTS |= {"terminations": "terminals", "truncations": "timeouts"}
_ARGUMENTS |= {"episodes": "episode_ids"}


def load_array_file(
    file: str | Path,
    path: str | Path,
    *,
    infos: Sequence[str] = (),
    exclude: Sequence[str] = (),
    action_bounds: tuple[Any, Any] | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes a file with flat arrays as TorchRL transitions, and opens them.

    The names of the arrays are those of the arguments of
    :func:`~torchrl_caiac.data.from_arrays`, as in files of D4RL: ``observations`` and
    ``actions`` are needed, and so are ``terminals``, ``timeouts``, ``episode_ids`` or
    ``episode_lengths``, which say where episodes end. ``terminations``,
    ``truncations`` and ``episodes`` are read as ``terminals``, ``timeouts`` and
    ``episode_ids``. A group ``observations``, or arrays ``observations/<name>`` in an
    ``.npz`` file, become a nested observation. These are also the files that
    :mod:`torchrl_caiac.augment` writes.

    Args:
        file (str or Path): the file, ``.npz`` or HDF5.
        path (str or Path): the folder to write. It is written atomically.

    Keyword Args:
        infos (sequence of str): other arrays to keep under ``"info"``, such as
            ``"infos/qpos"``. Defaults to ``()``: the others are left out, which a
            message in the log says, a warning if names have no ``/``.
        exclude (sequence of str): arrays to leave out. Defaults to ``()``.
        action_bounds (tuple of sequences, optional): see
            :func:`~torchrl_caiac.data.action_bounds`. Defaults to ``None``: unknown.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: the package ``h5py`` is needed and missing.
        KeyError: the file lacks an array; the message lists those that are there.
        UnreadableFileError: the file is damaged, or has Python objects.
        ValueError: see :func:`~torchrl_caiac.data.from_arrays`.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data.load_array_file import load_array_file
        >>> folder = tempfile.TemporaryDirectory()
        >>> np.savez(
        ...     f"{folder.name}/a.npz",
        ...     observations=np.zeros((4, 3)),
        ...     actions=np.zeros((4, 2)),
        ...     next_observations=np.zeros((4, 3)),
        ...     timeouts=np.array([0, 1, 0, 1]),
        ... )
        >>> data = load_array_file(
        ...     f"{folder.name}/a.npz", f"{folder.name}/rows", progress=False
        ... )
        >>> data["episode"]
        MemoryMappedTensor([0, 0, 1, 1])
        >>> folder.cleanup()
    """
    file = Path(file)
    if not file.exists():
        raise FileNotFoundError(f"there is no file {file}: give another one")
    with ExitStack() as stack:
        arrays = _arrays(file, stack)
        missing = [name for name in (*_NEEDED, *infos, *exclude) if name not in arrays]
        if missing:
            raise KeyError(
                f"{file} lacks {missing}, it has {sorted(arrays)}: rename its arrays, "
                "or use from_arrays"
            )
        used = {
            name: _ARGUMENTS[name]
            for name in arrays
            if name in _ARGUMENTS and name not in exclude
        }
        if len(set(used.values())) != len(used):
            raise ValueError(
                f"{file} has {sorted(used)}, of which two mean the same: leave one out "
                "with exclude="
            )
        left_out = sorted({*arrays} - {*used, *infos, *exclude})
        if left_out:
            # Names with a folder, such as D4RL's infos/qpos, are usual; others may be
            # misspelt.
            level = logging.INFO if all("/" in x for x in left_out) else logging.WARNING
            _logger.log(
                level,
                "%s of %s are left out: rename them if they are one of %s, or keep "
                "some by infos=",
                left_out,
                file,
                sorted(_ARGUMENTS),
            )
        kept = {argument: arrays[name] for name, argument in used.items()}
        try:
            return from_arrays(
                kept.pop("observations"),
                kept.pop("actions"),
                path,
                **kept,
                info={name: arrays[name] for name in infos} or None,
                action_bounds=action_bounds,
                overwrite=overwrite,
                progress=progress,
            )
        except UnreadableFileError:
            raise
        except (TypeError, ValueError) as error:
            # These name the arrays alone.
            kind = TypeError if isinstance(error, TypeError) else ValueError
            raise kind(f"{file}: {error}") from error
        except OSError as error:
            # h5py's has no number: a part cannot be decompressed.
            if type(error) is not OSError or error.errno is not None:
                raise
            raise UnreadableFileError(
                f"{file} cannot be read, it may be damaged ({error}): {_AGAIN}"
            ) from error


def _arrays(file: Path, stack: ExitStack) -> Mapping[str, Any]:
    """Returns the arrays of a file, or what reads them in parts."""
    if file.suffix == ".npz":
        streams = stack.enter_context(NpzStreams(file, "file of arrays", _AGAIN))
        return _Archive(streams)
    stored = stack.enter_context(open_hdf5(file))
    with reading_hdf5(file):
        check_hdf5_group(stored, file)
        found: dict[str, Any] = {}
        for name, item in stored.items():
            if hasattr(item, "keys") and name not in _ARGUMENTS:
                found |= {f"{name}/{inner}": _tree(item[inner]) for inner in item}
            else:
                found[name] = _tree(item)
        return found


class _Archive(Mapping[str, Any]):
    """The arrays of an archive, read when they are asked for."""

    def __init__(self, streams: NpzStreams) -> None:
        self._streams = streams
        # The arrays of a name: one, or those of a group.
        self._parts: dict[str, list[str]] = {}
        for name, kind in streams.kinds.items():
            group = name.split("/")[0]
            if kind.shape:
                whole = group if group in _ARGUMENTS else name
                self._parts.setdefault(whole, []).append(name)
        for names in self._parts.values():
            for name in names:
                below = [other for other in names if other.startswith(f"{name}/")]
                if below:
                    raise ValueError(
                        f"the file has the array {name!r} and arrays below it, "
                        f"{below}: rename them, or pass the arrays to from_arrays"
                    )

    def __getitem__(self, name: str) -> Any:
        tree: dict[str, Any] = {}
        for part in self._parts[name]:
            array = self._streams.take(part, self._streams.kinds[part].shape[0])
            if part == name:
                return array
            *above, last = part.split("/")[1:]
            inner = tree
            for group in above:
                inner = inner.setdefault(group, {})
            inner[last] = array
        return tree

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)

    def __contains__(self, name: object) -> bool:
        return name in self._parts


def _tree(item: Any) -> Any:
    if hasattr(item, "keys"):
        return {name: _tree(item[name]) for name in item}
    return item
