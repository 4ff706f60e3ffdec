"""A transformer over entities, whose attention CoDA reads as influence."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import torch
from tensordict.utils import NestedKey
from torch import nn

from torchrl_caiac._checks import check_int
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules._variance_floor import VarianceFloor
from torchrl_caiac.modules.entity_dynamics_model import EntityDynamicsModel

__all__ = ["TransformerWorldModel"]


class TransformerWorldModel(EntityDynamicsModel):
    r"""The transition model from which CoDA reads the local graph (paper, A.7).

    Every entity is one token, in layout order, and the action is the last one. Each
    token has a linear projection of its own, from its features (normalised by a running
    mean and variance) to ``width`` dimensions. ``layers`` of
    :class:`torch.nn.TransformerEncoderLayer` follow, and for each entity a linear
    projection of its own to the expected *normalised target*
    (:class:`EntityDynamicsModel`). The projections distinguish the tokens; there is no
    positional encoding.

    The likelihood that :class:`~torchrl_caiac.objectives.EntityDynamicsLoss` maximises
    is that of a Gaussian of unit variance, without its constant: half the squared
    error is minimised.

    Args:
        layout (EntityLayout): the entities.
        action_dim (int): the size ``A`` of the action.
        layers (int): the number of encoder layers. Defaults to ``3``.
        heads (int): the number of attention heads in each layer, a divisor of
            ``width``. Defaults to ``4``.
        width (int): the size of the tokens. Defaults to ``128``.
        predict (Mapping of str to iterable of int, optional): the columns to predict
            of some entities, as in :class:`EntityDynamicsModel`. Defaults to all
            columns.

    Keyword Args:
        feedforward (int, optional): the hidden width between two attentions. Defaults
            to ``width``; the paper does not state it.
        dropout (float): the dropout rate in every layer. Defaults to ``0.0``.
        widths (Mapping of str to int, optional): the number of features of each
            entity, ``layout.widths(td)``. Required for nested layouts only.
        action_key (NestedKey): the action. Defaults to ``"action"``.
        out_keys (sequence of one NestedKey): where the expectation ``[*B, P]`` is
            written. Defaults to ``("prediction", "loc")``.
        target (str): ``"change"`` (next minus current state) or ``"absolute"`` (the
            next state, centred). Defaults to ``"change"``.
        variance_floor (float, Mapping or "auto", optional): the smallest standard
            deviation to divide targets by, in the units of the data, as in
            :class:`EntityDynamicsModel`. Defaults to that of the layout, or to ``1e-3``
            (1 mm, 1 mrad) if it has none.
        inputs (Mapping of str to iterable of int, optional): the columns of some
            entities that their tokens are projected from, as in
            :class:`EntityDynamicsModel`, at least one of each entity. Defaults to all
            columns.

    Attributes:
        predicted (dict of str to slice): the position of each predicted entity in
            ``P``.

    Raises:
        ValueError: an argument is out of range or does not fit the layout.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules import TransformerWorldModel
        >>> layout = EntityLayout({"arm": [0, 1], "cup": [2, 3, 4]})
        >>> model = TransformerWorldModel(layout, 2, layers=2, heads=2, width=16)
        >>> td = TensorDict(
        ...     {"observation": torch.randn(8, 5), "action": torch.randn(8, 2)}, [8]
        ... )
        >>> model(td)["prediction", "loc"].shape
        torch.Size([8, 5])
        >>> model.attention(layout.read(td), td["action"]).shape
        torch.Size([8, 2, 3, 3])
    """

    def __init__(
        self,
        layout: EntityLayout,
        action_dim: int,
        layers: int = 3,
        heads: int = 4,
        width: int = 128,
        predict: Mapping[str, Iterable[int]] | None = None,
        *,
        feedforward: int | None = None,
        dropout: float = 0.0,
        widths: Mapping[str, int] | None = None,
        action_key: NestedKey = "action",
        out_keys: Sequence[NestedKey] = (("prediction", "loc"),),
        target: Literal["change", "absolute"] = "change",
        variance_floor: VarianceFloor = None,
        inputs: Mapping[str, Iterable[int]] | None = None,
    ) -> None:
        feedforward = width if feedforward is None else feedforward
        for name, value in (
            ("layers", layers),
            ("heads", heads),
            ("width", width),
            ("feedforward", feedforward),
        ):
            check_int(name, value, 1)
        if width % heads:
            raise ValueError(
                f"width is {width}, expected a multiple of the {heads} heads: change "
                "one of them"
            )
        if not 0 <= dropout < 1:
            raise ValueError(f"dropout must be in [0, 1), got {dropout!r}")
        if len(tuple(out_keys)) != 1:
            raise ValueError(
                f"out_keys must be one key, of the expectation, got {out_keys!r}"
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
        empty = [name for name, own in self.input_positions.items() if not own]
        if empty:
            raise ValueError(
                f"inputs give {empty} no columns, so that their tokens would say "
                "nothing of the state: give each entity at least one column"
            )
        self._sizes = [len(own) for own in self.input_positions.values()]
        self.heads = heads
        self.width = width
        self.feedforward = feedforward
        self.dropout = float(dropout)
        self.inputs = nn.ModuleList(
            nn.Linear(size, width) for size in (*self._sizes, action_dim)
        )
        # Not nn.TransformerEncoder: all of its layers start with the same weights.
        self.layers = nn.ModuleList(
            nn.TransformerEncoderLayer(
                width, heads, feedforward, self.dropout, batch_first=True
            )
            for _ in range(layers)
        )
        self.outputs = nn.ModuleList(
            nn.Linear(width, where.stop - where.start)
            for where in self.predicted.values()
        )
        self._predicted_tokens = [layout.index(name) for name in self.predicted]

    def forward_tensors(
        self, state: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Predicts the expectation of the normalised target from tensors.

        Args:
            state (torch.Tensor): the entities' features ``[*B, W]``.
            action (torch.Tensor): ``[*B, A]``; batch dimensions broadcast.

        Returns:
            tuple of torch.Tensor: the expectation, ``[*B, P]``.

        Raises:
            ValueError: a last dimension has the wrong size.
        """
        tokens, batch = self._tokens(state, action)
        tokens = self._encode(tokens)
        parts = [
            output(tokens[:, token])
            for output, token in zip(self.outputs, self._predicted_tokens, strict=True)
        ]
        return (torch.cat(parts, -1).reshape(*batch, self.predict_dim),)

    def nll(
        self, prediction: tuple[torch.Tensor, ...], target: torch.Tensor
    ) -> torch.Tensor:
        """Returns the negative log likelihood for unit variance, without its constant.

        Args:
            prediction (tuple of torch.Tensor): the expectation, ``[*B, P]``.
            target (torch.Tensor): normalised targets ``[*B, P]``.

        Returns:
            torch.Tensor: half the mean squared error, ``[*B]``.
        """
        return 0.5 * (target - prediction[0]).square().mean(-1)

    def constant_prediction(
        self, mean: torch.Tensor, var: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Returns the mean of all targets, since the model predicts no variance.

        Args:
            mean (torch.Tensor): the mean of the normalised targets, ``[P]``.
            var (torch.Tensor): their variance, ``[P]``, not used.

        Returns:
            tuple of torch.Tensor: the mean.
        """
        return (mean,)

    def attention(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Returns the attention matrices of all layers, averaged over the heads.

        Hooks record them: no other thread may use the model at the same time.

        Args:
            state (torch.Tensor): the entities' features ``[*B, W]``.
            action (torch.Tensor): ``[*B, A]``; batch dimensions broadcast.

        Returns:
            torch.Tensor: ``[*B, layers, N + 1, N + 1]``, the attention of the token of
            the row (a query) to that of the column (a key); entities in layout order,
            then the action. Rows sum to 1.

        Raises:
            RuntimeError: a layer returned no attention.
            ValueError: a last dimension has the wrong size.
        """
        tokens, batch = self._tokens(state, action)
        size = tokens.shape[1]
        if not tokens.shape[0]:  # torch's fused attention would return no weights
            return tokens.new_zeros(*batch, len(self.layers), size, size)
        with _recording(list(self.layers)) as weights:
            self._encode(tokens)
        return torch.stack(weights, 1).reshape(*batch, len(weights), size, size)

    def _tokens(
        self, state: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Size]:
        """Returns the input tokens ``[rows, N + 1, width]`` and the batch shape."""
        self._check_widths(state, action)
        last: Any = self.inputs[-1]
        dtype = last.weight.dtype
        state = self.read_inputs(state.to(dtype))
        action = self.action_norm(action.to(dtype))
        batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
        parts = [*state.split(self._sizes, -1), action]
        tokens = [
            project(part).expand(*batch, self.width)
            for project, part in zip(self.inputs, parts, strict=True)
        ]
        return torch.stack(tokens, -2).reshape(-1, len(tokens), self.width), batch

    def _encode(self, tokens: torch.Tensor) -> torch.Tensor:
        for layer in self.layers:
            tokens = layer(tokens)
        return tokens

    @property
    def config(self) -> dict[str, Any]:
        """The class of the model and its arguments, JSON-compatible."""
        return {
            **super().config,
            "layers": len(self.layers),
            "heads": self.heads,
            "width": self.width,
            "feedforward": self.feedforward,
            "dropout": self.dropout,
        }


@contextmanager
def _recording(layers: Sequence[Any]) -> Iterator[list[torch.Tensor]]:
    """Records the attention of each encoder layer that runs in the block."""
    found: list[Any] = []

    # An encoder layer does not request the weights of its attention. Hooks also make
    # it leave the fused path, which does not call the attention module.
    def request(module: nn.Module, args: Any, kwargs: dict[str, Any]) -> Any:
        return args, {**kwargs, "need_weights": True, "average_attn_weights": True}

    def keep(module: nn.Module, args: Any, output: Any) -> None:
        found.append(output[1])

    hooks = []
    for layer in layers:
        attention = layer.self_attn
        hooks.append(attention.register_forward_pre_hook(request, with_kwargs=True))
        hooks.append(attention.register_forward_hook(keep))
    try:
        yield found
    finally:
        for hook in hooks:
            hook.remove()
    given = sum(weights is not None for weights in found)
    if not given or given != len(layers):
        raise RuntimeError(
            f"{given} of {len(layers)} encoder layers returned their attention: use "
            "layers of nn.TransformerEncoderLayer with nn.MultiheadAttention"
        )
