"""Tests of the product of a linear layer: values, gradients, stacks, both libraries."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
import torch.nn.functional as F
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchrl_caiac._kernels import onednn_has_float32
from torchrl_caiac.modules import linear as module
from torchrl_caiac.modules import linear_kernel
from torchrl_caiac.modules.linear import faster_dtype, inference_linear, linear

KERNELS = ["plain", "onednn"] if onednn_has_float32() else ["plain"]


@pytest.fixture(params=KERNELS)
def kernel(request, monkeypatch) -> Iterator[str]:
    """What computes all float32 products, however small."""
    monkeypatch.setattr(module, "_SMALL", 1)
    with linear_kernel(request.param):
        yield request.param


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
def test_values_and_gradients(kernel, dtype, batch, wide, high, relu, seed):
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


def test_factors_that_are_views(kernel):
    value, weight = draw(12, 10)[::2, 1::2], draw(5, 8, seed=1).t()
    for one in (value, value[:1].expand(6, 5), value.t().contiguous().t()):
        torch.testing.assert_close(
            linear(one, weight, draw(8)), F.linear(one, weight, draw(8))
        )
    assert linear(value[:0], weight, draw(8)).shape == (0, 8)


@pytest.mark.parametrize("relu", [False, True])
def test_gradients_of_gradients(kernel, relu):
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
def test_vmap(kernel, shared):
    value = draw(6, 5) if shared else draw(2, 6, 5)
    weight, bias = draw(2, 3, 5, seed=1).requires_grad_(), draw(2, 3, seed=2)
    mapped = torch.vmap(linear, (None if shared else 0, 0, 0, None))
    got = mapped(value, weight, bias, True)
    layers = zip(value.expand(2, 6, 5), weight, bias, strict=True)
    want = torch.stack([linear(*layer, True) for layer in layers])
    torch.testing.assert_close(got, want)
    (a,), (b,) = (torch.autograd.grad(x.square().sum(), weight) for x in (got, want))
    torch.testing.assert_close(a, b)


@contextmanager
def counted(monkeypatch) -> Iterator[list[None]]:
    """Collects the calls of oneDNN."""
    calls, through = [], module.through_onednn

    def spy():
        calls.append(None)
        return through()

    with monkeypatch.context() as patch:
        patch.setattr(module, "through_onednn", spy)
        yield calls


@pytest.mark.parametrize(
    ("case", "want"),
    [
        ("large", True),
        ("small", False),
        ("float64", False),
        ("bfloat16", False),
        ("autocast", False),
        ("absent", False),
        ("mapped", False),
    ],
)
def test_who_multiplies(monkeypatch, new_process, case, want):
    """oneDNN only where it is there, may be faster, and gives the same dtype."""
    new_process("onednn")
    rows = 8 if case == "small" else 256
    operands = [draw(rows, 64), draw(128, 64, seed=1), draw(128, seed=2)]
    if case in ("float64", "bfloat16"):
        operands = [x.to(getattr(torch, case)) for x in operands]
    product = linear
    if case == "mapped":
        operands[0], product = operands[0][None], torch.vmap(linear, (0, None, None))
    monkeypatch.setattr(module, "onednn_has_float32", lambda: case != "absent")
    with (
        torch.autocast("cpu", torch.bfloat16, enabled=case == "autocast"),
        counted(monkeypatch) as calls,
    ):
        torch.testing.assert_close(product(*operands), F.linear(*operands))
    assert bool(calls) is want


STRIDED = pytest.mark.parametrize(
    "strided",
    [
        lambda: draw(64, 16)[::4],
        lambda: draw(16, 32)[:, ::2],
        lambda: draw(16, 32)[:, :16],
        lambda: draw(1, 16).expand(16, 16),
        lambda: draw(16, 16).t(),
        lambda: draw(2, 8, 32)[..., ::2],
    ],
    ids=["rows", "columns", "first", "expanded", "transposed", "batched"],
)


@STRIDED
@pytest.mark.parametrize("relu", [False, True])
def test_strided_operands(kernel, strided, relu) -> None:
    operands = [strided(), strided().reshape(16, 16), draw(16, seed=2)]
    results = []
    for product in (lambda *x: linear(*x, relu), lambda *x: slow_linear(*x, relu)):
        factors = [x.detach().requires_grad_() for x in operands]
        out = product(*factors)
        out.sum().backward()  # whose gradient is expanded
        results.append([out.double(), *(x.grad.double() for x in factors)])
    for got, want in zip(*results, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("needed", [(False, False), (True, False), (False, True)])
@pytest.mark.parametrize("layout", ["dense", "transposed", "columns", "rows"])
def test_measuring_computes_the_product_itself(monkeypatch, tmp_path, layout, needed):
    """What is timed has the shape, the strides and the gradients of what is called."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(module, "_ALIKE", 32)
    wide = draw(48, 2 * 300, seed=3)
    value = {
        "dense": lambda: draw(48, 300),
        "transposed": lambda: draw(300, 48).t(),
        "columns": lambda: wide[:, ::2],
        "rows": lambda: wide[:, :300],
    }[layout]()
    weight, bias = draw(200, 300, seed=1), draw(200, seed=2)
    value.requires_grad_(needed[0])
    weight.requires_grad_(needed[1])
    seen, plain = [], module._plain

    def look(value, weight, bias, relu):
        out = plain(value, weight, bias, relu)
        grads = (value.requires_grad, weight.requires_grad)
        seen.append((tuple(value.shape), value.stride(), out.shape[1], relu, grads))
        return out

    before = torch.get_rng_state()
    with monkeypatch.context() as patch:
        patch.setattr(module, "_plain", look)
        linear(value, weight, bias, True)
    assert torch.equal(before, torch.get_rng_state())
    stride = (1, 32) if layout == "transposed" else value.stride()
    timed = [x for x in seen if x[0] == (32, 300)]
    assert timed
    assert {x[:4] for x in timed} == {((32, 300), stride, 200, True)}
    assert needed in {x[4] for x in timed}
    with monkeypatch.context() as patch:  # and once only
        patch.setattr(module, "_plain", look)
        seen.clear()
        linear(value.detach().requires_grad_(needed[0]), weight, bias, True)
    assert (32, 300) not in {x[0] for x in seen}


