"""Atomic writing of files and folders, and folders with one writing process."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

__all__ = [
    "claim_folder",
    "plain",
    "remove_leftovers",
    "whole_file",
    "whole_folder",
    "write_json",
]

_PARTIAL = ".partial-"


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Context manager that writes a file atomically.

    The file replaces ``path`` at the end of the block. If the block raises, the old
    file is unchanged. Missing parent folders are created.

    Args:
        path (path): the file to write.

    Yields:
        Path: a temporary file in the same folder, with the same suffix.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import whole_file
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with whole_file(f"{folder}/results/table.txt") as partial:
        ...         _ = partial.write_text("42")
        ...     open(f"{folder}/results/table.txt").read()
        '42'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{_PARTIAL}{os.getpid()}-{path.name}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def remove_leftovers(path: str | os.PathLike[str]) -> None:
    """Removes the partial files of interrupted calls of :func:`whole_file`.

    Temporary files and folders whose names begin with that of a partial file, which
    other libraries create, are removed too. No other process may be writing the file.

    Args:
        path (path): the file.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import remove_leftovers
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(f"{folder}/.partial-7-table.txt").write_text("4")
        ...     remove_leftovers(f"{folder}/table.txt")
        ...     os.listdir(folder)
        []
    """
    path = Path(path)
    if not path.parent.is_dir():
        return
    pattern = rf"\.?{re.escape(_PARTIAL)}\d+-{re.escape(path.name)}(\.\w+-\w+)?"
    for left in path.parent.iterdir():
        if re.fullmatch(pattern, left.name):
            if left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Context manager that writes a folder atomically.

    The folder replaces ``path`` at the end of the block. If the block raises, the old
    folder is unchanged. Missing parent folders are created.

    Args:
        path (path): the folder to write.

    Yields:
        Path: a temporary folder on the same file system, to be created in the block.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import whole_folder
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with whole_folder(f"{folder}/data") as partial:
        ...         partial.mkdir()
        ...     os.path.isdir(f"{folder}/data")
        True
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=path.parent, prefix=_PARTIAL))
    made, replaced = partial / path.name, partial / f"replaced-{path.name}"
    try:
        yield made
        was_there = path.exists()
        if was_there:
            os.replace(path, replaced)
        try:
            os.replace(made, path)
        except OSError:
            if was_there:
                os.replace(replaced, path)
            raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def plain(value: Any) -> Any:
    """Converts mappings to dictionaries and sequences to lists, for JSON.

    Args:
        value (Any): the value, for example a ``DictConfig``.

    Returns:
        Any: the same content in plain containers.

    Examples:
        >>> from torchrl_caiac._files import plain
        >>> plain({"sizes": (1, 2)})
        {'sizes': [1, 2]}
    """
    if isinstance(value, Mapping):
        return {str(key): plain(value[key]) for key in value}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(item) for item in value]
    return value


def write_json(
    path: str | os.PathLike[str], value: Any, *, indent: int | None = 1
) -> None:
    """Writes a value as JSON, atomically.

    Args:
        path (path): the file. It is replaced if it exists.
        value (Any): mappings, sequences, strings, numbers, booleans and ``None``.

    Keyword Args:
        indent (int, optional): the number of spaces for each level. Defaults to ``1``.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import write_json
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_json(f"{folder}/a.json", {"b": (1, 2)})
        ...     json.load(open(f"{folder}/a.json"))
        {'b': [1, 2]}
    """
    text = json.dumps(plain(value), indent=indent) + "\n"
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


@contextmanager
def claim_folder(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Context manager that locks a folder for this process.

    The lock ends with the block or with the process.

    Args:
        folder (path): the folder, in which the file ``.lock`` is created. A missing
            folder is created.

    Raises:
        RuntimeError: another process has locked the folder.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import claim_folder
        >>> with tempfile.TemporaryDirectory() as folder, claim_folder(folder):
        ...     pass  # no other process works in the folder
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise RuntimeError(
            f"another process is using {folder}: wait for it, stop it, or give another "
            "folder"
        ) from None
    try:
        yield
    finally:
        lock.release()
