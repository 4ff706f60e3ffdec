"""Any Minari dataset as TorchRL transitions in memory-mapped files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tqdm.auto import tqdm

from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.minari_files import whole_folder

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.dataset.episode_data import EpisodeData

__all__ = ["load_minari"]

# What an observation's entries must not be called.
_TAKEN = {"action", "done", "episode", "info", "next"}
_TAKEN |= {"reward", "terminated", "truncated"}


def load_minari(
    dataset: str | MinariDataset,
    path: str | Path,
    *,
    download: bool = False,
    columns: Sequence[int] | None = None,
    infos: Sequence[str] = (),
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes a Minari dataset as TorchRL transitions, and opens them.

    Rows ``[T]`` hold ``"observation"``, ``"action"``, ``"episode"`` (int64 ``[]``, the
    trajectory's number) and, under ``"next"``, the observation that followed (the
    episode's own last one at its end), ``"reward"``, ``"terminated"``,
    ``"truncated"`` and ``"done"`` (``[1]``). An episode's last row is always done: it
    counts as truncated where the file has no flag.

    A dict of observations becomes keys at the root if it has an ``"observation"``, as
    those of a goal environment, whatever else it has; other dicts lie under
    ``"observation"``. Floating-point numbers become float32.

    Args:
        dataset (str or MinariDataset): the dataset, or its id.
        path (str or Path): the folder to write, which appears whole or not at all.

    Keyword Args:
        download (bool): fetch a dataset that is not there. Defaults to ``False``.
        columns (sequence of int, optional): keep these columns of the observation
            (of the entry ``"observation"`` of a goal environment).
        infos (sequence of str): entries of the episodes' infos to keep, under
            ``"info"``, as they are: row ``t`` holds that of its state.
        overwrite (bool): replace what is at ``path``. Defaults to ``False``.
        progress (bool): show a progress bar over the episodes. Defaults to ``True``.

    Returns:
        TensorDict: the memmap tensordict, ``[T]``.

    Raises:
        FileExistsError: there is something at ``path``.
        FileNotFoundError: the dataset is not on this machine.
        ValueError: the dataset is empty; an episode is empty, does not fit together,
            or holds NaN or infinities; ``columns`` do not fit.
        KeyError: an episode lacks one of ``infos``.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.data import load_minari
        >>> from torchrl_caiac.envs import create_fetch_push_random
        >>> folder = tempfile.TemporaryDirectory()
        >>> dataset = create_fetch_push_random(
        ...     episodes=2, steps=5, root=folder.name, workers=1, progress=False
        ... )
        >>> rows = load_minari(dataset, f"{folder.name}/rows", progress=False)
        >>> rows["episode"]
        MemoryMappedTensor([0, 0, 0, 0, 0, 1, 1, 1, 1, 1])
        >>> rows["next", "observation"].shape
        torch.Size([10, 34])
        >>> folder.cleanup()
    """
    import minari

    path = Path(path)
    if path.exists() and not overwrite:
        raise FileExistsError(
            f"there is something at {path}: open it with load_transitions, or pass "
            "overwrite=True to replace it"
        )
    if isinstance(dataset, str):
        dataset = minari.load_dataset(dataset, download=download)
    lengths = [
        int(meta["total_steps"])
        for meta in dataset.storage.get_episode_metadata(dataset.episode_indices)
    ]
    if not sum(lengths):
        raise ValueError(f"the dataset {dataset.id} has no steps")
    with whole_folder(path) as folder:
        _fill(dataset, lengths, folder, columns, infos, progress)
    return load_transitions(path)


def _fill(
    dataset: MinariDataset,
    lengths: Sequence[int],
    folder: Path,
    columns: Sequence[int] | None,
    infos: Sequence[str],
    progress: bool,
) -> None:
    rows: TensorDict | None = None
    first = 0
    episodes: Iterator[EpisodeData] = dataset.iterate_episodes()
    bar = tqdm(
        zip(episodes, lengths, strict=True),
        total=len(lengths),
        desc=f"loading {dataset.id}",
        unit="episode",
        disable=not progress,
    )
    for number, (episode, length) in enumerate(bar):
        part = _transitions(episode, length, columns, infos, dataset.id)
        part["episode"] = torch.full((length,), number)
        if rows is None:
            rows = part[:1].expand(sum(lengths)).memmap_like(folder)
        # A memmap would broadcast, cast or leave out what does not fit, silently.
        differ = {leaf[0] for leaf in _structure(part) ^ _structure(rows)}
        if differ:
            raise ValueError(
                f"episode {episode.id} of {dataset.id} and the first one differ in the "
                f"shapes or types of {sorted(differ, key=str)}: load them apart"
            )
        rows[first : first + length] = part
        first += length


