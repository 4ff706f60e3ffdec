"""Digests of stored transitions, which detect changed or damaged files."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._files import UnreadableFileError, read_json, write_json
from torchrl_caiac._keys import path as path_of
from torchrl_caiac._torchrl import memmap_folder

__all__ = [
    "content_digests",
    "data_digest",
    "data_source",
    "file_digest",
    "has_digests",
    "original_leaves",
    "tensor_bytes",
    "verify_digests",
    "write_digests",
]

_FILE = "digests.json"
_FORMAT = "torchrl_caiac.digests"
_VERSION = 1
_CHUNK = 1 << 20  # bytes that are read at a time
_AGAIN = "create the data again"


def file_digest(file: str | os.PathLike[str]) -> str:
    """Returns the digest of a file.

    Args:
        file (path): the file.

    Returns:
        str: hexadecimal SHA-256.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.data.digests import file_digest
        >>> with tempfile.NamedTemporaryFile() as file:
        ...     file_digest(file.name)[:8]
        'e3b0c442'
    """
    # 0.6 s for 1 GB where the processor has SHA instructions, as most have.
    digest = hashlib.sha256()
    with open(file, "rb") as stream:
        while chunk := stream.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def content_digests(rows: TensorDictBase, *added: NestedKey | None) -> dict[str, str]:
    """Returns digests of what is in transitions now.

    Of opened transitions with a ``digests.json``, only the leaves that were written
    together enter, and those of ``added`` that are there. Hence the result does not
    change when scores of another kind are added. Of other transitions, all leaves
    enter.

    Args:
        rows (TensorDictBase): the transitions, ``[T]``.
        *added (NestedKey, optional): leaves that were added later and matter, such as
            scores. ``None`` is left out.

    Returns:
        dict of str to str: hexadecimal SHA-256 by the key of the leaf, its parts joined
        by dots.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.digests import content_digests
        >>> rows = TensorDict({"next": {"done": torch.ones(3, 1)}}, [3])
        >>> list(content_digests(rows))
        ['next.done']
    """
    leaves = original_leaves(rows, *added)
    return {".".join(key): _tensor_digest(leaf) for key, leaf in leaves.items()}


def original_leaves(
    rows: TensorDictBase, *added: NestedKey | None
) -> dict[tuple[str, ...], torch.Tensor]:
    """Returns the leaves of transitions without those that were added later.

    Args:
        rows (TensorDictBase): the transitions, ``[T]``.
        *added (NestedKey, optional): as for :func:`content_digests`.

    Returns:
        dict of tuple to torch.Tensor: the leaves that were written together, and those
        of ``added`` that are there, by the parts of their keys. All leaves, if the
        transitions have no folder with a ``digests.json``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.digests import original_leaves
        >>> rows = TensorDict({"next": {"done": torch.ones(3, 1)}}, [3])
        >>> list(original_leaves(rows))
        [('next', 'done')]
    """
    leaves = {path_of(key): leaf for key, leaf in rows.items(True, True)}
    folder = memmap_folder(rows)
    if folder is None or not has_digests(folder):
        return leaves
    names = set(_read(Path(folder))["sha256"])
    kept = {path_of(key) for key in added if key is not None}
    return {
        key: leaf
        for key, leaf in leaves.items()
        if key in kept or _name(folder, leaf) in names
    }


def _name(folder: str, leaf: torch.Tensor) -> str | None:
    file = getattr(leaf, "filename", None)
    if file is None:
        return None
    # Either of them may be relative to the working directory.
    path, root = Path(file).resolve(), Path(folder).resolve()
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else None


def _tensor_digest(tensor: torch.Tensor) -> str:
    digest = hashlib.sha256(f"{tensor.dtype}{list(tensor.shape)}".encode())
    for part in tensor.detach().split(1 << 16) if tensor.ndim else (tensor,):
        digest.update(tensor_bytes(part))
    return digest.hexdigest()


def tensor_bytes(tensor: torch.Tensor) -> memoryview:
    """Returns the content of a tensor, as it is in the file of a memory-mapped one.

    Args:
        tensor (torch.Tensor): ``[*]``.

    Returns:
        memoryview: the bytes.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.data.digests import tensor_bytes
        >>> list(tensor_bytes(torch.tensor([1, 2], dtype=torch.int16)))
        [1, 0, 2, 0]
    """
    flat = tensor.detach().cpu().contiguous().reshape(-1)
    if flat.stride(0) != 1:  # a single number, expanded, counts as contiguous
        flat = flat.clone(memory_format=torch.contiguous_format)
    content: memoryview = flat.view(torch.uint8).numpy().data
    return content


def write_digests(
    folder: str | os.PathLike[str], source: Mapping[str, Any] | None = None
) -> None:
    """Writes the digests of all leaves of stored transitions to ``digests.json``.

    Leaves that are added later, such as scores, have no digest.

    Args:
        folder (path): the folder of a memory-mapped tensordict.
        source (mapping, optional): what the transitions were made from, JSON values. It
            is stored too. Defaults to ``None``.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data import verify_digests, write_digests
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = TensorDict({"action": torch.zeros(3, 2)}, [3]).memmap(folder)
        ...     write_digests(folder)
        ...     verify_digests(folder)
    """
    folder = Path(folder)
    files = {
        file.relative_to(folder).as_posix(): file_digest(file)
        for file in sorted(folder.rglob("*.memmap"))
    }
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "sha256": files,
        "source": None if source is None else dict(source),
    }
    write_json(folder / _FILE, content)


def has_digests(folder: str | os.PathLike[str]) -> bool:
    """Returns whether stored transitions have digests.

    Args:
        folder (path): the folder.

    Returns:
        bool: whether there is a ``digests.json``.

    Examples:
        >>> from torchrl_caiac.data.digests import has_digests
        >>> has_digests("/missing")
        False
    """
    return (Path(folder) / _FILE).exists()


def verify_digests(folder: str | os.PathLike[str]) -> None:
    """Raises if a leaf has changed since its digest was written.

    Args:
        folder (path): the folder, after :func:`write_digests`.

    Raises:
        FileNotFoundError: the folder has no digests.
        UnreadableFileError: leaves have other content or are missing, or the digests
            are damaged.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data import verify_digests, write_digests
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     rows = TensorDict({"action": torch.zeros(3, 2)}, [3]).memmap(folder)
        ...     write_digests(folder)
        ...     _ = rows["action"].fill_(1)
        ...     verify_digests(folder)
        Traceback (most recent call last):
        ...
        torchrl_caiac._files.UnreadableFileError: .../action.memmap ...
    """
    folder = Path(folder)
    changed = []
    for name, expected in _read(folder)["sha256"].items():
        file = folder / name
        if not file.is_file() or file_digest(file) != expected:
            changed.append(str(file))
    if changed:
        raise UnreadableFileError(
            f"{', '.join(changed)} changed since the data were written, or cannot be "
            f"found: {_AGAIN}"
        )


def data_digest(folder: str | os.PathLike[str]) -> str:
    """Returns one digest of stored transitions, without the leaves that were added.

    Args:
        folder (path): the folder, after :func:`write_digests`.

    Returns:
        str: hexadecimal SHA-256 of the digests of the leaves. The leaves themselves are
        not read.

    Raises:
        FileNotFoundError: the folder has no digests.
        UnreadableFileError: the digests are damaged.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data.digests import data_digest, write_digests
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = TensorDict({"action": torch.zeros(3, 2)}, [3]).memmap(folder)
        ...     write_digests(folder)
        ...     len(data_digest(folder))
        64
    """
    digests = _read(Path(folder))["sha256"]
    return hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest()


def data_source(folder: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Returns what stored transitions were made from.

    Args:
        folder (path): the folder, after :func:`write_digests`.

    Returns:
        dict, optional: the ``source`` of :func:`write_digests`.

    Raises:
        FileNotFoundError: the folder has no digests.
        UnreadableFileError: the digests are damaged.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.data.digests import data_source, write_digests
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_digests(folder, source={"dataset": "push/play-v0"})
        ...     data_source(folder)
        {'dataset': 'push/play-v0'}
    """
    source: dict[str, Any] | None = _read(Path(folder))["source"]
    return source


def _read(folder: Path) -> dict[str, Any]:
    file = folder / _FILE
    if not file.exists():
        raise FileNotFoundError(
            f"{folder} has no {_FILE}, so its content cannot be compared: write it "
            "with write_digests, or create the data again"
        )
    content = read_json(file, "file of digests", _AGAIN)
    if (
        not isinstance(content, dict)
        or content.get("format") != _FORMAT
        or content.get("version") != _VERSION
        or not isinstance(content.get("sha256"), dict)
        or not isinstance(content.get("source"), (dict, type(None)))
        or not all(_inside(name) for name in content["sha256"])
    ):
        raise UnreadableFileError(
            f"{file} is not a file of digests of version {_VERSION}: {_AGAIN}"
        )
    return content


def _inside(name: str) -> bool:
    return name.endswith(".memmap") and not {"..", ""} & set(name.split("/"))
