"""The short form of an entity layout, which a person writes by hand."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NoReturn

from torchrl_caiac._columns import column_ranges
from torchrl_caiac._keys import jsonable, key_from_json
from torchrl_caiac._layout_yaml import Lines, Plain

if TYPE_CHECKING:
    from torchrl_caiac.entities import EntityLayout

__all__ = ["layout_to_short", "short_arguments"]

_KEYS = ("observation_key", "desired_goal_key", "achieved_goal_key", "next_key")
_DEFAULTS = ("observation", "desired_goal", "achieved_goal", "next")
_COMMON = {"goal", "achieved", "fixed", "positions", "variance_floor", "next_key"}
_FLAT = _COMMON | {"entities", "width", *_KEYS}
_NESTED = _COMMON | {"keys"}
_RANGE = re.compile(r"\s*(\d{1,10})\s*(?::\s*(\d{1,10})\s*)?")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_LAST_COLUMN = 2**31 - 1
_MOST_COLUMNS = 1_000_000  # a range is short to write, and long to hold
_COLUMNS = "columns such as [10, 11, 12] or '10:13'"


def layout_to_short(layout: EntityLayout) -> dict[str, Any]:
    """Returns a layout in the short form.

    Args:
        layout (EntityLayout): the layout.

    Returns:
        dict: the input of :func:`short_arguments`.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_short import layout_to_short
        >>> layout_to_short(EntityLayout({"arm": [0, 1, 2], "cup": [5]}))
        {'entities': {'arm': '0:3', 'cup': [5]}}
    """
    content: dict[str, Any] = {}
    if layout.is_flat:
        content["entities"] = {n: _short(c) for n, c in layout.columns.items()}
    else:
        content["keys"] = {n: jsonable(key) for n, key in layout.keys.items()}
    if layout.fixed:
        content["fixed"] = list(layout.fixed)
    for part in ("goal", "achieved"):
        named = getattr(layout, part)
        if named:
            write = _short if layout.is_flat else jsonable
            content[part] = {name: write(value) for name, value in named.items()}
    if layout.positions:
        content["positions"] = {n: _short(c) for n, c in layout.positions.items()}
    if layout.variance_floor:
        content["variance_floor"] = {
            name: list(floor) if isinstance(floor, tuple) else floor
            for name, floor in layout.variance_floor.items()
        }
    if layout.width is not None:
        content["width"] = layout.width
    for name, default in zip(_KEYS, _DEFAULTS, strict=True):
        if getattr(layout, name) not in (None, default):
            content[name] = jsonable(getattr(layout, name))
    return content


def _short(columns: tuple[int, ...]) -> Any:
    text = column_ranges(columns)
    is_range = ":" in text and len(columns) <= _MOST_COLUMNS
    return text[1:-1] if is_range else list(columns)


def short_arguments(
    content: Any, lines: Lines | None = None
) -> tuple[bool, dict[str, Any]]:
    """Returns the arguments of the layout that a person has described.

    Args:
        content (Any): a mapping with ``entities``, or ``keys`` for a nested layout,
            and any other argument of ``EntityLayout``.
        lines (dict, optional): the lines of the values, for error messages. Defaults
            to ``None``: the messages have none.

    Returns:
        tuple of bool and dict: whether the layout is flat, and the arguments of
        ``EntityLayout`` or ``EntityLayout.from_keys``.

    Raises:
        ValueError: a field is unknown or has a wrong value; the message names it.

    Examples:
        >>> from torchrl_caiac._layout_short import short_arguments
        >>> short_arguments({"entities": {"arm": "0:3", "cup": "3, 5:7"}})
        (True, {'entities': {'arm': (0, 1, 2), 'cup': (3, 5, 6)}})
        >>> short_arguments({"entities": {"arm": "0-3"}})
        Traceback (most recent call last):
        ...
        ValueError: entities.arm: expected columns such as ... got '0-3'
    """
    return _Reader(lines or {}).arguments(content)


class _Reader:
    def __init__(self, lines: Lines) -> None:
        self.lines = lines

    def arguments(self, content: Any) -> tuple[bool, dict[str, Any]]:
        if not isinstance(content, Mapping):
            self.fail((), "a mapping with 'entities'", content)
        is_flat = "keys" not in content
        known = _FLAT if is_flat else _NESTED
        for name in content:
            if name not in known:
                self.fail((name,), f"only the fields {sorted(known)}", name)
        if is_flat and "entities" not in content:
            self.fail((), "'entities', or 'keys' of a nested layout", list(content))
        arguments: dict[str, Any] = {}
        if is_flat:
            read: Any = self.columns
            arguments["entities"] = self.named(content, "entities", read)
        else:
            read = self.key_or_none
            arguments["entities"] = self.named(content, "keys", self.key)
        for part in ("goal", "achieved"):
            if part in content:
                arguments[part] = self.named(content, part, read)
        if "positions" in content:
            arguments["positions"] = self.named(content, "positions", self.columns)
        if "fixed" in content:
            fixed = content["fixed"]
            if not isinstance(fixed, list):
                self.fail(("fixed",), "a list of names", fixed)
            arguments["fixed"] = [
                self.text(name, ("fixed", i)) for i, name in enumerate(fixed)
            ]
        if "variance_floor" in content:
            floor = content["variance_floor"]
            if isinstance(floor, Mapping):
                floor = self.named(content, "variance_floor", self.floors)
            else:
                floor = self.number(floor, ("variance_floor",))
            arguments["variance_floor"] = floor
        if "width" in content:
            width = self.integer(content["width"], ("width",), "a number of columns")
            arguments["width"] = width
        for name in _KEYS:
            if name in content:
                arguments[name] = self.key(content[name], (name,))
        return is_flat, arguments

    def named(self, content: Mapping[str, Any], part: str, read: Any) -> dict[str, Any]:
        values = content[part]
        if not isinstance(values, Mapping):
            self.fail((part,), "a mapping from names", values)
        return {name: read(value, (part, name)) for name, value in values.items()}

    def columns(self, value: Any, where: tuple[str | int, ...]) -> tuple[int, ...]:
        if not isinstance(value, list):
            value = value.split(",") if isinstance(value, str) else [value]
            return tuple(c for item in value for c in self.span(item, where))
        return tuple(
            c for i, item in enumerate(value) for c in self.span(item, (*where, i))
        )

    def span(self, value: Any, where: tuple[str | int, ...]) -> range:
        match = _RANGE.fullmatch(value) if isinstance(value, str) else None
        if match is None:
            column = self.integer(value, where, _COLUMNS)
            return range(column, column + 1)
        first, end = int(match[1]), int(match[2] or int(match[1]) + 1)
        if not (first < end <= first + _MOST_COLUMNS and end <= _LAST_COLUMN + 1):
            self.fail(where, f"{_COLUMNS}, from small to large", value)
        return range(first, end)

    def integer(self, value: Any, where: tuple[str | int, ...], wanted: str) -> int:
        if isinstance(value, Plain) and re.fullmatch(r"\d{1,10}", value):
            value = int(value)
        # type(), because True is an int.
        if type(value) is not int or not 0 <= value <= _LAST_COLUMN:
            self.fail(where, wanted, value)
        return int(value)

    def floors(self, value: Any, where: tuple[str | int, ...]) -> Any:
        if isinstance(value, list):
            return [self.number(v, (*where, i)) for i, v in enumerate(value)]
        return self.number(value, where)

    def number(self, value: Any, where: tuple[str | int, ...]) -> float:
        if isinstance(value, Plain) and _NUMBER.fullmatch(value):
            return float(value)
        if isinstance(value, (str, bool)) or not isinstance(value, (int, float)):
            self.fail(where, "a number", value)
        return float(value)

    def text(self, value: Any, where: tuple[str | int, ...]) -> str:
        if not isinstance(value, str):
            self.fail(where, "a text", value)
        return str(value)

    def key(self, value: Any, where: tuple[str | int, ...]) -> Any:
        if isinstance(value, list) and value:
            parts = [self.text(v, (*where, i)) for i, v in enumerate(value)]
            return key_from_json(parts)
        if not isinstance(value, str):
            self.fail(where, "a key: a text, or a list of texts", value)
        return str(value)

    def key_or_none(self, value: Any, where: tuple[str | int, ...]) -> Any:
        if value is None or (isinstance(value, Plain) and value in ("null", "~", "")):
            return None
        return self.key(value, where)

    def fail(self, where: tuple[str | int, ...], wanted: str, found: Any) -> NoReturn:
        line = self.lines.get(where)
        name = ".".join(map(str, where)) or "the layout"
        raise ValueError(
            f"{f'line {line}, ' if line else ''}{name}: expected {wanted}, got "
            f"{reprlib.repr(str(found) if isinstance(found, Plain) else found)}"
        )
