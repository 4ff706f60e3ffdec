"""Checks of Minari datasets, before Minari reads them and allocates memory."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_caiac._files import UnreadableFileError, read_json

if TYPE_CHECKING:
    from minari import MinariDataset

__all__ = [
    "check_hdf5_array",
    "check_hdf5_group",
    "check_metadata",
    "episode_lengths",
]

_MAIN_FILE = "main_data.hdf5"
_AGAIN = "download or collect the dataset again"
# The most that zlib compresses; more means that a file was made to fill the memory.
_MOST_COMPRESSION = 1100


def check_metadata(data: Path) -> None:
    """Raises if the metadata of a dataset would run code or fill the memory.

    Minari creates the environment where the spaces are missing, and its entry point
    could be any function. It also allocates what the spaces and counts say.

    Args:
        data (Path): the folder with ``metadata.json``.

    Raises:
        FileNotFoundError: there are no metadata.
        UnreadableFileError: the metadata are damaged.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchrl_caiac.data.minari_checks import check_metadata
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(f"{folder}/metadata.json").write_text("{}")
        ...     check_metadata(Path(folder))
        Traceback (most recent call last):
        ...
        torchrl_caiac._files.UnreadableFileError: .../metadata.json ...
    """
    file = data / "metadata.json"
    what = "description of a Minari dataset"
    metadata = read_json(file, what, _AGAIN)
    try:
        if not isinstance(metadata, dict):
            raise ValueError(f"it has a {type(metadata).__name__}")
        for name in ("observation_space", "action_space"):
            space = metadata.get(name)
            if not isinstance(space, str):
                raise ValueError(
                    f"{name!r} is {space!r}, so Minari would run the dataset's "
                    "environment to find it"
                )
            _check_space(json.loads(space), name)
        for name in ("total_episodes", "total_steps"):
            if type(metadata.get(name)) is not int or metadata[name] < 0:
                raise ValueError(f"{name!r} is {metadata.get(name)!r}")
        if metadata.get("data_format") == "hdf5":
            import h5py

            with h5py.File(data / _MAIN_FILE, "r") as stored:
                found = len(stored)
            if metadata["total_episodes"] > found:
                raise ValueError(
                    f"it says {metadata['total_episodes']} episodes, {_MAIN_FILE} has "
                    f"{found}"
                )
    except (ValueError, KeyError, TypeError, RecursionError, OSError) as error:
        raise UnreadableFileError(
            f"{file} is not a readable {what} ({error}): {_AGAIN}"
        ) from error


def _check_space(space: Any, where: str) -> None:
    if not isinstance(space, dict):
        raise ValueError(f"{where} is {space!r}")
    parts = space.get("subspaces")
    for key, part in (
        parts.items() if isinstance(parts, dict) else enumerate(parts or ())
    ):
        _check_space(part, f"{where}[{key!r}]")
    if space.get("type") == "Box":
        shape = space["shape"]
        if not isinstance(shape, list) or not all(type(x) is int for x in shape):
            raise ValueError(f"the shape of {where} is {shape!r}")
        for bound in ("low", "high"):
            numbers = sum(1 for _ in _leaves(space[bound]))
            if numbers != math.prod(shape):
                raise ValueError(
                    f"{bound!r} of {where} has {numbers} numbers, but shape {shape}"
                )


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, list):
        for item in value:
            yield from _leaves(item)
    else:
        yield value


def episode_lengths(dataset: MinariDataset) -> list[int]:
    """Returns the number of steps of each episode, after checking what is stored.

    Args:
        dataset (MinariDataset): the dataset.

    Returns:
        list of int: the lengths, in the order of ``dataset.episode_indices``.

    Raises:
        UnreadableFileError: an array is not whole, refers to another file, or has a
            shape that does not fit the size of the file.

    Examples:
        >>> import tempfile
        >>> import gymnasium
        >>> import numpy as np
        >>> from minari.data_collector import EpisodeBuffer
        >>> from torchrl_caiac.data import minari_checks, minari_files
        >>> episode = EpisodeBuffer(
        ...     observations=np.zeros((3, 4), np.float32),
        ...     actions=np.zeros(2, int),
        ...     rewards=np.zeros(2),
        ...     terminations=np.zeros(2, bool),
        ...     truncations=np.array([False, True]),
        ... )
        >>> with tempfile.TemporaryDirectory() as root:
        ...     dataset = minari_files.publish_dataset(
        ...         "pole/rest-v0",
        ...         [episode],
        ...         minari_files.free_dataset_path("pole/rest-v0", root),
        ...         lambda: gymnasium.make("CartPole-v1"),
        ...         code="examples/collect.py",
        ...         requirements=["gymnasium>=1"],
        ...         progress=False,
        ...         description="A pole at rest.",
        ...         algorithm_name="none",
        ...     )
        ...     minari_checks.episode_lengths(dataset)
        [2]
    """
    storage = dataset.storage
    metadata = storage.get_episode_metadata(dataset.episode_indices)
    if storage.FORMAT != "hdf5":
        return [int(episode["total_steps"]) for episode in metadata]
    import h5py

    file = Path(storage.data_path) / _MAIN_FILE
    lengths = []
    try:
        with h5py.File(file, "r") as stored:
            for index, episode in zip(dataset.episode_indices, metadata, strict=True):
                group = stored[f"episode_{index}"]
                check_hdf5_group(group, file)
                length, said = len(group["rewards"]), episode["total_steps"]
                if said != length:
                    raise ValueError(
                        f"episode_{index} has {length} rewards, but 'total_steps' is "
                        f"{said!r}"
                    )
                lengths.append(length)
    except (ValueError, KeyError, TypeError, OSError, RuntimeError) as error:
        if isinstance(error, UnreadableFileError):
            raise
        raise UnreadableFileError(
            f"{file} is not a readable Minari dataset ({error}): {_AGAIN}"
        ) from error
    return lengths


def check_hdf5_group(group: Any, file: Path) -> None:
    """Raises if an array in an HDF5 group, or in the groups below, is not whole.

    Args:
        group (h5py.Group): the group.
        file (Path): the file.

    Raises:
        UnreadableFileError: see :func:`check_hdf5_array`.
        ValueError: an entry is a link.

    Examples:
        >>> import tempfile, h5py
        >>> from pathlib import Path
        >>> from torchrl_caiac.data.minari_checks import check_hdf5_group
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(f"{folder}/a.hdf5")
        ...     with h5py.File(path, "w") as stored:
        ...         stored["a/b"] = [1.0, 2.0]
        ...         check_hdf5_group(stored, path)
    """
    import h5py

    for name in group:
        where = f"{group.name}/{name}"
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"{where} is a link, perhaps into another file")
        item = group[name]
        if isinstance(item, h5py.Group):
            check_hdf5_group(item, file)
        else:
            check_hdf5_array(item, file)


def check_hdf5_array(array: Any, file: Path) -> None:
    """Raises if an array in an HDF5 file is not whole.

    HDF5 returns zeros for parts that were never written, and allocates what the shape
    says.

    Args:
        array (h5py.Dataset): the array.
        file (Path): the file.

    Raises:
        UnreadableFileError: parts are missing, the array is stored in another file, or
            its shape does not fit the size of the file.

    Examples:
        >>> import tempfile, h5py
        >>> from pathlib import Path
        >>> from torchrl_caiac.data.minari_checks import check_hdf5_array
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(f"{folder}/a.hdf5")
        ...     with h5py.File(path, "w") as stored:
        ...         stored["a"] = [1.0, 2.0]
        ...         check_hdf5_array(stored["a"], path)
    """
    import h5py

    if not isinstance(array, h5py.Dataset):
        raise UnreadableFileError(f"{array.name} in {file} is not an array: {_AGAIN}")
    here = Path(array.file.filename).resolve() == file.resolve()
    if array.is_virtual or array.external or not here:
        raise UnreadableFileError(
            f"{array.name} in {file} is stored in another file: {_AGAIN}"
        )
    properties = array.id.get_create_plist()
    needed = array.size * array.id.get_type().get_size() if array.shape else 0
    stored = array.id.get_storage_size()
    if properties.get_layout() == h5py.h5d.CHUNKED:
        chunks = zip(array.shape, array.chunks, strict=True)
        expected = math.prod(-(-size // chunk) for size, chunk in chunks)
        whole = array.id.get_num_chunks() == expected
        if properties.get_nfilters():
            needed //= _MOST_COMPRESSION
    else:
        whole = True
    if needed and (not whole or stored < needed):
        raise UnreadableFileError(
            f"{array.name} in {file} has shape {array.shape} and {stored} bytes, parts "
            f"of it were not written: {_AGAIN}"
        )
