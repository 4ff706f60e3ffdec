"""The layout of the package: imports follow the data flow, files stay short."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import torchrl_caiac

PACKAGE = Path(torchrl_caiac.__file__).parent
# Each may import those before it and those of its own layer.
LAYERS = [
    {
        "_batches",
        "_buffer_transform",
        "_checks",
        "_column_motion",
        "_columns",
        "_extras",
        "_figures",
        "_files",
        "_fingerprints",
        "_kernels",
        "_keys",
        "_processes",
        "_random",
        "_sampling",
        "_spread",
        "_torchrl",
        "_whole_files",
    },
    {
        "_layout_files",
        "_layout_format",
        "_layout_proposal",
        "_layout_reading",
        "_layout_short",
        "_layout_units",
        "_layout_yaml",
        "_moving_groups",
        "entities",
        "trajectories",
        "trajectory_cache",
    },
    {"checkpoint", "data"},
    {"noise", "layouts"},
    {"envs"},
    {"modules"},
    {"check"},
    {"objectives"},
    {"_fit_rows"},
    {"_fit_quality", "_fit_ranks"},
    {"fit"},
    {"influence"},
    {"transforms"},
    {"caiac_buffer"},
    {"evaluation"},
    {"plotting"},
    {"augment", "inspection", "report", "scored"},
    {"__main__", "cli"},
]
LAYER = {name: number for number, names in enumerate(LAYERS) for name in names}
MODULES = sorted(PACKAGE.rglob("*.py"))
# Tables of numbers may be long.
TABLES = {"waypoints.py"}


def part_of(module: str) -> str:
    """The subpackage or module of the first level, "" for the package itself."""
    return module.split(".")[1] if "." in module else ""


def imports(path: Path) -> list[tuple[str, list[str]]]:
    """What a module imports of the package, also inside functions."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found.append((node.module, [alias.name for alias in node.names]))
        elif isinstance(node, ast.Import):
            found += [(alias.name, []) for alias in node.names]
    return [item for item in found if item[0].split(".")[0] == "torchrl_caiac"]


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_downwards(path: Path) -> None:
    own = path.relative_to(PACKAGE).with_suffix("").parts[0]
    if own == "__init__":
        return
    for module, names in imports(path):
        parts = [part_of(module)] if part_of(module) else names
        for part in parts:
            if part in LAYER:  # else a name of the package itself, as EntityLayout
                assert LAYER[part] <= LAYER[own], (path.name, module)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_private_name_crosses_a_module(path: Path) -> None:
    for module, names in imports(path):
        private = [name for name in names if name.startswith("_")]
        if module == "torchrl_caiac":  # private modules are for the whole package
            private = [name for name in private if name not in LAYER]
        assert not private, (module, private)


def test_every_module_has_its_layer() -> None:
    names = {p.relative_to(PACKAGE).with_suffix("").parts[0] for p in MODULES}
    assert names - {"__init__"} == set(LAYER)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_are_short(path: Path) -> None:
    lines = len(path.read_text().splitlines())
    assert lines <= 600 or path.name in TABLES
