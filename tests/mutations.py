"""Random damage to JSON values and to files, for tests of what reads them."""

from __future__ import annotations

import copy
import json
import random
from pathlib import Path
from typing import Any

VALUES: list[Any] = [
    None, True, False, 0, 1, -1, 3, 2**31, 2**63, 10**30, 0.5, -0.0, float("nan"),
    float("inf"), "", "a", "arm", "../x", "a/b", "\0", "torch.float32", "[6, 2]",
    [], [0], [-1], [1, 2], [2**62, 4], ["a"], [None], [[]], {}, {"a": 1}, {"type": "x"},
]  # fmt: skip


def mutate_json(value: Any, rng: random.Random) -> Any:
    """A copy in which one to three random places are replaced, removed or doubled."""
    value = copy.deepcopy(value)
    for _ in range(rng.randint(1, 3)):
        holder: list[Any] = [value]
        places = list(_places(holder))
        parent, key = rng.choice(places)
        action = rng.choice(["replace", "replace", "remove", "double", "swap"])
        if action == "replace" or parent is holder:
            parent[key] = copy.deepcopy(rng.choice(VALUES))
        elif action == "remove":
            del parent[key]
        elif action == "double" and isinstance(parent, list):
            parent.insert(key, copy.deepcopy(parent[key]))
        elif action == "double":
            parent[rng.choice(["extra", "", "arm", "a"])] = copy.deepcopy(parent[key])
        else:
            other, place = rng.choice(places)
            parent[key] = copy.deepcopy(other[place])
        value = holder[0]
    return value


def _places(holder: Any) -> Any:
    pairs = holder.items() if isinstance(holder, dict) else enumerate(holder)
    for key, value in list(pairs):
        yield holder, key
        if isinstance(value, (dict, list)):
            yield from _places(value)


def mutate_file(file: Path, rng: random.Random) -> None:
    """Damages a file: bits, length, content, or JSON values."""
    content = bytearray(file.read_bytes())
    action = rng.choice(["bits", "cut", "append", "zeros", "json", "remove", "folder"])
    if action == "json" and file.suffix == ".json":
        text = json.dumps(mutate_json(json.loads(content), rng))
        content = bytearray(text.encode())
    elif action == "remove":
        file.unlink()
        return
    elif action == "folder":
        file.unlink()
        file.mkdir()
        return
    elif action == "cut":
        del content[rng.randint(0, len(content)) :]
    elif action == "append":
        content += rng.randbytes(rng.randint(1, 100))
    elif action == "zeros" and content:
        first = rng.randrange(len(content))
        content[first : first + 64] = bytes(len(content[first : first + 64]))
    elif content:
        for _ in range(rng.randint(1, 8)):
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    file.write_bytes(content)
