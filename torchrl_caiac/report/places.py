"""Where each entity is: the features of a state that are its position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tensordict import TensorDictBase

from torchrl_caiac._columns import column_ranges
from torchrl_caiac._keys import path
from torchrl_caiac.entities import EntityLayout

__all__ = ["Place", "entity_places"]


@dataclass(frozen=True)
class Place:
    """The features that say where an entity is.

    Attributes:
        features (tuple of int): the positions in the last dimension of
            :meth:`~torchrl_caiac.EntityLayout.read`.
        labels (tuple of str): the names of these features, such as
            ``"observation[10]"``.
        floors (tuple of float): the change of each feature that is noise; 0 if unknown.
        known (bool): whether the layout says that these are positions. If not, they are
            all features of the entity, velocities included.
        text (str): all labels in short, such as ``"observation[10:13]"``.
    """

    features: tuple[int, ...]
    labels: tuple[str, ...]
    floors: tuple[float, ...]
    known: bool = True
    text: str = ""

    @property
    def is_point(self) -> bool:
        """Whether the entity is at a point in space, with three coordinates."""
        return self.known and len(self.features) == 3


def entity_places(layout: EntityLayout, data: TensorDictBase) -> dict[str, Place]:
    """Returns where each entity is.

    These are the layout's ``positions``. An entity without them is at the observation
    columns that its goal mirrors, if there are any, else at all of its features.

    Args:
        layout (EntityLayout): the entities.
        data (TensorDictBase): transitions ``[T]``, for the widths of nested entities.

    Returns:
        dict of str to Place: the places, in layout order.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.report.places import entity_places
        >>> layout = EntityLayout(
        ...     {"arm": [4, 5], "cup": [0, 1, 2, 3]}, positions={"cup": [2, 3]}
        ... )
        >>> data = TensorDict({"observation": torch.zeros(5, 6)}, [5])
        >>> places = entity_places(layout, data)
        >>> places["cup"].features, places["cup"].labels, places["cup"].text
        ((4, 5), ('observation[2]', 'observation[3]'), 'observation[2:4]')
        >>> places["arm"].known
        False
    """
    places = {}
    for name, features in layout.slices(data[:1]).items():
        if layout.is_flat:
            key = "/".join(path(layout.in_keys[0]))
            numbers: Sequence[int] = layout.columns[name]
            columns = layout.positions.get(name) or layout.achieved.get(name) or ()
        else:
            key = "/".join(path(layout.keys[name]))
            numbers = range(features.stop - features.start)
            columns = layout.positions.get(name, ())
        chosen = [numbers.index(column) for column in columns]
        known = bool(chosen)
        chosen = chosen or list(range(len(numbers)))
        floor = layout.variance_floor.get(name, 0.0)
        floors = floor if isinstance(floor, tuple) else (floor,) * len(numbers)
        places[name] = Place(
            tuple(features.start + i for i in chosen),
            tuple(f"{key}[{numbers[i]}]" for i in chosen),
            tuple(float(floors[i]) for i in chosen),
            known,
            key + column_ranges([numbers[i] for i in chosen]),
        )
    return places
