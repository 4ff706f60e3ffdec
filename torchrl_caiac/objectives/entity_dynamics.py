"""The loss of world models."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule

from torchrl_caiac._torchrl import reduce_loss
from torchrl_caiac.modules.entity_dynamics_model import (
    EntityDynamicsModel,
    evaluating,
)
from torchrl_caiac.modules.gaussian_world_model import gaussian_nll

__all__ = ["EntityDynamicsLoss", "gaussian_nll"]


class EntityDynamicsLoss(LossModule):
    """The negative log likelihood of the next state of every entity (paper, A.7).

    The targets are those of the model (normalised changes by default), so call
    ``model.fit_statistics(data)`` first, as :func:`~torchrl_caiac.fit.fit_world_model`
    does. The keys of the states are those of the model's layout.

    Args:
        model (EntityDynamicsModel): the model to fit. The likelihood of a
            :class:`~torchrl_caiac.modules.TransformerWorldModel` is that of a Gaussian
            of unit variance, up to a constant: half the squared error.

    Keyword Args:
        functional (bool): whether the loss keeps the parameters in a
            :class:`~tensordict.nn.TensorDictParams`, as TorchRL's losses do, or has the
            model as a submodule. Both are the model's own parameters. Defaults to
            ``True``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"`` over the transitions,
            except those under the ``loss_mask_key`` of
            :class:`~torchrl.objectives.LossModule`. Defaults to ``"mean"``.

    Returns:
        TensorDict: ``"loss_nll"``, in nats per predicted column, and ``"mse"``, the
        squared error of the normalised targets, detached.

    Raises:
        TypeError: the model is not a world model.
        ValueError: the reduction is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules import GaussianWorldModel
        >>> from torchrl_caiac.objectives import EntityDynamicsLoss
        >>> layout = EntityLayout({"arm": [0, 1], "cup": [2]})
        >>> td = TensorDict(
        ...     {
        ...         "observation": torch.randn(8, 3),
        ...         "action": torch.randn(8, 2),
        ...         "next": {"observation": torch.randn(8, 3)},
        ...     },
        ...     [8],
        ... )
        >>> model = GaussianWorldModel(layout, 2, (16,))
        >>> model.fit_statistics(td)
        >>> loss = EntityDynamicsLoss(model)
        >>> loss(td)["loss_nll"].backward()
        >>> sorted(loss.entity_mse(td).keys())
        ['arm', 'cup']
    """

    @dataclass
    class _AcceptedKeys:
        """The keys that :meth:`set_keys` accepts.

        Attributes:
            action (NestedKey): the action, ``[*B, A]``. Defaults to the model's.
        """

        action: NestedKey = "action"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys: ClassVar[list[NestedKey]] = ["loss_nll", "mse"]

    model: EntityDynamicsModel
    model_params: TensorDictParams | None
    target_model_params: TensorDictParams | None

    def __init__(
        self,
        model: EntityDynamicsModel,
        *,
        functional: bool = True,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        if not isinstance(model, EntityDynamicsModel):
            raise TypeError(
                "expected an EntityDynamicsModel, such as a GaussianWorldModel, got "
                f"{type(model).__name__}"
            )
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(
                f"reduction must be 'mean', 'sum' or 'none', got {reduction!r}"
            )
        self._functional = functional
        super().__init__()
        if functional:
            self.convert_to_functional(model, "model")
        else:
            self.model = model
            self.model_params = None
        self.reduction = reduction
        self.set_keys(action=model.action_key)

    @property
    def functional(self) -> bool:
        """Whether the loss keeps the parameters outside of the model."""
        return self._functional

    def _set_in_keys(self) -> None:
        layout = self.model.layout
        self._in_keys = [
            *layout.in_keys,
            self.tensor_keys.action,
            *(layout.next(key) for key in layout.in_keys),
        ]

    @property
    def in_keys(self) -> list[NestedKey]:
        """The states, the action and the next states."""
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def train(self, mode: bool = True) -> EntityDynamicsLoss:
        """Sets the mode of the loss and of its model."""
        super().train(mode)
        self.model.train(mode)
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss of transitions.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]``, not changed.

        Returns:
            TensorDictBase: ``"loss_nll"`` and ``"mse"``.
        """
        model = self.model
        state = model.layout.read(tensordict)
        target = model.targets(tensordict)
        with self._parameters_in():
            prediction = model.forward_tensors(
                state, tensordict.get(self.tensor_keys.action)
            )
        error = (target - prediction[0].detach()).square().mean(-1)
        out = TensorDict(
            {
                "loss_nll": reduce_loss(
                    self, model.nll(prediction, target), tensordict
                ),
                "mse": reduce_loss(self, error, tensordict),
            }
        )
        if self.reduction == "none":
            out.batch_size = tensordict.batch_size
        return out

    @torch.no_grad()
    def entity_mse(self, tensordict: TensorDictBase) -> TensorDict:
        """Returns the mean squared error of the predicted next state of every entity.

        The model predicts in evaluation mode.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]``.

        Returns:
            TensorDict: a float ``[]`` for each predicted entity, in squared physical
            units, the mean over the transitions and the entity's predicted columns.
        """
        model, layout = self.model, self.model.layout
        with evaluating(model), self._parameters_in():
            state = layout.read(tensordict)
            prediction = model.forward_tensors(
                state, tensordict.get(self.tensor_keys.action)
            )
        after = layout.read(tensordict, next=True)[..., model.index]
        error = (model.physical(state, prediction[0]) - after).square()
        return TensorDict(
            {name: error[..., where].mean() for name, where in model.predicted.items()}
        )

    def _parameters_in(self) -> AbstractContextManager[Any]:
        if self.model_params is None:
            return nullcontext()
        return self.model_params.to_module(self.model)