@pytest.mark.parametrize("relu", [False, True])
def test_inference(kernel, relu):
    weight, bias = draw(6, 5, seed=1), draw(6, seed=2)
    apply = inference_linear(weight, bias, relu, 8)
    for value in (draw(8, 5), draw(3, 5), draw(2, 3, 5)):
        want = slow_linear(value, weight, bias, relu)
        torch.testing.assert_close(apply(value).double(), want, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["float32", "bfloat16"])
def test_the_faster_dtype_is_measured_once(new_process, name):
    new_process(name)
    assert faster_dtype(256, 64) == getattr(torch, name)


def test_both_dtypes_are_measured(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    seen, plain = set(), module._plain

    def look(value, weight, bias, relu):
        seen.add((value.dtype, tuple(value.shape), tuple(weight.shape), relu))
        return plain(value, weight, bias, relu)

    monkeypatch.setattr(module, "_plain", look)
    with linear_kernel("plain"):
        assert faster_dtype(256, 96) in (torch.float32, torch.bfloat16)
    shapes = ((256, 96), (96, 96), True)
    assert seen == {(torch.float32, *shapes), (torch.bfloat16, *shapes)}


@pytest.mark.parametrize("needs", [False, True])
def test_operands_from_around_a_map(monkeypatch, tmp_path, needs):
    """What measures may not run inside of torch.vmap."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    operands = [draw(256, 80), draw(128, 80, seed=1), draw(128, seed=2)]
    operands[0].requires_grad_(needs)
    got = torch.vmap(lambda x: x + linear(*operands).sum())(torch.zeros(2))
    torch.testing.assert_close(got, F.linear(*operands).sum().expand(2))
