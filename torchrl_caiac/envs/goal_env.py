"""Gymnasium environments of this package as TorchRL environments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torchrl.data import TensorSpec
    from torchrl.envs import EnvBase

__all__ = ["make_goal_env"]


def make_goal_env(
    env_id: str, info: Mapping[str, TensorSpec], *, device: Any = "cpu", **kwargs: Any
) -> EnvBase:
    """Creates a registered environment and reads entries of its info.

    Args:
        env_id (str): gymnasium's name of the environment.
        info (Mapping of str to TensorSpec): the entries of its info to read, with
            their specs.

    Keyword Args:
        device (torch.device or str): device of the tensors. Defaults to ``"cpu"``.
        **kwargs (Any): passed to the environment.

    Returns:
        TransformedEnv: the environment, with ``"is_init"``.

    Examples:
        >>> import torch
        >>> from torchrl.data import Binary
        >>> import torchrl_caiac.envs  # registers
        >>> success = Binary(1, dtype=torch.bool)
        >>> env = make_goal_env(
        ...     "torchrl_caiac/FetchPushCubes-v0", {"success": success}
        ... )
        >>> env.rollout(2)["next", "success"].shape
        torch.Size([2, 1])
    """
    from torchrl.data import Composite
    from torchrl.envs import (
        GymEnv,
        InitTracker,
        TransformedEnv,
        default_info_dict_reader,
    )

    spec = Composite(dict(info), device=device)
    keys = list(info)

    class Reader(default_info_dict_reader):
        def __call__(
            self, info_dict: dict[str, Any], tensordict: TensorDictBase
        ) -> TensorDictBase:
            # TorchRL's flags are [*B, 1], gymnasium's are scalars.
            shaped = {key: np.reshape(info_dict[key], spec[key].shape) for key in keys}
            return super().__call__(shaped, tensordict)

    env = GymEnv(env_id, device=device, disable_env_checker=True, **kwargs)
    env.set_info_dict_reader(Reader(keys, spec=spec))
    return TransformedEnv(env, InitTracker())
