"""The leaf of a storage that contains the scores."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import TensorStorage

from torchrl_caiac._files import write_json
from torchrl_caiac._keys import path
from torchrl_caiac._torchrl import drop_memmap_leaf, forget_leaves, memmap_folder
from torchrl_caiac.entities import EntityLayout

__all__ = ["all_nan", "check_leaf", "find_leaf", "new_leaf"]


def find_leaf(data: TensorDictBase, key: NestedKey) -> torch.Tensor | None:
    """Returns the score leaf, ``None`` where there is none.

    Args:
        data (TensorDictBase): the rows of the storage, ``[capacity]``.
        key (NestedKey): the score leaf.

    Returns:
        torch.Tensor, optional: the leaf, ``[capacity, ...]``.

    Raises:
        ValueError: ``key`` is another entry, or below a tensor.
    """
    parts = path(key)
    for depth in range(1, len(parts)):
        if isinstance(data.get(parts[:depth], None), torch.Tensor):
            raise ValueError(
                f"{parts[:depth]} is a tensor in the storage, so {key!r} cannot be "
                "below it: give another key"
            )
    leaf = data.get(key, None)
    if leaf is not None and not isinstance(leaf, torch.Tensor):
        raise ValueError(
            f"{key!r} is a {type(leaf).__name__} in the storage: give another key"
        )
    return leaf


def check_leaf(
    leaf: torch.Tensor, key: NestedKey, data: TensorDictBase, layout: EntityLayout
) -> None:
    """Raises if a leaf cannot contain the scores of a layout's entities.

    Args:
        leaf (torch.Tensor): the leaf.
        key (NestedKey): its key.
        data (TensorDictBase): the rows of the storage, ``[capacity]``.
        layout (EntityLayout): the ``N`` entities.

    Raises:
        ValueError: it is not float32, or its shape is neither ``[capacity, N]`` nor
            ``[capacity, N + 1, N]``.
    """
    n = layout.num_entities
    expected = [(len(data), n), (len(data), n + 1, n)]
    if leaf.dtype != torch.float32 or tuple(leaf.shape) not in expected:
        raise ValueError(
            f"{key!r} is {leaf.dtype} {list(leaf.shape)}, expected torch.float32 "
            f"{list(expected[0])} for the {n} entities {list(layout.names)}: it was "
            "written by something else or for another layout. Call "
            "score_buffer(..., overwrite=True) to replace it, or give another key"
        )


def all_nan(leaf: torch.Tensor, batch_size: int) -> bool:
    """Returns whether no row has a score.

    Args:
        leaf (torch.Tensor): ``[T, ...]``.
        batch_size (int): rows that are read at a time.

    Returns:
        bool: whether all values are NaN.
    """
    return all(bool(part.isnan().all()) for part in leaf.split(batch_size))


def new_leaf(
    storage: TensorStorage,
    data: TensorDictBase,
    key: NestedKey,
    feature_shape: tuple[int, ...],
) -> torch.Tensor:
    """Adds a score leaf in which no row is scored.

    An existing leaf is reused if its shape and dtype fit, and replaced otherwise.

    Args:
        storage (TensorStorage): the storage.
        data (TensorDictBase): its rows, ``[capacity]``.
        key (NestedKey): the score leaf.
        feature_shape (tuple of int): the shape of the scores of a row.

    Returns:
        torch.Tensor: the leaf, float32 NaN ``[capacity, *feature_shape]``.

    Raises:
        ValueError: the storage is shared between processes and lacks the leaf.
    """
    shape = (len(data), *feature_shape)
    leaf = data.get(key, None)
    if leaf is not None and (tuple(leaf.shape) != shape or leaf.dtype != torch.float32):
        _remove_leaf(data, key)
        leaf = None
    if leaf is None:
        if data.is_memmap():
            leaf = data.make_memmap(key, shape=torch.Size(shape), dtype=torch.float32)
        else:
            if data.is_locked and data.is_shared():
                raise ValueError(
                    f"the storage is shared with other processes and has no {key!r}: "
                    "score the buffer before it is shared"
                )
            leaf = torch.empty(shape, dtype=torch.float32, device=data.device)
            with data.unlock_() if data.is_locked else contextlib.nullcontext():
                data.set(key, leaf)
            leaf = data.get(key)
    leaf.fill_(torch.nan)
    # The storage filters what is written by a list of keys that it created earlier.
    forget_leaves(storage)
    return leaf


def _remove_leaf(data: TensorDictBase, key: NestedKey) -> None:
    parts = path(key)
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
