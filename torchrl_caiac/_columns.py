"""The names, columns and keys of an entity layout, and the checks of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from tensordict.utils import NestedKey

from torchrl_caiac._keys import as_key, path

__all__ = [
    "check_goal_names",
    "check_names",
    "column_owner",
    "column_ranges",
    "column_spans",
    "disjoint_columns",
    "disjoint_keys",
    "entity_names",
    "fixed_names",
    "goal_vector_columns",
    "mirrored_columns",
    "observation_columns",
]


def entity_names(entities: Any) -> tuple[str, ...]:
    """Returns the names of the entities, after checking them.

    Args:
        entities (mapping of str to Any): the columns or the key of each entity.

    Returns:
        tuple of str: the names, in the order given.

    Raises:
        TypeError: a name is not a non-empty string.
        ValueError: there are no entities.

    Examples:
        >>> from torchrl_caiac._columns import entity_names
        >>> entity_names({"arm": range(2), "cup": [3]})
        ('arm', 'cup')
    """
    if not isinstance(entities, Mapping) or not entities:
        raise ValueError(
            "a layout needs at least one entity: expected a mapping from names to "
            f"columns or keys, got {entities!r}"
        )
    for name in entities:
        if not isinstance(name, str) or not name:
            raise TypeError(f"entity names must be non-empty str, got {name!r}")
    return tuple(entities)


def check_names(names: Iterable[str], known: Sequence[str], argument: str) -> None:
    """Raises if a name is not an entity.

    Args:
        names (iterable of str): the names to check.
        known (sequence of str): the entities of the layout.
        argument (str): the argument's name in error messages.

    Raises:
        ValueError: a name is not an entity.

    Examples:
        >>> from torchrl_caiac._columns import check_names
        >>> check_names(["cup"], ("arm", "cup"), "fixed")
    """
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(
            f"{argument} names {unknown}, which are not entities of this layout; it "
            f"has {list(known)}"
        )


def fixed_names(fixed: Iterable[str], known: Sequence[str]) -> tuple[str, ...]:
    """Returns the names of the fixed entities, after checking them.

    Args:
        fixed (iterable of str): the names.
        known (sequence of str): the entities of the layout.

    Returns:
        tuple of str: the names, in the order given.

    Raises:
        TypeError: ``fixed`` is a string.
        ValueError: a name is not an entity.

    Examples:
        >>> from torchrl_caiac._columns import fixed_names
        >>> fixed_names(["arm"], ("arm", "cup"))
        ('arm',)
    """
    if isinstance(fixed, str):
        raise TypeError(
            f"fixed must be a sequence of names, got {fixed!r}: pass ({fixed!r},)"
        )
    names = tuple(fixed)
    check_names(names, known, "fixed")
    return names


def check_goal_names(
    goal: Mapping[str, Any] | None,
    achieved: Mapping[str, Any] | None,
    names: Sequence[str],
    fixed: Sequence[str],
    nothing: str,
) -> None:
    """Raises if goals are not given for the right entities.

    Args:
        goal (mapping of str to Any, optional): the goal of each entity.
        achieved (mapping of str to Any, optional): what each goal mirrors.
        names (sequence of str): the entities of the layout.
        fixed (sequence of str): entities that need no goal.
        nothing (str): how to write that an entity has no goal, for error messages.

    Raises:
        ValueError: a name is not an entity, an entity is missing, or the two mappings
            have different entities.

    Examples:
        >>> from torchrl_caiac._columns import check_goal_names
        >>> check_goal_names({"cup": [0]}, None, ("arm", "cup"), ("arm",), "()")
    """
    if goal is not None:
        check_names(goal, names, "goal")
        missing = [name for name in names if name not in goal and name not in fixed]
        if missing:
            raise ValueError(
                f"goal lacks {missing}: name the robot in fixed, and give the goal of "
                f"every other entity, {nothing} (in a file []) if it has none"
            )
    if achieved is not None:
        if goal is None:
            raise ValueError("achieved needs goal: pass goal= as well")
        check_names(achieved, names, "achieved")
        unmatched = sorted(set(achieved) ^ set(goal))
        if unmatched:
            raise ValueError(
                f"goal and achieved must name the same entities; {unmatched} are in "
                "only one of them"
            )


def disjoint_columns(
    entities: Mapping[str, Iterable[int]], what: str
) -> dict[str, tuple[int, ...]]:
    """Returns the columns of each entity as tuples, after checking them.

    Args:
        entities (mapping of str to iterable of int): the columns of each entity.
        what (str): the columns' name in error messages.

    Returns:
        dict of str to tuple of int: the columns, in the order given.

    Raises:
        TypeError: a column is not an integer.
        ValueError: a column is negative or belongs to two entities.

    Examples:
        >>> from torchrl_caiac._columns import disjoint_columns
        >>> disjoint_columns({"arm": range(2), "cup": [3]}, "observation")
        {'arm': (0, 1), 'cup': (3,)}
    """
    owner: dict[int, str] = {}
    result: dict[str, tuple[int, ...]] = {}
    for name, columns in entities.items():
        columns = tuple(columns)
        for column in columns:
            if isinstance(column, bool) or not hasattr(column, "__index__"):
                raise TypeError(
                    f"the {what} columns of entity {name!r} must be ints, got "
                    f"{column!r}"
                )
            if column < 0:
                raise ValueError(
                    f"{what} column {column} of entity {name!r} is out of range: "
                    "columns count from 0"
                )
            if column in owner:
                raise ValueError(
                    f"{what} column {column} belongs to both {owner[column]!r} and "
                    f"{name!r}: entities must be disjoint"
                )
            owner[int(column)] = name
        result[name] = tuple(int(column) for column in columns)
    return result


def observation_columns(
    entities: Mapping[str, Iterable[int]],
) -> dict[str, tuple[int, ...]]:
    """Returns the observation columns of each entity as tuples, after checking them.

    Args:
        entities (mapping of str to iterable of int): the columns of each entity.

    Returns:
        dict of str to tuple of int: the columns, in the order given.

    Raises:
        TypeError: a column is not an integer.
        ValueError: an entity has no columns, or a column belongs to two entities.

    Examples:
        >>> from torchrl_caiac._columns import observation_columns
        >>> observation_columns({"arm": range(2), "cup": [3]})
        {'arm': (0, 1), 'cup': (3,)}
    """
    result = disjoint_columns(entities, "observation")
    for name, columns in result.items():
        if not columns:
            raise ValueError(
                f"entity {name!r} has no columns: give it at least one column of the "
                "observation, or leave it out"
            )
    return result


def observation_width(
    width: int | None, columns: Mapping[str, Sequence[int]]
) -> int | None:
    """Returns the width of the observation, after checking it.

    Args:
        width (int, optional): the width, ``None`` for any.
        columns (mapping of str to sequence of int): the columns of each entity.

    Returns:
        int, optional: the width.

    Raises:
        TypeError: the width is not an integer.
        ValueError: an entity has a column beyond it.

    Examples:
        >>> from torchrl_caiac._columns import observation_width
        >>> observation_width(3, {"arm": (0, 2)})
        3
    """
    if width is None:
        return None
    if isinstance(width, bool) or not hasattr(width, "__index__"):
        raise TypeError(f"width must be an int or None, got {width!r}")
    for name, owned in columns.items():
        beyond = [column for column in owned if column >= width]
        if beyond:
            raise ValueError(
                f"entity {name!r} has the columns {beyond}, but width is {width}: "
                "columns count from 0, correct one of the two"
            )
    return int(width)


def goal_vector_columns(
    goal: Mapping[str, Iterable[int]],
) -> dict[str, tuple[int, ...]]:
    """Returns the goal columns of each entity as tuples, after checking them.

    Args:
        goal (mapping of str to iterable of int): the goal columns of each entity.

    Returns:
        dict of str to tuple of int: the columns, in the order given.

    Raises:
        TypeError: a column is not an integer.
        ValueError: a column is missing or belongs to two entities.

    Examples:
        >>> from torchrl_caiac._columns import goal_vector_columns
        >>> goal_vector_columns({"cup": range(0, 2)})
        {'cup': (0, 1)}
    """
    result = disjoint_columns(goal, "goal")
    owned = sorted(column for columns in result.values() for column in columns)
    if owned != list(range(len(owned))):
        raise ValueError(
            f"the goal columns must be 0 to {len(owned) - 1} without a gap, got "
            f"{owned}: assign every goal column to one entity"
        )
    return result


def mirrored_columns(
    achieved: Mapping[str, Iterable[int]],
    goal: Mapping[str, Sequence[int]],
    observed: Mapping[str, Sequence[int]],
) -> dict[str, tuple[int, ...]]:
    """Returns the observation columns that the goal columns of each entity mirror.

    Args:
        achieved (mapping of str to iterable of int): the columns to check.
        goal (mapping of str to sequence of int): the goal columns of each entity.
        observed (mapping of str to sequence of int): the observation columns of each
            entity.

    Returns:
        dict of str to tuple of int: the columns, in the order given.

    Raises:
        TypeError: a column is not an integer.
        ValueError: an entity's columns do not match its goal columns in number, or are
            not among its observation columns.

    Examples:
        >>> from torchrl_caiac._columns import mirrored_columns
        >>> mirrored_columns({"cup": [2]}, {"cup": (0,)}, {"cup": (1, 2)})
        {'cup': (2,)}
    """
    result = disjoint_columns(achieved, "achieved")
    for name, columns in result.items():
        if len(columns) != len(goal[name]):
            raise ValueError(
                f"entity {name!r} has {len(goal[name])} goal columns but "
                f"{len(columns)} achieved columns: give one achieved column for each "
                "goal column"
            )
        foreign = sorted(set(columns) - set(observed[name]))
        if foreign:
            raise ValueError(
                f"the achieved columns {foreign} of entity {name!r} are not among its "
                f"observation columns {column_ranges(observed[name])}"
            )
    return result


def disjoint_keys(keys: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Returns the key of each entity in canonical form, after checking them.

    Args:
        keys (mapping of str to NestedKey): the key of each entity, ``None`` for an
            entity without one.
        what (str): the keys' name in error messages.

    Returns:
        dict of str to NestedKey: the keys, in the order given.

    Raises:
        TypeError: a key is not a string or a tuple of strings.
        ValueError: a key is equal to or below another.

    Examples:
        >>> from torchrl_caiac._columns import disjoint_keys
        >>> disjoint_keys({"arm": "a", "cup": ("a", "b")}, "entity")
        Traceback (most recent call last):
        ...
        ValueError: the entity keys of 'arm' ('a',) and 'cup' ('a', 'b') overlap...
    """
    result: dict[str, NestedKey | None] = {
        name: None if key is None else as_key(key) for name, key in keys.items()
    }
    paths = sorted((path(key), name) for name, key in result.items() if key is not None)
    for (first, name), (second, other) in pairwise(paths):
        if second[: len(first)] == first:
            raise ValueError(
                f"the {what} keys of {name!r} {first} and {other!r} {second} overlap: "
                "give each entity a key of its own"
            )
    return result


