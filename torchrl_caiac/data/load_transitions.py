"""Opens a folder of transitions, after checking that it is complete."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._files import (
    UnreadableFileError,
    meta_state,
    read_json,
    recover_meta,
    remove_leftovers,
)
from torchrl_caiac._keys import leaf_names
from torchrl_caiac._torchrl import file_name, mark_memmap
from torchrl_caiac.data.digests import verify_digests

__all__ = ["check_transitions", "load_transitions"]

_KEYS: tuple[NestedKey, ...] = ("action", "episode", ("next", "done"))
# What meta.json has besides the entries.
_COMMON = {"shape", "device", "_type"}

_TRIES = 20  # to read a folder while other processes add leaves
_AGAIN = "delete the folder and create the data again"


def load_transitions(
    path: str | Path, *, keys: Iterable[NestedKey] = _KEYS, verify: bool = False
) -> TensorDict:
    """Opens a memory-mapped tensordict of flat transitions.

    ``TensorDict.load_memmap`` fills the missing part of a truncated file with zeros, in
    the data and on disk. This function checks the size of every file first, and reads
    nothing but tensors. The returned tensordict is flagged as memory-mapped, so that
    :func:`~torchrl_caiac.data.add_leaf` can add leaves to it and to the folder. If a
    process was killed while it added one, or while it replaced the folder, the folder
    is restored to what it was before. While another process replaces it, it is missing
    for a moment.

    Args:
        path (str or Path): the folder, as written by
            :func:`~torchrl_caiac.data.load_minari` or by ``tensordict.memmap(path)``
            with one batch dimension.

    Keyword Args:
        keys (iterable of NestedKey): the keys that the data must have. Defaults to
            ``"action"``, ``"episode"`` and ``("next", "done")``.
        verify (bool): whether to compare the content of all leaves with the digests
            that were written with them, see
            :func:`~torchrl_caiac.data.verify_digests`. This reads all files.
            Defaults to ``False``: only sizes are checked.

    Returns:
        TensorDict: the transitions, ``[T]``, memory-mapped and locked. Writing to a
        leaf writes to disk, unless its file is read-only.

    Raises:
        FileNotFoundError: the folder does not exist, or has no digests to verify.
        UnreadableFileError: the folder is not a memory-mapped tensordict, is truncated,
            has something other than tensors (it could be a pickle, and is not read), or
            other content than its digests; or another process is adding a leaf.
        ValueError: it has no rows or several batch dimensions, lacks a key, or is a
            replay buffer that was saved before it was full.

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
    remove_leftovers(path)
    if not path.is_dir():
        raise FileNotFoundError(
            f"the folder {path} does not exist: create the data first, for example "
            "with load_minari"
        )
    for _ in range(_TRIES):
        before = meta_state(path)
        recover_meta(path)
        try:
            return _open(path, keys, verify)
        except UnreadableFileError:
            # Perhaps it was read while another process added a leaf.
            if meta_state(path) == before:
                raise
    return _open(path, keys, verify)


