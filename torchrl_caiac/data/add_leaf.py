"""Adds leaves to opened transitions and to their folder."""

from __future__ import annotations

import contextlib
import json
import logging
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._files import (
    allocate,
    recover_meta,
    reserve,
    safe_meta,
    write_json,
)
from torchrl_caiac._keys import as_key
from torchrl_caiac._keys import path as path_of
from torchrl_caiac._torchrl import (
    drop_memmap_leaf,
    file_name,
    mark_memmap,
    memmap_folder,
    set_memmap_entry,
)
from torchrl_caiac._whole_files import naming_full_disk
from torchrl_caiac.data.write_transitions import check_entries, check_key_names

__all__ = ["add_leaf", "new_leaf", "open_leaf", "remove_leaf", "store_leaves"]

_logger = logging.getLogger("torchrl_caiac.data.add_leaf")


def add_leaf(data: TensorDictBase, key: NestedKey, values: Any) -> torch.Tensor:
    """Adds a leaf to transitions, and to their folder.

    Opened transitions are locked, and ``data[key] = values`` raises an error. After
    ``unlock_()`` it works, but the leaf is in memory only, until
    :func:`~torchrl_caiac.data.offline_buffer` or
    :func:`~torchrl_caiac.influence.score_buffer` writes it to the folder.

    Args:
        data (TensorDictBase): transitions ``[T]``, as from
            :func:`~torchrl_caiac.data.load_transitions`, or in memory.
        key (NestedKey): the new key.
        values (torch.Tensor or array): ``[T, ...]``.

    Returns:
        torch.Tensor: the leaf, ``[T, ...]``. Writing to it writes to disk, if the
        transitions are memory-mapped.

    Raises:
        OSError: the disk is full, or the folder is read-only.
        ValueError: the key exists, is below a tensor, or has a reserved name; or the
            values are no numbers or have another number of rows.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data import add_leaf, from_arrays, load_transitions
        >>> folder = tempfile.TemporaryDirectory()
        >>> data = from_arrays(
        ...     np.zeros((5, 3)),
        ...     np.zeros((4, 2)),
        ...     f"{folder.name}/data",
        ...     episode_lengths=[4],
        ...     progress=False,
        ... )
        >>> _ = add_leaf(data, ("info", "weight"), np.ones(4, np.float32))
        >>> load_transitions(f"{folder.name}/data")["info", "weight"]
        MemoryMappedTensor([1., 1., 1., 1.])
        >>> folder.cleanup()
    """
    key = as_key(key)
    store_leaves(data)
    try:
        leaf = torch.as_tensor(values).detach()
    except (TypeError, ValueError) as error:
        raise ValueError(f"the values of {key!r} are no numbers: {error}") from error
    if leaf.shape[: data.batch_dims] != data.batch_size:
        raise ValueError(
            f"the values of {key!r} have shape {list(leaf.shape)}, expected "
            f"{[*data.batch_size]} and any further dimensions: give one for each row"
        )
    parts = path_of(key)
    for depth in range(1, len(parts) + 1):
        there = data.get(parts[:depth], None)
        is_end = depth == len(parts)
        if there is not None and (is_end or isinstance(there, torch.Tensor)):
            raise ValueError(
                f"{parts[:depth]} exists already: "
                + (
                    "to change it, write to it in place, as in data[key][:] = values; "
                    "else give another key"
                    if is_end
                    else f"{key!r} cannot be below a tensor, give another key"
                )
            )
    check_entries(data.empty().set(key, leaf), "the data")
    check_key_names([*data.keys(True, True), key], "the data")
    if not data.is_memmap():
        with data.unlock_() if data.is_locked else contextlib.nullcontext():
            data.set(key, leaf)
        return data.get(key)
    return _stored(data, key, leaf)


