"""Atomic writing, and removal of the partial files of killed processes."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import re
import shutil
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

__all__ = [
    "has_ended",
    "naming_full_disk",
    "remove_leftovers",
    "remove_leftovers_in",
    "this_process",
    "whole_file",
    "whole_folder",
]

_PARTIAL = ".partial-"
_REPLACED = "replaced-"
_NO_SPACE = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
# The partial files and folders of this process, as absolute paths.
_in_use: set[Path] = set()
# No name is used twice: a thread that has listed the old file would remove the new one.
# An earlier process may have had the same process number, so the time is the start.
_numbers = count(time.time_ns())


@contextmanager
def whole_file(path: str | os.PathLike[str], *, tidy: bool = True) -> Iterator[Path]:
    """Context manager that writes a file atomically.

    The file replaces ``path`` at the end of the block. If the block raises, the old
    file is unchanged. Missing parent folders are created.

    Args:
        path (path): the file to write.

    Keyword Args:
        tidy (bool): whether to call :func:`remove_leftovers` first, which lists the
            whole folder. Defaults to ``True``.

    Yields:
        Path: a temporary file in the same folder, with the same suffix.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._whole_files import whole_file
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with whole_file(f"{folder}/results/table.txt") as partial:
        ...         _ = partial.write_text("42")
        ...     open(f"{folder}/results/table.txt").read()
        '42'
    """
    path = _absolute(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if tidy:
        remove_leftovers(path)
    with _partial(path) as partial, naming_full_disk(path):
        try:
            yield partial
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Context manager that writes a folder atomically.

    The folder replaces ``path`` at the end of the block. If the block raises, the old
    folder is unchanged. Missing parent folders are created.

    An old folder is moved away before the new one takes its place, so ``path`` is
    missing for a moment. If the process is killed then, :func:`remove_leftovers` moves
    the old folder back.

    Args:
        path (path): the folder to write.

    Yields:
        Path: a temporary folder on the same file system, to be created in the block.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._whole_files import whole_folder
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with whole_folder(f"{folder}/data") as partial:
        ...         partial.mkdir()
        ...     os.path.isdir(f"{folder}/data")
        True
    """
    path = _absolute(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path)
    with _partial(path) as partial:
        partial.mkdir()
        made, replaced = partial / path.name, partial / f"{_REPLACED}{path.name}"
        try:
            yield made
            if path.exists():
                os.replace(path, replaced)
            os.replace(made, path)
        finally:
            if replaced.exists() and not path.exists():  # interrupted in between
                os.replace(replaced, path)
            shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def naming_full_disk(path: str | os.PathLike[str]) -> Iterator[None]:
    """Context manager that names a file in the error of a full disk.

    Args:
        path (path): what is written in the block.

    Raises:
        OSError: with ``errno.ENOSPC``, the disk is full.

    Examples:
        >>> from torchrl_caiac._whole_files import naming_full_disk
        >>> try:
        ...     with naming_full_disk("/dev/full"), open("/dev/full", "w") as file:
        ...         _ = file.write("42")
        ... except OSError as error:
        ...     str(error).partition(",")[0]
        '[Errno 28] the disk is full: /dev/full could not be written'
    """
    try:
        yield
    except OSError as error:
        # Others say more.
        if error.errno not in _NO_SPACE or error.strerror != os.strerror(error.errno):
            raise
        folder = Path(path).absolute().parent
        raise OSError(
            errno.ENOSPC,
            f"the disk is full: {path} could not be written, {folder} has "
            f"{shutil.disk_usage(folder).free} bytes left: make space, and repeat the "
            "call",
        ) from error


@contextmanager
def _partial(path: Path) -> Iterator[Path]:
    """Yields a temporary path that names the process, and that nothing else uses."""
    owner = f"{this_process()}.{next(_numbers)}"
    partial = path.with_name(f"{_PARTIAL}{owner}-{path.name}")
    _in_use.add(partial)
    try:
        yield partial
    finally:
        _in_use.discard(partial)


def _absolute(path: str | os.PathLike[str]) -> Path:
    """Returns one path for all spellings. A link itself is replaced, not its target."""
    path = Path(path)
    return path.parent.resolve() / path.name


def remove_leftovers(path: str | os.PathLike[str]) -> None:
    """Removes the partial files and folders of processes that were killed.

    Those of :func:`whole_file` and :func:`whole_folder` for this path are removed, and
    those of other libraries whose names begin with them. A folder that was moved away
    and not yet replaced is moved back. What running processes write stays, and so does
    what processes on other machines wrote. Nothing happens in a read-only folder, or in
    one that cannot be listed.

    Args:
        path (path): the file or folder that was to be written.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._whole_files import remove_leftovers, whole_file
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with whole_file(f"{folder}/table.txt") as partial:
        ...         partial.touch()
        ...         remove_leftovers(f"{folder}/table.txt")
        ...         partial.exists()
        True
    """
    path = Path(path)
    _remove_leftovers(path.parent, re.escape(path.name))


def remove_leftovers_in(folder: str | os.PathLike[str]) -> None:
    """Removes all partial files and folders of killed processes in a folder.

    Args:
        folder (path): the folder.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._whole_files import remove_leftovers_in
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     remove_leftovers_in(folder)
    """
    _remove_leftovers(Path(folder), ".+?")


def _remove_leftovers(folder: Path, name: str) -> None:
    folder = folder.resolve()
    try:
        found = list(folder.iterdir())
    except OSError:  # it is missing, or must not be listed
        return
    owner = r"(?P<owner>\w+-\d+)\.\d+"
    pattern = rf"\.?{re.escape(_PARTIAL)}{owner}-(?P<name>{name})(\.\w+-\w+)*"
    for left in found:
        match = re.fullmatch(pattern, left.name)
        if match is None or left in _in_use or not has_ended(match["owner"]):
            continue
        with contextlib.suppress(OSError):  # a read-only folder, or another was faster
            target, old = folder / match["name"], left / f"{_REPLACED}{match['name']}"
            if old.exists() and not target.exists():
                os.replace(old, target)  # killed between the two moves
            if left.is_dir():
                shutil.rmtree(left)
            else:
                left.unlink()


def this_process() -> str:
    """Returns a name of this process, for the files that it is writing.

    Returns:
        str: the machine and the number of the process.

    Examples:
        >>> from torchrl_caiac._whole_files import this_process
        >>> this_process().endswith(f"-{os.getpid()}")
        True
    """
    # Numbers of processes are known on their own machine only.
    return f"{zlib.crc32(platform.node().encode()):08x}-{os.getpid()}"


def has_ended(process: str) -> bool | None:
    """Returns whether a process has ended.

    Args:
        process (str): its name, from :func:`this_process`.

    Returns:
        bool, optional: ``True`` for the name of this process too: earlier ones may have
        had the same number. ``None``: it is of another machine.

    Examples:
        >>> from torchrl_caiac._whole_files import has_ended, this_process
        >>> has_ended(this_process())
        True
    """
    machine, _, number = process.rpartition("-")
    if machine != this_process().rpartition("-")[0]:
        return None
    pid = int(number)
    if pid == os.getpid():
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # it belongs to another user
        return False
    return False
