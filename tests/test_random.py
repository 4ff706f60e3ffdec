"""Tests of random numbers on one device from generators of another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from tests.pretend_cuda import nothing_waits
from torchrl_caiac._random import draw_below, draw_numbers

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


def test_numbers_below_limits_have_equal_chances():
    limit = torch.tensor([[3], [1], [0], [-1]]).expand(4, 30_000)
    found = draw_below(limit, generator=torch.Generator().manual_seed(0))
    counts = found[0].bincount()
    assert len(counts) == 3 and (counts - 10_000).abs().max() < 5 * 82
    assert not found[1:].any() and found.dtype == torch.int64


def test_the_largest_share_is_below_the_limit(monkeypatch):
    largest = 1 - 2.0**-53
    monkeypatch.setattr(
        torch, "rand", lambda size, dtype, **_: torch.full(size, largest, dtype=dtype)
    )
    limits = torch.tensor([1, 2, 3, 5, 512, 1000, 3 * 2**40, 2**48 - 1, 2**48])
    assert torch.equal(draw_below(limits), limits - 1)


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