def store_leaves(data: TensorDictBase) -> list[NestedKey]:
    """Writes leaves that were set after ``unlock_()`` to the folder, and locks again.

    ``unlock_()`` makes opened transitions an ordinary tensordict, whose new leaves are
    in memory only. Afterwards they are memory-mapped again.

    Args:
        data (TensorDictBase): the transitions. Nothing happens if they have no folder.

    Returns:
        list of NestedKey: the keys that were written.

    Raises:
        OSError: the disk is full, or the folder is read-only.
        ValueError: a leaf of the folder was replaced by another tensor; or a new one is
            not a tensor or has a reserved name.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data import load_transitions
        >>> from torchrl_caiac.data.add_leaf import store_leaves
        >>> rows = TensorDict({"action": torch.zeros(3, 2)}, [3])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = rows.memmap(folder)
        ...     data = load_transitions(folder, keys=["action"]).unlock_()
        ...     data["weight"] = torch.ones(3)
        ...     store_leaves(data)
        ['weight']
    """
    folder = memmap_folder(data)
    if folder is None or data.is_memmap():
        return []
    root = Path(folder).resolve()
    check_entries(data, f"the data opened from {folder}")
    added: list[tuple[NestedKey, torch.Tensor]] = []
    for key, leaf in data.items(True, True):
        file = root.joinpath(*map(file_name, path_of(key)))
        file = file.with_name(f"{file.name}.memmap")
        if isinstance(leaf, MemoryMappedTensor) and _file_of(leaf) == file:
            continue
        # A process that was killed in add_leaf may have left a file that is not listed.
        if leaf.numel() and file.exists() and _is_listed(file, key):
            raise ValueError(
                f"{key!r} of the data opened from {folder} was replaced by another "
                f"tensor, and {file} has other content: write in place, as in "
                "data[key][:] = values, give the new one another key, or write the "
                "data to another folder with write_transitions"
            )
        if leaf.numel():
            added.append((key, leaf))
    dropped = _drop_foreign(data, [key for key, _ in added])
    mark_memmap(data)
    try:
        for key, leaf in added:
            _stored(data, key, leaf)
    except BaseException:
        # A parent may hold the lock; the error that led here is the one to raise.
        with contextlib.suppress(RuntimeError):
            data.unlock_()
        for key, entry in dropped:
            data.set(key, entry)  # as it was, in memory
        raise
    data.lock_()
    keys = [key for key, _ in added]
    if keys:
        _logger.info("%s, set after unlock_(), are written to %s", keys, folder)
    return keys


def _is_listed(file: Path, key: NestedKey) -> bool:
    meta = file.with_name("meta.json")
    if not meta.exists():  # nor is the entry above it
        return False
    return path_of(key)[-1] in json.loads(meta.read_text(encoding="utf-8"))


def _file_of(leaf: MemoryMappedTensor) -> Path | None:
    try:
        return Path(leaf.filename).resolve()
    except (AttributeError, RuntimeError, TypeError):  # it has no file
        return None


def _drop_foreign(
    data: TensorDictBase, keys: list[NestedKey]
) -> list[tuple[NestedKey, Any]]:
    """Removes leaves, and the entries above them that have no folder, from a mapping.

    Returns:
        list of tuple: the keys and what was there.
    """
    dropped: list[tuple[NestedKey, Any]] = []
    for key in keys:
        parts = path_of(key)
        for depth in range(1, len(parts) + 1):
            place: NestedKey = parts[:depth] if depth > 1 else parts[0]
            entry = data.get(place, None)
            if entry is None:
                break  # dropped with another leaf
            nested = isinstance(entry, TensorDictBase)
            if nested and memmap_folder(entry) is not None:
                continue
            dropped.append((place, entry))
            drop_memmap_leaf(data, place)
            break
    return dropped


def new_leaf(
    data: TensorDictBase, key: NestedKey, shape: torch.Size, dtype: torch.dtype
) -> torch.Tensor:
    """Adds a leaf to memory-mapped data, whose folder survives a killed process.

    Args:
        data (TensorDictBase): the memory-mapped data.
        key (NestedKey): the new key.
        shape (torch.Size): the shape of the leaf.
        dtype (torch.dtype): its type.

    Returns:
        torch.Tensor: the leaf, zero.

    Raises:
        OSError: the disk is full; the leaf is removed.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.add_leaf import new_leaf
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     data = TensorDict({"action": torch.zeros(3, 2)}, [3]).memmap(folder)
        ...     new_leaf(data, "weight", torch.Size([3]), torch.float32)
        MemoryMappedTensor([0., 0., 0.])
    """
    folder = memmap_folder(data)
    with contextlib.nullcontext() if folder is None else safe_meta(folder):
        leaf = data.make_memmap(key, shape=shape, dtype=dtype)
        if folder is not None:
            try:
                reserve(leaf.filename)
            except OSError:
                remove_leaf(data, key)
                raise
    return leaf


