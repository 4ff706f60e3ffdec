"""Minari datasets of the Franka-Kitchen as TorchRL transitions."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from torchrl_caiac.data.action_bounds import action_bounds
from torchrl_caiac.data.load_minari import load_minari
from torchrl_caiac.data.minari_checks import episode_lengths
from torchrl_caiac.data.minari_files import open_minari
from torchrl_caiac.data.write_transitions import check_free, write_transitions
from torchrl_caiac.envs.kitchen.tasks import STATE_COLUMNS, task_number

if TYPE_CHECKING:
    from minari import MinariDataset
    from tensordict import TensorDict

__all__ = ["kitchen_transitions"]


def kitchen_transitions(
    dataset: MinariDataset | str,
    path: str | os.PathLike[str] | None = None,
    *,
    root: str | os.PathLike[str] | None = None,
    download: bool = False,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Returns a kitchen dataset as TorchRL transitions with the 30-column state.

    Transitions ``[T]`` contain ``"observation"`` ``[30]`` (columns 0-8 and 18-38 of the
    59), ``"action"`` ``[9]``, the same under ``"next"`` with ``"reward"``, ``"done"``,
    ``"terminated"`` and ``"truncated"`` ``[1]``, ``"episode"`` ``[]`` int64, ``"task"``
    ``[]`` int64 and, if the episodes' infos have them, the simulator's exact
    ``("sim", "qpos")`` ``[30]`` and ``("sim", "qvel")`` ``[29]`` in float64. ``"task"``
    is the current task, an index in :data:`~torchrl_caiac.envs.KITCHEN_TASKS`: that of
    the step if the infos have a ``"task"``, else the one that the episode's metadata
    name, else -1. All other real numbers are float32. Goals are left out: they are
    drawn from later states.

    Args:
        dataset (MinariDataset or str): a Minari dataset of ``FrankaKitchen-v1``,
            ``D4RL/kitchen/*`` included, or its name.
        path (path, optional): folder for a memory-mapped result. Defaults to ``None``:
            in memory.

    Keyword Args:
        root (path, optional): folder of Minari datasets, for a name. Defaults to
            ``MINARI_DATASETS_PATH`` or Minari's own.
        download (bool): whether to fetch a missing dataset (for example
            ``"D4RL/kitchen/mixed-v2"``) with :func:`minari.download_dataset`. Defaults
            to ``False``.
        overwrite (bool): whether to replace what is at ``path``. Defaults to ``False``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.

    Returns:
        TensorDict: transitions of batch size ``[T]``.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is ``False``.
        FileNotFoundError: the dataset is not on this machine.
        ValueError: observations do not have 59 columns or actions not 9, an episode's
            arrays do not match or have values that are not finite, or there are no
            transitions.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.envs import create_kitchen_demonstrations
        >>> from torchrl_caiac.envs.kitchen import Demonstrations
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dataset, _ = create_kitchen_demonstrations(
        ...         demonstrations=[Demonstrations("kettle", episodes=1)],
        ...         root=folder, workers=1, progress=False,
        ...     )
        ...     data = kitchen_transitions(dataset, progress=False)
        >>> data["observation"].shape[1:], data["action"].shape[1:]
        (torch.Size([30]), torch.Size([9]))
    """
    check_free(path, overwrite)
    if isinstance(dataset, str):
        dataset = open_minari(dataset, root, download=download)
    episode_lengths(dataset)  # raises before an episode is read
    indices = dataset.episode_indices
    known = dataset.storage.get_episode_metadata(indices)
    tasks = torch.tensor(
        [task_number((meta.get("options") or {}).get("task")) for meta in known]
    )
    first = (dataset[indices[0]].infos or {}) if len(indices) else {}
    infos = [name for name in ("qpos", "qvel", "task") if name in first]
    with tempfile.TemporaryDirectory(prefix="kitchen-") as folder:
        loaded = load_minari(
            dataset,
            Path(folder) / "rows",
            infos=infos,
            progress=progress,
        )
        for name, width in (("observation", 59), ("action", 9)):
            if loaded[name].shape[1:] != (width,):
                raise ValueError(
                    f"the {name}s of {dataset.id} have shape "
                    f"{list(loaded[name].shape[1:])}, expected [{width}]: give a "
                    "dataset of FrankaKitchen-v1"
                )
        bounds = action_bounds(loaded)
        columns = list(STATE_COLUMNS)
        # In memory: the loaded files are deleted at the end of the block.
        rows = loaded.select("action", "episode").clone()
        rows["next"] = loaded["next"].exclude("achieved_goal", "desired_goal").clone()
        rows["observation"] = loaded["observation"][:, columns]
        rows["next", "observation"] = loaded["next", "observation"][:, columns]
        rows["task"] = tasks[rows["episode"]]
        for name in infos:
            key = "task" if name == "task" else ("sim", name)
            rows[key] = loaded["info", name].clone()
    if path is None:
        return rows
    return write_transitions(rows, path, overwrite=overwrite, action_bounds=bounds)