def column_owner(
    columns: Mapping[str, Sequence[int]], names: Sequence[str], width: int
) -> torch.Tensor:
    """Returns the position of the entity that owns each column.

    Args:
        columns (mapping of str to sequence of int): the columns of each entity.
        names (sequence of str): the order of the entities.
        width (int): the number of columns, ``W``.

    Returns:
        torch.Tensor: int64 ``[W]``, -1 where no entity owns the column.

    Examples:
        >>> from torchrl_caiac._columns import column_owner
        >>> column_owner({"arm": [0, 3], "cup": [1]}, ["arm", "cup"], 4)
        tensor([ 0,  1, -1,  0])
    """
    owner = torch.full((width,), -1)
    for name, owned in columns.items():
        owner[list(owned)] = names.index(name)
    return owner


def column_ranges(columns: Sequence[int]) -> str:
    """Returns columns as text, a slice where they are consecutive.

    Args:
        columns (sequence of int): the columns.

    Returns:
        str: the text.

    Examples:
        >>> from torchrl_caiac._columns import column_ranges
        >>> column_ranges([2, 3, 4]), column_ranges([4, 2])
        ('[2:5]', '[4, 2]')
    """
    if len(columns) > 1 and all(b == a + 1 for a, b in pairwise(columns)):
        return f"[{columns[0]}:{columns[-1] + 1}]"
    return str(list(columns))


def column_spans(columns: Sequence[int]) -> str:
    """Returns columns as text for people, as spans where they are consecutive.

    Args:
        columns (sequence of int): the columns, in ascending order.

    Returns:
        str: the text.

    Examples:
        >>> from torchrl_caiac._columns import column_spans
        >>> column_spans([0, 1, 2, 3, 7])
        '0-3, 7'
    """
    parts: list[list[int]] = []
    for column in columns:
        if parts and column == parts[-1][-1] + 1:
            parts[-1] = [parts[-1][0], column]
        else:
            parts.append([column])
    return ", ".join("-".join(map(str, part)) for part in parts)
