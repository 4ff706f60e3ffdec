"""The files through which processes share the scoring of a folder.

Beside the record of the scores, ``caiac.score.json``, lies a folder
``caiac.score.parts`` until all rows are scored. It has

- ``plan.json``: the settings, and ranges of rows, written by the first process,
- a file for each process at work, which it touches every few seconds,
- ``<plan>-<range>.claim``: the process that scores a range, created exclusively,
- ``<plan>-<range>.npz``: the finished scores of a range, renamed into place.

No process writes to a page of a file that another one writes to, so that the folder may
be on a file system that several machines share. If two processes ever score the same
range, for example because one of them was suspended, both write the same bytes.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import threading
import time
import uuid
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from tensordict.utils import NestedKey

from torchrl_caiac._files import (
    UnreadableFileError,
    claim_folder,
    read_json,
    write_json,
)
from torchrl_caiac._whole_files import has_ended, naming_full_disk, this_process
from torchrl_caiac.influence.score_record import score_file

__all__ = ["Plan", "ScoreParts", "new_plan", "refuse_members"]

_SUFFIX = ".parts"
_PLAN, _MASK = "plan.json", "mask.npy"
_VERSION = 1
_SECONDS_BETWEEN_SIGNS = 5.0
_SECONDS_WITHOUT_SIGN = 60.0
# Enough ranges that processes end at nearly the same time, and that little is lost with
# one that is killed; few enough files for a folder.
_RANGES_PER_PROCESS, _LEAST_RANGES = 32, 256
_MOST_CHUNKS = 64
_TRIES, _SECONDS_BETWEEN_TRIES = 10, 0.1
_members: set[str] = set()  # those of this process


@dataclass(frozen=True)
class Plan:
    """What processes that score a folder together agree on.

    Args:
        name (str): a name that no other plan has.
        settings (dict): what the scores depend on.
        geometry (dict): ``"batch_size"``, and what the index of trajectories is like:
            processes that differ in it would mean other rows by the same range.
        feature_shape (list of int): the shape of the scores of a row.
        chunks (int): the number of chunks in a range.
        rows (list of int): the number of rows that are scored in each range.
        has_mask (bool): whether some rows are not scored.
    """

    name: str
    settings: dict[str, Any]
    geometry: dict[str, Any]
    feature_shape: list[int]
    chunks: int
    rows: list[int]
    has_mask: bool


def new_plan(
    settings: dict[str, Any],
    geometry: dict[str, Any],
    feature_shape: tuple[int, ...],
    needed: torch.Tensor | None,
    processes: int,
) -> Plan:
    """Returns a plan for some rows.

    Args:
        settings (dict): what the scores depend on.
        geometry (dict): with ``"batch_size"`` and ``"rows"``.
        feature_shape (tuple of int): the shape of the scores of a row.
        needed (torch.Tensor, optional): bool ``[T]``, which positions are scored;
            ``None`` for all.
        processes (int): how many take part, about.

    Returns:
        Plan: the plan.

    Examples:
        >>> from torchrl_caiac.influence.score_parts import new_plan
        >>> new_plan({}, {"batch_size": 4, "rows": 10}, (2,), None, 2).rows
        [4, 4, 2]
    """
    size, length = geometry["batch_size"], geometry["rows"]
    number = -(-length // size)
    chunks = -(-number // max(_RANGES_PER_PROCESS * processes, _LEAST_RANGES))
    chunks = max(1, min(_MOST_CHUNKS, chunks))
    starts = range(0, length, chunks * size)
    if needed is None:
        rows = [min(chunks * size, length - start) for start in starts]
    else:
        rows = [int(part.sum()) for part in needed.split(chunks * size)]
    name = uuid.uuid4().hex[:12]
    shape = list(feature_shape)
    return Plan(name, settings, geometry, shape, chunks, rows, needed is not None)


def refuse_members(folder: str | os.PathLike[str]) -> None:
    """Raises if processes score a folder together.

    Args:
        folder (path): the folder of the data.

    Raises:
        RuntimeError: the message names one of them.
    """
    for root in Path(folder).glob(f"*{_SUFFIX}"):
        parts = ScoreParts(root)
        members = parts.members()
        if members:
            raise RuntimeError(
                f"{parts.describe(members[0])} is using {folder}, to score it together "
                "with others: take part with shard=(i, n), wait for it, or stop it"
            )


class ScoreParts:
    """The files through which processes share the scoring of a folder.

    Args:
        root (Path): the folder of these files, see :meth:`of`.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.member: str | None = None
        self._claimed: set[int] = set()  # which a list of files may not show yet

    @classmethod
    def of(cls, folder: str | os.PathLike[str], key: NestedKey) -> ScoreParts:
        """Returns those of a score leaf.

        Args:
            folder (path): the folder of the data.
            key (NestedKey): the leaf.
        """
        return cls(score_file(Path(folder), key).with_suffix(_SUFFIX))

    # --- who takes part ---------------------------------------------------------------

    @contextmanager
    def leading(self) -> Iterator[None]:
        """Context manager in which no other process begins or ends scoring.

        Raises:
            RuntimeError: a process scores the folder alone.
        """
        folder = self.root.parent
        with (
            FileLock(folder / ".lock-shards", poll_interval=0.1),
            ExitStack() as stack,
        ):
            for left in reversed(range(_TRIES)):
                try:
                    stack.enter_context(claim_folder(folder))
                    break
                except RuntimeError:  # perhaps a call that is being refused
                    if not left:
                        raise
                    time.sleep(_SECONDS_BETWEEN_TRIES)
            yield

    @contextmanager
    def taking_part(self) -> Iterator[None]:
        """Context manager that ends the part of this process, see :meth:`enter`."""
        ended = threading.Event()
        thread = threading.Thread(target=self._give_signs, args=(ended,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            if self.member is not None:
                _members.discard(self.member)
                self._file(self.member).unlink(missing_ok=True)

    def enter(self) -> None:
        """Makes this process known to the others, within :meth:`leading`."""
        self.root.mkdir(exist_ok=True)
        member = f"{this_process()}-{uuid.uuid4().hex[:8]}"
        name = f"process {os.getpid()} on {platform.node()}"
        _members.add(member)
        write_json(self._file(member), {"name": name})
        self.member = member

    def members(self) -> list[str]:
        """Returns the processes that are at work, without this one."""
        found = [file.name.removesuffix(".member") for file in self._all(".member")]
        return [m for m in found if m != self.member and self._is_alive(m)]

    def describe(self, member: str) -> str:
        """Returns the number and machine of a process."""
        try:
            return str(json.loads(self._file(member).read_text("utf-8"))["name"])
        except (OSError, ValueError, KeyError, TypeError):
            return "another process"

    def _file(self, member: str) -> Path:
        return self.root / f"{member}.member"

    def _all(self, suffix: str) -> list[Path]:
        return sorted(self.root.glob(f"*{suffix}")) if self.root.is_dir() else []

    def _give_signs(self, ended: threading.Event) -> None:
        while not ended.wait(_SECONDS_BETWEEN_SIGNS):
            if self.member is not None:
                with suppress(OSError):  # all is done, and the folder is removed
                    os.utime(self._file(self.member))

    def _is_alive(self, member: str) -> bool:
        process, _, _ = member.rpartition("-")
        if member not in _members and has_ended(process):
            return False
        try:
            # Opened, so that a shared file system asks for the time anew.
            with open(self._file(member), "rb") as stream:
                last = os.fstat(stream.fileno()).st_mtime
        except OSError:
            return False
        # A sign from the future is one before the clock was set back.
        return abs(self._now() - last) < _SECONDS_WITHOUT_SIGN

    def _now(self) -> float:
        """Returns the time of the file system, whose clock may be another."""
        name = this_process() if self.member is None else self.member
        file = self.root / f".now-{name}"
        try:
            file.touch()
            return file.stat().st_mtime
        except FileNotFoundError:  # all is done, and the folder is removed
            return time.time()
        finally:
            file.unlink(missing_ok=True)

    # --- the plan -------------------------------------------------------------------

    def read(self) -> Plan | None:
        """Returns the plan, ``None`` if there is none.

        Raises:
            UnreadableFileError: it is damaged.
        """
        file = self.root / _PLAN
        remedy = f"delete {self.root}, and score again what it has"
        try:
            content = read_json(file, "plan of scoring", remedy)
        except FileNotFoundError:
            return None
        try:
            if content.pop("version") == _VERSION:
                plan = Plan(**content)
                if _is_consistent(plan):
                    return plan
        except (AttributeError, KeyError, TypeError, ValueError):
            pass
        raise UnreadableFileError(f"{file} is not a plan of scoring: {remedy}")

    def write(self, plan: Plan, needed: torch.Tensor | None) -> None:
        """Writes a new plan.

        Args:
            plan (Plan): the plan.
            needed (torch.Tensor, optional): as for :func:`new_plan`.
        """
        self.root.mkdir(exist_ok=True)
        if needed is not None:
            with open(self.root / _MASK, "wb") as stream:
                np.save(stream, np.packbits(needed.numpy()), allow_pickle=False)
        write_json(self.root / _PLAN, {"version": _VERSION, **asdict(plan)})

    def mask(self, plan: Plan) -> torch.Tensor | None:
        """Returns which positions are scored, bool ``[T]``; ``None`` for all."""
        if not plan.has_mask:
            return None
        length = plan.geometry["rows"]
        with open(self.root / _MASK, "rb") as stream:
            packed = np.load(stream, allow_pickle=False)
        return torch.from_numpy(np.unpackbits(packed, count=length).astype(bool))

    def is_current(self, plan: Plan) -> bool:
        """Returns whether a plan is still there, with rows to score or to join."""
        now = self.read()
        return now is not None and now.name == plan.name

    def discard(self) -> None:
        """Removes all files, the plan first."""
        (self.root / _PLAN).unlink(missing_ok=True)
        shutil.rmtree(self.root, ignore_errors=True)

    # --- ranges ---------------------------------------------------------------------

    def finished(self, plan: Plan) -> set[int]:
        """Returns the ranges whose scores are there."""
        return self._numbers(plan, ".npz")

    def claim(self, plan: Plan, first: int) -> int | None:
        """Claims a range that no process has claimed.

        Args:
            plan (Plan): the plan.
            first (int): the range to take if it is free; otherwise it is the middle of
                the longest run of free ranges.

        Returns:
            int, optional: the range; ``None`` if all are claimed.
        """
        while True:
            taken = self._numbers(plan, ".claim") | self._numbers(plan, ".npz")
            taken |= self._claimed
            number = _choice(len(plan.rows), taken, first)
            if number is None:
                return None
            self._claimed.add(number)
            if plan.rows[number] and self._create(self._claim(plan, number)):
                return number

    def take_over(self, plan: Plan) -> int | None:
        """Takes an unfinished range over from a process that has ended.

        Returns:
            int, optional: the range; ``None`` if all are in work.
        """
        for number in sorted(self.unfinished(plan)):
            file = self._claim(plan, number)
            try:
                owner = file.read_text("utf-8", "replace")
                if not re.fullmatch(r"[\w-]*", owner, re.ASCII):  # by a crash
                    owner = ""
                # Between its creation and the first byte.
                is_new = not owner and (
                    self._now() - file.stat().st_mtime < _SECONDS_WITHOUT_SIGN
                )
            except OSError:  # it was damaged, and removed by another process
                owner, is_new = "", False
            if is_new or (owner and owner != self.member and self._is_alive(owner)):
                continue
            mine = self.root / f".claim-{self.member}"
            with suppress(FileNotFoundError):  # all is done, the folder is removed
                mine.write_text(str(self.member), "utf-8")
                os.replace(mine, file)
                return number
        return None

    def unfinished(self, plan: Plan) -> set[int]:
        """Returns the ranges that have rows to score, and no scores yet."""
        needed = {number for number, rows in enumerate(plan.rows) if rows}
        return needed - self.finished(plan)

    def put(
        self, plan: Plan, number: int, scores: torch.Tensor, fingerprints: torch.Tensor
    ) -> None:
        """Writes the scores of a range.

        Args:
            plan (Plan): the plan.
            number (int): the range.
            scores (torch.Tensor): float32 ``[n, *feature_shape]``.
            fingerprints (torch.Tensor): int64 ``[n]``.
        """
        partial = self.root / f".part-{self.member}"
        try:
            with naming_full_disk(partial), open(partial, "wb") as stream:
                np.savez(
                    stream, scores=scores.numpy(), fingerprints=fingerprints.numpy()
                )
            os.replace(partial, self._part(plan, number))
        except FileNotFoundError:  # another process has finished all of it
            pass
        finally:
            partial.unlink(missing_ok=True)

    def get(self, plan: Plan, number: int) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Returns what :meth:`put` wrote.

        A damaged file, as a machine that fails may leave, is removed, and the range is
        free again.

        Returns:
            tuple of torch.Tensor, optional: the scores and fingerprints; ``None`` if
            the file is missing or damaged.
        """
        file = self._part(plan, number)
        expected = ((plan.rows[number], *plan.feature_shape), (plan.rows[number],))
        try:
            # The archive has checksums, which are compared.
            with np.load(file, allow_pickle=False) as part:
                found = part["scores"], part["fingerprints"]
            if (found[0].dtype, found[1].dtype) != (np.float32, np.int64):
                raise ValueError("other types")
            if (found[0].shape, found[1].shape) != expected:
                raise ValueError("other shapes")
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            self._claim(plan, number).unlink(missing_ok=True)
            file.unlink(missing_ok=True)
            self._claimed.discard(number)
            return None
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])

    def _claim(self, plan: Plan, number: int) -> Path:
        return self.root / f"{plan.name}-{number:07d}.claim"

    def _part(self, plan: Plan, number: int) -> Path:
        return self.root / f"{plan.name}-{number:07d}.npz"

    def _create(self, file: Path) -> bool:
        """Creates a file that names this process, unless it is there."""
        try:
            descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            return False
        except FileNotFoundError:  # another process has finished, and removed all files
            return False
        try:
            with naming_full_disk(file), open(descriptor, "w", encoding="utf-8") as out:
                out.write(str(self.member))
        except OSError:
            file.unlink(missing_ok=True)
            raise
        return True

    def _numbers(self, plan: Plan, suffix: str) -> set[int]:
        start = f"{plan.name}-"
        names = [file.name.removesuffix(suffix) for file in self._all(suffix)]
        numbers = [x.removeprefix(start) for x in names if x.startswith(start)]
        return {int(number) for number in numbers if number.isdecimal()}


def _is_consistent(plan: Plan) -> bool:
    """Returns whether the ranges are those of the rows; raises for other types."""
    numbers = [plan.chunks, *plan.rows, *plan.feature_shape]
    length, size = plan.geometry["rows"], plan.chunks * plan.geometry["batch_size"]
    full = [min(size, length - start) for start in range(0, length, size)]
    return (
        all(type(number) is int and number >= 0 for number in numbers)
        and type(plan.has_mask) is bool
        and isinstance(plan.settings, dict)
        and plan.name.isalnum()
        and len(plan.rows) == len(full)
        and all(n <= most for n, most in zip(plan.rows, full, strict=True))
        and (plan.has_mask or plan.rows == full)
    )


def _choice(number: int, taken: set[int], first: int) -> int | None:
    """Returns the range to take, ``None`` if all are taken."""
    if first < number and first not in taken:
        return first
    longest, run, start = range(0), 0, 0
    for r in range(number + 1):
        if r < number and r not in taken:
            start, run = (r, 1) if not run else (start, run + 1)
        else:
            if run > len(longest):
                longest = range(start, r)
            run = 0
    return longest[len(longest) // 2] if longest else None
