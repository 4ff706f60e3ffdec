"""Tests of the product of a linear layer: values, gradients, stacks, both libraries."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchrl_caiac.modules import linear as module
from torchrl_caiac.modules.linear import linear


@pytest.fixture(params=[False, True], ids=["torch", "onednn"])
def onednn(request, monkeypatch) -> bool:
    """Whether all float32 products, however small, go to oneDNN."""
    monkeypatch.setattr(module, "_SMALL", 0)
    monkeypatch.setattr(
        module,
        "_onednn",
        lambda *x: request.param and all(y.dtype == torch.float32 for y in x),
    )
    return request.param


def draw(*shape: int, seed: int = 0, dtype=torch.float32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator).to(dtype)


def slow_linear(value, weight, bias, relu):
    """Sums of products in float64."""
    value, weight, bias = (x.double() for x in (value, weight, bias))
    out = (value.unsqueeze(-2) * weight).sum(-1) + bias
    return out.clamp_min(0.0) if relu else out


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    batch=st.sampled_from([(), (1,), (7,), (2, 3)]),
    wide=st.integers(1, 9),
    high=st.integers(1, 9),
    relu=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_values_and_gradients(onednn, dtype, batch, wide, high, relu, seed):
    shapes = [(*batch, wide), (high, wide), (high,)]
    operands = [
        draw(*shape, seed=seed + i, dtype=dtype).requires_grad_()
        for i, shape in enumerate(shapes)
    ]
    got, want = linear(*operands, relu), slow_linear(*operands, relu)
    assert got.dtype == dtype
    tolerance = 0.03 if dtype == torch.bfloat16 else 1e-5
    torch.testing.assert_close(got.double(), want, rtol=tolerance, atol=tolerance)
    # Where rounding decides the sign, the gradients may differ.
    factor = draw(*want.shape, seed=seed + 3, dtype=dtype)
    factor = factor * (want.abs() > 2 * tolerance)
    gradients = torch.autograd.grad(got, operands, factor)
    wanted = torch.autograd.grad(want, operands, factor.double())
    for a, b in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=10 * tolerance)


def test_factors_that_are_views(onednn):
    value, weight = draw(12, 10)[::2, 1::2], draw(5, 8, seed=1).t()
    for one in (value, value[:1].expand(6, 5), value.t().contiguous().t()):
        torch.testing.assert_close(
            linear(one, weight, draw(8)), F.linear(one, weight, draw(8))
        )
    assert linear(value[:0], weight, draw(8)).shape == (0, 8)


@pytest.mark.parametrize("relu", [False, True])
def test_gradients_of_gradients(onednn, relu):
    def torchs(*operands):
        return F.relu(F.linear(*operands)) if relu else F.linear(*operands)

    results = []
    for product in (lambda *x: linear(*x, relu), torchs):
        value, weight = draw(6, 5).requires_grad_(), draw(3, 5, seed=1).requires_grad_()
        out = product(value, weight, draw(3)).square().sum()
        (slope,) = torch.autograd.grad(out, value, create_graph=True)
        slope.square().sum().backward()
        results.append((value.grad, weight.grad))
    for got, want in zip(*results, strict=True):
        torch.testing.assert_close(got, want)


@pytest.mark.parametrize("shared", [False, True])
def test_vmap(onednn, shared):
    value = draw(6, 5) if shared else draw(2, 6, 5)
    weight, bias = draw(2, 3, 5, seed=1).requires_grad_(), draw(2, 3, seed=2)
    mapped = torch.vmap(linear, (None if shared else 0, 0, 0, None))
    got = mapped(value, weight, bias, True)
    layers = zip(value.expand(2, 6, 5), weight, bias, strict=True)
    want = torch.stack([linear(*layer, True) for layer in layers])
    torch.testing.assert_close(got, want)
    (a,), (b,) = (torch.autograd.grad(x.square().sum(), weight) for x in (got, want))
    torch.testing.assert_close(a, b)


def used(monkeypatch, *operands: torch.Tensor) -> bool:
    """Whether oneDNN is called for a product."""
    calls = []
    product = module._Linear.apply
    monkeypatch.setattr(
        module._Linear, "apply", lambda *x: calls.append(x) or product(*x)
    )
    got = linear(*operands)
    torch.testing.assert_close(got, F.linear(*operands))
    return bool(calls)


@pytest.mark.parametrize(
    ("case", "want"),
    [
        ("large", True),
        ("small", False),
        ("float64", False),
        ("bfloat16", False),
        ("autocast", False),
        ("narrow", False),
        ("absent", False),
    ],
)
def test_who_multiplies(monkeypatch, case, want):
    """oneDNN only where it is there, may be quicker, and gives the same dtype."""
    rows = 8 if case == "small" else 256
    operands = [draw(rows, 64), draw(128, 64, seed=1), draw(128, seed=2)]
    if case in ("float64", "bfloat16"):
        operands = [x.to(getattr(torch, case)) for x in operands]
    capability = "AVX2" if case == "narrow" else "AVX512"
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: case != "absent")
    with torch.autocast("cpu", torch.bfloat16, enabled=case == "autocast"):
        assert used(monkeypatch, *operands) is want


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize(
    "strided",
    [
        lambda: draw(64, 16)[::4],
        lambda: draw(16, 32)[:, ::2],
        lambda: draw(16, 32)[:, :16],
        lambda: draw(1, 16).expand(16, 16),
        lambda: draw(16, 16).t(),
    ],
    ids=["rows", "columns", "first", "expanded", "transposed"],
)
def test_onednn_gets_dense_operands(strided, relu, monkeypatch) -> None:
    # On others it is hundreds of times slower.
    monkeypatch.setattr(module, "_SMALL", 0)
    monkeypatch.setattr(module, "_onednn", lambda *x: True)
    product, seen = module.linear_pointwise, []

    def spy(value, weight, bias, positive):
        seen.extend([value, weight])
        return product(value, weight, bias, positive)

    monkeypatch.setattr(module, "linear_pointwise", spy)
    value, weight = strided().requires_grad_(), strided().requires_grad_()
    bias = draw(16, seed=2).requires_grad_()
    out = linear(value, weight, bias, relu)
    out.sum().backward()  # whose gradient is expanded
    assert len(seen) == 6
    assert all(x.is_contiguous() or x.t().is_contiguous() for x in seen)
    torch.testing.assert_close(
        out.double(), slow_linear(value, weight, bias, relu), rtol=1e-4, atol=1e-4
    )