def _structure(rows: TensorDictBase) -> set[tuple[Any, ...]]:
    return {
        (key, leaf.dtype, tuple(leaf.shape[1:]))
        for key, leaf in rows.items(include_nested=True, leaves_only=True)
    }


def _transitions(
    episode: EpisodeData,
    length: int,
    columns: Sequence[int] | None,
    infos: Sequence[str],
    dataset_id: str,
) -> TensorDict:
    where = f"episode {episode.id} of {dataset_id}"
    if length < 1:
        raise ValueError(f"{where} has no steps: filter it out of the dataset")
    states = episode.observations
    if not isinstance(states, Mapping) or "observation" not in states:
        states = {"observation": states}
    taken = sorted(_TAKEN & set(states))
    if taken:
        raise ValueError(
            f"the observations in {where} have entries named {taken}, which are keys "
            "of transitions: rename them in the dataset"
        )
    if columns is not None:
        states = {**states, "observation": _columns(states, columns, where)}
    flags = {
        "reward": episode.rewards,
        "terminated": episode.terminations,
        "truncated": episode.truncations,
    }
    kept = {}
    for name in infos:
        if name not in (episode.infos or {}):
            raise KeyError(
                f"{where} has no {name!r} in its infos, it has "
                f"{sorted(episode.infos or {})}"
            )
        kept[name] = episode.infos[name]
    td = TensorDict(
        {
            **_tensors(states, length + 1, where, slice(0, length)),
            **_tensors({"action": episode.actions}, length, where),
            "next": {
                **_tensors(states, length + 1, where, slice(1, length + 1)),
                **{
                    key: value.reshape(length, 1)
                    for key, value in _tensors(flags, length, where).items()
                },
            },
        },
        [length],
    )
    if kept:
        td["info"] = _tensors(kept, length + 1, where, slice(0, length), cast=False)
    for key in ("terminated", "truncated"):
        td["next", key] = td["next", key].bool()
    td["next", "truncated"][-1] |= ~td["next", "terminated"][-1]
    td["next", "done"] = td["next", "terminated"] | td["next", "truncated"]
    return td


def _columns(states: Mapping[str, Any], columns: Sequence[int], where: str) -> Any:
    observation = states["observation"]
    if isinstance(observation, Mapping) or observation.ndim != 2:
        raise ValueError(
            f"{where} has no flat observation [L + 1, D] to take columns of"
        )
    if min(columns) < 0 or max(columns) >= observation.shape[1]:
        raise ValueError(
            f"columns reach from {min(columns)} to {max(columns)}, but {where} has "
            f"{observation.shape[1]} columns"
        )
    return observation[:, list(columns)]


def _tensors(
    tree: Mapping[str, Any],
    length: int,
    where: str,
    part: slice = slice(None),
    *,
    cast: bool = True,
) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            result[key] = _tensors(value, length, where, part, cast=cast)
            continue
        if isinstance(value, tuple):
            raise ValueError(
                f"{key!r} in {where} is a tuple of spaces, which has no keys: make a "
                "dict of it"
            )
        array = np.asarray(value)
        if len(array) != length:
            raise ValueError(
                f"{key!r} in {where} has {len(array)} entries, wanted {length}"
            )
        if np.issubdtype(array.dtype, np.floating):
            with np.errstate(over="ignore"):
                array = array.astype(np.float32) if cast else array
            if not np.isfinite(array).all():
                raise ValueError(
                    f"{key!r} in {where} has NaN or infinite values (as float32): "
                    "leave the episode out, say with MinariDataset.filter_episodes"
                )
        # A copy: what Minari hands out may be read-only.
        result[key] = torch.from_numpy(np.array(array[part]))
    return result
