"""The Franka-Kitchen as a registered gymnasium and as a TorchRL environment."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import gymnasium
import torch

from torchrl_caiac.envs.goal_env import make_goal_env
from torchrl_caiac.envs.kitchen.tasks import KITCHEN_TASKS

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

__all__ = ["KITCHEN_ENV_ID", "make_kitchen_env", "register_kitchen"]

#: The gymnasium id of :class:`~torchrl_caiac.envs.KitchenEnv`.
KITCHEN_ENV_ID = "torchrl_caiac/FrankaKitchen-v0"


def register_kitchen() -> None:
    """Registers the kitchen with gymnasium as :data:`KITCHEN_ENV_ID`.

    Importing ``torchrl_caiac.envs`` does this; another call changes nothing. A worker
    process started by ``spawn`` registers through the import too, or through
    ``gymnasium.make("torchrl_caiac.envs:torchrl_caiac/FrankaKitchen-v0")``.

    Examples:
        >>> import gymnasium
        >>> register_kitchen()
        >>> KITCHEN_ENV_ID in gymnasium.registry
        True
    """
    if KITCHEN_ENV_ID not in gymnasium.registry:
        gymnasium.register(
            id=KITCHEN_ENV_ID, entry_point="torchrl_caiac.envs.kitchen:KitchenEnv"
        )


def make_kitchen_env(
    task: str | None = "microwave", *, device: Any = "cpu", **kwargs: Any
) -> EnvBase:
    """Creates the kitchen as a TorchRL environment.

    Args:
        task (str, optional): one of :data:`KITCHEN_TASKS`, or ``None`` to draw one in
            each episode. Defaults to ``"microwave"``.

    Keyword Args:
        device (torch.device or str): device of the tensors. Defaults to ``"cpu"``.
        **kwargs (Any): passed to :class:`~torchrl_caiac.envs.KitchenEnv`.

    Returns:
        TransformedEnv: its tensordicts contain ``"observation"``, ``"achieved_goal"``,
        ``"desired_goal"``, ``"is_init"`` and, from ``info``, ``"success"``,
        ``"task_success"`` (bool ``[1]``), ``"wrong_tasks"`` (bool ``[7]``) and
        ``"task"`` (int64 ``[1]``). ``env.reset(options={...})`` takes the options of
        :meth:`~torchrl_caiac.envs.KitchenEnv.reset`.

    Examples:
        >>> env = make_kitchen_env("kettle")
        >>> rollout = env.rollout(3)
        >>> rollout["next", "success"].shape
        torch.Size([3, 1])
        >>> rollout["is_init"].flatten().tolist()
        [True, False, False]
    """
    from torchrl.data import Binary, Unbounded

    register_kitchen()
    flag = functools.partial(Binary, dtype=torch.bool, device=device)
    info = {
        "success": flag(1),
        "task_success": flag(1),
        "wrong_tasks": flag(len(KITCHEN_TASKS)),
        "task": Unbounded((1,), dtype=torch.int64, device=device),
    }
    return make_goal_env(KITCHEN_ENV_ID, info, task=task, device=device, **kwargs)


register_kitchen()
