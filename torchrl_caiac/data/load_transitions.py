"""Opens a folder of transitions, after checking that it is complete."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey

from torchrl_caiac._keys import leaf_names
from torchrl_caiac._torchrl import file_name, mark_memmap

__all__ = ["load_transitions"]

_KEYS: tuple[NestedKey, ...] = ("action", "episode", ("next", "done"))

_AGAIN = "delete the folder and create the data again"


def load_transitions(
    path: str | Path, *, keys: Iterable[NestedKey] = _KEYS
) -> TensorDict:
    """Opens a memory-mapped tensordict of flat transitions.

    ``TensorDict.load_memmap`` fills the missing part of a truncated file with zeros, in
    the data and on disk. This function checks the size of every file first. The
    returned tensordict is flagged as memory-mapped, so that leaves can be added to it.

    Args:
        path (str or Path): the folder, as written by
            :func:`~torchrl_caiac.data.load_minari` or by ``tensordict.memmap(path)``
            with one batch dimension.

    Keyword Args:
        keys (iterable of NestedKey): the keys that the data must have. Defaults to
            ``"action"``, ``"episode"`` and ``("next", "done")``.

    Returns:
        TensorDict: the transitions, ``[T]``, memory-mapped and locked. Writing to a
        leaf writes to disk.

    Raises:
        FileNotFoundError: the folder does not exist.
        ValueError: the folder is not a memory-mapped tensordict, is truncated, has
            something other than tensors (it could be a pickle, and is not read), has no
            rows or several batch dimensions, or lacks a key.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict, TensorDictBase
        >>> from torchrl_caiac.data.load_transitions import load_transitions
        >>> rows = TensorDict({"action": torch.zeros(3, 2)}, [3])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = rows.memmap(folder)
        ...     load_transitions(folder, keys=["action"]).batch_size
        torch.Size([3])
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(
            f"the folder {path} does not exist: create the data first, for example "
            "with load_minari"
        )
    shape = _check_folder(path, path)
    if len(shape) != 1 or not shape[0]:
        raise ValueError(
            f"{path} has batch size {shape}, expected [T] with at least one row: store "
            "flat transitions"
        )
    data = TensorDict.load_memmap(path, allow_pickle=False)
    missing = [key for key in keys if data.get(key, None) is None]
    if missing:
        raise ValueError(
            f"{path} lacks {missing}, it has {leaf_names(data)}: give another folder, "
            "or pass keys="
        )
    mark_memmap(data)
    return data.lock_()


def _check_folder(folder: Path, root: Path) -> list[int]:
    """Checks that a folder contains only complete tensors; returns its batch size."""
    meta = folder / "meta.json"
    if not meta.exists():
        raise ValueError(
            f"{root} is not a memory-mapped tensordict, {meta} is missing: give "
            f"another folder, or {_AGAIN}"
        )
    try:
        content = json.loads(meta.read_text(encoding="utf-8"))
        kind, shape = content["_type"], _shape(content["shape"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{meta} is truncated or not from tensordict ({error}): {_AGAIN}"
        ) from error
    if kind != str(TensorDict):
        raise ValueError(
            f"{meta} describes a {kind}, expected a TensorDict: store plain tensordicts"
        )
    for key, entry in content.items():
        if not isinstance(entry, dict):
            continue
        name = file_name(key)
        if entry.get("type") == "TensorDict":
            _check_folder(folder / name, root)
        elif entry.get("type") is not None:
            # Its content may be a pickle, which could execute anything.
            raise ValueError(
                f"{meta} has a {entry['type']} in {key!r}, expected only tensors: "
                "leave it out with exclude() before the data are stored"
            )
        else:
            _check_leaf(folder / f"{name}.memmap", entry, shape, meta, key)
    return shape


def _check_leaf(
    file: Path, entry: dict[str, Any], batch: list[int], meta: Path, key: str
) -> None:
    """Checks that the size of a leaf's file matches its dtype and shape."""
    try:
        dtype = getattr(torch, str(entry["dtype"]).removeprefix("torch."))
        shape = _shape(entry["shape"])
        if not isinstance(dtype, torch.dtype) or entry.get("is_nested"):
            raise ValueError(f"{entry} is not a dense tensor")
        if shape[: len(batch)] != batch:
            raise ValueError(
                f"shape {shape} does not begin with the batch size {batch}"
            )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{meta} has an unreadable description of {key!r} ({error}): {_AGAIN}"
        ) from error
    expected = dtype.itemsize * math.prod(shape)
    if not file.exists():
        if not expected:
            return  # tensordict writes no file for a tensor without elements
        raise ValueError(f"{meta.parent} is incomplete, {file} is missing: {_AGAIN}")
    if file.stat().st_size != expected:
        raise ValueError(
            f"{file} has {file.stat().st_size} bytes, expected {expected} ({dtype} "
            f"{shape}): {_AGAIN}"
        )


def _shape(value: Any) -> list[int]:
    if not isinstance(value, list) or not all(type(x) is int and x >= 0 for x in value):
        raise ValueError(f"{value!r} is not a shape")
    return value
