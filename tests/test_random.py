"""Tests of random numbers on one device from generators of another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from tests.pretend_cuda import nothing_waits
from torchrl_caiac._random import draw_numbers

KINDS: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]] = [
    (torch.rand, ((2, 3),), {"dtype": torch.float64}),
    (torch.randn, ((5,),), {}),
    (torch.randint, (9, (4,)), {"dtype": torch.int32}),
]


@pytest.mark.parametrize(("kind", "args", "kwargs"), KINDS)
def test_numbers_are_those_of_the_generator(kind, args, kwargs):
    for generator in (None, torch.Generator().manual_seed(0)):
        torch.manual_seed(0)
        found = draw_numbers(
            kind, *args, device=torch.device("cpu"), generator=generator, **kwargs
        )
        torch.manual_seed(0)
        torch.testing.assert_close(found, kind(*args, **kwargs))


@pytest.mark.gpu
@pytest.mark.parametrize(("kind", "args", "kwargs"), KINDS)
def test_a_generator_of_the_host_gives_its_numbers_to_a_gpu(kind, args, kwargs):
    device = torch.device("cuda", 0)
    generator = torch.Generator().manual_seed(0)
    with nothing_waits():
        found = draw_numbers(kind, *args, device=device, generator=generator, **kwargs)
    assert found.device == device
    expected = kind(*args, generator=generator.manual_seed(0), **kwargs)
    torch.testing.assert_close(found.cpu(), expected)
    found = draw_numbers(kind, *args, device=device, **kwargs)
    assert found.device == device and found.dtype == expected.dtype
