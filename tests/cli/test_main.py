"""The command line as a whole: codes, errors, JSON, and what others print."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import torchrl_caiac
from tests.cli.conftest import Caiac
from torchrl_caiac.cli import main

ROOT = Path(torchrl_caiac.__file__).parents[1]
COMMANDS = ("inspect", "check", "score", "report", "augment", "demo")


def run_process(*arguments: str, **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "torchrl_caiac", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        **options,
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example(caiac: Caiac, command: str) -> None:
    result = caiac(command, "--help")
    assert result.code == 0
    assert "example" in result.out and f"\n  caiac {command} " in result.out


def test_version(caiac: Caiac) -> None:
    assert caiac("--version").out == f"caiac {torchrl_caiac.__version__}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["unknown"],
        ["check", "data"],
        ["check", "data", "--layout"],
        ["score", "data", "--layout", "x", "--out", "y", "--estimator", "magic"],
        ["score", "data", "--layout", "x", "--out", "y", "--steps", "few"],
        ["score", "data", "--layout", "x", "--out", "y", "--tolerance", "-1"],
        ["inspect", "a", "--what"],
    ],
)
def test_a_wrong_command_line(caiac: Caiac, arguments: list[str]) -> None:
    result = caiac(*arguments)
    assert result.code == 2
    assert "usage:" in result.err and not result.out


def test_no_command_shows_the_help(caiac: Caiac) -> None:
    result = caiac()
    assert result.code == 2 and "COMMAND" in result.err and not result.out


def test_an_error_is_one_line_and_a_document(caiac: Caiac) -> None:
    result = caiac("inspect", "missing.npz", "--json")
    assert result.code == 2
    assert result.document == {"error": result.error.removeprefix("error: ")}
    assert "missing.npz does not exist" in result.error


def test_debug_shows_the_traceback(caiac: Caiac) -> None:
    result = caiac("inspect", "missing.npz", "--debug")
    assert "Traceback" in result.err and "UsageError" in result.err


def test_a_mistake_of_the_package_is_one_line(
    caiac: Caiac, pushes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*args: object, **kwargs: object) -> None:
        raise AttributeError("no such thing")

    monkeypatch.setattr("torchrl_caiac.cli.inspect.inspect_dataset", broken)
    result = caiac("inspect", pushes)
    assert result.code == 1
    assert "AttributeError: no such thing; this is a mistake" in result.error


def test_interrupting(
    caiac: Caiac, pushes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrl_caiac.cli.inspect.inspect_dataset", interrupted)
    result = caiac("inspect", pushes)
    assert result.code == 130
    assert result.err.endswith("interrupted: run the same command again to resume\n")


def test_what_others_print_is_not_shown(
    caiac: Caiac, pushes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torchrl_caiac.cli.inspect as command

    original = command.inspect_dataset

    def loud(*args: object, **kwargs: object) -> object:
        print("to the output")
        print("to the error", file=sys.stderr)
        logging.getLogger("another").error("a log message")
        logging.getLogger("torchrl_caiac.x").info("a detail")
        logging.getLogger("torchrl_caiac.x").warning("a matter\nof importance")
        warnings.warn("a warning of another package", stacklevel=1)
        return original(*args, **kwargs)

    monkeypatch.setattr(command, "inspect_dataset", loud)
    result = caiac("inspect", pushes, "--json")
    assert result.document["num_transitions"] == 240
    lines = result.err.splitlines()
    assert lines == ["looking at the columns ...", "warning: a matter of importance"]
    shown = caiac("inspect", pushes, "--json", "--debug")
    assert shown.document["num_transitions"] == 240
    assert "to the output" in shown.err and "a detail" in shown.err


def test_loggers_and_streams_are_given_back(caiac: Caiac, pushes: Path) -> None:
    logger = logging.getLogger("torchrl_caiac")
    before = (sys.stdout, sys.stderr, warnings.showwarning, list(logger.handlers))
    caiac("inspect", pushes)
    after = (sys.stdout, sys.stderr, warnings.showwarning, list(logger.handlers))
    assert before == after


def test_as_a_process(pushes: Path) -> None:
    done = run_process("inspect", str(pushes), "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["episodes"]["count"] == 6
    assert done.stderr == "looking at the columns ...\n"


def test_output_to_a_closed_pipe(pushes: Path) -> None:
    done = subprocess.run(
        f"{sys.executable} -m torchrl_caiac inspect {pushes} | true; "
        'echo "${PIPESTATUS[0]}"',
        shell=True,
        executable="/bin/bash",
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.stdout == "0\n"
    assert "Traceback" not in done.stderr and "BrokenPipe" not in done.stderr


def test_main_reads_the_arguments_of_the_process(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["caiac", "--version"])
    assert main() == 0
    assert capsys.readouterr().out.startswith("caiac ")
