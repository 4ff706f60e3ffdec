"""The base class of world models: normalised targets, checks, and saving."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import nn

from torchrl_caiac._checks import check_int
from torchrl_caiac._keys import as_key, floating, jsonable
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules._finite import FiniteChecks, owner
from torchrl_caiac.modules._predicted_columns import (
    checked_inputs,
    checked_predict,
    checked_widths,
    named_columns,
)
from torchrl_caiac.modules._saved_model import SavedModel
from torchrl_caiac.modules._variance_floor import (
    FloorFromData,
    VarianceFloor,
    checked_floor,
    layout_floor,
)
from torchrl_caiac.modules.running_norm import RunningNorm

__all__ = ["EntityDynamicsModel", "evaluating"]

_STATISTICS_ROWS = 65_536  # rows read at once for the statistics of the targets


class EntityDynamicsModel(
    FiniteChecks, FloorFromData, SavedModel, TensorDictModuleBase
):
    r"""The base class of models that predict how an action moves every entity.

    A model reads the features of all ``N`` entities (``W`` numbers,
    :meth:`~torchrl_caiac.EntityLayout.read`) and the action (``A``), and predicts
    ``P`` columns of the next state. Subclasses define two methods:
    ``forward_tensors(state, action)`` returns a tuple of the tensors under
    :attr:`out_keys`, the expectation of the normalised target first;
    ``nll(prediction, target)`` returns what
    :class:`~torchrl_caiac.objectives.EntityDynamicsLoss` minimises. They read the
    state by :meth:`read_inputs` and normalise the action by ``action_norm``, and add
    their own arguments to :attr:`config`.

    The *normalised target* is by default the change of each column over the step,
    divided by its standard deviation in the data, or by the floor if that is larger.

    Args:
        layout (EntityLayout): the entities.
        action_dim (int): the size ``A`` of the action.
        predict (Mapping of str to iterable of int, optional): the columns to predict
            of some entities; all columns of the others are predicted. For flat layouts
            observation columns that the entity owns, for nested layouts positions in
            the entity's flattened features. ``()`` leaves an entity out: it then has no
            score. Defaults to all columns.

    Keyword Args:
        widths (Mapping of str to int, optional): the number of features of each
            entity, ``layout.widths(td)``. Required for nested layouts only.
        action_key (NestedKey): the action. Defaults to ``"action"``.
        out_keys (sequence of NestedKey): where the prediction is written.
        target (str): ``"change"`` (next minus current state) or ``"absolute"`` (the
            next state, centred). Defaults to ``"change"``.
        variance_floor (float, Mapping or "auto", optional): the smallest standard
            deviation to divide targets by, in the units of the data. One number, or for
            each entity one number or one for each predicted column. ``"auto"`` takes it
            from the data, see :meth:`fit_variance_floor`. Defaults to that of the
            layout, or to ``1e-3`` (1 mm, 1 mrad) if it has none.
        inputs (Mapping of str to iterable of int, optional): the columns of some
            entities that the model reads, named as those of ``predict``; all columns of
            the others are read. ``()`` leaves an entity out. The columns to predict,
            and those that are swapped, are not affected. Defaults to all columns.

    Attributes:
        predicted (dict of str to slice): the position of each predicted entity in
            ``P``.
        slices (dict of str to slice): the position of each entity in ``W``.
        action_low (torch.Tensor): float32 ``[A]``, the lowest action, as recorded by
            :meth:`set_action_bounds`; NaN if unknown.
        action_high (torch.Tensor): float32 ``[A]``, the highest action.
        floor (torch.Tensor): float64 ``[P]``, the variance floor; NaN until it is
            taken from data.
        floor_reasons (dict of str to str): how the floor of each entity was taken from
            data; empty if it was given.

    Raises:
        ValueError: an argument does not fit the layout.

    Examples:
        >>> import torch
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules.entity_dynamics_model import EntityDynamicsModel
        >>> class Linear(EntityDynamicsModel):
        ...     def __init__(self, layout, action_dim):
        ...         super().__init__(layout, action_dim, out_keys=["change"])
        ...         self.map = torch.nn.Linear(self.input_dim, self.predict_dim)
        ...     def forward_tensors(self, state, action):
        ...         return (self.map(self.read_inputs(state)),)
        ...     def nll(self, prediction, target):
        ...         return (prediction[0] - target).square().mean(-1)
        >>> model = Linear(EntityLayout({"arm": [0, 1], "cup": [2]}), 2)
        >>> model(observation=torch.zeros(5, 3), action=torch.zeros(5, 2)).shape
        torch.Size([5, 3])
        >>> model.slices
        {'arm': slice(0, 2, None), 'cup': slice(2, 3, None)}
    """

    def __init__(
        self,
        layout: EntityLayout,
        action_dim: int,
        predict: Mapping[str, Iterable[int]] | None = None,
        *,
        widths: Mapping[str, int] | None = None,
        action_key: NestedKey = "action",
        out_keys: Sequence[NestedKey],
        target: Literal["change", "absolute"] = "change",
        variance_floor: VarianceFloor = None,
        inputs: Mapping[str, Iterable[int]] | None = None,
    ) -> None:
        super().__init__()
        check_int("action_dim", action_dim, 1)
        if target not in ("change", "absolute"):
            raise ValueError(f"target must be 'change' or 'absolute', got {target!r}")
        self.layout = layout
        self.action_dim = action_dim
        self.target = target
        self.action_key: NestedKey = as_key(action_key)
        self.in_keys = [*layout.in_keys, self.action_key]
        self.out_keys = [as_key(key) for key in out_keys]
        self.fitted = False

        self.widths = checked_widths(layout, widths)
        self.predict = checked_predict(layout, self.widths, predict)
        self.input_positions = checked_inputs(layout, self.widths, inputs)
        if variance_floor is None:
            variance_floor = layout_floor(layout, self.predict)
        self.auto_floor = isinstance(variance_floor, str)
        self.floor_reasons: dict[str, str] = {}
        floor = checked_floor(variance_floor, self.predict)
        self.slices: dict[str, slice] = {}
        self.predicted: dict[str, slice] = {}
        start = stop = 0
        index: list[int] = []
        read: list[int] = []
        for name, positions in self.predict.items():
            self.slices[name] = slice(start, start + self.widths[name])
            index += [start + position for position in positions]
            read += [start + position for position in self.input_positions[name]]
            start += self.widths[name]
            if positions:
                self.predicted[name] = slice(stop, stop + len(positions))
                stop += len(positions)
        self.state_dim, self.predict_dim = start, stop
        self.input_dim = len(read)
        self._reads_all = read == list(range(start))

        self.state_norm = RunningNorm(self.input_dim)
        self.action_norm = RunningNorm(action_dim)
        self.index: torch.Tensor
        self.input_index: torch.Tensor
        self.register_buffer("input_index", torch.tensor(read), persistent=False)
        self.floor: torch.Tensor
        self.target_loc: torch.Tensor
        self.target_scale: torch.Tensor
        self.register_buffer("index", torch.tensor(index), persistent=False)
        self.register_buffer("floor", torch.tensor(floor, dtype=torch.float64))
        zeros = torch.zeros(self.predict_dim, dtype=torch.float64)
        self.register_buffer("target_loc", zeros)
        self.register_buffer("target_scale", torch.ones_like(zeros))
        self.action_low: torch.Tensor
        self.action_high: torch.Tensor
        unknown = torch.full((action_dim,), math.nan, dtype=torch.float32)
        self.register_buffer("action_low", unknown)
        self.register_buffer("action_high", unknown.clone())

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the parameters."""
        return next(self.parameters()).dtype

    @property
    def device(self) -> torch.device:
        """The device of the model."""
        return self.target_loc.device

    # --- predicting --------------------------------------------------------------

    def forward_tensors(
        self, state: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Predicts the normalised target from tensors.

        Args:
            state (torch.Tensor): the entities' features ``[*B, W]``.
            action (torch.Tensor): ``[*B, A]``; batch dimensions broadcast.

        Returns:
            tuple of torch.Tensor: the tensors under :attr:`out_keys`, in their order,
            the expectation ``[*B, P]`` first.
        """
        raise NotImplementedError(f"{type(self).__name__} has no forward_tensors")

    def select_inputs(self, state: torch.Tensor) -> torch.Tensor:
        """Returns the columns that the model reads, not normalised.

        Args:
            state (torch.Tensor): the entities' features ``[*B, W]``.

        Returns:
            torch.Tensor: ``[*B, I]``, entities in layout order; ``I`` is
            ``input_dim``.
        """
        return state if self._reads_all else state[..., self.input_index]

    def read_inputs(self, state: torch.Tensor) -> torch.Tensor:
        """Returns the normalised columns that the model reads.

        In training mode, they enter the statistics of the normalisation.

        Args:
            state (torch.Tensor): the entities' features ``[*B, W]``.

        Returns:
            torch.Tensor: ``[*B, I]``.
        """
        return self.state_norm(self.select_inputs(state))

    def nll(
        self, prediction: tuple[torch.Tensor, ...], target: torch.Tensor
    ) -> torch.Tensor:
        """Returns the negative log likelihood of targets, up to a constant.

        Args:
            prediction (tuple of torch.Tensor): the output of :meth:`forward_tensors`.
            target (torch.Tensor): normalised targets ``[*B, P]``.

        Returns:
            torch.Tensor: in nats per column, ``[*B]``.
        """
        raise NotImplementedError(f"{type(self).__name__} has no nll")

    def constant_prediction(
        self, mean: torch.Tensor, var: torch.Tensor
    ) -> tuple[torch.Tensor, ...] | None:
        """Returns the prediction that targets have one mean and variance everywhere.

        :func:`~torchrl_caiac.fit.fit_world_model` warns if a model is no better.

        Args:
            mean (torch.Tensor): the mean of the normalised targets, ``[P]``.
            var (torch.Tensor): their variance, ``[P]``.

        Returns:
            tuple of torch.Tensor: what :meth:`nll` reads; ``None`` (the default) if
            the model has no such prediction.
        """
        return None

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the prediction of the normalised target.

        Args:
            tensordict (TensorDictBase): states and actions ``[*B]``.

        Returns:
            TensorDictBase: the same tensordict with :attr:`out_keys`, each
            ``[*B, P]``.
        """
        prediction = self.forward_tensors(
            self.layout.read(tensordict), tensordict.get(self.action_key)
        )
        for key, value in zip(self.out_keys, prediction, strict=True):
            tensordict.set(key, value)
        return tensordict

    def _check_widths(self, state: torch.Tensor, action: torch.Tensor) -> None:
        for name, x, size in (
            ("state", state, self.state_dim),
            ("action", action, self.action_dim),
        ):
            if x.ndim < 1 or x.shape[-1] != size:
                raise ValueError(
                    f"the {name} has the shape {list(x.shape)}, expected "
                    f"[*B, {size}]: the model was made for other data"
                )

    def predict_next(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Predicts the next state, in physical units.

        Args:
            tensordict (TensorDictBase): states and actions ``[*B]``, not changed.

        Returns:
            torch.Tensor: the predicted columns of all entities, ``[*B, P]``.

        Raises:
            RuntimeError: :meth:`fit_statistics` was not called.
        """
        state = self.layout.read(tensordict)
        prediction = self.forward_tensors(state, tensordict.get(self.action_key))
        return self.physical(state, prediction[0])

    # --- targets -----------------------------------------------------------------

    def raw_targets(
        self, state: torch.Tensor, next_state: torch.Tensor
    ) -> torch.Tensor:
        """Returns the target in physical units: the change, or the next state.

        Args:
            state (torch.Tensor): the entities' features ``[*B, W]``.
            next_state (torch.Tensor): the same after the step, ``[*B, W]``.

        Returns:
            torch.Tensor: ``[*B, P]``.
        """
        after = floating(next_state[..., self.index])
        if self.target != "change":
            return after
        return after - floating(state[..., self.index])

    def normalise(self, raw: torch.Tensor) -> torch.Tensor:
        """Normalises raw targets, in the dtype of the parameters.

        Args:
            raw (torch.Tensor): the output of :meth:`raw_targets`, ``[*B, P]``.

        Returns:
            torch.Tensor: ``[*B, P]``.

        Raises:
            RuntimeError: :meth:`fit_statistics` was not called.
        """
        self._check_fitted()
        raw = floating(raw)
        loc, scale = (x.to(raw.dtype) for x in (self.target_loc, self.target_scale))
        return ((raw - loc) / scale).to(self.dtype)

    def physical(self, state: torch.Tensor, loc: torch.Tensor) -> torch.Tensor:
        """Returns the next state for normalised targets, the inverse of both methods.

        Args:
            state (torch.Tensor): the entities' features ``[*B, W]``.
            loc (torch.Tensor): normalised targets, ``[*B, P]``.

        Returns:
            torch.Tensor: the predicted columns, ``[*B, P]``, in physical units.

        Raises:
            RuntimeError: :meth:`fit_statistics` was not called.
        """
        self._check_fitted()
        raw = loc * self.target_scale.to(loc.dtype) + self.target_loc.to(loc.dtype)
        if self.target != "change":
            return raw
        return raw + floating(state[..., self.index])

    def targets(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Returns the normalised targets of transitions.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]`` with next states.

        Returns:
            torch.Tensor: ``[*B, P]``.

        Raises:
            RuntimeError: :meth:`fit_statistics` was not called.
        """
        layout = self.layout
        return self.normalise(
            self.raw_targets(
                layout.read(tensordict), layout.read(tensordict, next=True)
            )
        )

    def fit_statistics(
        self,
        data: TensorDictBase | torch.Tensor | Iterable[TensorDictBase | torch.Tensor],
    ) -> None:
        """Sets the scale (and for absolute targets the centre) of the targets.

        The scale of a predicted column is the standard deviation of its raw target, or
        its floor if that is larger. With ``variance_floor="auto"``, the floor is first
        taken from the data, unless it is known.

        Args:
            data (TensorDictBase, torch.Tensor or iterable of them): transitions
                ``[T]``, which are read in chunks, or raw targets ``[T, P]``.

        Raises:
            ValueError: the data are empty, or a value is not finite; the floor is not
                known and the data are not transitions.
        """
        if not self.has_floor:
            whole = [data] if isinstance(data, TensorDictBase) else data
            if not isinstance(whole, Sequence) or any(
                not isinstance(part, TensorDictBase) for part in whole
            ):
                raise ValueError(
                    "variance_floor='auto' needs transitions to read the floor from: "
                    "pass them, or a list of them, or call fit_variance_floor first"
                )
            self.fit_variance_floor(whole)
            data = whole
        stats = RunningNorm(self.predict_dim).to(self.target_loc.device)
        for raw in self._raw_chunks(data):
            stats.update(raw)
        if not stats.count:
            raise ValueError("the data are empty: give some transitions")
        if not bool(torch.isfinite(stats.var).all()):
            bad = (~torch.isfinite(stats.var)).nonzero()[0].item()
            name = owner(self.predicted, int(bad))
            raise ValueError(
                f"the targets of entity {name!r} are not finite: remove transitions "
                "with NaN or infinite observations"
            )
        scale = stats.var.sqrt()
        self.target_scale.copy_(torch.maximum(scale, self.floor))
        # The scale of a constant column whose floor is 0.
        self.target_scale[self.target_scale == 0] = 1.0
        if self.target == "absolute":
            self.target_loc.copy_(stats.mean)
        self.fitted = True

    @property
    def action_bounds(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """The lowest and the highest action, ``[A]`` each; ``None`` if unknown."""
        if bool(self.action_low.isnan().any() | self.action_high.isnan().any()):
            return None
        return self.action_low, self.action_high

    def set_action_bounds(
        self,
        low: torch.Tensor | Sequence[float] | float,
        high: torch.Tensor | Sequence[float] | float,
    ) -> None:
        """Records the bounds of the actions, which are saved with the model.

        :func:`~torchrl_caiac.fit.fit_world_model` calls it.

        Args:
            low (torch.Tensor, sequence of float or float): the lowest action, ``[A]``
                or one number.
            high (torch.Tensor, sequence of float or float): the highest action.

        Raises:
            ValueError: a bound is not finite, or a lower one is above a higher one.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> from torchrl_caiac.modules import GaussianWorldModel
            >>> model = GaussianWorldModel(EntityLayout({"arm": [0]}), 2, (8,))
            >>> model.set_action_bounds(-1.0, [1.0, 2.0])
            >>> model.action_bounds
            (tensor([-1., -1.]), tensor([1., 2.]))
        """
        device = self.action_low.device
        low, high = (
            torch.as_tensor(x, dtype=torch.float32, device=device) for x in (low, high)
        )
        # Written so that NaN fails too.
        if not bool((low.isfinite() & high.isfinite() & (low <= high)).all()):
            raise ValueError(
                f"the lowest action {low.tolist()} and the highest {high.tolist()} "
                "must be finite, and none of the lowest above the highest"
            )
        self.action_low.copy_(low)
        self.action_high.copy_(high)

    def _raw_chunks(self, data: Any) -> Iterator[torch.Tensor]:
        layout, device = self.layout, self.target_loc.device
        single = isinstance(data, (TensorDictBase, torch.Tensor))
        for part in [data] if single else data:
            if isinstance(part, torch.Tensor):
                yield from part.to(device).split(_STATISTICS_ROWS)
                continue
            if not part.numel():
                continue
            rows = part if part.batch_dims == 1 else part.reshape(-1)
            for start in range(0, len(rows), _STATISTICS_ROWS):
                td = rows[start : start + _STATISTICS_ROWS].to(device)
                yield self.raw_targets(layout.read(td), layout.read(td, next=True))

    def _check_fitted(self) -> None:
        if not self.fitted:
            raise RuntimeError(
                "the scale of the targets is not known: call "
                "model.fit_statistics(data), or fit_world_model(model, data), first"
            )

    # --- saving ------------------------------------------------------------------

    @property
    def config(self) -> dict[str, Any]:
        """The class of the model and its arguments, JSON-compatible."""
        config: dict[str, Any] = {
            "class": type(self).__name__,
            "layout": self.layout.to_dict(),
            "action_dim": self.action_dim,
            "widths": dict(self.widths),
            "predict": named_columns(self.layout, self.predict),
            "action_key": jsonable(self.action_key),
            "out_keys": [jsonable(key) for key in self.out_keys],
            "target": self.target,
            "variance_floor": "auto" if self.auto_floor else self.entity_floors(),
        }
        if not self._reads_all:
            config["inputs"] = named_columns(self.layout, self.input_positions)
        return config


@contextmanager
def evaluating(module: nn.Module) -> Iterator[None]:
    """Context manager that puts a module in evaluation mode for the block."""
    modes = [(part, part.training) for part in module.modules()]
    module.eval()
    try:
        yield
    finally:
        for part, training in modes:
            part.training = training
