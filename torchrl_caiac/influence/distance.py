"""Influence by distance: what is far apart is independent."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import nn

from torchrl_caiac.entities import EntityLayout

__all__ = ["DistanceInfluence"]


class DistanceInfluence(nn.Module):
    """Calls entities linked that are close, and acted on that are close to the agent.

    The hand-made rule that CoDA used online ("objects are disentangled if more than
    10 cm apart", paper A.3.1): no model, and the user's knowledge in its place. The
    scores are 1 or 0, to be used with any threshold between; the graphs are for
    :class:`~torchrl_caiac.transforms.CoDATransform`, the action's row alone for
    :class:`~torchrl_caiac.transforms.CAIACTransform`.

    Args:
        layout (EntityLayout): the entities.
        positions (mapping of str to iterable of int): the columns that hold each
            entity's position, the same number for all, in one order and unit. Flat
            layouts: observation columns that the entity owns. Nested layouts:
            positions in the entity's flattened features.
        agent (str, optional): the entity that the action moves. Defaults to the
            layout's only ``fixed`` one.
        distance (float): the largest distance of linked entities, in the unit of the
            positions. Defaults to 0.1 (10 cm).

    Keyword Args:
        action_only (bool): give the action's row alone. Defaults to ``False``.

    Raises:
        ValueError: positions are missing or of several sizes, or are not the entity's;
            the agent is unknown; the distance is not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence import DistanceInfluence
        >>> layout = EntityLayout({"arm": [0], "cup": [1], "box": [2]}, fixed=["arm"])
        >>> rule = DistanceInfluence(layout, {"arm": [0], "cup": [1], "box": [2]})
        >>> rule(TensorDict({"observation": torch.tensor([0.0, 0.08, 0.15])}))
        tensor([[1., 1., 0.],
                [1., 1., 1.],
                [0., 1., 1.],
                [1., 1., 0.]])
    """

    def __init__(
        self,
        layout: EntityLayout,
        positions: Mapping[str, Iterable[int]],
        agent: str | None = None,
        distance: float = 0.1,
        *,
        action_only: bool = False,
    ) -> None:
        super().__init__()
        self.layout = layout
        self.positions = {name: tuple(columns) for name, columns in positions.items()}
        if set(self.positions) != set(layout.names):
            raise ValueError(
                f"positions name {sorted(self.positions)}, wanted all entities "
                f"{list(layout.names)}: give the columns of each one's position"
            )
        sizes = {name: len(columns) for name, columns in self.positions.items()}
        if len(set(sizes.values())) != 1 or not min(sizes.values()):
            raise ValueError(
                f"the positions have {sizes} columns, wanted the same number for all, "
                "at least 1"
            )
        for name, columns in self.positions.items():
            own = layout.columns[name] if layout.is_flat else None
            foreign = [c for c in columns if (c < 0 if own is None else c not in own)]
            if foreign:
                raise ValueError(
                    f"positions give entity {name!r} the columns {foreign}, which it "
                    "does not own: name columns of its own"
                )
        if agent is None:
            if len(layout.fixed) != 1:
                raise ValueError(
                    f"the layout has {len(layout.fixed)} fixed entities "
                    f"{list(layout.fixed)}: name the one that the action moves by agent"
                )
            agent = layout.fixed[0]
        if agent not in layout.names:
            raise ValueError(
                f"agent is {agent!r}, which is no entity: the layout has "
                f"{list(layout.names)}"
            )
        if not (distance > 0 and math.isfinite(distance)):
            raise ValueError(f"distance must be positive and finite, got {distance!r}")
        self.agent = agent
        self.distance = float(distance)
        self.action_only = bool(action_only)

    @property
    def in_keys(self) -> list[NestedKey]:
        """What is read: the state alone."""
        return self.layout.in_keys

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> torch.Tensor:
        """The graph of every state.

        Args:
            tensordict (TensorDictBase): states ``[*B]``; nothing is written.

        Returns:
            torch.Tensor: float32 ``[*B, N + 1, N]``, 1 where the row (the entities in
            layout order, then the action) is linked to the column, else 0; with
            ``action_only`` the last row alone, ``[*B, N]``.

        Raises:
            ValueError: a position is not finite, or the state has too few columns.
        """
        place = self._positions(tensordict)
        agent = self.layout.index(self.agent)
        apart = (place.unsqueeze(-2) - place.unsqueeze(-3)).norm(dim=-1)
        near = apart <= self.distance
        if self.action_only:
            return near[..., agent, :].float()
        return torch.cat([near, near[..., agent : agent + 1, :]], -2).float()

    def _positions(self, td: TensorDictBase) -> torch.Tensor:
        """The positions ``[*B, N, coordinates]``."""
        state = self.layout.read(td)
        slices = self.layout.slices(td)
        index = []
        for name in self.layout.names:
            where, columns = slices[name], self.positions[name]
            if self.layout.is_flat:
                columns = tuple(self.layout.columns[name].index(c) for c in columns)
            if max(columns) >= where.stop - where.start:
                raise ValueError(
                    f"positions give entity {name!r} the features {list(columns)}, but "
                    f"it has {where.stop - where.start}"
                )
            index.append([where.start + column for column in columns])
        place = state[..., torch.tensor(index, device=state.device)]
        finite = place.isfinite()
        if not bool(finite.all()):
            bad = (~finite).reshape(-1, *place.shape[-2:]).any(0).any(-1)
            names = [
                n for n, b in zip(self.layout.names, bad.tolist(), strict=True) if b
            ]
            raise ValueError(
                f"the positions of {names} have NaN or infinite values: remove or "
                "repair these rows"
            )
        return place

    def extra_repr(self) -> str:
        """The settings, for ``repr``."""
        return (
            f"positions={self.positions}, agent={self.agent!r}, "
            f"distance={self.distance}, action_only={self.action_only}"
        )
