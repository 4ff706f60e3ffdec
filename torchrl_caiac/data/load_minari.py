"""Minari datasets as TorchRL transitions in memory-mapped files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tensordict import TensorDict
from tensordict.utils import NestedKey

from torchrl_caiac._files import UnreadableFileError
from torchrl_caiac._keys import as_key
from torchrl_caiac._keys import path as path_of
from torchrl_caiac.data.digests import file_digest
from torchrl_caiac.data.episodes import episode_transitions
from torchrl_caiac.data.minari_checks import episode_lengths
from torchrl_caiac.data.minari_files import open_minari
from torchrl_caiac.data.write_episodes import Part, write_episodes

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.dataset.episode_data import EpisodeData

__all__ = ["load_minari"]

_REMOVE = "remove the episode with MinariDataset.filter_episodes"


def load_minari(
    dataset: str | MinariDataset,
    path: str | Path,
    *,
    download: bool = False,
    columns: Sequence[int] | None = None,
    infos: Sequence[str] = (),
    exclude: Sequence[NestedKey] = (),
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes a Minari dataset as TorchRL transitions, and opens them.

    The transitions ``[T]`` have ``"observation"``, ``"action"``, ``"episode"`` (the
    number of the trajectory, int64 ``[T]``) and, under ``"next"``, the observation
    after the action, ``"reward"``, ``"terminated"``, ``"truncated"`` and ``"done"``
    (each ``[T, 1]``). The last row of an episode is always done: it counts as truncated
    if the dataset has no flag for it.

    If the observation is a dict with the entry ``"observation"``, as in goal
    environments, its entries become entries of the root. Any other dict becomes a
    nested ``"observation"``. Floating-point numbers become float32.

    The folder also has the bounds of the action space (see
    :func:`~torchrl_caiac.data.action_bounds`) where they are finite, and the digests of
    its leaves and of the dataset's files. A second call with the same dataset and
    arguments opens the folder.

    Args:
        dataset (str or MinariDataset): the dataset or its id.
        path (str or Path): the folder to write. It is written atomically.

    Keyword Args:
        download (bool): whether to download a missing dataset. Defaults to ``False``.
        columns (sequence of int, optional): the columns of the observation to keep
            (in goal environments, of the entry ``"observation"``). Defaults to
            ``None``: all.
        infos (sequence of str): the entries of the episodes' infos to keep, unchanged,
            under ``"info"``. Row ``t`` has the info of its state. Defaults to ``()``.
        exclude (sequence of NestedKey): entries of the observations and of ``infos`` to
            leave out, such as texts, by their keys in the transitions, for example
            ``"mission"``, ``("observation", "camera")`` or ``("info", "name")``.
            Defaults to ``()``.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar over the episodes. Defaults to
            ``True``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileExistsError: ``path`` exists, was not written by an equal call, and
            ``overwrite`` is ``False``.
        FileNotFoundError: the dataset is not on this machine.
        KeyError: an episode lacks one of ``infos`` or ``exclude``.
        OSError: the disk is full.
        UnreadableFileError: the dataset is damaged, or opening it would run code.
        ValueError: the dataset is empty; an episode is empty, inconsistent, or has NaN,
            infinite values, texts or objects; ``columns`` is empty or does not fit the
            observation.

    Examples:
        >>> import os, tempfile
        >>> from unittest.mock import patch
        >>> import minari
        >>> import numpy as np
        >>> from gymnasium.spaces import Box
        >>> from minari.data_collector import EpisodeBuffer
        >>> from torchrl_caiac.data import load_minari
        >>> folder = tempfile.TemporaryDirectory()
        >>> episode = EpisodeBuffer(
        ...     observations=np.zeros((6, 3)),
        ...     actions=np.zeros((5, 2)),
        ...     rewards=np.zeros(5),
        ...     terminations=np.zeros(5, bool),
        ...     truncations=np.zeros(5, bool),
        ... )
        >>> with patch.dict(os.environ, MINARI_DATASETS_PATH=folder.name):
        ...     dataset = minari.create_dataset_from_buffers(
        ...         "example/zeros-v0",
        ...         [episode, episode],
        ...         observation_space=Box(-1, 1, (3,)),
        ...         action_space=Box(-1, 1, (2,)),
        ...     )
        >>> data = load_minari(dataset, f"{folder.name}/data", progress=False)
        >>> data["episode"]
        MemoryMappedTensor([0, 0, 0, 0, 0, 1, 1, 1, 1, 1])
        >>> data["next", "observation"].shape
        torch.Size([10, 3])
        >>> folder.cleanup()
    """
    if columns is not None and not len(columns):
        raise ValueError(
            "columns is empty, expected at least one column of the observation: leave "
            "out columns= to keep all"
        )
    if isinstance(dataset, str):
        dataset = open_minari(dataset, download=download)
    lengths = episode_lengths(dataset)
    if not sum(lengths):
        raise ValueError(f"the dataset {dataset.id} has no steps: give another one")
    import gymnasium

    left_out = {path_of(as_key(key)) for key in exclude}
    source = _source(dataset)
    arguments = {
        "columns": None if columns is None else [int(column) for column in columns],
        "infos": list(infos),
        "exclude": sorted(map(list, left_out)),
    }
    if any(arguments.values()):
        source["arguments"] = arguments
    space = dataset.action_space
    is_box = isinstance(space, gymnasium.spaces.Box)
    is_bounded = is_box and space.shape and space.is_bounded()
    return write_episodes(
        _parts(dataset, lengths, columns, infos, left_out),
        path,
        source=source,
        action_bounds=(space.low, space.high) if is_bounded else None,
        overwrite=overwrite,
        progress=progress,
        rows=sum(lengths),
        total=len(lengths),
        description=f"loading {dataset.id}",
    )


