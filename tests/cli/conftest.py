"""What the tests of the command line share."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.pushes import LAYOUT, push_transitions
from torchrl_caiac.cli import main
from torchrl_caiac.data import write_transitions


@dataclass
class Result:
    """What a call of the command line left."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> Any:
        """The standard output as JSON."""
        return json.loads(self.out)

    @property
    def error(self) -> str:
        """The only line of the standard error that is an error."""
        (line,) = [x for x in self.err.splitlines() if x.startswith("error: ")]
        assert "Traceback" not in self.err
        return line


Caiac = Callable[..., Result]


@pytest.fixture
def caiac(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> Caiac:
    """Runs the command line in this process, with a cache and working folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)

    def run(*arguments: str | Path) -> Result:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        found = capsys.readouterr()
        return Result(code, found.out, found.err)

    return run


@pytest.fixture
def pushes(caiac: Caiac) -> Path:
    """A folder of transitions and ``layout.json``, in the working folder."""
    write_transitions(push_transitions(), "pushes", action_bounds=([-1], [1]))
    LAYOUT.save("layout.json")
    return Path("pushes")


@pytest.fixture
def scored(caiac: Caiac, pushes: Path) -> Path:
    """The folder ``scored`` that ``caiac score`` wrote."""
    result = caiac("score", pushes, "--layout", "layout.json", "--out", "scored")
    assert result.code == 0, result.err
    return Path("scored")
