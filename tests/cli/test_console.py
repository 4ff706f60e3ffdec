"""The console on a terminal, and what it keeps from it."""

from __future__ import annotations

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

import torchrl_caiac
from torchrl_caiac.cli.console import Console

ROOT = Path(torchrl_caiac.__file__).parents[1]

SCRIPT = """
import os, sys, time, warnings
from tqdm.auto import tqdm
from torchrl_caiac.cli.console import Console
with Console() as console:
    with console.step("working"):
        print("noise")
        print("more noise", file=sys.stderr)
        os.write(1, b"noise of C")
        os.write(2, b"noise of C")
        warnings.warn("noise")
        for _ in tqdm(range(3), disable=not console.progress, desc="bar"):
            pass
    console.text("the result")
print("afterwards")
"""


def on_a_terminal(script: str) -> tuple[str, str]:
    """Runs a script whose standard error is a terminal; returns output and error."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=theirs,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    os.close(theirs)
    out, _ = process.communicate()
    shown = b""
    while True:
        try:
            part = os.read(ours, 4096)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        shown += part
    os.close(ours)
    return out, shown.decode()


def test_a_terminal_sees_bars_and_steps() -> None:
    out, shown = on_a_terminal(SCRIPT)
    assert out == "the result\nafterwards\n"
    assert "bar: 100%" in shown and "3/3" in shown
    assert shown.startswith("working ...")
    assert "noise" not in shown and "Warning" not in shown


def test_a_warning_is_shown_once_and_on_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with Console() as console:
        console.warn("look\n  here")
        console.warn("look here")
    assert capsys.readouterr().err == "warning: look here\n"
    assert console.warnings == ["look here"]


def test_everything_is_given_back_after_an_error(
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = sys.stdout, sys.stderr
    with pytest.raises(ValueError, match="oops"), Console() as console:
        console.text("a")
        raise ValueError("oops")
    assert (sys.stdout, sys.stderr) == before
    print("b")
    assert capsys.readouterr().out == "a\nb\n"
