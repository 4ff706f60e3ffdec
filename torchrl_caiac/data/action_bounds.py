"""The bounds of the action space, which are stored beside the transitions."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_caiac._files import UnreadableFileError, read_json, write_json
from torchrl_caiac._torchrl import memmap_folder

__all__ = ["action_bounds", "check_action_bounds", "write_action_bounds"]

_FILE = "action_space.json"


def action_bounds(
    source: str | os.PathLike[str] | TensorDictBase,
) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Returns the bounds of the actions of stored transitions.

    :func:`~torchrl_caiac.data.load_minari`,
    :func:`~torchrl_caiac.data.mix_trajectories` and
    :func:`~torchrl_caiac.data.write_transitions` store them in
    ``action_space.json``.

    Args:
        source (path or TensorDictBase): the folder of the transitions, or the opened
            transitions themselves.

    Returns:
        tuple of torch.Tensor, optional: the lowest and the highest action, float32
        ``[A]`` each, finite. ``None`` where no bounds are stored: the action space is
        unbounded or unknown, or the transitions have no folder.

    Raises:
        FileNotFoundError: the folder does not exist.
        UnreadableFileError: the file is damaged.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.data import action_bounds, write_transitions
        >>> data = TensorDict(
        ...     {
        ...         "action": torch.zeros(3, 2),
        ...         "episode": torch.zeros(3, dtype=torch.int64),
        ...         "next": {"done": torch.tensor([[False], [False], [True]])},
        ...     },
        ...     [3],
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     rows = write_transitions(
        ...         data, f"{folder}/data", action_bounds=([-1, -1], [1, 1])
        ...     )
        ...     action_bounds(rows)
        (tensor([-1., -1.]), tensor([1., 1.]))
    """
    if isinstance(source, TensorDictBase):
        folder = memmap_folder(source)
        if folder is None:
            return None
    else:
        folder = os.fspath(source)
        if not os.path.isdir(folder):
            raise FileNotFoundError(
                f"the folder {folder} does not exist: create the data first, for "
                "example with load_minari"
            )
    file = Path(folder) / _FILE
    if not file.exists():
        return None
    what = "description of an action space"
    remedy = "create the data again, or delete this file if the bounds are unknown"
    content = read_json(file, what, remedy)
    try:
        return check_action_bounds(content["low"], content["high"])
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise UnreadableFileError(
            f"{file} is not a readable {what} ({error!r}): {remedy}"
        ) from error


def write_action_bounds(
    folder: str | os.PathLike[str],
    low: torch.Tensor | Sequence[Any],
    high: torch.Tensor | Sequence[Any],
) -> None:
    """Stores the bounds of the actions in the folder of transitions.

    Args:
        folder (path): the folder.
        low (torch.Tensor or sequence of float): the lowest action, ``[A]``.
        high (torch.Tensor or sequence of float): the highest action, ``[A]``.

    Raises:
        ValueError: a bound is not finite, a lower one is above a higher one, or they
            have different shapes.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.data import action_bounds
        >>> from torchrl_caiac.data.action_bounds import write_action_bounds
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_action_bounds(folder, [0.0], [2.0])
        ...     action_bounds(folder)
        (tensor([0.]), tensor([2.]))
    """
    low, high = check_action_bounds(low, high)
    write_json(Path(folder) / _FILE, {"low": low.tolist(), "high": high.tolist()})


def check_action_bounds(low: Any, high: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Raises if numbers are not bounds of actions.

    Args:
        low (torch.Tensor or sequence of float): the lowest action, ``[A]``.
        high (torch.Tensor or sequence of float): the highest action, ``[A]``.

    Returns:
        tuple of torch.Tensor: both, float32 ``[A]``.

    Raises:
        ValueError: a bound is not finite, a lower one is above a higher one, or they
            have different shapes.

    Examples:
        >>> from torchrl_caiac.data.action_bounds import check_action_bounds
        >>> check_action_bounds([-1, -1], [1, 2])
        (tensor([-1., -1.]), tensor([1., 2.]))
    """
    low, high = (torch.as_tensor(x, dtype=torch.float32) for x in (low, high))
    if low.shape != high.shape or not low.ndim:
        raise ValueError(
            f"the lowest action has shape {list(low.shape)} and the highest "
            f"{list(high.shape)}, expected [A] for both"
        )
    # Written so that NaN fails too.
    if not (low.isfinite() & high.isfinite() & (low <= high)).all():
        raise ValueError(
            f"the lowest action {low.tolist()} and the highest {high.tolist()} must be "
            "finite, and none of the lowest above the highest"
        )
    return low, high
