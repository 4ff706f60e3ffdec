"""Writes a folder of transitions, atomically."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_leaf_nontensor
from tensordict.utils import NestedKey

from torchrl_caiac._files import remove_leftovers, reserve, whole_folder
from torchrl_caiac._keys import path as path_of
from torchrl_caiac.data.action_bounds import write_action_bounds
from torchrl_caiac.data.digests import write_digests
from torchrl_caiac.data.load_transitions import check_transitions, load_transitions

__all__ = [
    "check_bounds_fit",
    "check_entries",
    "check_free",
    "check_key_names",
    "whole_transitions",
    "write_parts",
    "write_transitions",
]

# Under these names, tensordict writes its own entries to meta.json.
_RESERVED = {"_type", "device", "shape"}


def check_free(path: str | os.PathLike[str] | None, overwrite: bool = False) -> None:
    """Raises if a folder of transitions would be replaced without permission.

    A folder that a killed process moved away, and did not replace, is moved back first.

    Args:
        path (path, optional): the folder to write. ``None``: nothing is written.
        overwrite (bool): whether the folder may be replaced. Defaults to ``False``.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.

    Examples:
        >>> from torchrl_caiac.data.write_transitions import check_free
        >>> check_free("/tmp", overwrite=True)
    """
    if path is None:
        return
    remove_leftovers(path)
    if not overwrite and Path(path).exists():
        raise FileExistsError(
            f"{path} exists: open it with load_transitions, or pass overwrite=True to "
            "replace it"
        )


def check_entries(data: TensorDictBase, what: str = "the data") -> None:
    """Raises if entries cannot be stored as transitions.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.
        what (str): the data's name in the error message. Defaults to ``"the data"``.

    Raises:
        ValueError: an entry is not a tensor, or has a name that tensordict's files
            reserve; or see :func:`check_key_names`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.write_transitions import check_entries
        >>> check_entries(TensorDict({"action": torch.zeros(3, 2)}, [3]))
    """
    for key, leaf in data.items(True, True, is_leaf=is_leaf_nontensor):
        if not isinstance(leaf, torch.Tensor):
            raise ValueError(
                f"{key!r} of {what} is a {type(leaf).__name__}, expected a tensor: "
                "leave it out with exclude()"
            )
        if _RESERVED & set(path_of(key)):
            raise ValueError(
                f"{key!r} of {what} has one of the names {sorted(_RESERVED)}, which "
                "tensordict's files reserve: rename it"
            )
    check_key_names(data.keys(True, True), what)


def check_key_names(keys: Iterable[NestedKey], what: str) -> None:
    """Raises if two keys have the same name where their parts are joined by dots.

    Args:
        keys (iterable of NestedKey): the keys of the transitions.
        what (str): the name of the transitions in the error message.

    Raises:
        ValueError: two keys do. The digests are stored by these names.

    Examples:
        >>> from torchrl_caiac.data.write_transitions import check_key_names
        >>> check_key_names(["a.b", ("a", "c")], "the data")
    """
    found: dict[str, NestedKey] = {}
    for key in keys:
        other = found.setdefault(".".join(path_of(key)), key)
        if path_of(other) != path_of(key):
            raise ValueError(
                f"{other!r} and {key!r} of {what} have the same name with dots, by "
                "which digests are stored: rename one of them"
            )


@contextmanager
def whole_transitions(
    path: str | os.PathLike[str],
    *,
    keys: Iterable[NestedKey] | None = None,
    overwrite: bool = True,
) -> Iterator[Path]:
    """Context manager that writes a folder of transitions atomically.

    At the end of the block, the new folder is opened as
    :func:`~torchrl_caiac.data.load_transitions` does. Only then does it replace
    ``path``.

    Args:
        path (path): the folder to write.

    Keyword Args:
        keys (iterable of NestedKey, optional): the keys that the transitions must have.
            Defaults to ``None``: those of ``load_transitions``.
        overwrite (bool): whether a folder may be replaced that is there at the end.
            Defaults to ``True``.

    Yields:
        Path: a temporary folder on the same file system, to be created in the block.

    Raises:
        FileExistsError: another process has written ``path`` meanwhile.
        ValueError: the new folder cannot be opened. ``path`` is unchanged.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.write_transitions import whole_transitions
        >>> rows = TensorDict({"action": torch.zeros(3, 2)}, [3])
        >>> with tempfile.TemporaryDirectory() as root:
        ...     with whole_transitions(f"{root}/data", keys=["action"]) as folder:
        ...         _ = rows.memmap(folder)
        ...     os.listdir(root)
        ['data']
    """
    with whole_folder(path) as folder:
        yield folder
        try:
            if keys is None:
                load_transitions(folder)
            else:
                load_transitions(folder, keys=keys)
        except (ValueError, FileNotFoundError) as error:
            raise ValueError(
                f"the data for {path} cannot be opened once they are written "
                f"({error}); {path} is unchanged: correct the data"
            ) from error
        check_free(path, overwrite)  # another process may have been faster


def write_transitions(
    data: TensorDictBase,
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    action_bounds: tuple[Any, Any] | None = None,
) -> TensorDict:
    """Writes transitions to a folder, atomically, and opens it.

    The digests of all leaves are written too, see
    :func:`~torchrl_caiac.data.verify_digests`.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.
        path (path): the folder.

    Keyword Args:
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        action_bounds (tuple of torch.Tensor or sequence, optional): the lowest and the
            highest action, ``[A]`` each, finite. They are stored beside the
            transitions, see :func:`~torchrl_caiac.data.action_bounds`. Defaults to
            ``None``: the bounds are unknown.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        OSError: the disk is full.
        ValueError: the data have no rows or several batch dimensions, or lack
            ``"action"``, ``"episode"`` or ``("next", "done")``; an entry is not a
            tensor or has a reserved name; ``action_bounds`` are not bounds of the
            actions.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data import write_transitions
        >>> data = TensorDict(
        ...     {
        ...         "action": torch.zeros(3, 2),
        ...         "episode": torch.zeros(3, dtype=torch.int64),
        ...         "next": {"done": torch.tensor([[False], [False], [True]])},
        ...     },
        ...     [3],
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_transitions(data, f"{folder}/data").is_memmap()
        True
    """
    return write_parts(
        data, [data], path, overwrite=overwrite, action_bounds=action_bounds
    )


def write_parts(
    like: TensorDictBase,
    parts: Iterable[TensorDictBase],
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    action_bounds: tuple[Any, Any] | None = None,
) -> TensorDict:
    """Writes transitions part by part, see :func:`write_transitions`.

    Args:
        like (TensorDictBase): what the transitions are like, ``[T]``: their keys,
            shapes and types. Its values are not read, so that it may be one row that is
            expanded.
        parts (iterable of TensorDictBase): the transitions, ``[T]`` together.
        path (path): the folder.

    Keyword Args:
        overwrite (bool): as for :func:`write_transitions`.
        action_bounds (tuple of torch.Tensor or sequence, optional): the same.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.write_transitions import write_parts
        >>> row = TensorDict(
        ...     {
        ...         "action": torch.zeros(1, 2),
        ...         "episode": torch.zeros(1, dtype=torch.int64),
        ...         "next": {"done": torch.tensor([[False]])},
        ...     },
        ...     [1],
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_parts(row.expand(2), [row, row], f"{folder}/data").shape
        torch.Size([2])
    """
    check_free(path, overwrite)
    check_transitions(like)
    check_entries(like)
    if action_bounds is not None:
        check_bounds_fit(like, action_bounds)
    with whole_transitions(path, overwrite=overwrite) as folder:
        stored = like.memmap_like(folder)
        reserve(folder)
        start = 0
        for part in parts:
            stored[start : start + len(part)].update_(part)
            start += len(part)
        write_digests(folder)
        if action_bounds is not None:
            write_action_bounds(folder, *action_bounds)
    return load_transitions(Path(path))


def check_bounds_fit(data: TensorDictBase, bounds: tuple[Any, Any]) -> None:
    """Raises if bounds do not have the shape of an action.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.
        bounds (tuple): the lowest and the highest action, ``[A]`` each.

    Raises:
        ValueError: they have another shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.write_transitions import check_bounds_fit
        >>> rows = TensorDict({"action": torch.zeros(3, 2)}, [3])
        >>> check_bounds_fit(rows, ([-1, -1], [1, 1]))
    """
    action, shape = data.get("action", None), list(torch.as_tensor(bounds[0]).shape)
    if action is not None and list(action.shape[data.batch_dims :]) != shape:
        raise ValueError(
            f"action_bounds have shape {shape}, but 'action' has shape "
            f"{list(action.shape)}: give one bound for each number of an action"
        )
