"""Reading and writing files: checks, disk space, locks and atomic writing."""

from __future__ import annotations

import errno
import fnmatch
import json
import logging
import os
import platform
import shutil
import time
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from torchrl_caiac._whole_files import (
    has_ended,
    naming_full_disk,
    remove_leftovers,
    remove_leftovers_in,
    this_process,
    whole_file,
    whole_folder,
)

__all__ = [
    "UnreadableFileError",
    "allocate",
    "check_archive",
    "claim_folder",
    "meta_state",
    "plain",
    "read_json",
    "recover_meta",
    "remove_leftovers",
    "remove_leftovers_in",
    "reserve",
    "safe_meta",
    "whole_file",
    "whole_folder",
    "write_json",
]

_logger = logging.getLogger("torchrl_caiac")

_MOST_JSON = 64 << 20  # bytes; settings, layouts and records are far smaller
_META = "meta.json"  # tensordict's, one in every folder of a memory-mapped tensordict
_COPIES = "meta.json.*-*.bak"  # named after the process that has made them
_SECONDS_TO_ADD_A_LEAF = 600.0
_TRIES, _SECONDS_BETWEEN_TRIES = 20, 0.05
_guarded: set[Path] = set()  # the folders to which this process is adding a leaf


class UnreadableFileError(ValueError):
    """A file or folder is truncated, damaged, or not what it should be.

    The message names the path, what was found, and what to do.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.data import UnreadableFileError
        >>> with tempfile.NamedTemporaryFile() as file:
        ...     try:
        ...         EntityLayout.load(file.name)
        ...     except UnreadableFileError as error:
        ...         file.name in str(error)
        True
    """


def reserve(path: str | os.PathLike[str], nbytes: int | None = None) -> None:
    """Allocates the space of files, before they are written through memory.

    A memory-mapped file has no blocks until it is written to. If the disk is full by
    then, the operating system ends the process by a signal. After this call there is
    space for every byte. The content of the files is not changed.

    Args:
        path (path): a file, created if it is missing; or a folder, for all files in it
            and in its subfolders.
        nbytes (int, optional): the size that the file gets. Defaults to ``None``: the
            current size of each file.

    Raises:
        OSError: with ``errno.ENOSPC``, the disk has too little space. A file that this
            call created is removed, one that it enlarged has its old size.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import reserve
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     reserve(f"{folder}/score.memmap", 4096)
        ...     os.path.getsize(f"{folder}/score.memmap")
        4096
    """
    path = Path(path)
    if path.is_dir():
        for file in sorted(item for item in path.rglob("*") if item.is_file()):
            _reserve_file(file, file.stat().st_size)
    else:
        _reserve_file(path, path.stat().st_size if nbytes is None else nbytes)


def _reserve_file(file: Path, nbytes: int) -> None:
    before = file.stat().st_size if file.exists() else None
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        os.ftruncate(descriptor, nbytes)
        if nbytes:
            allocate(descriptor, nbytes)
    except OSError as error:
        if before is None:
            file.unlink()
        else:
            os.ftruncate(descriptor, before)
        if error.errno not in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT):
            raise
        free = shutil.disk_usage(file.parent).free
        raise OSError(
            errno.ENOSPC,
            f"the disk is full: {file} needs {nbytes} bytes, {free} are free; make "
            "space, or give a folder on another disk",
        ) from error
    finally:
        os.close(descriptor)


def allocate(descriptor: int, nbytes: int) -> None:
    """Allocates the space of an open file, or checks that there is enough of it.

    Args:
        descriptor (int): the file.
        nbytes (int): its size, at least 1.

    Raises:
        OSError: with ``errno.ENOSPC``, the disk has too little space.
    """
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(descriptor, 0, nbytes)
            return
        except OSError as error:
            # Some file systems do not support it.
            if error.errno not in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
                raise
    system = os.fstatvfs(descriptor)
    used = os.fstat(descriptor).st_blocks * 512
    if nbytes - used > system.f_bavail * system.f_frsize:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextmanager
def safe_meta(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Context manager for adding leaves to a memory-mapped tensordict.

    tensordict writes ``meta.json`` in place, so a process that is killed may leave an
    empty one. In the block, a copy of every ``meta.json`` lies beside it. If the
    process is killed, :func:`recover_meta` restores them, and
    :func:`~torchrl_caiac.data.load_transitions` calls it. If the block raises, damaged
    files are restored at once.

    Args:
        folder (path): the outermost folder of the tensordict.

    Raises:
        UnreadableFileError: a ``meta.json`` is damaged, and there is no copy.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac._files import safe_meta
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     data = TensorDict({"action": torch.zeros(3, 2)}, [3]).memmap(folder)
        ...     with safe_meta(folder):
        ...         _ = data.make_memmap(("caiac", "score"), shape=[3, 2])
        ...     sorted(os.listdir(folder))
        ['action.memmap', 'caiac', 'meta.json']
    """
    root = Path(folder).resolve()
    if root in _guarded:
        yield
        return
    recover_meta(root)
    files = sorted(_find(root, _META))
    damaged = [str(file) for file in files if not _is_json(file)]
    if damaged:
        raise UnreadableFileError(
            f"{', '.join(damaged)} is damaged, and has no copy to restore: delete the "
            "folder and create the data again"
        )
    for copy in _ended_copies(root):
        copy.unlink(missing_ok=True)
    copies = [file.with_name(f"{_META}.{this_process()}.bak") for file in files]
    for file, copy in zip(files, copies, strict=True):
        with whole_file(copy) as partial:
            shutil.copyfile(file, partial)
    _guarded.add(root)
    try:
        yield
    finally:
        _guarded.discard(root)
        if _has_damage(root):
            _restore(root, copies)
        for copy in copies:
            copy.unlink(missing_ok=True)


def recover_meta(folder: str | os.PathLike[str]) -> bool:
    """Undoes the addition of a leaf by a process that was killed in :func:`safe_meta`.

    Nothing happens if every ``meta.json`` can be read. Otherwise, all of them become
    what they were before the leaf. If another process is adding a leaf right now, this
    call waits for it, for about a second.

    Args:
        folder (path): the outermost folder of a memory-mapped tensordict.

    Returns:
        bool: whether files were restored.

    Raises:
        UnreadableFileError: a ``meta.json`` cannot be read yet, because another process
            is adding a leaf.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import recover_meta
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     recover_meta(folder)
        False
    """
    root = Path(folder).resolve()
    for _ in range(_TRIES):
        if not _has_damage(root):
            return False
        running = set(_find(root, _COPIES))
        copies = _ended_copies(root)
        running.difference_update(copies)
        if not running:
            break
        time.sleep(_SECONDS_BETWEEN_TRIES)
    if running:
        raise UnreadableFileError(
            f"another process is adding a leaf to {folder}, and has left "
            f"{sorted(copy.name for copy in running)[0]} there until it has ended: try "
            "again"
        )
    if not copies:
        return False
    # Of the last process, if several were killed.
    newest = max(copies, key=lambda copy: copy.stat().st_mtime_ns).name
    _restore(root, [copy for copy in copies if copy.name == newest])
    for copy in copies:
        copy.unlink(missing_ok=True)
    _logger.warning(
        "%s: a leaf was being added when a process was killed; meta.json is restored, "
        "without that leaf",
        folder,
    )
    return True


def meta_state(folder: str | os.PathLike[str]) -> dict[str, tuple[int, int]]:
    """Returns a value that differs after a leaf was added to a folder.

    Args:
        folder (path): the outermost folder of a memory-mapped tensordict.

    Returns:
        dict: the time and size of every ``meta.json``.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import meta_state
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     meta_state(folder)
        {}
    """
    found = {}
    for file in _find(Path(folder), _META):
        with suppress(FileNotFoundError):
            status = file.stat()
            found[str(file)] = status.st_mtime_ns, status.st_size
    return found


def _restore(root: Path, copies: Sequence[Path]) -> None:
    # All, not only the damaged one: an outer file may list what an inner one lost.
    for copy in copies:
        if _is_json(copy):
            with whole_file(copy.with_name(_META)) as partial:
                shutil.copyfile(copy, partial)
    before = {copy.with_name(_META) for copy in copies}
    for file in _find(root, _META):
        if file not in before and not _is_json(file):
            file.unlink()  # of the leaf; no other file lists it any more


def _ended_copies(root: Path) -> list[Path]:
    """Returns the copies that processes left which have ended."""
    ended = []
    for copy in _find(root, _COPIES):
        process = copy.name.removeprefix(f"{_META}.").removesuffix(".bak")
        over = has_ended(process)
        if over is None:  # of another machine: a leaf is added in far less time
            with suppress(FileNotFoundError):  # it has ended meanwhile
                age = time.time() - copy.stat().st_mtime
                over = age > _SECONDS_TO_ADD_A_LEAF
        if over and root not in _guarded:
            ended.append(copy)
    return ended


def _has_damage(root: Path) -> bool:
    return not all(_is_json(file) for file in _find(root, _META))


def _find(root: Path, pattern: str) -> list[Path]:
    """Returns the files with such a name, while others may remove folders."""
    return [
        Path(folder, name)
        for folder, _, names in os.walk(root)
        for name in fnmatch.filter(names, pattern)
    ]


def _is_json(file: Path) -> bool:
    try:
        return isinstance(json.loads(file.read_text(encoding="utf-8")), dict)
    except (FileNotFoundError, ValueError, RecursionError):
        return False


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


def read_json(path: str | os.PathLike[str], what: str, remedy: str) -> Any:
    """Reads a JSON file.

    Args:
        path (path): the file.
        what (str): what the file is, for the error message, such as ``"layout"``.
        remedy (str): the end of the message, which says what to do.

    Returns:
        Any: the content.

    Raises:
        FileNotFoundError: there is no such file.
        UnreadableFileError: it is not a file, is not JSON, or is too large for JSON.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import read_json
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(f"{folder}/a.json").write_text('{"b": 1}')
        ...     read_json(f"{folder}/a.json", "record", "delete it")
        {'b': 1}
    """
    path = Path(path)
    size = path.stat().st_size
    try:
        if not path.is_file():
            raise ValueError("it is not a file")
        if size > _MOST_JSON:
            raise ValueError(f"it has {size} bytes, expected at most {_MOST_JSON}")
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise UnreadableFileError(
            f"{path} is not a readable {what}, it may be truncated or damaged "
            f"({error}): {remedy}"
        ) from error


def check_archive(path: str | os.PathLike[str], what: str, remedy: str) -> None:
    """Raises if a ZIP file has compressed or encrypted parts, or is damaged.

    The files of this package are not compressed. A small compressed file could expand
    to any size.

    Args:
        path (path): the file.
        what (str): what the file is, for the error message.
        remedy (str): the end of the message, which says what to do.

    Raises:
        FileNotFoundError: there is no such file.
        UnreadableFileError: it is not a ZIP file, has compressed or encrypted parts, or
            parts that are larger than the file.

    Examples:
        >>> import tempfile, zipfile
        >>> from torchrl_caiac._files import check_archive
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with zipfile.ZipFile(f"{folder}/a.zip", "w") as archive:
        ...         archive.writestr("b", "1")
        ...     check_archive(f"{folder}/a.zip", "archive", "delete it")
    """
    path = Path(path)
    size = path.stat().st_size
    try:
        if not path.is_file():
            raise ValueError("it is not a file")
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
        packed = [
            part.filename
            for part in parts
            if part.compress_type != zipfile.ZIP_STORED
            or part.flag_bits & 1  # encrypted
            or part.compress_size != part.file_size
        ]
        if packed:
            raise ValueError(f"{packed} are compressed or encrypted")
        total = sum(part.file_size for part in parts)
        if total > size:
            raise ValueError(f"its parts have {total} bytes, the file has {size}")
    except Exception as error:  # zipfile raises many kinds for damaged files
        raise UnreadableFileError(
            f"{path} is not a readable {what}, it may be truncated or damaged "
            f"({error}): {remedy}"
        ) from error


@contextmanager
def claim_folder(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Context manager that locks a folder for this process.

    The lock ends with the block or with the process.

    Args:
        folder (path): the folder, in which the files ``.lock`` and ``.lock-owner`` are
            created. A missing folder is created.

    Raises:
        RuntimeError: another process has locked the folder; the message names it.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._files import claim_folder
        >>> with tempfile.TemporaryDirectory() as folder, claim_folder(folder):
        ...     pass  # no other process works in the folder
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    lock, owner = FileLock(folder / ".lock"), folder / ".lock-owner"
    try:
        lock.acquire(timeout=0)
    except Timeout:
        name = "another process"
        with suppress(OSError):  # it may not have written its name yet
            name = owner.read_text(encoding="utf-8") or name
        raise RuntimeError(
            f"{name} is using {folder}: wait for it, stop it, or give another folder"
        ) from None
    try:
        with naming_full_disk(owner):
            owner.write_text(f"process {os.getpid()} on {platform.node()}", "utf-8")
        yield
    finally:
        owner.unlink(missing_ok=True)
        lock.release()
