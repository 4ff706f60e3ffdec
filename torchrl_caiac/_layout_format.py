"""The JSON form and the text form of an entity layout."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from torchrl_caiac._columns import column_ranges
from torchrl_caiac._keys import jsonable, key_from_json

if TYPE_CHECKING:
    from torchrl_caiac.entities import EntityLayout

__all__ = ["layout_arguments", "layout_text", "layout_to_dict"]

_FORMAT = "torchrl_caiac.EntityLayout"
_VERSION = 1
_KEYS = {"format", "version", "entities", "flat", "goal", "achieved", "fixed"}
_KEYS |= {"next_key"}
_MOST_COLUMNS = 2**31 - 1
# Written only where they are given, so that digests of other layouts stay the same.
_UNITS = {"positions", "variance_floor"}
# The keys that only flat layouts have.
_FLAT_KEYS = ("observation_key", "desired_goal_key", "achieved_goal_key")


def layout_to_dict(layout: EntityLayout) -> dict[str, Any]:
    """Returns a layout as JSON-compatible values.

    Args:
        layout (EntityLayout): the layout.

    Returns:
        dict: the input of :func:`layout_arguments`.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_format import layout_to_dict
        >>> layout_to_dict(EntityLayout({"arm": [0, 1]}))["entities"]
        [['arm', [0, 1]]]
    """
    entities: Mapping[str, Any] = layout.columns if layout.is_flat else layout.keys

    # Pairs, because the order of the entities is part of the layout.
    def pairs(named: Mapping[str, Any]) -> list[Any]:
        return [[name, jsonable(value)] for name, value in named.items()]

    content: dict[str, Any] = {
        "format": _FORMAT,
        "version": _VERSION,
        "entities": pairs(entities),
        "flat": layout.is_flat,
        "goal": pairs(layout.goal),
        "achieved": pairs(layout.achieved),
        "fixed": list(layout.fixed),
        "next_key": jsonable(layout.next_key),
    }
    if layout.is_flat:
        content |= {key: jsonable(getattr(layout, key)) for key in _FLAT_KEYS}
    for part in sorted(_UNITS):
        if getattr(layout, part):
            content[part] = pairs(getattr(layout, part))
    if layout.width is not None:
        content["width"] = layout.width
    return content


def layout_arguments(content: Any) -> tuple[bool, dict[str, Any]]:
    """Returns the arguments of the layout that :func:`layout_to_dict` described.

    Args:
        content (Any): the result of :func:`layout_to_dict`.

    Returns:
        tuple of bool and dict: whether the layout is flat, and the arguments of
        ``EntityLayout`` or ``EntityLayout.from_keys``.

    Raises:
        ValueError: the content does not describe a layout, or has another version.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_format import layout_arguments
        >>> content = EntityLayout({"arm": [0, 1]}).to_dict()
        >>> layout_arguments(content)[1]["entities"]
        {'arm': (0, 1)}
    """
    if not isinstance(content, Mapping) or content.get("format") != _FORMAT:
        raise ValueError(
            "the content does not describe an EntityLayout: expected a mapping with "
            f"'format': {_FORMAT!r}"
        )
    if content.get("version") != _VERSION:
        raise ValueError(
            f"the layout has version {reprlib.repr(content.get('version'))}, expected "
            f"{_VERSION}: update torchrl_caiac"
        )
    is_flat = content.get("flat")
    if not isinstance(is_flat, bool):
        raise _unexpected("flat", "true or false", is_flat)
    expected = _KEYS | set(_FLAT_KEYS if is_flat else ())
    optional = _UNITS | ({"width"} if is_flat else set())
    if content.keys() - optional != expected:
        raise ValueError(
            f"the layout lacks {sorted(expected - content.keys())} and has the unknown "
            f"{reprlib.repr(sorted(map(str, content.keys() - expected - optional)))}"
        )
    named = {part: _pairs(content, part) for part in ("entities", "goal", "achieved")}
    for part, pairs in named.items():
        for name, value in pairs.items():
            where = f"{part} of {name!r}"
            if is_flat:
                pairs[name] = _columns(value, where)
            elif value is not None or part == "entities":
                pairs[name] = _key(value, where)
    fixed = content["fixed"]
    if not _is_list_of(str, fixed):
        raise _unexpected("fixed", "a list of names", fixed)
    arguments: dict[str, Any] = {
        "entities": named["entities"],
        "goal": named["goal"] or None,
        "achieved": named["achieved"] or None,
        "fixed": fixed,
        "next_key": _key(content["next_key"], "next_key"),
    }
    if is_flat:
        arguments |= {key: _key(content[key], key) for key in _FLAT_KEYS}
    if "positions" in content:
        arguments["positions"] = {
            name: _columns(value, f"positions of {name!r}")
            for name, value in _pairs(content, "positions").items()
        }
    if "variance_floor" in content:
        arguments["variance_floor"] = _pairs(content, "variance_floor")
    if "width" in content:
        if type(content["width"]) is not int:
            raise _unexpected("width", "a number of columns", content["width"])
        arguments["width"] = content["width"]
    return is_flat, arguments


def _pairs(content: Mapping[str, Any], part: str) -> dict[str, Any]:
    pairs = content[part]
    if not isinstance(pairs, (list, tuple)) or not all(
        isinstance(pair, (list, tuple)) and len(pair) == 2 and isinstance(pair[0], str)
        for pair in pairs
    ):
        raise _unexpected(part, "a list of [name, columns or key] pairs", pairs)
    result = dict(pairs)
    if len(result) != len(pairs):
        raise _unexpected(part, "each name once", [name for name, _ in pairs])
    return result


def _columns(value: Any, where: str) -> tuple[int, ...]:
    if not _is_list_of(int, value) or not all(0 <= x < _MOST_COLUMNS for x in value):
        raise _unexpected(where, f"a list of columns from 0 to {_MOST_COLUMNS}", value)
    return tuple(value)


def _key(value: Any, where: str) -> Any:
    if isinstance(value, str) or (value and _is_list_of(str, value)):
        return key_from_json(list(value) if isinstance(value, tuple) else value)
    raise _unexpected(where, "a key: text, or a list of texts", value)


def _is_list_of(kind: type, value: Any) -> bool:
    # type(), because True is an int.
    return isinstance(value, (list, tuple)) and all(type(x) is kind for x in value)


def _unexpected(where: str, expected: str, found: Any) -> ValueError:
    return ValueError(
        f"{where} of the layout: expected {expected}, got {reprlib.repr(found)}"
    )


def layout_text(layout: EntityLayout) -> str:
    """Returns a layout as text, one line for each entity.

    Args:
        layout (EntityLayout): the layout.

    Returns:
        str: the text.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_format import layout_text
        >>> print(layout_text(EntityLayout({"arm": [0, 1]})))
        EntityLayout(
            arm: observation[0:2]
        )
    """
    lines = []
    for name in layout.names:
        goal, achieved = layout.goal.get(name), layout.achieved.get(name)
        if layout.is_flat:
            observation = _key_text(layout.observation_key)
            line = f"{observation}{column_ranges(layout.columns[name])}"
            if goal:
                line += f", goal{column_ranges(goal)}"
                if achieved is not None:
                    line += f" mirrors {observation}{column_ranges(achieved)}"
        else:
            line = _key_text(layout.keys[name])
            if goal is not None:
                line += f", goal {_key_text(goal)}"
                if achieved is not None:
                    line += f" mirrors {_key_text(achieved)}"
        lines.append(f"    {name}: {line}{', fixed' if name in layout.fixed else ''}")
    return "\n".join(["EntityLayout(", *lines, ")"])


def _key_text(key: Any) -> str:
    return key if isinstance(key, str) else repr(key)
