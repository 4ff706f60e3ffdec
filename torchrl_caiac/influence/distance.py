"""Influence by distance: entities that are far apart are independent."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import nn

from torchrl_caiac.entities import EntityLayout

__all__ = ["DistanceInfluence", "checked_agent"]


def checked_agent(layout: EntityLayout, agent: str | None) -> str:
    """Returns the entity that the action moves, after checking it.

    Args:
        layout (EntityLayout): the entities.
        agent (str, optional): its name. ``None``: the layout's only ``fixed`` entity.

    Returns:
        str: the name.

    Raises:
        ValueError: it is not an entity, or the layout has not exactly one fixed one.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence.distance import checked_agent
        >>> checked_agent(EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"]), None)
        'arm'
    """
    if agent is None:
        if len(layout.fixed) != 1:
            raise ValueError(
                f"the layout has {len(layout.fixed)} fixed entities "
                f"{list(layout.fixed)}: pass the one that the action moves as agent"
            )
        return layout.fixed[0]
    if agent not in layout.names:
        raise ValueError(
            f"agent is {agent!r}, which is not an entity: the layout has "
            f"{list(layout.names)}"
        )
    return agent


class DistanceInfluence(nn.Module):
    """Links entities that are close, and the action to entities close to the agent.

    This is the rule that CoDA used online ("objects are disentangled if more than
    10 cm apart", paper A.3.1). It needs no model but knowledge of the positions. The
    scores are 1 or 0, for any threshold in between. The graphs are for
    :class:`~torchrl_caiac.transforms.CoDATransform`, the row of the action for
    :class:`~torchrl_caiac.transforms.CAIACTransform`.

    Args:
        layout (EntityLayout): the entities.
        positions (mapping of str to iterable of int, optional): the columns of each
            entity's position, the same number for all, in the same order and unit. In
            flat layouts these are observation columns of the entity, in nested layouts
            places in the entity's flattened features. Defaults to
            ``layout.positions``.
        agent (str, optional): the entity that the action moves. Defaults to the
            layout's only ``fixed`` one.
        distance (float): the largest distance of linked entities, in the unit of the
            positions. Defaults to 0.1 (10 cm).

    Keyword Args:
        action_only (bool): return only the row of the action. Defaults to ``False``.

    Raises:
        ValueError: positions are missing, differ in size or belong to another entity;
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
        positions: Mapping[str, Iterable[int]] | None = None,
        agent: str | None = None,
        distance: float = 0.1,
        *,
        action_only: bool = False,
    ) -> None:
        super().__init__()
        self.layout = layout
        given = layout.positions if positions is None else positions
        self.positions = {name: tuple(columns) for name, columns in given.items()}
        if set(self.positions) != set(layout.names):
            whose = "the layout's positions" if positions is None else "positions"
            raise ValueError(
                f"{whose} name {sorted(self.positions)}, expected all entities "
                f"{list(layout.names)}: give the columns of each position"
            )
        sizes = {name: len(columns) for name, columns in self.positions.items()}
        if len(set(sizes.values())) != 1 or not min(sizes.values()):
            raise ValueError(
                f"the positions have {sizes} columns, expected the same number, at "
                "least 1, for all"
            )
        for name, columns in self.positions.items():
            own = layout.columns[name] if layout.is_flat else None
            foreign = [c for c in columns if (c < 0 if own is None else c not in own)]
            if foreign:
                raise ValueError(
                    f"positions give entity {name!r} the columns {foreign}, which it "
                    "does not have: give columns of the entity"
                )
        agent = checked_agent(layout, agent)
        if not (distance > 0 and math.isfinite(distance)):
            raise ValueError(f"distance must be positive and finite, got {distance!r}")
        self.agent = agent
        self.distance = float(distance)
        self.action_only = bool(action_only)

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys of the state."""
        return self.layout.in_keys

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Returns the graph of each state.

        Args:
            tensordict (TensorDictBase): states ``[*B]``; it is not changed.

        Returns:
            torch.Tensor: float32 ``[*B, N + 1, N]``, 1 where the row (the entities in
            layout order, then the action) is linked to the column, else 0; with
            ``action_only`` only the last row, ``[*B, N]``.

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
        """Returns the positions ``[*B, N, coordinates]``."""
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
        """Returns the settings, for ``repr``."""
        return (
            f"positions={self.positions}, agent={self.agent!r}, "
            f"distance={self.distance}, action_only={self.action_only}"
        )
