"""What a CUDA device does not allow, and its stand-in neither."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from tests.pretend_cuda import nothing_waits

pytestmark = pytest.mark.gpu


@pytest.fixture
def x() -> torch.Tensor:
    return torch.arange(3.0, device="cuda")


def test_values_are_those_of_the_cpu(x: torch.Tensor) -> None:
    y = torch.zeros_like(x)
    y[1:] += x.sort(descending=True).values[:2] * torch.tensor(2.0)
    y[torch.tensor([0])] = 7.0
    assert y.tolist() == [7.0, 4.0, 2.0]
    assert x.device == y.device == torch.device("cuda", 0) and y.is_cuda
    assert torch.equal(y.cpu(), torch.tensor([7.0, 4.0, 2.0]))
    assert not y.cpu().is_cuda


@pytest.mark.parametrize(
    "mix",
    [
        lambda x: x + torch.ones(3),
        lambda x: torch.cat([torch.ones(3), x]),
        lambda x: x.gather(0, torch.tensor([0])),
        lambda x: torch.nn.Linear(3, 3)(x),
        lambda x: torch.nn.Linear(3, 3).to("cuda")(x.cpu()),
    ],
)
def test_operands_lie_on_one_device(mix: Callable[[Any], Any], x: torch.Tensor) -> None:
    with pytest.raises(RuntimeError, match="same device"):
        mix(x)


def test_generators_draw_on_their_own_device() -> None:
    with pytest.raises(RuntimeError, match="generator"):
        torch.rand(3, generator=torch.Generator(), device="cuda")


@pytest.mark.parametrize(
    "look",
    [
        lambda x: x.sum().item(),
        lambda x: x.tolist(),
        lambda x: x.cpu(),
        lambda x: torch.zeros(3).copy_(x),
        lambda x: bool((x > 0).all()),
        lambda x: x[x > 0],
        lambda x: x.__setitem__(x > 0, torch.ones_like(x)[:2]),
        lambda x: x[torch.tensor([0])],
        lambda x: x.nonzero(),
        lambda x: x.unique(),
        lambda x: torch.equal(x, x + 1),
        lambda x: x.repeat_interleave(x.long()),
        lambda x: x + torch.tensor([1.0, 2.0, 3.0], device="cuda"),
    ],
)
def test_looking_waits(look: Callable[[Any], Any], x: torch.Tensor) -> None:
    look(x)
    with nothing_waits(), pytest.raises(RuntimeError, match=r"waits|synchronizing"):
        look(x)


def test_work_on_the_device_waits_for_nothing(x: torch.Tensor) -> None:
    here = torch.zeros(3, pin_memory=True)
    with nothing_waits():
        y = torch.randn(3, device="cuda").clamp(min=x.amin()) + 1.0
        y[:2] = x[x.long()][:2]
        here.copy_(y, non_blocking=True)
        y.copy_(here, non_blocking=True)
        torch.where(y > 0, y, x)
