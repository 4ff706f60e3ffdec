"""Goal-conditioned policies, action values and state values."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from functools import cache

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import nn
from torchrl.modules import MLP

from torchrl_caiac._checks import check_int
from torchrl_caiac._keys import as_key
from torchrl_caiac.modules.goal_features import GoalFeatures, read_leaves
from torchrl_caiac.modules.linear import linear

__all__ = ["GoalConditionedActor", "GoalConditionedCritic", "GoalConditionedValue"]


_DTYPES = torch.float32, torch.bfloat16, torch.float16, torch.float64


class _CastLinear(nn.Linear):
    """A linear layer that computes in one dtype and keeps its weights in another.

    It is ``torch.autocast`` for single layers.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        bias: bool = True,
        device: torch.device | None = None,
        compute_dtype: torch.dtype | None = None,
        relu: bool = False,
        layer_norm: bool = False,
    ) -> None:
        super().__init__(in_features, out_features, bias=bias, device=device)
        self.compute_dtype = compute_dtype
        self.relu = relu
        self.layer_norm = layer_norm

    def forward(
        self,
        value: torch.Tensor,
        weight: torch.Tensor | None = None,
        bias: torch.Tensor | None = None,
    ) -> torch.Tensor:
        weight = self.weight if weight is None else weight
        bias = self.bias if bias is None else bias
        dtype = self.compute_dtype or weight.dtype
        if dtype is torch.bfloat16 and _on_cpu(value):
            _warn_without_bfloat16()
        value, weight, bias = (x.to(dtype) for x in (value, weight, bias))
        if weight.ndim == 2:
            if not self.layer_norm:
                return linear(value, weight, bias, self.relu)
            out = linear(value, weight, bias)
        else:
            rows = value.reshape(len(weight), -1, value.shape[-1])
            out = torch.baddbmm(bias.unsqueeze(-2), rows, weight.mT)
            out = out.reshape(*value.shape[:-1], -1)
        if self.layer_norm:
            out = nn.functional.layer_norm(out, out.shape[-1:])
        return out.relu() if self.relu else out

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, compute_dtype={self.compute_dtype}"


class _MLP(MLP):
    """An MLP that can be called with external parameters.

    Swapping parameters in and out of the modules would take a fifth of a training step.
    Stacked parameters of ``C`` networks map ``[C, *B, I]`` to ``[C, *B, O]``.
    """

    def forward(
        self, value: torch.Tensor, params: TensorDictBase | None = None
    ) -> torch.Tensor:
        layers: list[tuple[_CastLinear, list[torch.Tensor]]] = [
            (
                layer,
                []
                if params is None
                else [params.get((name, key)) for key in ("weight", "bias")],
            )
            for name, layer in self.named_children()
            if isinstance(layer, _CastLinear)
        ]
        if params is None or not params.batch_dims or not _on_cpu(value):
            for layer, own in layers:
                value = layer(value, *own)
            return value
        # Batched products are no faster on a CPU, and slower in float32.
        values = list(value.unbind(0))
        for layer, own in layers:
            # Cast before they are unbound: gradients are stacked in the smaller dtype.
            cast = [x.to(layer.compute_dtype or x.dtype).unbind(0) for x in own]
            values = [layer(*one) for one in zip(values, *cast, strict=True)]
        return torch.stack(values)


def _on_cpu(value: torch.Tensor) -> bool:
    return value.device.type == "cpu"


@cache
def _warn_without_bfloat16() -> None:
    """Warns once that bfloat16 is slow on this processor."""
    capabilities = torch.cpu.get_capabilities()
    if not any(known for name, known in capabilities.items() if "bf16" in name):
        warnings.warn(
            "hidden layers in bfloat16 are slower than in float32 here: this processor "
            f"({capabilities.get('cpu_name', 'unknown')}) has no bfloat16 units, and "
            "torch emulates them. Use hidden_dtype=None",
            RuntimeWarning,
            stacklevel=2,
        )


def _mlp(
    in_features: int,
    out_features: int,
    hidden_sizes: Sequence[int],
    hidden_dtype: torch.dtype | None,
    layer_norm: bool = False,
) -> _MLP:
    is_text = isinstance(hidden_sizes, (str, bytes, bytearray))
    is_sequence = isinstance(hidden_sizes, Sequence) and not is_text
    sizes = list(hidden_sizes) if is_sequence else []
    if not sizes or any(type(size) is not int or size < 1 for size in sizes):
        raise ValueError(
            "hidden_sizes must be a sequence of the widths of at least one hidden "
            f"layer, each an int of at least 1, got {hidden_sizes!r}"
        )
    if hidden_dtype not in (None, *_DTYPES):
        raise ValueError(
            f"hidden_dtype must be None or one of {list(_DTYPES)}, got {hidden_dtype!r}"
        )
    hidden = {"compute_dtype": hidden_dtype, "relu": True, "layer_norm": layer_norm}
    return _MLP(
        in_features,
        out_features,
        num_cells=sizes,
        activation_class=nn.Identity,  # the layers apply ReLU themselves
        layer_class=_CastLinear,
        # The last layer computes values and actions, in the dtype of the weights.
        layer_kwargs=[*[hidden] * len(sizes), {}],
    )