def _stored(data: TensorDictBase, key: NestedKey, leaf: torch.Tensor) -> torch.Tensor:
    """Adds a leaf with its values, which a killed process adds as a whole or not."""
    folder = memmap_folder(data)
    if folder is None:
        return new_leaf(data, key, leaf.shape, leaf.dtype).copy_(leaf)
    with safe_meta(folder):
        # A full disk would kill the process while it writes to mapped memory.
        with naming_full_disk(folder), TemporaryFile(dir=folder) as file:
            allocate(file.fileno(), max(1, leaf.numel() * leaf.element_size()))
        # The values are written first, and then the list of leaves.
        return data.make_memmap_from_tensor(key, leaf.cpu().contiguous())


def open_leaf(data: TensorDictBase, key: NestedKey) -> bool:
    """Opens a leaf that another process has added to the folder of opened data.

    A leaf that is open already is opened again, as its file may be another.

    Args:
        data (TensorDictBase): memory-mapped data with a folder.
        key (NestedKey): the leaf.

    Returns:
        bool: whether the folder has the leaf.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data import add_leaf, load_transitions
        >>> from torchrl_caiac.data.add_leaf import open_leaf
        >>> rows = TensorDict({"action": torch.zeros(3, 2)}, [3])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = rows.memmap(folder)
        ...     data = load_transitions(folder, keys=["action"])
        ...     other = load_transitions(folder, keys=["action"])
        ...     _ = add_leaf(other, ("info", "weight"), torch.ones(3))
        ...     open_leaf(data, ("info", "weight")), data["info", "weight"]
        (True, MemoryMappedTensor([1., 1., 1.]))
    """
    folder = memmap_folder(data)
    if folder is None:
        return False
    recover_meta(folder)
    fresh = TensorDict.load_memmap(folder, allow_pickle=False)
    if not isinstance(fresh.get(key, None), torch.Tensor):
        return False
    mark_memmap(fresh)
    parts = path_of(key)
    for depth in range(1, len(parts) + 1):
        place: NestedKey = parts[:depth] if depth > 1 else parts[0]
        if depth == len(parts) or not isinstance(data.get(place, None), TensorDictBase):
            set_memmap_entry(data, place, fresh.get(place))
            break
    return True


def remove_leaf(data: TensorDictBase, key: NestedKey) -> None:
    """Removes a leaf from data, and from their folder.

    Args:
        data (TensorDictBase): the data, in memory or memory-mapped.
        key (NestedKey): the leaf.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.add_leaf import remove_leaf
        >>> data = TensorDict({"action": torch.zeros(3), "weight": torch.ones(3)}, [3])
        >>> remove_leaf(data, "weight")
        >>> list(data.keys())
        ['action']
    """
    parts = path_of(key)
    node = data if len(parts) == 1 else data.get(parts[:-1])
    if not data.is_memmap():
        with data.unlock_() if data.is_locked else contextlib.nullcontext():
            data.del_(key)
        return
    # A memory-mapped tensordict cannot drop a leaf, and unlocking it would make it an
    # ordinary one. So remove the leaf from the folder's list, the file and the mapping.
    folder = memmap_folder(node)
    if folder is not None:
        meta = Path(folder) / "meta.json"
        content = json.loads(meta.read_text(encoding="utf-8"))
        content.pop(parts[-1], None)
        write_json(meta, content)
    filename = getattr(node.get(parts[-1]), "filename", None)
    if filename:
        Path(filename).unlink(missing_ok=True)
    drop_memmap_leaf(data, key)
