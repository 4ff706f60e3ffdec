"""Fetch-Push as an environment of gymnasium and of TorchRL."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import gymnasium
import torch

from torchrl_caiac.envs.goal_env import make_goal_env

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

__all__ = ["FETCH_PUSH_ENV_ID", "make_fetch_push_env", "register_fetch_push"]

#: The name of :class:`~torchrl_caiac.envs.FetchPushCubes` in gymnasium.
FETCH_PUSH_ENV_ID = "torchrl_caiac/FetchPushCubes-v0"


def register_fetch_push() -> None:
    """Registers Fetch-Push with gymnasium as ``torchrl_caiac/FetchPushCubes-v0``.

    Importing ``torchrl_caiac.envs`` does this; a second call has no effect. A worker
    process started by ``spawn`` registers through the import too, or through
    ``gymnasium.make("torchrl_caiac.envs:torchrl_caiac/FetchPushCubes-v0")``.

    Examples:
        >>> import gymnasium
        >>> from torchrl_caiac.envs.fetch_push import FETCH_PUSH_ENV_ID
        >>> FETCH_PUSH_ENV_ID in gymnasium.registry
        True
    """
    if FETCH_PUSH_ENV_ID not in gymnasium.registry:
        gymnasium.register(
            id=FETCH_PUSH_ENV_ID,
            entry_point="torchrl_caiac.envs.fetch_push:FetchPushCubes",
        )


def make_fetch_push_env(
    num_cubes: int = 2, *, device: Any = "cpu", **kwargs: Any
) -> EnvBase:
    """Makes Fetch-Push as a TorchRL environment.

    Args:
        num_cubes (int): the number of cubes ``n``. Defaults to 2.

    Keyword Args:
        device (torch.device or str): the device of the tensors. Defaults to ``"cpu"``.
        **kwargs (Any): of :class:`~torchrl_caiac.envs.FetchPushCubes`.

    Returns:
        EnvBase: a ``TransformedEnv`` whose tensordicts contain ``"observation"``,
        ``"achieved_goal"``, ``"desired_goal"``, ``"is_init"`` and, from ``info``,
        ``"success"`` (bool ``[1]``) and ``"cube_success"`` (bool ``[n]``).
        ``env.reset(options={...})`` takes the options of ``FetchPushCubes.reset``.

    Examples:
        >>> from torchrl_caiac.envs import make_fetch_push_env
        >>> env = make_fetch_push_env(2)
        >>> rollout = env.rollout(3)
        >>> rollout["next", "success"].shape, rollout["observation"].shape
        (torch.Size([3, 1]), torch.Size([3, 34]))
    """
    from torchrl.data import Binary

    register_fetch_push()
    flag = functools.partial(Binary, dtype=torch.bool, device=device)
    info = {"success": flag(1), "cube_success": flag(num_cubes)}
    return make_goal_env(
        FETCH_PUSH_ENV_ID, info, num_cubes=num_cubes, device=device, **kwargs
    )


register_fetch_push()
