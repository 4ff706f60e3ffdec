"""The Fetch-Push task: entities, distances to the goals, and reward."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.layouts.fetch import fetch_push_cubes

__all__ = [
    "CUBE_WIDTH",
    "DISTANCE_THRESHOLD",
    "GRIPPER_WIDTH",
    "fetch_push_distances",
    "fetch_push_layout",
    "fetch_push_reward",
]

#: Columns of the gripper, and of each cube, in the observation.
GRIPPER_WIDTH, CUBE_WIDTH = 10, 12
#: A cube that is closer to its goal than this has reached it, in metres.
DISTANCE_THRESHOLD = 0.05


def fetch_push_layout(num_cubes: int = 2) -> EntityLayout:
    """Returns the entities of the observation: the gripper (fixed) and the cubes.

    Args:
        num_cubes (int): the number of cubes ``n``. Defaults to 2.

    Returns:
        EntityLayout: a flat layout over ``10 + 12 n`` columns. The goal has three
        columns per cube, which mirror the position of the cube.

    Raises:
        ValueError: ``num_cubes`` is less than 1.

    Examples:
        >>> from torchrl_caiac.envs import fetch_push_layout
        >>> fetch_push_layout(2)
        EntityLayout(
            gripper: observation[0:10], fixed
            cube0: observation[10:22], goal[0:3] mirrors observation[10:13]
            cube1: observation[22:34], goal[3:6] mirrors observation[22:25]
        )
    """
    if num_cubes < 1:
        raise ValueError(f"num_cubes is {num_cubes}, expected at least 1")
    return fetch_push_cubes(num_cubes).layout()


def fetch_push_distances(achieved: Any, desired: Any) -> Any:
    """Returns the distance of each cube to its goal, in metres.

    Args:
        achieved (np.ndarray or torch.Tensor): positions of the cubes ``[*B, 3 n]``.
        desired (np.ndarray or torch.Tensor): goals of the cubes ``[*B, 3 n]``.

    Returns:
        np.ndarray or torch.Tensor: distances ``[*B, n]``; a tensor if one of the
        arguments is a tensor.

    Raises:
        ValueError: a shape is wrong, or the numbers of cubes differ.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs import fetch_push_distances
        >>> fetch_push_distances(np.zeros(6), np.array([0.0, 3, 4, 0, 0, 1]))
        array([5., 1.])
    """
    shapes = {"achieved": np.shape(achieved), "desired": np.shape(desired)}
    for name, shape in shapes.items():
        if not shape or shape[-1] == 0 or shape[-1] % 3:
            raise ValueError(
                f"{name} goal has shape {tuple(shape)}, expected [*B, 3 n]: the "
                "positions of n cubes"
            )
    if shapes["achieved"][-1] != shapes["desired"][-1]:
        raise ValueError(
            f"achieved and desired goals have shapes {tuple(shapes['achieved'])} and "
            f"{tuple(shapes['desired'])}, expected the same last dimension: use goals "
            "of environments with the same number of cubes"
        )
    if isinstance(achieved, torch.Tensor) or isinstance(desired, torch.Tensor):
        achieved = torch.as_tensor(achieved)
        difference = achieved - torch.as_tensor(desired, device=achieved.device)
        return (
            difference.unflatten(-1, (difference.shape[-1] // 3, 3))
            .square()
            .sum(-1)
            .sqrt()
        )
    difference = np.asarray(achieved) - np.asarray(desired)
    shape = (*difference.shape[:-1], difference.shape[-1] // 3, 3)
    return np.sqrt(np.square(difference.reshape(shape)).sum(-1))


def fetch_push_reward(
    achieved: Any,
    desired: Any,
    info: Any = None,
    *,
    threshold: float = DISTANCE_THRESHOLD,
) -> Any:
    """Returns the sparse reward: 0 if every cube is at its goal, else -1 (A.6.2).

    Args:
        achieved (np.ndarray or torch.Tensor): positions of the cubes ``[*B, 3 n]``.
        desired (np.ndarray or torch.Tensor): goals of the cubes ``[*B, 3 n]``.
        info (Any, optional): ignored; goal environments pass it.

    Keyword Args:
        threshold (float): a cube that is closer to its goal than this has reached it,
            in metres. Defaults to 0.05.

    Returns:
        np.ndarray or torch.Tensor: rewards ``[*B]``, float32.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.envs import fetch_push_reward
        >>> achieved = torch.zeros(2, 6)
        >>> fetch_push_reward(achieved, torch.tensor([0, 0, 0, 0, 0, 0.04]))
        tensor([0., 0.])
        >>> fetch_push_reward(achieved, torch.tensor([0, 0, 0, 0, 0, 0.06]))
        tensor([-1., -1.])
    """
    reached = (fetch_push_distances(achieved, desired) < threshold).all(-1)
    if isinstance(reached, torch.Tensor):
        return reached.to(torch.float32) - 1
    return np.asarray(reached).astype(np.float32) - np.float32(1)