def _source(dataset: MinariDataset) -> dict[str, Any]:
    """Returns the digests of the dataset's files, and the episodes that are taken."""
    folder = Path(dataset.storage.data_path)
    files = {
        file.relative_to(folder).as_posix(): file_digest(file)
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.name != "metadata.json"  # it may get new remarks
    }
    episodes = [int(index) for index in dataset.episode_indices]
    return {"dataset": dataset.id, "sha256": files, "episodes": episodes}


def _episodes(dataset: MinariDataset) -> Iterator[EpisodeData]:
    """Yields all episodes; names the file and the episode that cannot be read."""
    episodes = dataset.iterate_episodes()
    for index in dataset.episode_indices:
        try:
            episode = next(episodes)
        except Exception as error:  # h5py, Pillow and Minari raise many kinds
            raise UnreadableFileError(
                f"Minari cannot read episode {index} of {dataset.id} in "
                f"{dataset.storage.data_path} ({type(error).__name__}: {error}): "
                "download or collect the dataset again"
            ) from error
        yield episode


def _parts(
    dataset: MinariDataset,
    lengths: Sequence[int],
    columns: Sequence[int] | None,
    infos: Sequence[str],
    left_out: set[tuple[str, ...]],
) -> Iterator[Part]:
    for episode, length in zip(_episodes(dataset), lengths, strict=True):
        where = f"episode {episode.id} of {dataset.id}"
        rows = _transitions(episode, length, columns, infos, left_out, where)
        yield Part(rows, where)


def _transitions(
    episode: EpisodeData,
    length: int,
    columns: Sequence[int] | None,
    infos: Sequence[str],
    left_out: set[tuple[str, ...]],
    where: str,
) -> TensorDict:
    if length < 1:
        raise ValueError(f"{where} has no steps: filter it out of the dataset")
    states = episode.observations
    if not isinstance(states, Mapping) or "observation" not in states:
        states = {"observation": states}
    if columns is not None:
        states = {**states, "observation": _columns(states, columns, where)}
    kept = {}
    for name in infos:
        if name not in (episode.infos or {}):
            raise KeyError(
                f"{where} has no {name!r} in its infos; it has "
                f"{sorted(episode.infos or {})}: correct infos="
            )
        kept[name] = episode.infos[name]
    known = set(_paths({**states, "info": kept}))
    unknown = sorted(left_out - known)
    if unknown:
        raise KeyError(
            f"{where} has no {unknown}, its observations and infos have "
            f"{sorted(known)}: correct exclude="
        )
    kept = _without(kept, {key[1:] for key in left_out if key[0] == "info"})
    _check_infos(kept, length + 1, where)
    return episode_transitions(
        _without(states, left_out),
        episode.actions,
        where=where,
        rewards=episode.rewards,
        terminated=episode.terminations,
        truncated=episode.truncations,
        info=kept,
        remove=_REMOVE,
        leave_out="pass exclude=[{key!r}]",
    )


def _check_infos(
    infos: Mapping[str, Any], states: int, where: str, above: tuple[str, ...] = ()
) -> None:
    """Raises if an entry has no value for each state, such as one for each action."""
    for name, value in infos.items():
        key = (*above, name)
        if isinstance(value, Mapping):
            _check_infos(value, states, where, key)
        elif len(value) != states:
            raise ValueError(
                f"{('info', *key)!r} in {where} has {len(value)} entries, expected "
                f"{states}: {_REMOVE}, or leave it out of infos="
            )


def _columns(states: Mapping[str, Any], columns: Sequence[int], where: str) -> Any:
    observation = states["observation"]
    if isinstance(observation, Mapping) or observation.ndim != 2:
        raise ValueError(
            f"{where} has no flat observation [L + 1, D] to take columns from: "
            "leave out columns="
        )
    if min(columns) < 0 or max(columns) >= observation.shape[1]:
        raise ValueError(
            f"columns range from {min(columns)} to {max(columns)}, but {where} has "
            f"{observation.shape[1]} columns: correct columns="
        )
    return observation[:, list(columns)]


def _paths(
    tree: Mapping[str, Any], above: tuple[str, ...] = ()
) -> Iterator[tuple[str, ...]]:
    for key, value in tree.items():
        yield (*above, key)
        if isinstance(value, Mapping):
            yield from _paths(value, (*above, key))


def _without(
    tree: Mapping[str, Any], keys: set[tuple[str, ...]], above: tuple[str, ...] = ()
) -> dict[str, Any]:
    return {
        key: _without(value, keys, (*above, key))
        if isinstance(value, Mapping)
        else value
        for key, value in tree.items()
        if (*above, key) not in keys
    }
