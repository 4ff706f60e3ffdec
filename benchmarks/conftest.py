"""Options and fixtures that all benchmarks share."""

from __future__ import annotations

import pytest
import torch


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds ``--device``, which ``make bench DEVICE=...`` sets."""
    parser.addoption(
        "--device", default="cpu", choices=["cpu", "cuda"], help="where to measure"
    )


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> torch.device:
    """The device to measure on."""
    name = request.config.getoption("--device")
    if name == "cuda" and not torch.cuda.is_available():
        raise pytest.UsageError("--device=cuda, but torch sees no CUDA device")
    return torch.device(name)
