"""Checks of the arguments that say which columns a world model reads and predicts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from torchrl_caiac.entities import EntityLayout

__all__ = [
    "checked_inputs",
    "checked_predict",
    "checked_widths",
    "named_columns",
]


def checked_widths(
    layout: EntityLayout, widths: Mapping[str, int] | None
) -> dict[str, int]:
    """Returns the number of features of each entity, in layout order.

    Args:
        layout (EntityLayout): the entities.
        widths (Mapping of str to int, optional): the argument of the model.

    Returns:
        dict of str to int: one number for each entity.

    Raises:
        ValueError: the widths do not fit the layout.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules._predicted_columns import checked_widths
        >>> checked_widths(EntityLayout({"arm": [0, 1], "cup": [2]}), None)
        {'arm': 2, 'cup': 1}
    """
    if layout.is_flat:
        own = layout.widths()
        if widths is not None and dict(widths) != own:
            raise ValueError(
                f"widths are {dict(widths)}, expected {own}: leave widths out for a "
                "flat layout"
            )
        return own
    if widths is None:
        raise ValueError(
            "the number of features of a nested layout is unknown: pass "
            "widths=layout.widths(td) with an example tensordict"
        )
    if set(widths) != set(layout.names):
        raise ValueError(
            f"widths are of {sorted(widths)}, expected those of {list(layout.names)}"
        )
    for name, width in widths.items():
        if not isinstance(width, int) or width < 1:
            raise ValueError(
                f"the width of entity {name!r} must be an int of at least 1, got "
                f"{width!r}"
            )
    return {name: widths[name] for name in layout.names}


def checked_predict(
    layout: EntityLayout,
    widths: Mapping[str, int],
    predict: Mapping[str, Iterable[int]] | None,
) -> dict[str, tuple[int, ...]]:
    """Returns the positions to predict in the features of each entity.

    Args:
        layout (EntityLayout): the entities.
        widths (Mapping of str to int): the number of features of each entity.
        predict (Mapping of str to iterable of int, optional): the argument of the
            model.

    Returns:
        dict of str to tuple of int: one tuple for each entity, in layout order.

    Raises:
        ValueError: a column is not the entity's, is given twice, or none is left.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules._predicted_columns import checked_predict
        >>> layout = EntityLayout({"arm": [0, 1], "cup": [2, 3]})
        >>> checked_predict(layout, layout.widths(), {"cup": [3]})
        {'arm': (0, 1), 'cup': (1,)}
    """
    positions = _positions(layout, widths, predict, "predict")
    if not any(positions.values()):
        raise ValueError("predict leaves nothing to predict: give some columns")
    return positions


def checked_inputs(
    layout: EntityLayout,
    widths: Mapping[str, int],
    inputs: Mapping[str, Iterable[int]] | None,
) -> dict[str, tuple[int, ...]]:
    """Returns the positions to read in the features of each entity.

    Args:
        layout (EntityLayout): the entities.
        widths (Mapping of str to int): the number of features of each entity.
        inputs (Mapping of str to iterable of int, optional): the argument of the
            model.

    Returns:
        dict of str to tuple of int: one tuple for each entity, in layout order.

    Raises:
        ValueError: a column is not the entity's, is given twice, or none is left.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules._predicted_columns import checked_inputs
        >>> layout = EntityLayout({"arm": [0, 1], "cup": [2, 3]})
        >>> checked_inputs(layout, layout.widths(), {"arm": ()})
        {'arm': (), 'cup': (0, 1)}
    """
    positions = _positions(layout, widths, inputs, "inputs")
    if not any(positions.values()):
        raise ValueError(
            "inputs leave no column of the state to read, so that the model would "
            "predict the same in every state: give some columns"
        )
    return positions


def named_columns(
    layout: EntityLayout, positions: Mapping[str, tuple[int, ...]]
) -> dict[str, list[int]]:
    """Returns the columns at some positions, as the arguments of a model name them.

    Args:
        layout (EntityLayout): the entities.
        positions (Mapping of str to tuple of int): the output of
            :func:`checked_predict` or :func:`checked_inputs`.

    Returns:
        dict of str to list of int: columns of the observation for flat layouts, the
        positions themselves for nested ones.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules._predicted_columns import named_columns
        >>> named_columns(EntityLayout({"arm": [0, 3]}), {"arm": (1,)})
        {'arm': [3]}
    """
    columns = layout.columns
    return {
        name: [columns[name][p] for p in places] if layout.is_flat else list(places)
        for name, places in positions.items()
    }


def _positions(
    layout: EntityLayout,
    widths: Mapping[str, int],
    given: Mapping[str, Iterable[int]] | None,
    argument: str,
) -> dict[str, tuple[int, ...]]:
    given = {} if given is None else given
    unknown = [name for name in given if name not in layout.names]
    if unknown:
        raise ValueError(
            f"{argument} names {unknown}, which are not entities of this layout: "
            f"expected some of {list(layout.names)}"
        )
    positions: dict[str, tuple[int, ...]] = {}
    for name in layout.names:
        own = layout.columns[name] if layout.is_flat else tuple(range(widths[name]))
        columns = tuple(given.get(name, own))
        foreign = [column for column in columns if column not in own]
        if foreign or len(set(columns)) != len(columns):
            what = f"{foreign}, which it does not own" if foreign else f"{columns}"
            raise ValueError(
                f"{argument} gives entity {name!r} the columns {what}: name each of "
                f"its columns {list(own)} at most once"
            )
        positions[name] = tuple(own.index(column) for column in columns)
    return positions
