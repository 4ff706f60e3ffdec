"""How ready layouts are written down: the columns of an observation, in order."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

from tensordict.utils import NestedKey

from torchrl_caiac.entities import EntityLayout

__all__ = ["MILLIMETRE", "MILLIRADIAN", "STATE", "TURN", "Columns", "LayoutDescription"]

#: In metres.
MILLIMETRE = 1e-3
#: In radians: of joints. It moves a point one metre from the axis by a millimetre.
MILLIRADIAN = 1e-3
#: In radians: of things as large as a hand. It moves their surface by a millimetre.
TURN = 0.03
#: Of columns that are 0 or 1.
STATE = 0.05


@dataclass(frozen=True)
class Columns:
    """Columns of an observation that follow each other and have one meaning.

    Attributes:
        what (str): the meaning, with the unit.
        width (int): the number of columns.
        entity (str, optional): whose they are; ``None`` if they depend on several
            entities or are not used.
        floor (float): the change that is noise: a millimetre, or an angle that moves
            a surface about as far, in the units of the columns.
        is_position (bool): whether they say where the entity is.
        is_goal (bool): whether the goal mirrors them.
        is_unit (bool): whether their Euclidean norm is 1.
        is_not_zero (bool): whether they are never all zero.
        bounds (tuple of float, optional): the least and the largest value.
        difference (tuple of int, optional): the first columns of two others: these are
            the first minus the second.
    """

    what: str
    width: int
    entity: str | None = None
    floor: float = MILLIMETRE
    is_position: bool = False
    is_goal: bool = False
    is_unit: bool = False
    is_not_zero: bool = False
    bounds: tuple[float, float] | None = None
    difference: tuple[int, int] | None = None


@dataclass(frozen=True)
class LayoutDescription:
    """A ready layout with what is needed to recognise its data.

    Attributes:
        name (str): the name, as ``"ogbench/scene"``.
        columns (tuple of Columns): all columns of the observation, in order.
        fixed (tuple of str): the entities that are never swapped.
        notes (str): what a user has to know.
        observation_key (NestedKey): the key of the observation.

    Examples:
        >>> from torchrl_caiac.layouts.description import Columns, LayoutDescription
        >>> description = LayoutDescription(
        ...     "toy",
        ...     (
        ...         Columns("joint angles, rad", 2, "arm"),
        ...         Columns("position, m", 3, "cup", is_position=True),
        ...     ),
        ...     fixed=("arm",),
        ...     notes="",
        ... )
        >>> description.layout()
        EntityLayout(
            arm: observation[0:2], fixed
            cup: observation[2:5]
        )
        >>> description.layout().positions
        {'cup': (2, 3, 4)}
    """

    name: str
    columns: tuple[Columns, ...]
    fixed: tuple[str, ...]
    notes: str
    observation_key: NestedKey = "observation"

    @property
    def width(self) -> int:
        """The number of columns."""
        return sum(part.width for part in self.columns)

    @property
    def places(self) -> list[tuple[Columns, range]]:
        """The parts of the observation, each with its columns."""
        ends = accumulate(part.width for part in self.columns)
        return [
            (part, range(end - part.width, end))
            for part, end in zip(self.columns, ends, strict=True)
        ]

    @property
    def unowned(self) -> list[int]:
        """The columns that belong to no entity."""
        return [c for part, place in self.places if part.entity is None for c in place]

    def layout(self) -> EntityLayout:
        """Returns the layout.

        Returns:
            EntityLayout: a flat layout with positions, floors and the exact width.
        """
        owned = [(p.entity, p, place) for p, place in self.places if p.entity]
        entities: dict[str, list[int]] = {name: [] for name, _, _ in owned}
        floors: dict[str, list[float]] = {name: [] for name in entities}
        positions: dict[str, list[int]] = {}
        achieved: dict[str, list[int]] = {}
        goal: dict[str, list[int]] = {}
        goals = 0
        for name, part, place in owned:
            entities[name] += place
            floors[name] += [part.floor] * part.width
            if part.is_position:
                positions.setdefault(name, []).extend(place)
            if part.is_goal:
                achieved.setdefault(name, []).extend(place)
                goal.setdefault(name, []).extend(range(goals, goals + part.width))
                goals += part.width
        return EntityLayout(
            entities,
            observation_key=self.observation_key,
            goal=goal or None,
            achieved=achieved or None,
            fixed=self.fixed,
            positions=positions,
            variance_floor=floors,
            width=self.width,
        )
