"""Streams of arrays as TorchRL transitions in memory-mapped files."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal

import numpy as np
from tensordict import TensorDict

from torchrl_caiac.data.array_parts import (
    ArraySet,
    FlatArrays,
    LostRows,
    episode_parts,
    next_states,
)
from torchrl_caiac.data.array_trees import (
    check_arrays,
    entries,
    joined,
    plain_tree,
    to_numpy,
    with_goals,
)
from torchrl_caiac.data.write_episodes import Part, write_episodes

__all__ = ["from_stream"]

_ENTRIES = [field.name for field in dataclasses.fields(ArraySet)]
_GOALS = ("achieved_goals", "desired_goals", "next_achieved_goals")


def from_stream(
    stream: Iterable[Mapping[str, Any]],
    path: str | os.PathLike[str],
    *,
    of: Literal["episodes", "parts"] = "episodes",
    action_bounds: tuple[Any, Any] | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes a stream of arrays as TorchRL transitions, and opens them.

    It is for data that do not fit into the memory and have no array that could be
    sliced, such as many files.

    Args:
        stream (iterable of mapping): mappings with the arguments of
            :func:`from_arrays` for arrays: ``"observations"``, ``"actions"`` and, in
            all mappings or in none, the others. Each is read once, before the next
            one is requested. Afterwards, the stream may overwrite its arrays.
        path (path): the folder to write. It is written atomically.

    Keyword Args:
        of (str): what a mapping has. ``"episodes"``: one episode. ``"parts"``: any
            number of rows of flat arrays, with as many observations as actions and with
            ``"terminals"``, ``"timeouts"`` or ``"dones"``; an episode may begin in one
            part and end in a later one. Defaults to ``"episodes"``.
        action_bounds (tuple of sequence, optional): see :func:`from_arrays`.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileExistsError: see :func:`from_arrays`.
        OSError: the disk is full.
        ValueError: a mapping has an unknown entry, or others than the first one; the
            last episode has no end; or see :func:`from_arrays`.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data import from_stream
        >>> def read():
        ...     for length in (3, 2):
        ...         yield {
        ...             "observations": np.zeros((length + 1, 4)),
        ...             "actions": np.zeros((length, 2)),
        ...         }
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     data = from_stream(read(), f"{folder}/data", progress=False)
        ...     data["episode"]
        MemoryMappedTensor([0, 0, 0, 1, 1])
    """
    if of not in ("episodes", "parts"):
        raise ValueError(f"of is {of!r}, expected 'episodes' or 'parts'")
    items, lost = _items(stream), LostRows()
    convert = episode_parts if of == "episodes" else _from_parts
    return write_episodes(
        lost.told(convert(items, lost)),
        path,
        action_bounds=action_bounds,
        overwrite=overwrite,
        progress=progress,
        description="writing episodes",
    )


def _items(stream: Iterable[Mapping[str, Any]]) -> Iterator[ArraySet]:
    expected: set[str] | None = None
    for number, item in enumerate(stream):
        where = f"item {number} of the stream"
        item = plain_tree(item)
        if not isinstance(item, Mapping):
            raise ValueError(
                f"{where} is a {type(item).__name__}, expected a mapping with the "
                "entries 'observations' and 'actions'"
            )
        found = {name for name, value in item.items() if value is not None}
        wrong = sorted(found - {*_ENTRIES, *_GOALS})
        lacking = sorted({"observations", "actions"} - found)
        if wrong or lacking:
            raise ValueError(
                f"{where} lacks {lacking} and has the unknown {wrong}: the entries are "
                f"{[*_ENTRIES, *_GOALS]}"
            )
        expected = found if expected is None else expected
        if found != expected:
            raise ValueError(
                f"only one of {where} and the first item has "
                f"{sorted(found ^ expected)}: give them in all or in none"
            )
        goals = [item.get(name) for name in _GOALS]
        arrays = {name: item.get(name) for name in _ENTRIES}
        arrays["observations"] = with_goals(arrays["observations"], *goals[:2])
        arrays["next_observations"] = next_states(arrays["next_observations"], *goals)
        yield ArraySet(**arrays)


def _from_parts(parts: Iterable[ArraySet], lost: LostRows) -> Iterator[Part]:
    """Yields the episodes of flat arrays, which may begin in one and end in another."""
    rest: ArraySet | None = None
    first = number = 0
    for number, part in enumerate(parts):
        where = f"part {number}"
        for name, value in part.given().items():
            check_arrays(value, name, where)
        if rest is not None:
            part = _joined(rest, part, where)
        counts = {
            name: entries(value, name, where) for name, value in part.given().items()
        }
        if len(set(counts.values())) > 1:
            raise ValueError(
                f"{where} (with the rest of earlier ones) has other numbers of entries "
                f"for some arrays: {counts}; a part has one of each for each action"
            )
        flags = [
            x for x in (part.terminals, part.timeouts, part.dones) if x is not None
        ]
        if not flags:
            raise ValueError(
                f"{where} has no 'terminals', 'timeouts' or 'dones', so nothing says "
                "where episodes end: give them, or of='episodes'"
            )
        ends = np.zeros(counts["actions"], bool)
        for flag in flags:
            ends |= to_numpy(flag).reshape(len(ends), -1).any(1)
        stop = int(ends.nonzero()[0][-1]) + 1 if ends.any() else 0
        if stop:
            spans = FlatArrays(part.cut(slice(0, stop)), f"the stream from row {first}")
            yield from spans.parts(lost)
        # Copied, because the stream may write its next part to the same arrays.
        rest = part.cut(slice(stop, None)).copied() if stop < len(ends) else None
        first += stop
    if rest is not None:
        raise ValueError(
            f"the last {entries(rest.actions, 'actions', 'the stream')} rows of the "
            f"stream, in part {number}, have no end: set 'timeouts' in the last row if "
            "the recording stops there, else leave them out"
        )


def _joined(before: ArraySet, after: ArraySet, where: str) -> ArraySet:
    try:
        return ArraySet(
            **{
                field.name: joined(
                    getattr(before, field.name), getattr(after, field.name)
                )
                for field in dataclasses.fields(ArraySet)
            }
        )
    except ValueError as error:
        raise ValueError(
            f"{where} does not continue the part before it ({error}): give the same "
            "entries, shapes and types in all parts"
        ) from error
