"""Which columns of a layout are positions, and how noisy they are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torchrl_caiac._columns import check_names, disjoint_columns

if TYPE_CHECKING:
    from torchrl_caiac.entities import EntityLayout

__all__ = [
    "FloorArgument",
    "entity_floors",
    "position_columns",
    "position_features",
    "position_places",
]

FloorArgument = float | Mapping[str, float | Sequence[float]] | None


def position_columns(
    positions: Mapping[str, Iterable[int]] | None,
    names: Sequence[str],
    columns: Mapping[str, tuple[int, ...]],
) -> dict[str, tuple[int, ...]]:
    """Returns the columns of each position as tuples, after checking them.

    Args:
        positions (mapping of str to iterable of int, optional): the argument of the
            layout.
        names (sequence of str): the entities of the layout.
        columns (mapping of str to tuple of int): the columns of each entity, empty
            for nested layouts, whose widths are unknown.

    Returns:
        dict of str to tuple of int: the columns, in layout order.

    Raises:
        TypeError: a column is not an integer.
        ValueError: a name is not an entity; a column is negative, given twice, or not
            one of the entity's.

    Examples:
        >>> from torchrl_caiac._layout_units import position_columns
        >>> position_columns({"cup": [3]}, ("arm", "cup"), {"arm": (0,), "cup": (2, 3)})
        {'cup': (3,)}
    """
    if positions is None:
        return {}
    check_names(positions, names, "positions")
    result: dict[str, tuple[int, ...]] = {}
    for name in names:
        if name not in positions:
            continue
        # One entity at a time: places in different entities may be equal.
        result |= disjoint_columns({name: positions[name]}, "position")
        foreign = [c for c in result[name] if columns and c not in columns[name]]
        if foreign or not result[name]:
            raise ValueError(
                f"positions give entity {name!r} the columns {foreign}, which it does "
                f"not have, expected some of {list(columns.get(name, ()))}: correct "
                "positions="
                if foreign
                else f"positions give entity {name!r} no columns: leave it out"
            )
    return result


def entity_floors(
    floor: FloorArgument,
    names: Sequence[str],
    columns: Mapping[str, tuple[int, ...]],
    argument: str = "variance_floor",
) -> dict[str, float | tuple[float, ...]]:
    """Returns the variance floor of each entity, after checking it.

    Args:
        floor (float or mapping, optional): the argument of the layout.
        names (sequence of str): the entities of the layout.
        columns (mapping of str to tuple of int): the columns of each entity, empty
            for nested layouts, whose widths are unknown.
        argument (str): the argument's name in error messages. Defaults to
            ``"variance_floor"``.

    Returns:
        dict of str to float or tuple of float: one number for an entity, or one for
        each of its columns, in layout order; empty if there is no floor.

    Raises:
        TypeError: a floor is not a number.
        ValueError: a name is not an entity; an entity has no floor; a floor is not
            positive and finite; the number of floors is not that of the columns.

    Examples:
        >>> from torchrl_caiac._layout_units import entity_floors
        >>> entity_floors({"arm": 0.1, "cup": [1, 2]}, ("arm", "cup"), {})
        {'arm': 0.1, 'cup': (1.0, 2.0)}
    """
    if floor is None:
        return {}
    given: dict[str, Any]
    given = dict(floor) if isinstance(floor, Mapping) else dict.fromkeys(names, floor)
    check_names(given, names, argument)
    missing = [name for name in names if name not in given]
    if missing:
        raise ValueError(
            f"{argument} lacks {missing}: give each entity its own, in the units "
            "of its columns, or one number for all"
        )
    result: dict[str, float | tuple[float, ...]] = {}
    for name in names:
        value = given[name]
        # NumPy's numbers and arrays, and tensors, become Python's.
        value = value.tolist() if hasattr(value, "tolist") else value
        one = not isinstance(value, Sequence) or isinstance(value, str)
        values = [value] if one else list(value)
        if any(
            isinstance(v, (bool, str)) or not hasattr(v, "__float__") for v in values
        ):
            raise TypeError(
                f"{argument} of entity {name!r} is {value!r}, expected a number or "
                "one for each of its columns"
            )
        numbers = tuple(float(v) for v in values)
        if any(not 0 < v < float("inf") for v in numbers):
            raise ValueError(
                f"{argument} of entity {name!r} is {value!r}, expected "
                "a number in the units of the data, positive and finite"
            )
        if not one and columns and len(numbers) != len(columns[name]):
            raise ValueError(
                f"{argument} of entity {name!r} has {len(numbers)} numbers, "
                f"expected one for each of its {len(columns[name])} columns"
            )
        result[name] = numbers[0] if one else numbers
    return result


def position_features(layout: EntityLayout, name: str, width: int) -> list[int]:
    """Returns which features of an entity tell where it is.

    Args:
        layout (EntityLayout): the entities.
        name (str): the entity.
        width (int): the number of its features.

    Returns:
        list of int: the places of ``layout.positions`` in its features, all of them if
        the layout does not name the entity's positions.

    Raises:
        ValueError: a position is beyond the width (nested layouts).

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_units import position_features
        >>> layout = EntityLayout({"cup": [4, 5, 6]}, positions={"cup": [5]})
        >>> position_features(layout, "cup", 3)
        [1]
    """
    places = position_places(layout, name)
    if not places:
        return list(range(width))
    if max(places) >= width:
        raise ValueError(
            f"positions give entity {name!r} the features {places}, but it has "
            f"{width}: correct positions="
        )
    return places


def position_places(layout: EntityLayout, name: str) -> list[int]:
    """Returns the places of an entity's positions in its features.

    Args:
        layout (EntityLayout): the entities.
        name (str): the entity.

    Returns:
        list of int: the places, empty if the layout does not name its positions.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_units import position_places
        >>> layout = EntityLayout(
        ...     {"arm": [0], "cup": [4, 5, 6]}, positions={"cup": [5]}
        ... )
        >>> position_places(layout, "cup"), position_places(layout, "arm")
        ([1], [])
    """
    positions = layout.positions.get(name, ())
    if not layout.is_flat:
        return list(positions)
    return [layout.columns[name].index(column) for column in positions]
