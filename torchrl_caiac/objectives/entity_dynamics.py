"""The loss that fits a world model to transitions."""

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
    """Negative log likelihood of the next state of every entity (paper, A.7).

    The targets are those of the model (normalised changes by default), so call
    ``model.fit_statistics(data)`` first; :func:`fit_world_model` does. The state's keys
    are those of the model's layout.

    Args:
        model (EntityDynamicsModel): the model to fit. A
            :class:`~torchrl_caiac.modules.TransformerWorldModel` has the likelihood of
            a Gaussian of unit variance, up to a constant: half the squared error.

    Keyword Args:
        functional (bool): keep the parameters in a
            :class:`~tensordict.nn.TensorDictParams` of the loss, as TorchRL's losses
            do; else hold the model as a submodule. They are the model's own parameters
            in both cases. Defaults to ``True``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"`` over the rows. Defaults to
            ``"mean"``. Rows that ``loss_mask_key`` masks do not count.

    Returns:
        TensorDict: ``"loss_nll"``, nats per predicted column, and ``"mse"``, the
        squared error of the normalised targets, detached.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
        >>> from torchrl_caiac.objectives.entity_dynamics import EntityDynamicsLoss
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
                "the loss takes a TransformerWorldModel or a GaussianWorldModel, got "
                f"{type(model).__name__}"
            )
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction is 'mean', 'sum' or 'none', got {reduction!r}")
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
        """Whether the parameters are held apart from the model."""
        return self._functional

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """The states, the action and the next states."""
        layout = self.model.layout
        return [
            *layout.in_keys,
            self.tensor_keys.action,
            *(layout.next(key) for key in layout.in_keys),
        ]

    def train(self, mode: bool = True) -> EntityDynamicsLoss:
        """Sets the mode of the loss and of its model (its running normalisation)."""
        super().train(mode)
        self.model.train(mode)
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss of transitions.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]``; left as they are.

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
        """The mean squared error of every entity's predicted next state.

        The model is put in evaluation mode meanwhile.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]``.

        Returns:
            TensorDict: per predicted entity a float ``[]``, in squared physical units,
            mean over rows and the entity's predicted columns.
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
