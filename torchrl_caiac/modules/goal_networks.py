"""Goal-conditioned policies and action values for TD3."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.modules import MLP

from torchrl_caiac.modules.goal_features import GoalFeatures, read

__all__ = ["GoalConditionedActor", "GoalConditionedCritic"]


class _CastLinear(nn.Linear):
    """A linear layer that computes in one dtype and keeps its weights in another.

    What ``torch.autocast`` does, but for chosen layers.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        bias: bool = True,
        device: torch.device | None = None,
        compute_dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__(in_features, out_features, bias=bias, device=device)
        self.compute_dtype = compute_dtype

    def forward(self, value: torch.Tensor) -> torch.Tensor:
        dtype = self.compute_dtype or self.weight.dtype
        return F.linear(value.to(dtype), self.weight.to(dtype), self.bias.to(dtype))

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, compute_dtype={self.compute_dtype}"


def _mlp(
    in_features: int,
    out_features: int,
    hidden_sizes: Sequence[int],
    hidden_dtype: torch.dtype | None,
) -> MLP:
    hidden_sizes = list(hidden_sizes)
    if not hidden_sizes or any(
        not isinstance(size, int) or size < 1 for size in hidden_sizes
    ):
        raise ValueError(
            "hidden_sizes names the width of at least one hidden layer, each an int of "
            f"at least 1, got {hidden_sizes!r}"
        )
    if hidden_dtype is not None and not hidden_dtype.is_floating_point:
        raise ValueError(f"hidden_dtype is a floating point dtype, got {hidden_dtype}")
    # The last layer gives values and actions and keeps the dtype of the weights.
    dtypes = [*[hidden_dtype] * len(hidden_sizes), None]
    return MLP(
        in_features,
        out_features,
        num_cells=hidden_sizes,
        activation_class=nn.ReLU,
        layer_class=_CastLinear,
        layer_kwargs=[{"compute_dtype": dtype} for dtype in dtypes],
    )


