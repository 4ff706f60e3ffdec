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


def load_transitions(
    path: str | Path, *, keys: Iterable[NestedKey] = _KEYS
) -> TensorDict:
    """Opens a memory-mapped tensordict of flat transitions.

    ``TensorDict.load_memmap`` fills the missing part of a truncated file with zeros, in
    the data and on disk. This function checks the size of every file first. The
    tensordict it returns is marked as memory-mapped, so that leaves can be added to it.

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
        ValueError: the folder is not a memory-mapped tensordict, is truncated, has no
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
    data = TensorDict.load_memmap(path)
    missing = [key for key in keys if data.get(key, None) is None]
    if missing:
        raise ValueError(
            f"{path} lacks {missing}, it has {leaf_names(data)}: give another folder, "
            "or pass keys="
        )
    mark_memmap(data)
    return data.lock_()


def _check_folder(folder: Path, root: Path) -> list[int]:
    """Checks that the file of every leaf is complete, and returns the batch size."""
    meta = folder / "meta.json"
    again = "delete the folder and create the data again"
    if not meta.exists():
        raise ValueError(
            f"{root} is not a memory-mapped tensordict, {meta} is missing: give "
            f"another folder, or {again}"
        )
    try:
        content = json.loads(meta.read_text(encoding="utf-8"))
        shape = [int(size) for size in content["shape"]]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{meta} is truncated or not from tensordict ({error}): {again}"
        ) from error
    for key, entry in content.items():
        if not isinstance(entry, dict):
            continue
        name = file_name(key)
        if entry.get("type") is not None:
            if entry["type"] == "TensorDict":
                _check_folder(folder / name, root)
            continue
        file = folder / f"{name}.memmap"
        if not file.exists():
            raise ValueError(f"{root} is incomplete, {file} is missing: {again}")
        expected = _bytes(entry)
        if expected is not None and file.stat().st_size != expected:
            raise ValueError(
                f"{file} has {file.stat().st_size} bytes, expected {expected} "
                f"({entry['dtype']} {entry['shape']}): {again}"
            )
    return shape


def _bytes(entry: dict[str, Any]) -> int | None:
    dtype = getattr(torch, str(entry.get("dtype")).removeprefix("torch."), None)
    shape = entry.get("shape")
    if not isinstance(dtype, torch.dtype) or not isinstance(shape, list):
        return None
    return dtype.itemsize * math.prod(shape)