def _open(path: Path, keys: Iterable[NestedKey], verify: bool) -> TensorDict:
    """Opens a folder, after checking it."""
    leaves: set[tuple[str, ...]] = set()
    try:
        shape = _check_folder(path, path, [], leaves)
    except RecursionError:
        raise UnreadableFileError(f"{path} is nested too deeply: {_AGAIN}") from None
    _check_batch_size(shape, str(path))
    _check_is_full(path, shape[0])
    if verify:
        verify_digests(path)
    try:
        data = TensorDict.load_memmap(path, allow_pickle=False)
    except (RuntimeError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise UnreadableFileError(
            f"{path} could not be opened by tensordict ({error}): {_AGAIN}"
        ) from error
    # tensordict leaves out what it does not understand.
    lost = leaves - {
        key if isinstance(key, tuple) else (key,)
        for key in data.keys(include_nested=True, leaves_only=True)
    }
    if lost:
        raise UnreadableFileError(
            f"tensordict did not open {sorted(lost)} of {path}: {_AGAIN}"
        )
    check_transitions(
        data, str(path), keys=keys, remedy="give another folder, or pass keys="
    )
    mark_memmap(data)
    return data.lock_()


def check_transitions(
    data: TensorDictBase,
    what: str = "the data",
    *,
    keys: Iterable[NestedKey] = _KEYS,
    remedy: str = "add them",
) -> None:
    """Raises if data are not flat transitions, or lack keys.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.
        what (str): the data's name in the error message. Defaults to ``"the data"``.

    Keyword Args:
        keys (iterable of NestedKey): the keys that the data must have. Defaults to
            ``"action"``, ``"episode"`` and ``("next", "done")``.
        remedy (str): the end of the message about missing keys, which says what to do.

    Raises:
        ValueError: the data have no rows or several batch dimensions, or lack a key.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.load_transitions import check_transitions
        >>> rows = TensorDict({"action": torch.zeros(3, 2)}, [3])
        >>> check_transitions(rows, keys=["action"])
    """
    _check_batch_size(list(data.batch_size), what)
    missing = [key for key in keys if data.get(key, None) is None]
    if missing:
        raise ValueError(f"{what} lacks {missing}, it has {leaf_names(data)}: {remedy}")


def _check_batch_size(shape: list[int], what: str) -> None:
    if len(shape) != 1 or not shape[0]:
        raise ValueError(
            f"{what} has batch size {shape}, expected [T] with at least one row: store "
            "flat transitions"
        )


def _check_is_full(folder: Path, rows: int) -> None:
    """Raises if a folder is a storage, by ``dumps``, with rows that are not in use."""
    file = folder / "storage_metadata.json"
    if not file.exists():
        return
    content = read_json(file, "description of a saved storage", _AGAIN)
    used = content.get("len") if isinstance(content, dict) else None
    if used != rows:
        raise ValueError(
            f"{folder} is the storage of a saved replay buffer, which uses {used} of "
            f"its {rows} rows, see {file.name}: load it with rb.loads(...), and write "
            "rb.storage[:] to another folder with memmap(...)"
        )


def _check_folder(
    folder: Path, root: Path, batch: list[int], leaves: set[tuple[str, ...]]
) -> list[int]:
    """Checks that a folder has only complete tensors, and adds their keys to a set.

    Args:
        folder (Path): the folder.
        root (Path): the outermost one.
        batch (list of int): the batch size of the tensordict around it.
        leaves (set): what is added to.

    Returns:
        list of int: its own batch size.
    """
    meta = folder / "meta.json"
    if not meta.exists():
        raise UnreadableFileError(
            f"{root} is not a memory-mapped tensordict, {meta} is missing: give "
            f"another folder, or {_AGAIN}"
        )
    content = read_json(meta, "description of a tensordict", _AGAIN)
    try:
        kind, device = content["_type"], content["device"]
        shape = _shape(content["shape"])
        _check_batch(shape, batch)
    except (ValueError, KeyError, TypeError) as error:
        raise UnreadableFileError(
            f"{meta} is truncated or not from tensordict ({error!r}): {_AGAIN}"
        ) from error
    if kind != str(TensorDict) or device not in ("cpu", "None"):
        raise UnreadableFileError(
            f"{meta} describes a {kind} on device {device}, expected a TensorDict in "
            "memory: store plain tensordicts"
        )
    for key, entry in _entries(content, meta):
        name = file_name(key)
        if entry.get("type") == "TensorDict":
            inner: set[tuple[str, ...]] = set()
            _check_folder(folder / name, root, shape, inner)
            leaves |= {(key, *leaf) for leaf in inner}
        elif entry.get("type") is not None:
            # Its content may be a pickle, which could execute anything.
            raise UnreadableFileError(
                f"{meta} has a {entry['type']} in {key!r}, expected only tensors: "
                "leave it out with exclude() before the data are stored"
            )
        else:
            _check_leaf(folder / f"{name}.memmap", entry, shape, meta, key)
            leaves.add((key,))
    return shape


def _entries(
    content: dict[str, Any], meta: Path
) -> Iterator[tuple[str, dict[str, Any]]]:
    for key, entry in content.items():
        if isinstance(entry, dict) and key not in _COMMON:
            yield key, entry
        elif key not in _COMMON:
            raise UnreadableFileError(
                f"{meta} has an unreadable description of {key!r} ({entry!r}): {_AGAIN}"
            )


def _check_leaf(
    file: Path, entry: dict[str, Any], batch: list[int], meta: Path, key: str
) -> None:
    """Checks that the size of a leaf's file matches its dtype and shape."""
    try:
        dtype = getattr(torch, str(entry["dtype"]).removeprefix("torch."), None)
        # Exactly as tensordict writes it: it leaves out what it cannot read.
        if not isinstance(dtype, torch.dtype) or str(dtype) != entry["dtype"]:
            raise ValueError(f"{entry['dtype']!r} is not a dtype")
        if entry.get("is_nested"):
            raise ValueError("it is not a dense tensor")
        shape = _shape(entry["shape"])
        _check_batch(shape, batch)
    except (ValueError, KeyError, TypeError) as error:
        raise UnreadableFileError(
            f"{meta} has an unreadable description of {key!r} ({error!r}): {_AGAIN}"
        ) from error
    expected = dtype.itemsize * math.prod(shape)
    if not file.exists():
        if not expected:
            return  # tensordict writes no file for a tensor without elements
        raise UnreadableFileError(
            f"{meta.parent} is incomplete, {file} is missing: {_AGAIN}"
        )
    size = file.stat().st_size if file.is_file() else -1
    if size != expected:
        raise UnreadableFileError(
            f"{file} has {size} bytes, expected {expected} ({dtype} {shape}): {_AGAIN}"
        )


def _check_batch(shape: list[int], batch: list[int]) -> None:
    if shape[: len(batch)] != batch:
        raise ValueError(f"shape {shape} does not begin with the batch size {batch}")


def _shape(value: Any) -> list[int]:
    if not isinstance(value, list) or not all(type(x) is int and x >= 0 for x in value):
        raise ValueError(f"{value!r} is not a shape")
    return value