def _copied(features: GoalFeatures) -> GoalFeatures:
    if not isinstance(features, GoalFeatures):
        raise TypeError(
            f"features must be GoalFeatures(layout), got {type(features).__name__}"
        )
    return copy.deepcopy(features)


def _low_and_span(
    low: float | torch.Tensor, high: float | torch.Tensor, size: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the smallest action and the width of its range, each ``[size]``."""
    try:  # on the CPU, since a value of a meta device cannot be compared
        least, most = (
            torch.as_tensor(x, dtype=torch.float32, device="cpu")
            .expand(size)
            .detach()
            .clone()
            for x in (low, high)
        )
    except (TypeError, ValueError, OverflowError, RuntimeError):
        least = most = torch.zeros(size, device="cpu")
    span = most - least
    if not ((span > 0) & span.isfinite()).all():
        raise ValueError(
            "low and high must be finite numbers or tensors of shape "
            f"[{size}], low below high; got {low!r} and {high!r}"
        )
    device = torch.get_default_device()
    return least.to(device), span.to(device)


class GoalConditionedActor(TensorDictModuleBase):
    """A deterministic policy ``π(s, g)``: features, a ReLU network, tanh.

    Args:
        features (GoalFeatures): the input of the network. It is copied: fit its
            statistics first.
        action_dim (int): the size ``A`` of the action.
        hidden_sizes (sequence of int): the widths of the hidden layers. Defaults to
            three layers of 256 (paper, A.5.2).

    Keyword Args:
        low (float or torch.Tensor): the smallest action, a number or ``[A]``. Defaults
            to ``-1.0``.
        high (float or torch.Tensor): the largest action, a number or ``[A]``. Defaults
            to ``1.0``.
        hidden_dtype (torch.dtype, optional): the dtype in which hidden layers compute.
            Weights, gradients and the last layer keep theirs. ``torch.bfloat16`` takes
            less time on some processors and more on others; it is measured by
            :func:`~torchrl_caiac.modules.faster_dtype`. It rounds the features
            to two or three digits, so fit their statistics: a raw position of 1 m would
            be off by up to 4 mm. Defaults to ``None``: the dtype of the weights.
        action_key (NestedKey): where the action is written, ``[*B, A]``. Defaults to
            ``"action"``.

    Raises:
        TypeError: ``features`` are not goal features.
        ValueError: a size is not a positive int, a dtype not one of float16, bfloat16,
            float32 and float64, or ``low`` and ``high`` are not finite bounds.

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
        check_int("action_dim", action_dim, 1)
        self.features = _copied(features)
        self.network = _mlp(features.width, action_dim, hidden_sizes, hidden_dtype)
        low, span = _low_and_span(low, high, action_dim)
        self.register_buffer("low", low)
        self.register_buffer("span", span)
        self.in_keys = list(features.in_keys)
        self.out_keys = [as_key(action_key)]

    @dispatch
    def forward(
        self, tensordict: TensorDictBase, params: TensorDictBase | None = None
    ) -> TensorDictBase:
        """Writes the action.

        Args:
            tensordict (TensorDictBase): states ``[*B, D]`` and goals ``[*B, G]``.
            params (TensorDictBase, optional): parameters and buffers to use instead
                of the module's own, such as those of a loss. Defaults to the module's
                own.

        Returns:
            TensorDictBase: the same tensordict, with the action ``[*B, A]``.

        Raises:
            KeyError: an input is missing.
            ValueError: the state or the goal has the wrong width.
        """
        observation, goal = read_leaves(tensordict, self.in_keys)
        low, span, of_features, of_network = (
            (self.low, self.span, None, None)
            if params is None
            else (params.get(key) for key in ("low", "span", "features", "network"))
        )
        features = self.features.forward_tensors(observation, goal, of_features)
        value = self.network(features, of_network)
        return tensordict.set(self.out_keys[0], low + span * (0.5 * value.tanh() + 0.5))


class GoalConditionedCritic(TensorDictModuleBase):
    """An action value ``Q(s, g, a)``: features and action, then a ReLU network.

    Args:
        features (GoalFeatures): the input of the network in addition to the action. It
            is copied: fit its statistics first.
        action_dim (int): the size ``A`` of the action.
        hidden_sizes (sequence of int): the widths of the hidden layers. Defaults to
            three layers of 256 (paper, A.5.2).

    Keyword Args:
        hidden_dtype (torch.dtype, optional): as in :class:`GoalConditionedActor`.
        layer_norm (bool): whether each hidden layer is normalised over its units,
            before its ReLU and without weights of its own. Values of actions that the
            data lack then stay bounded, which offline learning needs (Ball et al.
            2023). Defaults to ``False``.
        action_key (NestedKey): the action, ``[*B, A]``. Defaults to ``"action"``.
        out_key (NestedKey): where the value is written, ``[*B, 1]``. Defaults to
            ``"state_action_value"``.

    Raises:
        TypeError: ``features`` are not goal features.
        ValueError: a size or a dtype is wrong, as in :class:`GoalConditionedActor`.

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
        layer_norm: bool = False,
        action_key: NestedKey = "action",
        out_key: NestedKey = "state_action_value",
    ) -> None:
        super().__init__()
        check_int("action_dim", action_dim, 1)
        # A loss stacks the buffers of its critics. Shared ones would become views of
        # one memory, to which load_state_dict cannot write.
        self.features = _copied(features)
        self.network = _mlp(
            features.width + action_dim, 1, hidden_sizes, hidden_dtype, layer_norm
        )
        self.in_keys = [*features.in_keys, as_key(action_key)]
        self.out_keys = [as_key(out_key)]

    @dispatch
    def forward(
        self, tensordict: TensorDictBase, params: TensorDictBase | None = None
    ) -> TensorDictBase:
        """Writes the value.

        Args:
            tensordict (TensorDictBase): states ``[*B, D]``, goals ``[*B, G]`` and
                actions ``[*B, A]``.
            params (TensorDictBase, optional): parameters and buffers to use instead
                of the module's own, such as those of ``C`` critics, stacked by a loss;
                ``*B`` then begins with ``C``, or with 1 for one input of all. Defaults
                to the module's own.

        Returns:
            TensorDictBase: the same tensordict, with the value ``[*B, 1]``; for one
            input of all, the same expanded to ``C``.

        Raises:
            KeyError: an input is missing.
            ValueError: the state or the goal has the wrong width.
        """
        observation, goal, action = read_leaves(tensordict, self.in_keys)
        of_features, of_network = (
            None if params is None else params.get(name)
            for name in ("features", "network")
        )
        features = self.features.forward_tensors(observation, goal, of_features)
        action = action.to(features.dtype)
        count = len(params) if params is not None and params.batch_dims else 1
        if count > 1 and tensordict.batch_size[:1] == (1,):  # one input for all
            tensordict = tensordict.expand(count, *tensordict.batch_size[1:])
            features, action = (
                x.expand(count, *x.shape[1:]) for x in (features, action)
            )
        value = self.network(torch.cat([features, action], -1), of_network)
        return tensordict.set(self.out_keys[0], value)


class GoalConditionedValue(TensorDictModuleBase):
    """A state value ``V(s, g)``: features, then a ReLU network.

    For losses such as TorchRL's :class:`~torchrl.objectives.IQLLoss`.

    Args:
        features (GoalFeatures): the input of the network. It is copied: fit its
            statistics first.
        hidden_sizes (sequence of int): the widths of the hidden layers. Defaults to
            three layers of 256.

    Keyword Args:
        hidden_dtype (torch.dtype, optional): as in :class:`GoalConditionedActor`.
        layer_norm (bool): as in :class:`GoalConditionedCritic`. Defaults to ``False``.
        out_key (NestedKey): where the value is written, ``[*B, 1]``. Defaults to
            ``"state_value"``.

    Raises:
        TypeError: ``features`` are not goal features.
        ValueError: a size or a dtype is wrong, as in :class:`GoalConditionedActor`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules import GoalConditionedValue, GoalFeatures
        >>> layout = EntityLayout(
        ...     {"cube": [0, 1]}, goal={"cube": [0]}, achieved={"cube": [0]}
        ... )
        >>> value = GoalConditionedValue(GoalFeatures(layout), (16, 16))
        >>> td = TensorDict(
        ...     {"observation": torch.randn(5, 2), "desired_goal": torch.randn(5, 1)},
        ...     [5],
        ... )
        >>> value(td)["state_value"].shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        features: GoalFeatures,
        hidden_sizes: Sequence[int] = (256, 256, 256),
        *,
        hidden_dtype: torch.dtype | None = None,
        layer_norm: bool = False,
        out_key: NestedKey = "state_value",
    ) -> None:
        super().__init__()
        self.features = _copied(features)
        self.network = _mlp(features.width, 1, hidden_sizes, hidden_dtype, layer_norm)
        self.in_keys = list(features.in_keys)
        self.out_keys = [as_key(out_key)]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the value.

        Args:
            tensordict (TensorDictBase): states ``[*B, D]`` and goals ``[*B, G]``.

        Returns:
            TensorDictBase: the same tensordict, with the value ``[*B, 1]``.

        Raises:
            KeyError: an input is missing.
            ValueError: the state or the goal has the wrong width.
        """
        observation, goal = read_leaves(tensordict, self.in_keys)
        features = self.features.forward_tensors(observation, goal)
        return tensordict.set(self.out_keys[0], self.network(features))


def takes_params(network: nn.Module) -> bool:
    """Returns whether a network can be called with external parameters.

    Args:
        network (torch.nn.Module): a policy or an action value.

    Returns:
        bool: ``True`` for the networks of this module, ``False`` for subclasses with a
        ``forward`` of their own and for other networks.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.goal_networks import takes_params
        >>> takes_params(torch.nn.Linear(1, 1))
        False
    """
    forward = type(network).forward
    return forward in (GoalConditionedActor.forward, GoalConditionedCritic.forward)
