"""Writes transitions episode by episode, without knowing how many there will be."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._files import reserve
from torchrl_caiac._keys import leaf_names
from torchrl_caiac._keys import path as path_of
from torchrl_caiac._torchrl import file_name
from torchrl_caiac.data.action_bounds import check_action_bounds, write_action_bounds
from torchrl_caiac.data.digests import tensor_bytes, write_digests
from torchrl_caiac.data.write_transitions import (
    check_bounds_fit,
    check_entries,
    check_free,
    whole_transitions,
)

__all__ = ["TransitionWriter"]

_FLAGS = ("terminated", "truncated", "done")
_NO_SPACE = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
_Key = tuple[str, ...]
_Kind = tuple[torch.dtype, tuple[int, ...]]


class TransitionWriter:
    """Context manager that writes a folder of transitions, one episode at a time.

    The folder appears at the end of the block, complete and with digests. If the block
    raises, nothing is left, and a folder that it would have replaced is unchanged. The
    memory needed is that of one episode.

    Open the folder with :func:`~torchrl_caiac.data.load_transitions`.

    Args:
        path (path): the folder to write.

    Keyword Args:
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        action_bounds (tuple of torch.Tensor or sequence, optional): the lowest and the
            highest action, ``[A]`` each, finite, see
            :func:`~torchrl_caiac.data.action_bounds`. Defaults to ``None``: the bounds
            are unknown.
        source (mapping, optional): what the transitions are made from, JSON values,
            stored with the digests. It can also be set in the block, as the attribute
            ``source``. Defaults to ``None``.
        rows (int, optional): the number of rows that will be written. With it, the disk
            space is reserved at the first episode, so that a full disk is found early.
            Defaults to ``None``: unknown.

    Attributes:
        episodes (int): the number of episodes that were added.
        rows (int): the number of rows that were added.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        OSError: the disk is full.
        ValueError: ``action_bounds`` are not bounds of the actions; no episode was
            added, or the last one has no end.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data import (
        ...     TransitionWriter, episode_transitions, load_transitions
        ... )
        >>> folder = tempfile.TemporaryDirectory()
        >>> with TransitionWriter(f"{folder.name}/data") as writer:
        ...     for length in (3, 2):
        ...         states, actions = np.zeros((length + 1, 4)), np.zeros((length, 2))
        ...         where = f"episode {writer.episodes}"
        ...         writer.add(
        ...             episode_transitions(states, actions, where=where), where=where
        ...         )
        >>> load_transitions(f"{folder.name}/data")["episode"]
        MemoryMappedTensor([0, 0, 0, 1, 1])
        >>> folder.cleanup()
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        action_bounds: tuple[Any, Any] | None = None,
        source: Mapping[str, Any] | None = None,
        rows: int | None = None,
    ) -> None:
        check_free(path, overwrite)
        if action_bounds is not None:
            action_bounds = check_action_bounds(*action_bounds)
        self.path = Path(path)
        self._overwrite = overwrite
        self.source = source
        self.episodes = self.rows = 0
        self._bounds, self._expected_rows = action_bounds, rows
        self._first: TensorDictBase | None = None  # one row, with "episode"
        self._first_name = ""
        self._kinds: dict[_Key, _Kind] = {}
        self._files: dict[_Key, IO[bytes]] = {}
        self._folder: Path | None = None
        self._is_open = self._is_damaged = False  # in an episode; by a failed write

    def __enter__(self) -> TransitionWriter:
        with ExitStack() as stack:
            self._folder = stack.enter_context(
                whole_transitions(self.path, overwrite=self._overwrite)
            )
            stack.push(self._finish)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool | None:
        try:
            return self._stack.__exit__(kind, error, trace)
        finally:
            self._folder = None

    def add(
        self, episode: TensorDictBase, *, where: str | None = None, ends: bool = True
    ) -> None:
        """Adds an episode, or a part of one.

        Args:
            episode (TensorDictBase): transitions ``[L]`` in the order of time, as from
                :func:`~torchrl_caiac.data.episode_transitions`: with ``"action"`` and,
                under ``"next"``, ``"terminated"``, ``"truncated"`` and ``"done"``, bool
                ``[L, 1]``; without ``"episode"``.

        Keyword Args:
            where (str, optional): the episode's name in error messages. Defaults to
                ``None``: its number.
            ends (bool): whether the episode ends with these rows. ``False``: the next
                call continues it. Defaults to ``True``.

        Raises:
            OSError: the disk is full.
            RuntimeError: the writer is not in its ``with`` block, or an earlier call
                failed while it was writing.
            ValueError: the episode has no rows or several batch dimensions; lacks
                entries, or has others, or other shapes and types, than the first one;
                has NaN or infinite values; or its flags are inconsistent or do not end
                it.
        """
        where = f"episode {self.episodes}" if where is None else where
        if self._folder is None or self._is_damaged:
            reason = "failed earlier" if self._is_damaged else "is not open"
            raise RuntimeError(
                f"{where} cannot be added, because the writer of {self.path} {reason}: "
                "add episodes in its with block, and leave the block after an error"
            )
        self._check(episode, where, ends)
        ids = torch.full((len(episode),), self.episodes)
        rows = episode.copy().set("episode", ids)  # without a copy of the leaves
        if self._first is None:
            check_entries(rows, where)
            if self._bounds is not None:
                check_bounds_fit(rows, self._bounds)
            first = rows[:1].detach().cpu().clone()
            self._first, self._first_name = first, where
            self._kinds = _kinds(rows)
            self._open_files(self._folder)
        self._check_kinds(_kinds(rows), where)
        self._is_damaged = True  # unless all of the writes succeed
        for key, leaf in rows.items(True, True):
            self._write(path_of(key), leaf)
        self._is_damaged = False
        self.rows += len(rows)
        self._is_open = not ends
        self.episodes += ends

    def _check(self, episode: TensorDictBase, where: str, ends: bool) -> None:
        if episode.batch_dims != 1 or not len(episode):
            raise ValueError(
                f"{where} has batch size {list(episode.batch_size)}, expected [L] with "
                "at least one row: leave it out, or give one episode at a time"
            )
        if episode.get("episode", None) is not None:
            raise ValueError(
                f"{where} has 'episode', which the writer numbers itself: remove it "
                "with exclude('episode')"
            )
        flags = {name: episode.get(("next", name), None) for name in _FLAGS}
        missing: list[NestedKey] = [("next", n) for n in _FLAGS if flags[n] is None]
        if episode.get("action", None) is None:
            missing.insert(0, "action")
        if missing:
            raise ValueError(
                f"{where} lacks {missing}, it has {leaf_names(episode)}: build it with "
                "episode_transitions"
            )
        for name, flag in flags.items():
            shape = (len(episode), 1)
            if flag.dtype != torch.bool or tuple(flag.shape) != shape:
                raise ValueError(
                    f"{('next', name)!r} of {where} is {flag.dtype} "
                    f"{list(flag.shape)}, expected torch.bool {list(shape)}: build it "
                    "with episode_transitions"
                )
        done = flags["terminated"] | flags["truncated"]
        if not torch.equal(done, flags["done"]):
            raise ValueError(
                f"('next', 'done') of {where} is not 'terminated' or 'truncated': "
                "correct the flags"
            )
        if bool(done[-1]) != ends:
            found, wanted = ("is", "not ") if not ends else ("is not", "")
            raise ValueError(
                f"the last row of {where} {found} done, but the episode is {wanted}to "
                f"end with it: set its flags, or pass ends={not ends}"
            )
        for key, leaf in episode.items(True, True):
            floating = isinstance(leaf, torch.Tensor) and leaf.is_floating_point()
            if floating and not leaf.isfinite().all():
                raise ValueError(
                    f"{key!r} of {where} has NaN or infinite values: remove the episode"
                )

    def _check_kinds(self, found: dict[_Key, _Kind], where: str) -> None:
        # Files that are appended to would not notice.
        if found == self._kinds:
            return
        keys = sorted(found.keys() | self._kinds.keys())
        differ = [k for k in keys if found.get(k) != self._kinds.get(k)]
        each = ", ".join(
            f"{_name(key)!r} is {_describe(found.get(key))} and was "
            f"{_describe(self._kinds.get(key))}"
            for key in differ
        )
        raise ValueError(
            f"{where} and the first one, {self._first_name}, differ in the shapes or "
            f"types of {[_name(key) for key in differ]}: {each}; convert them, or "
            "write them to separate folders"
        )

    def _open_files(self, folder: Path) -> None:
        for key, (dtype, shape) in self._kinds.items():
            name = ".".join(map(file_name, key))
            file = folder.with_name(f"{name}.memmap")
            if self._expected_rows is not None:
                numbers = self._expected_rows * torch.Size(shape).numel()
                reserve(file, numbers * dtype.itemsize)
            file.touch()
            # Not "wb", which would give the reserved space back.
            self._files[key] = file.open("r+b")

    def _write(self, key: _Key, leaf: torch.Tensor) -> None:
        file = self._files[key]
        content = tensor_bytes(leaf)
        try:
            file.write(content)
            file.flush()
        except OSError as error:
            if error.errno not in _NO_SPACE:
                raise
            free = shutil.disk_usage(self.path.parent).free
            raise OSError(
                errno.ENOSPC,
                f"the disk is full: {file.name} needs {content.nbytes} bytes more, "
                f"{free} are free; make space, or give a folder on another disk",
            ) from error

    def _finish(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._complete()
        finally:
            for file in self._files.values():
                file.close()

    def _complete(self) -> None:
        folder, first = self._folder, self._first
        if folder is None or first is None:
            raise ValueError(
                f"no episode was added to {self.path}: give at least one with an action"
            )
        if self._is_damaged or self._is_open:
            reason = "could not be written" if self._is_damaged else "has no end"
            raise ValueError(
                f"episode {self.episodes} of {self.path} {reason}: nothing is kept; "
                "write all of it"
            )
        for file in self._files.values():
            file.truncate()  # of what was reserved and not needed
            file.close()
        stored = first.expand(self.rows).memmap_like(folder)
        for key, leaf in stored.items(True, True):
            # The files of tensordict are empty yet, and take no space.
            os.replace(self._files[path_of(key)].name, leaf.filename)
        write_digests(folder, source=self.source)
        if self._bounds is not None:
            write_action_bounds(folder, *self._bounds)


def _kinds(rows: TensorDictBase) -> dict[_Key, _Kind]:
    return {
        path_of(key): (leaf.dtype, tuple(leaf.shape[1:]))
        for key, leaf in rows.items(True, True)
    }


def _name(key: _Key) -> str | _Key:
    return key[0] if len(key) == 1 else key


def _describe(kind: _Kind | None) -> str:
    if kind is None:
        return "missing"
    dtype, shape = kind
    return f"{dtype} {['L', *shape]}".replace("'", "")
