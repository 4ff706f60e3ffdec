"""What all loaders do: write episodes once, and open them at the second call."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tqdm.auto import tqdm

from torchrl_caiac._files import UnreadableFileError, plain
from torchrl_caiac._keys import path as path_of
from torchrl_caiac.data.action_bounds import action_bounds as stored_bounds
from torchrl_caiac.data.action_bounds import check_action_bounds
from torchrl_caiac.data.digests import data_source, has_digests, original_leaves
from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.transition_writer import TransitionWriter
from torchrl_caiac.data.write_transitions import check_free

__all__ = ["Part", "write_episodes"]

_logger = logging.getLogger("torchrl_caiac.data.write_episodes")


class Part(NamedTuple):
    """An episode, or a part of one.

    Attributes:
        rows (TensorDictBase): transitions ``[L]``, as from
            :func:`~torchrl_caiac.data.episode_transitions`.
        where (str): its name in error messages.
        ends (bool): whether the episode ends with these rows.
    """

    rows: TensorDictBase
    where: str
    ends: bool = True


def write_episodes(
    episodes: Iterable[Part],
    path: str | os.PathLike[str],
    *,
    source: Mapping[str, Any] | None = None,
    action_bounds: tuple[Any, Any] | None = None,
    overwrite: bool = False,
    progress: bool = True,
    rows: int | None = None,
    total: int | None = None,
    description: str = "loading",
) -> TensorDict:
    """Writes episodes to a folder, atomically, or opens what an equal call wrote.

    Without ``source``, the episodes are compared with those in the folder, row by row.
    With it, only the sources are compared, and the leaves with their digests; the
    episodes are not read.

    Args:
        episodes (iterable of Part): the episodes, in order. They are read one at a
            time.
        path (path): the folder.

    Keyword Args:
        source (mapping, optional): what the episodes are made from and how, JSON
            values: all that changes the result, such as the digests of the files (see
            :func:`~torchrl_caiac.data.digests.file_digest`) and the arguments of the
            loader. Defaults to ``None``: unknown.
        action_bounds (tuple of torch.Tensor or sequence, optional): see
            :class:`~torchrl_caiac.data.TransitionWriter`. Defaults to ``None``.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.
        rows (int, optional): the number of rows, to reserve their space. Defaults to
            ``None``: unknown.
        total (int, optional): the number of parts, for the progress bar. Defaults to
            ``None``: unknown.
        description (str): the name of the progress bar. Defaults to ``"loading"``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileExistsError: ``path`` exists, was not written from the same, and
            ``overwrite`` is ``False``.
        OSError: the disk is full.
        UnreadableFileError: ``path`` was written from the same, and is damaged or was
            changed since.
        ValueError: see :class:`~torchrl_caiac.data.TransitionWriter`.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data import episode_transitions
        >>> from torchrl_caiac.data.write_episodes import Part, write_episodes
        >>> def episodes():
        ...     for number in range(2):
        ...         where = f"episode {number}"
        ...         states, actions = np.full((4, 2), number), np.zeros((3, 1))
        ...         yield Part(
        ...             episode_transitions(states, actions, where=where), where
        ...         )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for _ in range(2):
        ...         data = write_episodes(episodes(), f"{folder}/a", progress=False)
        ...     data["episode"]
        MemoryMappedTensor([0, 0, 0, 1, 1, 1])
    """
    if source is not None:
        source = plain(source)
    if action_bounds is not None:
        action_bounds = check_action_bounds(*action_bounds)
    check_free(path, overwrite=True)  # what a killed process moved away comes back
    exists = Path(path).exists()
    if exists and source is not None:
        if not overwrite:
            return _same_source(path, source, action_bounds)
        _warn_of_other_source(path, source)
    bar = tqdm(
        episodes, total=total, desc=description, unit="episode", disable=not progress
    )
    with bar:
        if exists and not overwrite:
            return _same_rows(path, bar, action_bounds)
        with TransitionWriter(
            path,
            overwrite=overwrite,
            action_bounds=action_bounds,
            source=source,
            rows=rows,
        ) as writer:
            for part in bar:
                writer.add(part.rows, where=part.where, ends=part.ends)
    return load_transitions(Path(path))


def _same_source(
    path: str | os.PathLike[str],
    source: Mapping[str, Any],
    bounds: tuple[torch.Tensor, torch.Tensor] | None,
) -> TensorDict:
    _check_comparable(path)
    try:
        found = data_source(path) or {}
    except UnreadableFileError as error:
        raise _refusal(path, f"something that cannot be read ({error})") from error
    differ = sorted(
        name
        for name in found.keys() | source.keys()
        if found.get(name, _refusal) != source.get(name, _refusal)
    )
    if differ:
        raise _refusal(path, f"another source ({', '.join(differ)} differ)")
    _check_bounds(path, bounds)
    _logger.info("%s was written from the same before: it is opened", path)
    return load_transitions(Path(path), verify=True)


def _same_rows(
    path: str | os.PathLike[str],
    episodes: Iterable[Part],
    bounds: tuple[torch.Tensor, torch.Tensor] | None,
) -> TensorDict:
    _check_comparable(path)
    _check_bounds(path, bounds)
    try:
        stored = load_transitions(Path(path))
    except (UnreadableFileError, ValueError) as error:
        raise _refusal(path, f"something that cannot be opened ({error})") from error
    leaves = original_leaves(stored)
    first = 0
    for part, number in _numbered(episodes):
        count = len(part.rows)
        ids = torch.full((count,), number)
        rows = part.rows.detach().cpu().exclude().set("episode", ids)
        found = {path_of(key): leaf for key, leaf in rows.items(True, True)}
        differ = sorted(found.keys() ^ leaves.keys()) or [
            key
            for key, leaf in found.items()
            if not _equal(leaf, leaves[key][first : first + count])
        ]
        if differ:
            names = [key[0] if len(key) == 1 else key for key in differ]
            raise _refusal(path, f"other data ({names} of {part.where} differ)")
        first += count
    if first != len(stored):
        raise _refusal(path, f"other data ({len(stored)} rows, now {first})")
    _logger.info("%s was written from the same data before: it is opened", path)
    return stored


def _numbered(episodes: Iterable[Part]) -> Iterator[tuple[Part, int]]:
    number = 0
    for part in episodes:
        yield part, number
        number += part.ends


def _equal(rows: torch.Tensor, stored: torch.Tensor) -> bool:
    return rows.dtype == stored.dtype and torch.equal(rows, stored)


def _check_comparable(path: str | os.PathLike[str]) -> None:
    if not has_digests(path):
        raise _refusal(path, "something that it does not say (no digests.json)")


def _check_bounds(
    path: str | os.PathLike[str], bounds: tuple[torch.Tensor, torch.Tensor] | None
) -> None:
    found = stored_bounds(path)
    if (found is None) != (bounds is None) or (
        found is not None
        and bounds is not None
        and not torch.equal(torch.stack(found), torch.stack(bounds))
    ):
        raise _refusal(path, f"other action_bounds ({found}, now {bounds})")


def _refusal(path: str | os.PathLike[str], what: str) -> FileExistsError:
    return FileExistsError(
        f"{path} exists, and was written from {what}: pass overwrite=True to replace "
        "it, give another path, or open it with load_transitions"
    )


def _warn_of_other_source(
    path: str | os.PathLike[str], source: Mapping[str, Any]
) -> None:
    if not has_digests(path):
        return
    try:
        same = data_source(path) == source
    except UnreadableFileError as error:
        _logger.warning(
            "it cannot be known what %s was written from (%s): it is replaced",
            path,
            error,
        )
        return
    if not same:
        _logger.warning(
            "%s was written from other data than %s has now: it is replaced",
            path,
            source.get("dataset", "the source"),
        )
