"""``caiac demo``: how the study is started, and that the wheel has it."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.cli.conftest import Caiac

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The processes that would be started."""
    found: list[list[str]] = []

    def start(command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        found.append(command)
        return subprocess.CompletedProcess(command, 3 if "size=quick" in command else 0)

    monkeypatch.setattr("torchrl_caiac.cli.demo.subprocess.run", start)
    return found


def test_the_study_is_started(
    caiac: Caiac, calls: list[list[str]], tmp_path: Path
) -> None:
    assert caiac("demo", "--out", "here", "--json").document == {
        "written": "here/studies/demo"
    }
    ((python, study, *arguments),) = calls
    assert python == sys.executable and Path(study).read_text().startswith(
        '"""Runs all'
    )
    assert arguments == ["study=demo", f"root={tmp_path / 'work' / 'here'}"]


def test_a_study_that_fails(caiac: Caiac, calls: list[list[str]]) -> None:
    result = caiac("demo", "--quick")
    assert result.code == 1 and "exit code 3" in result.error


def test_the_extra_is_named(caiac: Caiac, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "hydra" else find(name)
    )
    result = caiac("demo")
    assert result.code == 1
    assert "needs hydra: pip install 'torchrl-caiac[examples]'" in result.error


def test_the_wheel_has_every_example(tmp_path: Path) -> None:
    """What setup.py names is what lies in the folder."""
    code = (
        "import json, runpy, setuptools\n"
        "setuptools.setup = lambda **options: print(json.dumps(options))\n"
        "runpy.run_path('setup.py')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    options = json.loads(done.stdout)
    # A package index has none of the files that the README refers to.
    addresses = re.findall(r"\]\(([^)]+)\)", options["long_description"])
    assert addresses and all(re.match("https?:|#", a) for a in addresses)
    packages = {
        p for p in options["packages"] if p.startswith("torchrl_caiac_examples")
    }
    folders = {
        ".".join(["torchrl_caiac_examples", *file.parent.relative_to(ROOT).parts[1:]])
        for file in (ROOT / "examples").rglob("*.py")
    }
    assert packages == folders
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    data = project["tool"]["setuptools"]["package-data"]["torchrl_caiac_examples"]
    settings = set((ROOT / "examples").rglob("*.yaml"))
    assert settings == {
        f for pattern in data for f in (ROOT / "examples").glob(pattern)
    }
    library = {p for p in options["packages"] if p not in packages}
    assert library == {
        ".".join(file.parent.relative_to(ROOT).parts)
        for file in (ROOT / "torchrl_caiac").rglob("__init__.py")
    }
