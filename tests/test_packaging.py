"""What the installed package promises: what it imports, names and documents."""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.version import Version

import torchrl_caiac

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
# A module here is the package itself, a sub-package, or a public module beside them.
MODULES = sorted(
    ["torchrl_caiac"]
    + [
        f"torchrl_caiac.{module.name}"
        for module in pkgutil.iter_modules(torchrl_caiac.__path__)
        if module.name != "entities"  # the package's own names
        and not module.name.startswith("_")
    ]
)
PUBLIC = [
    (module, name)
    for module in MODULES
    for name in importlib.import_module(module).__all__
]
# None of these may be needed to import the core.
OPTIONAL = (
    "gymnasium",
    "gymnasium_robotics",
    "h5py",
    "hydra",
    "matplotlib",
    "minari",
    "mujoco",
    "omegaconf",
    "PIL",
    "scipy",
    "sklearn",
    "tensorboard",
    "wandb",
)
CORE = (
    "torchrl_caiac",
    "torchrl_caiac.augment",
    "torchrl_caiac.checkpoint",
    "torchrl_caiac.cli",
    "torchrl_caiac.data",
    "torchrl_caiac.evaluation",
    "torchrl_caiac.fit",
    "torchrl_caiac.influence",
    "torchrl_caiac.inspection",
    "torchrl_caiac.modules",
    "torchrl_caiac.objectives",
    "torchrl_caiac.plotting",
    "torchrl_caiac.report",
    "torchrl_caiac.scored",
    "torchrl_caiac.transforms",
)


def test_core_imports_without_extras() -> None:
    code = (
        "import sys\n"
        f"sys.modules.update(dict.fromkeys({OPTIONAL!r}))\n"  # None: not to be had
        + "".join(f"import {module}\n" for module in CORE)
    )
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr


def test_version_is_one() -> None:
    """The citation is of the last release, or of the first one to come."""
    version = Version(importlib.metadata.version("torchrl-caiac"))
    assert torchrl_caiac.__version__ == str(version)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    fallback = Version(project["setuptools_scm"]["fallback_version"])
    assert fallback <= version
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == fallback.base_version
    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert f"\n## [{fallback.base_version}] - " in changelog


def test_installed_packages_are_at_their_pins() -> None:
    """A constraints file that does not match what runs here would prove nothing."""
    pins = [
        Requirement(line)
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if line and not line.startswith("#")
    ]
    wrong = {}
    for pin in pins:
        if pin.marker is not None and not pin.marker.evaluate():
            continue
        try:
            found = importlib.metadata.version(pin.name)
        except importlib.metadata.PackageNotFoundError:
            continue  # not on this platform
        if not pin.specifier.contains(found, prereleases=True):
            wrong[pin.name] = (found, str(pin.specifier))
    assert not wrong


def test_all_extra_names_every_other_extra_but_the_peers() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    (everything,) = extras["all"]
    named = set(re.search(r"\[(.*)\]", everything)[1].split(","))
    # What benchmarks compare with is installed for them alone.
    assert named == set(extras) - {"all", "bench"}


def test_every_supported_python_is_tested() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = [text.rsplit(" ", 1)[1] for text in project["classifiers"]]
    workflow = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text())
    tested = workflow["jobs"]["tests"]["strategy"]["matrix"]["python"]
    assert tested == [version for version in named if version.startswith("3.")]
    assert project["requires-python"] == f">={tested[0]}"


def test_package_is_typed() -> None:
    assert (Path(torchrl_caiac.__file__).parent / "py.typed").is_file()


@pytest.mark.parametrize(("module", "name"), PUBLIC)
def test_public_names_have_a_docstring(module: str, name: str) -> None:
    thing = getattr(importlib.import_module(module), name)
    if not (inspect.isclass(thing) or inspect.isroutine(thing)):
        return  # a constant: described where it is defined
    doc = inspect.getdoc(thing) or ""
    assert len(doc) > 20, f"{module}.{name} has no docstring"
    # The reference's tables end a summary at the first point.
    summary = re.sub(r"`[^`]*`", "", doc.split("\n\n")[0])
    assert not re.search(r"\.\s", summary), f"{module}.{name}: {summary}"
    own = (
        [
            n
            for n, v in vars(thing).items()
            # TorchRL puts its own forward into subclasses of its losses.
            if inspect.isfunction(v) and v.__module__.startswith("torchrl_caiac")
        ]
        if inspect.isclass(thing)
        else []
    )
    bare = [
        n
        for n in own
        if not n.startswith("_") and not inspect.getdoc(getattr(thing, n))
    ]
    assert not bare, f"{module}.{name} has public methods without docstring: {bare}"


def test_reference_lists_every_room() -> None:
    """The names within a module come from its ``__all__``, see docs/_templates."""
    text = (ROOT / "docs" / "reference" / "index.rst").read_text()
    listed = re.findall(r"^   (torchrl_caiac[\w.]*)$", text, flags=re.MULTILINE)
    assert sorted(listed) == sorted(MODULES)


@pytest.mark.parametrize("module", MODULES)
def test_all_resolves(module: str) -> None:
    module = importlib.import_module(module)
    assert len(module.__all__) == len(set(module.__all__))
    assert not [name for name in module.__all__ if not hasattr(module, name)]
