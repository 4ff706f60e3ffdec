"""Rewards of goals in OGBench's environments with cubes."""

from __future__ import annotations

import torch

__all__ = ["ogbench_cube_reward"]

_SCALE = 10.0  # of positions in observations
_TOLERANCE = 0.04  # metres, of OGBench's success


def ogbench_cube_reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    """Returns 0 where all cubes are within 4 cm of their goals, else -1.

    This is OGBench's success in ``cube-single`` to ``cube-quadruple``.

    Args:
        achieved (torch.Tensor): the positions of the cubes as the layouts' goals have
            them, ``[*B, 3 n]``, in 10 x m.
        desired (torch.Tensor): those of their goals, the same shape.

    Returns:
        torch.Tensor: ``[*B]``, in the type of ``achieved``.

    Raises:
        ValueError: the shapes differ, or are not those of positions.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.envs.ogbench import ogbench_cube_reward
        >>> achieved = torch.tensor([[0.0, 0.0, 0.2], [0.0, 0.5, 0.2]])
        >>> ogbench_cube_reward(achieved, torch.tensor([[0.3, 0.0, 0.2]]).expand(2, 3))
        tensor([ 0., -1.])
    """
    width = achieved.shape[-1] if achieved.ndim else 0
    if achieved.shape != desired.shape or not width or width % 3:
        raise ValueError(
            f"achieved has shape {list(achieved.shape)} and desired "
            f"{list(desired.shape)}, expected [*B, 3 n] of both: three positions of "
            "each cube"
        )
    offset = (achieved - desired).unflatten(-1, (-1, 3))
    reached = (offset.norm(dim=-1) <= _SCALE * _TOLERANCE).all(-1)
    return reached.to(achieved.dtype) - 1.0
