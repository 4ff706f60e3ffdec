"""The local causal graph in the attention of a transformer (CoDA)."""

from __future__ import annotations

from functools import reduce

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import nn

from torchrl_caiac._keys import get_leaf
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules.entity_dynamics_model import evaluating
from torchrl_caiac.modules.transformer_world_model import TransformerWorldModel

__all__ = ["AttentionInfluence"]

_CPU_ROWS = 2**9  # rows whose activations fit into a CPU's cache


class AttentionInfluence(nn.Module):
    r"""Scores influence by the attention of a transformer world model (paper, A.7).

    Let :math:`A_l` be the attention matrix of layer ``l`` (queries by keys, mean over
    the heads). The output of token ``j`` attends to the input of token ``i`` by
    :math:`(A_L \cdots A_1)_{ji}`. This is the score of the edge
    :math:`s_i \rightarrow s'_j`. The scores of all edges into one entity sum to 1.

    :func:`~torchrl_caiac.influence.score_buffer` stores the graphs, which
    :class:`~torchrl_caiac.transforms.CoDATransform` reads. With ``action_only`` there
    is one score for each entity, that of the edge from the action, which
    :class:`~torchrl_caiac.transforms.CAIACTransform` reads (CoDA-action).

    Args:
        model (TransformerWorldModel): a fitted world model that predicts every entity.
        action_only (bool): return only the row of the action. Defaults to ``False``.

    Keyword Args:
        max_memory (int): approximate bytes of working memory, without model, data and
            scores; rows are scored in chunks that fit. Defaults to 256 MiB.

    Raises:
        TypeError: the model has no attention.
        ValueError: the model does not predict an entity, or was never fitted.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence import AttentionInfluence
        >>> from torchrl_caiac.modules import TransformerWorldModel
        >>> layout = EntityLayout({"arm": [0, 1], "cup": [2]})
        >>> model = TransformerWorldModel(layout, 2, layers=2, heads=2, width=8)
        >>> _ = model.fit_statistics(torch.randn(5, 3))  # by fit_world_model
        >>> td = TensorDict(
        ...     {"observation": torch.randn(5, 3), "action": torch.randn(5, 2)}, [5]
        ... )
        >>> graph = AttentionInfluence(model)(td)
        >>> graph.shape  # from the arm, the cup and the action to the arm and the cup
        torch.Size([5, 3, 2])
        >>> torch.equal(AttentionInfluence(model, action_only=True)(td), graph[:, -1])
        True
    """

    def __init__(
        self,
        model: TransformerWorldModel,
        action_only: bool = False,
        *,
        max_memory: int = 256 * 2**20,
    ) -> None:
        super().__init__()
        if not isinstance(model, TransformerWorldModel):
            raise TypeError(
                f"a {type(model).__name__} has no attention: give a "
                "TransformerWorldModel"
            )
        missing = [n for n in model.layout.names if n not in model.predicted]
        if missing:
            raise ValueError(
                f"the model predicts no column of {missing}: every entity needs a "
                "score, predict at least one column of each"
            )
        if not model.fitted:
            raise ValueError(
                "the model was never fitted, so that its scores would mean nothing: "
                "call fit_world_model(model, data), or load a fitted one, first"
            )
        if max_memory < 1:
            raise ValueError(
                f"max_memory must be a number of bytes, got {max_memory!r}"
            )
        self.model = model
        self.action_only = bool(action_only)
        self.max_memory = int(max_memory)

    @property
    def layout(self) -> EntityLayout:
        """The entities that are scored, those of the model."""
        return self.model.layout

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys of the state and the action."""
        return self.model.in_keys

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Returns the scores of the graph, without gradients.

        The model is in evaluation mode.

        Args:
            tensordict (TensorDictBase): states and actions ``[*B]``; it is not changed.

        Returns:
            torch.Tensor: float32 ``[*B, N + 1, N]``, from the row (the entities in
            layout order, then the action) to the column; with ``action_only`` only the
            last row, ``[*B, N]``.

        Raises:
            KeyError: the action is missing.
            ValueError: an observation, an action or the attention is not finite.
        """
        model, n = self.model, self.layout.num_entities
        state = self.layout.read(tensordict)
        action = get_leaf(
            tensordict,
            model.action_key,
            "the data lack the action",
            "name it with the model's action_key",
        )
        batch = state.shape[:-1]
        state = state.reshape(-1, state.shape[-1])
        action = action.reshape(-1, action.shape[-1])
        shape = (n,) if self.action_only else (n + 1, n)
        scores = torch.empty(len(state), *shape, device=state.device)
        rows = self.chunk_rows
        with evaluating(model):
            for start in range(0, len(state), rows):
                part = slice(start, start + rows)
                model.check_finite(state[part], first_row=start)
                model.check_finite_action(action[part], first_row=start)
                graph = self._graph(
                    state[part].to(model.device), action[part].to(model.device)
                )
                self._check(graph, start)
                scores[part] = graph[:, -1] if self.action_only else graph
        return scores.reshape(*batch, *shape)

    def _graph(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        layers = self.model.attention(state, action).float().unbind(-3)
        total = reduce(lambda below, above: above @ below, layers)
        # From queries by keys to causes by effects, without effects on the action.
        return total[:, : self.layout.num_entities].mT

    def _check(self, graph: torch.Tensor, first_row: int) -> None:
        finite = torch.isfinite(graph)
        if bool(finite.all()):
            return
        names = [
            name
            for name, ok in zip(
                self.layout.names, finite.all(1).all(0).tolist(), strict=True
            )
            if not ok
        ]
        row = int((~finite).flatten(1).any(1).nonzero()[0, 0]) + first_row
        raise ValueError(
            f"the attention of {names} is NaN or infinite, first in row {row}: "
            "the model has diverged, or the states are far outside of its data"
        )

    @property
    def chunk_rows(self) -> int:
        """The number of rows in a chunk."""
        model = self.model
        tokens = self.layout.num_entities + 1
        # The activations of a layer with queries, keys and values, and its attention.
        per_token = 8 * model.width + 2 * model.feedforward
        per_token += (2 * model.heads + 2 * len(model.layers)) * tokens
        rows = max(1, self.max_memory // (4 * tokens * per_token))
        return min(rows, _CPU_ROWS) if model.device.type == "cpu" else rows

    def extra_repr(self) -> str:
        """Returns the settings, for ``repr``."""
        return f"action_only={self.action_only}"
