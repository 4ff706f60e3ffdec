"""Reading YAML: texts, lists and mappings, each with its line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from torchrl_caiac._files import UnreadableFileError

__all__ = ["Lines", "Plain", "read_yaml"]

#: The line of each value, by the names and places that lead to it.
Lines = dict[tuple[str | int, ...], int]

_MOST_BYTES = 1 << 20
# What YAML takes unquoted values for; a tag that is written out is something else.
_TYPES = ("str", "int", "float", "bool", "null", "map", "seq", "timestamp", "merge")
_TAGS = {f"tag:yaml.org,2002:{name}" for name in (*_TYPES, "value")}


class Plain(str):
    """A value without quotes: a text or a number, whatever its reader expects.

    YAML itself would take ``10:22`` for a number with base 60, ``no`` for a boolean
    and ``1e-3`` for a text.

    Examples:
        >>> from torchrl_caiac._layout_yaml import Plain
        >>> Plain("10:22") == "10:22"
        True
    """


def read_yaml(path: Path, what: str, remedy: str) -> tuple[Any, Lines]:
    r"""Reads a YAML file; only texts, lists and mappings come out of it.

    Args:
        path (Path): the file.
        what (str): what the file is, for the error message, such as ``"layout"``.
        remedy (str): the end of the message, which says what to do.

    Returns:
        tuple: the content, with unquoted values as :class:`Plain`, and the lines.

    Raises:
        FileNotFoundError: there is no such file.
        UnreadableFileError: it is not YAML, too large, or has a name twice, an anchor
            or a tag.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac._layout_yaml import read_yaml
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(f"{folder}/a.yaml")
        ...     _ = file.write_text("entities:\n  cup: [1, 2]")
        ...     read_yaml(file, "layout", "correct it")[0]
        {'entities': {'cup': ['1', '2']}}
    """
    size = path.stat().st_size
    lines: Lines = {}
    try:
        if not path.is_file():
            raise ValueError("it is not a file")
        if size > _MOST_BYTES:
            raise ValueError(f"it has {size} bytes, expected at most {_MOST_BYTES}")
        text = path.read_text(encoding="utf-8")
        # Nodes, not objects: nothing is constructed.
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        if node is None:
            raise ValueError("it is empty")
        return _value(node, (), lines, set()), lines
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise UnreadableFileError(
            f"{path} is not a readable {what} ({error}): {remedy}"
        ) from error


def _value(
    node: yaml.Node, path: tuple[str | int, ...], lines: Lines, seen: set[int]
) -> Any:
    line = lines[path] = node.start_mark.line + 1
    if id(node) in seen:
        raise ValueError(f"line {line} has an anchor that is used twice: write it out")
    seen.add(id(node))
    if node.tag not in _TAGS:
        raise ValueError(f"line {line} has the tag {node.tag!r}: leave it out")
    if isinstance(node, yaml.ScalarNode):
        return Plain(node.value) if node.style is None else str(node.value)
    if isinstance(node, yaml.SequenceNode):
        return [_value(n, (*path, i), lines, seen) for i, n in enumerate(node.value)]
    content: dict[str, Any] = {}
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise ValueError(f"line {line} has a name that is not a text")
        if key.value in content:
            raise ValueError(
                f"line {key.start_mark.line + 1} gives {key.value!r} a second time"
            )
        content[key.value] = _value(value, (*path, key.value), lines, seen)
    return content
