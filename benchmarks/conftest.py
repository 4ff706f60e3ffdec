"""Options and fixtures that all benchmarks share."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.ratios import Judged
from torchrl_caiac._kernels import machine, processor_slug
from torchrl_caiac._processes import available_processors

_LINES = pytest.StashKey[list[str]]()
# The units that decide which kernels are fast, by their names in torch.
_UNITS = {"AVX2": "avx2", "AVX-512": "avx512_f", "bfloat16": "bf16", "AMX": "amx"}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds ``--device`` and ``--ratios``, which ``make bench DEVICE=...`` sets."""
    parser.addoption(
        "--device", default="cpu", choices=["cpu", "cuda"], help="where to measure"
    )
    parser.addoption(
        "--ratios",
        help="a folder, in which benchmark_<processor>.txt gets the list of ratios",
    )


def described(name: str) -> str:
    """Returns the processor, or the card, and what it has."""
    own = machine()
    units = ", ".join(
        f"{unit} {'yes' if any(part in x for x in own['units']) else 'no'}"
        for unit, part in _UNITS.items()
    )
    card = f"{torch.cuda.get_device_name()}; " if name == "cuda" else ""
    return (
        f"{card}{own['processor']}, {available_processors()} cores; {units}; "
        f"torch {own['torch']}; {date.today()}"
    )


def pytest_report_header(config: pytest.Config) -> str:
    """Names the processor at the start of a run."""
    return described(config.getoption("--device"))


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> torch.device:
    """The device to measure on."""
    name = request.config.getoption("--device")
    if name == "cuda" and not torch.cuda.is_available():
        raise pytest.UsageError("--device=cuda, but torch sees no CUDA device")
    return torch.device(name)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Uses one thread and flushes denormal numbers, as the scripts do."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    yield
    torch.set_flush_denormal(False)
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def no_old_objects() -> Iterator[None]:
    """Excludes the objects of earlier benchmarks from garbage collection."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.fixture
def judge(benchmark: Any, request: pytest.FixtureRequest) -> Callable[..., None]:
    """Reports a ratio and its target: ``judge(name, value, at_most=1.6)``.

    The ratios are listed after the run, and saved with the benchmark's other figures.
    """

    def judge(
        name: str,
        value: float,
        *,
        at_least: float | None = None,
        at_most: float | None = None,
    ) -> None:
        target = at_most if at_least is None else at_least
        if target is None or None not in (at_least, at_most):
            raise ValueError("a ratio has one target, at_least or at_most")
        judged = Judged(name, value, target, at_least is not None)
        request.config.stash.setdefault(_LINES, []).append(str(judged))
        benchmark.extra_info[name] = {
            "ratio": round(value, 4),
            "at_least" if judged.at_least else "at_most": target,
            "holds": judged.holds,
        }

    return judge


@pytest.fixture
def note(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Adds a line to the list of ratios: ``note("text")``."""
    return request.config.stash.setdefault(_LINES, []).append


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Lists the ratios, their targets, and whether they are met."""
    device = config.getoption("--device")
    lines = [described(device), "", *config.stash.get(_LINES, [])]
    if lines[2:]:
        terminalreporter.section("ratios and their targets")
        for line in lines:
            terminalreporter.write_line(line)
    if config.getoption("--ratios"):
        name = "cuda" if device == "cuda" else processor_slug(machine()["processor"])
        file = Path(config.getoption("--ratios"), f"benchmark_{name}.txt")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("\n".join(lines) + "\n")
        terminalreporter.write_line(f"written to {file}")