class GoalConditionedActor(TensorDictModuleBase):
    """A deterministic policy ``π(s, g)``: features, a ReLU network, tanh.

    Args:
        features (GoalFeatures): what the network reads. It is copied: fit its
            statistics first.
        action_dim (int): the size ``A`` of the action.
        hidden_sizes (sequence of int): the widths of the hidden layers. Defaults to
            three layers of 256 (paper, A.5.2).

    Keyword Args:
        low (float or torch.Tensor): the smallest action, a number or ``[A]``. Defaults
            to -1.
        high (float or torch.Tensor): the largest action. Defaults to 1.
        hidden_dtype (torch.dtype, optional): compute the hidden layers in this dtype
            and keep the weights, their gradients and the last layer as they are.
            ``torch.bfloat16`` halves the time of a step on CPUs that multiply it
            natively. It rounds the features to two or three digits, so fit their
            statistics: a raw position of a metre would be off by up to 4 mm.
            ``None``, the default, computes all in the dtype of the weights.
        action_key (NestedKey): where the action is written, ``[*B, A]``. Defaults to
            ``"action"``.

    Raises:
        ValueError: a size is no positive int, or ``low`` is not below ``high``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules import GoalConditionedActor, GoalFeatures
        >>> layout = EntityLayout(
        ...     {"cube": [0, 1]}, goal={"cube": [0]}, achieved={"cube": [0]}
        ... )
        >>> actor = GoalConditionedActor(GoalFeatures(layout), 2, (16, 16))
        >>> td = TensorDict(
        ...     {"observation": torch.randn(5, 2), "desired_goal": torch.randn(5, 1)},
        ...     [5],
        ... )
        >>> actor(td)["action"].shape
        torch.Size([5, 2])
    """

    low: torch.Tensor
    span: torch.Tensor

    def __init__(
        self,
        features: GoalFeatures,
        action_dim: int,
        hidden_sizes: Sequence[int] = (256, 256, 256),
        *,
        low: float | torch.Tensor = -1.0,
        high: float | torch.Tensor = 1.0,
        hidden_dtype: torch.dtype | None = None,
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__()
        _check_action_dim(action_dim)
        low, high = (torch.as_tensor(x).float().expand(action_dim) for x in (low, high))
        if not (low < high).all():
            raise ValueError(f"low must be below high, got {low} and {high}")
        self.features = copy.deepcopy(features)
        self.network = _mlp(features.width, action_dim, hidden_sizes, hidden_dtype)
        self.register_buffer("low", low.clone())
        self.register_buffer("span", high - low)
        self.in_keys = list(features.in_keys)
        self.out_keys = [unravel_key(action_key)]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action.

        Args:
            tensordict (TensorDictBase): states ``[*B, D]`` and goals ``[*B, G]``.

        Returns:
            TensorDictBase: the same, with the action ``[*B, A]`` set.

        Raises:
            KeyError: an input is missing.
            ValueError: the state or the goal has the wrong width.
        """
        value = self.network(
            self.features.forward_tensors(*read(tensordict, self.in_keys))
        )
        return tensordict.set(
            self.out_keys[0], self.low + self.span * (0.5 * value.tanh() + 0.5)
        )


class GoalConditionedCritic(TensorDictModuleBase):
    """An action value ``Q(s, g, a)``: features and action, then a ReLU network.

    Args:
        features (GoalFeatures): what the network reads besides the action. It is
            copied: fit its statistics first.
        action_dim (int): the size ``A`` of the action.
        hidden_sizes (sequence of int): the widths of the hidden layers. Defaults to
            three layers of 256 (paper, A.5.2).

    Keyword Args:
        hidden_dtype (torch.dtype, optional): as in :class:`GoalConditionedActor`.
        action_key (NestedKey): the action, ``[*B, A]``. Defaults to ``"action"``.
        out_key (NestedKey): where the value is written, ``[*B, 1]``. Defaults to
            ``"state_action_value"``.

    Raises:
        ValueError: a size is no positive int.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules import GoalConditionedCritic, GoalFeatures
        >>> layout = EntityLayout(
        ...     {"cube": [0, 1]}, goal={"cube": [0]}, achieved={"cube": [0]}
        ... )
        >>> critic = GoalConditionedCritic(GoalFeatures(layout), 2, (16, 16))
        >>> td = TensorDict(
        ...     {
        ...         "observation": torch.randn(5, 2),
        ...         "desired_goal": torch.randn(5, 1),
        ...         "action": torch.rand(5, 2),
        ...     },
        ...     [5],
        ... )
        >>> critic(td)["state_action_value"].shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        features: GoalFeatures,
        action_dim: int,
        hidden_sizes: Sequence[int] = (256, 256, 256),
        *,
        hidden_dtype: torch.dtype | None = None,
        action_key: NestedKey = "action",
        out_key: NestedKey = "state_action_value",
    ) -> None:
        super().__init__()
        _check_action_dim(action_dim)
        # A copy, also because a loss stacks the buffers of its critics: shared ones
        # would become views of one memory, which load_state_dict cannot write.
        self.features = copy.deepcopy(features)
        self.network = _mlp(features.width + action_dim, 1, hidden_sizes, hidden_dtype)
        self.in_keys = [*features.in_keys, unravel_key(action_key)]
        self.out_keys = [unravel_key(out_key)]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the value.

        Args:
            tensordict (TensorDictBase): states ``[*B, D]``, goals ``[*B, G]`` and
                actions ``[*B, A]``.

        Returns:
            TensorDictBase: the same, with the value ``[*B, 1]`` set.

        Raises:
            KeyError: an input is missing.
            ValueError: the state or the goal has the wrong width.
        """
        *state, action = read(tensordict, self.in_keys)
        features = self.features.forward_tensors(*state)
        value = self.network(features, action.to(features.dtype))
        return tensordict.set(self.out_keys[0], value)


def _check_action_dim(action_dim: int) -> None:
    if not isinstance(action_dim, int) or action_dim < 1:
        raise ValueError(
            "action_dim is the size of the action, an int of at least 1, got "
            f"{action_dim!r}"
        )
