"""The Gaussian world model, for causal action influence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal

import torch
import torch.nn.functional as F
from tensordict.utils import NestedKey
from torch import nn
from torch.nn.utils import parametrizations

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules._variance_floor import VarianceFloor
from torchrl_caiac.modules.entity_dynamics_model import (
    EntityDynamicsModel,
    evaluating,
)
from torchrl_caiac.modules.linear import inference_linear, linear

__all__ = ["GaussianWorldModel", "gaussian_nll"]

_LOG_2PI = math.log(2 * math.pi)


def gaussian_nll(
    loc: torch.Tensor, var: torch.Tensor, target: torch.Tensor
) -> torch.Tensor:
    """Returns the negative log likelihood of diagonal Gaussians, mean over columns.

    Args:
        loc (torch.Tensor): the means, ``[*B, P]``.
        var (torch.Tensor): the variances, ``[*B, P]``.
        target (torch.Tensor): the targets, ``[*B, P]``.

    Returns:
        torch.Tensor: in nats per column, ``[*B]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.gaussian_world_model import gaussian_nll
        >>> gaussian_nll(torch.zeros(1, 2), torch.ones(1, 2), torch.zeros(1, 2))
        tensor([0.9189])
    """
    return 0.5 * (var.log() + (target - loc).square() / var + _LOG_2PI).mean(-1)


class GaussianWorldModel(EntityDynamicsModel):
    r"""The transition model ``p(s'_j | s, a)`` of the paper, section 3.2 and A.7.

    A multi-layer perceptron (ReLU, orthogonal weights, zero biases) reads the features
    of all ``N`` entities (``W`` numbers, :meth:`~torchrl_caiac.EntityLayout.read`), or
    the ``inputs`` among them, and the action (``A``), both normalised by a running mean
    and variance. Separate heads predict the mean and the variance of a diagonal
    Gaussian of ``P`` columns.

    The Gaussian describes the *normalised target*: by default the change of each
    column over the step, divided by its standard deviation in the data, or by the floor
    if that is larger. This makes learning easier. The scores do not change: causal
    action influence is a KL divergence, which is invariant under a fixed affine map of
    the target. The variance is ``softplus(·) + 1e-8`` plus the square of
    ``variance_floor``, at most ``max_variance`` (in normalised units). Without the
    floor, objects at rest get tiny variances, and the KL divergence amplifies a
    spurious dependence on the action.

    Args:
        layout (EntityLayout): the entities.
        action_dim (int): the size ``A`` of the action.
        hidden_sizes (sequence of int): the widths of the hidden layers. Defaults to
            ``(256, 256, 256)``.
        predict (Mapping of str to iterable of int, optional): the columns to predict
            of some entities, as in
            :class:`~torchrl_caiac.modules.EntityDynamicsModel`. Defaults to all
            columns.

    Keyword Args:
        widths (Mapping of str to int, optional): the number of features of each
            entity, ``layout.widths(td)``. Required for nested layouts only.
        action_key (NestedKey): the action. Defaults to ``"action"``.
        out_keys (pair of NestedKey): where mean and variance are written, both
            ``[*B, P]``. Defaults to ``("prediction", "loc")`` and
            ``("prediction", "var")``.
        target (str): ``"change"`` (next minus current state) or ``"absolute"`` (the
            next state, centred). Defaults to ``"change"``.
        variance_floor (float, Mapping or "auto", optional): the smallest standard
            deviation, in the units of the data, of the data and of a prediction. One
            number, or for each entity one number or one for each predicted column.
            ``"auto"`` takes it from the noise of entities at rest, see
            :meth:`~torchrl_caiac.modules.EntityDynamicsModel.fit_variance_floor`.
            Defaults to that of the layout, or to ``1e-3`` (1 mm, 1 mrad) if it has
            none.
        spectral_norm (bool): whether to normalise the hidden layers spectrally.
            Defaults to ``False``.
        max_variance (float): the largest variance, in normalised units. Defaults to
            ``200.0``.
        inputs (Mapping of str to iterable of int, optional): the columns of some
            entities that the model reads, as in
            :class:`~torchrl_caiac.modules.EntityDynamicsModel`. Defaults to all
            columns; see :func:`~torchrl_caiac.influence.default_world_model`.

    Attributes:
        predicted (dict of str to slice): the position of each predicted entity in
            ``P``.

    Raises:
        ValueError: an argument does not fit the layout.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
        >>> layout = EntityLayout({"arm": [0, 1], "cup": [2, 3, 4]})
        >>> model = GaussianWorldModel(layout, 2, (16, 16), predict={"cup": [2, 3]})
        >>> model.predicted
        {'arm': slice(0, 2, None), 'cup': slice(2, 4, None)}
        >>> observation = torch.randn(8, 5)
        >>> td = TensorDict(
        ...     {
        ...         "observation": observation,
        ...         "action": torch.randn(8, 2),
        ...         "next": {"observation": observation + 0.1 * torch.randn(8, 5)},
        ...     },
        ...     [8],
        ... )
        >>> model.fit_statistics(td)
        >>> model(td)["prediction", "var"].shape
        torch.Size([8, 4])
    """

    def __init__(
        self,
        layout: EntityLayout,
        action_dim: int,
        hidden_sizes: Sequence[int] = (256, 256, 256),
        predict: Mapping[str, Iterable[int]] | None = None,
        *,
        widths: Mapping[str, int] | None = None,
        action_key: NestedKey = "action",
        out_keys: Sequence[NestedKey] = (("prediction", "loc"), ("prediction", "var")),
        target: Literal["change", "absolute"] = "change",
        variance_floor: VarianceFloor = None,
        spectral_norm: bool = False,
        max_variance: float = 200.0,
        inputs: Mapping[str, Iterable[int]] | None = None,
    ) -> None:
        hidden_sizes = tuple(hidden_sizes)
        if not hidden_sizes or any(
            not isinstance(size, int) or size < 1 for size in hidden_sizes
        ):
            raise ValueError(
                "hidden_sizes must have the width of at least one hidden layer, each "
                f"an int of at least 1, got {hidden_sizes!r}"
            )
        if not max_variance > 0:
            raise ValueError(f"max_variance must be positive, got {max_variance!r}")
        if len(tuple(out_keys)) != 2:
            raise ValueError(
                f"out_keys must be two keys, of mean and variance, got {out_keys!r}"
            )
        super().__init__(
            layout,
            action_dim,
            predict,
            widths=widths,
            action_key=action_key,
            out_keys=out_keys,
            target=target,
            variance_floor=variance_floor,
            inputs=inputs,
        )
        self.hidden_sizes = hidden_sizes
        self.spectral_norm = bool(spectral_norm)
        self.max_variance = float(max_variance)
        sizes = [self.input_dim + action_dim, *hidden_sizes]
        self.hidden = nn.ModuleList(
            _orthogonal(nn.Linear(n_in, n_out)) for n_in, n_out in pairwise(sizes)
        )
        if self.spectral_norm:
            for layer in self.hidden:
                parametrizations.spectral_norm(layer)
        self.loc_head = _orthogonal(nn.Linear(sizes[-1], self.predict_dim))
        self.var_head = _orthogonal(nn.Linear(sizes[-1], self.predict_dim))

    def forward_tensors(
        self, state: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Predicts the Gaussian of the normalised target from tensors.

        Batch dimensions broadcast: states ``[B, 1, W]`` and actions ``[1, K, A]`` give
        ``[B, K, P]``. The first layer multiplies each state once for all ``K`` actions.

        Args:
            state (torch.Tensor): the entities' features ``[*B, W]``.
            action (torch.Tensor): ``[*B, A]``.

        Returns:
            tuple of torch.Tensor: mean and variance, ``[*B, P]`` each.

        Raises:
            ValueError: a last dimension has the wrong size.
        """
        self._check_widths(state, action)
        dtype = self.loc_head.weight.dtype
        first: Any = self.hidden[0]
        weight = first.weight
        x = F.linear(
            self.read_inputs(state.to(dtype)), weight[:, : self.input_dim], first.bias
        ) + F.linear(self.action_norm(action.to(dtype)), weight[:, self.input_dim :])
        x = F.relu(x, inplace=True)
        later: Any = self.hidden[1:]
        for layer in later:
            x = linear(x, layer.weight, layer.bias, relu=True)
        raw = F.softplus(self.var_head(x))
        var = (raw + self._variance_floor().to(dtype)).clamp_max(self.max_variance)
        return self.loc_head(x), var

    @torch.no_grad()
    def for_actions(
        self, actions: torch.Tensor, *, rows: int = 1024
    ) -> Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
        """Returns a function that predicts the same actions in many states.

        The function agrees with :meth:`forward_tensors` on states ``[B, 1, W]`` and
        actions ``[1, K, A]`` in evaluation mode, up to rounding, and has no gradients.
        The actions' part of the first layer is computed once. Request a new function
        when the model has changed.

        Args:
            actions (torch.Tensor): the actions, ``[K, A]``.

        Keyword Args:
            rows (int): the number of pairs of a state and an action in one forward
                pass. Defaults to ``1024``: their activations stay in the cache of the
                processor.

        Returns:
            callable: maps states ``[B, W]`` to mean and variance, ``[B, K, P]`` each.

        Raises:
            ValueError: a last dimension has the wrong size.

        Examples:
            >>> import torch
            >>> from torchrl_caiac import EntityLayout
            >>> from torchrl_caiac.modules import GaussianWorldModel
            >>> layout = EntityLayout({"arm": [0, 1], "cup": [2, 3, 4]})
            >>> model = GaussianWorldModel(layout, action_dim=2, hidden_sizes=(16, 16))
            >>> predict = model.for_actions(torch.rand(7, 2))
            >>> loc, var = predict(torch.randn(100, 5))
            >>> loc.shape, var.shape
            (torch.Size([100, 7, 5]), torch.Size([100, 7, 5]))
        """
        with evaluating(self):
            dtype = self.loc_head.weight.dtype
            first: Any = self.hidden[0]
            of_state, of_action = first.weight.split(
                [self.input_dim, self.action_dim], -1
            )
            by_action = F.linear(
                self.action_norm(actions.to(dtype)), of_action, first.bias
            )
            later: Any = self.hidden[1:]
            hidden = [
                inference_linear(layer.weight, layer.bias, True, rows)
                for layer in later
            ]
            heads = inference_linear(
                torch.cat([self.loc_head.weight, self.var_head.weight]),
                torch.cat([self.loc_head.bias, self.var_head.bias]),
                False,
                rows,
            )
            shift, gain = self.state_norm.shift, self.state_norm.gain
            floor = self._variance_floor().to(dtype)
        num_actions = len(actions)
        states_at_once = max(1, rows // num_actions)

        @torch.no_grad()
        def predict(state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            if state.shape[-1] != self.state_dim:
                raise ValueError(
                    f"expected states [B, {self.state_dim}], got {list(state.shape)}"
                )
            state = (self.select_inputs(state).to(dtype) - shift) * gain
            size = (len(state), num_actions, 2 * self.predict_dim)
            out = state.new_empty(size)
            for own_out, own in zip(
                out.split(states_at_once), state.split(states_at_once), strict=True
            ):
                by_state = F.linear(own, of_state)[:, None]
                for part, action in zip(
                    own_out.split(rows, 1), by_action.split(rows), strict=True
                ):
                    x = (by_state + action).relu_()
                    for layer in hidden:
                        x = layer(x)
                    part.copy_(heads(x))
            loc, raw = out.split(self.predict_dim, -1)
            var = _softplus(raw).add_(floor).clamp_max_(self.max_variance)
            return loc, var

        return predict

    def _variance_floor(self) -> torch.Tensor:
        if not self.has_floor:
            raise RuntimeError(
                "the variance floor is not known: call model.fit_statistics(data), or "
                "fit_world_model(model, data), first"
            )
        return (self.floor / self.target_scale).square() + 1e-8

    def nll(
        self, prediction: tuple[torch.Tensor, ...], target: torch.Tensor
    ) -> torch.Tensor:
        """Returns the negative log likelihood of targets, see :func:`gaussian_nll`.

        Args:
            prediction (tuple of torch.Tensor): mean and variance, ``[*B, P]``.
            target (torch.Tensor): normalised targets ``[*B, P]``.

        Returns:
            torch.Tensor: in nats per column, ``[*B]``.
        """
        loc, var = prediction
        return gaussian_nll(loc, var, target)

    def constant_prediction(
        self, mean: torch.Tensor, var: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Returns the Gaussian of all targets, with the variance floor.

        Args:
            mean (torch.Tensor): the mean of the normalised targets, ``[P]``.
            var (torch.Tensor): their variance, ``[P]``.

        Returns:
            tuple of torch.Tensor: mean and variance, ``[P]`` each.
        """
        floor = self._variance_floor().to(var.dtype)
        return mean, torch.maximum(var, floor).clamp_max(self.max_variance)

    @property
    def config(self) -> dict[str, Any]:
        """The class of the model and its arguments, JSON-compatible."""
        return {
            **super().config,
            "hidden_sizes": list(self.hidden_sizes),
            "spectral_norm": self.spectral_norm,
            "max_variance": self.max_variance,
        }


def _orthogonal(layer: nn.Linear) -> nn.Linear:
    nn.init.orthogonal_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def _softplus(x: torch.Tensor) -> torch.Tensor:
    """Computes ``F.softplus``, whose ``log1p`` is not vectorised on CPUs."""
    y = x.abs().neg_().exp_()
    one_and_y = 1 + y
    lost = (y - (one_and_y - 1)).div_(one_and_y)  # by rounding
    return one_and_y.log_().add_(lost).add_(x.relu())
