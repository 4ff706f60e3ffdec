"""The compiled kernel of eq. 3 against all pairs in float64."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch._dynamo.utils import counters
from torch._inductor import config
from torch._inductor.utils import fresh_cache

from torchrl_caiac.influence import causal_action_influence, mixture_divergence
from torchrl_caiac.influence.mixture_divergence import mixture_influence

APPROXIMATIONS: tuple[Any, ...] = ("bounds", "product")
# Each width needs its own kernel, which takes seconds to compile.
WIDTHS = (1, 3, 7)


def all_pairs(loc: torch.Tensor, var: torch.Tensor, approximation: str) -> torch.Tensor:
    """Eq. 3 of Gaussians ``[B, K, d]`` in float64, with all pairs."""
    loc, var = loc.double(), var.double()
    log_k = math.log(loc.shape[1])
    square = (loc[:, :, None] - loc[:, None]).square()
    v_i, v_k = var[:, :, None], var[:, None].expand_as(square)
    kl = 0.5 * (v_k.log() - v_i.log() + (v_i + square) / v_k - 1).sum(-1)
    log_product = -0.5 * ((2 * math.pi * (v_i + v_k)).log() + square / (v_i + v_k))
    factor = 4 * math.pi if approximation == "product" else 2 * math.pi * math.e
    own = -0.5 * (factor * var).log().sum(-1)
    upper = log_k - torch.logsumexp(-kl, -1)
    lower = own + log_k - torch.logsumexp(log_product.sum(-1), -1)
    mean = (upper.clamp_min(0) + lower.clamp_min(0)).mean(-1) / 2
    return mean.clamp_max(log_k)


def gaussians(
    *shape: int, spread: float = 1.0, log_var: float = 0.5
) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    loc = spread * torch.randn(shape, generator=generator)
    return loc, (log_var * torch.randn(shape, generator=generator)).exp()


def agrees(score: torch.Tensor, expected: torch.Tensor) -> bool:
    error = (score - expected).abs()
    return bool(((error <= 1e-5) | (error <= 1e-4 * expected)).all())


@pytest.fixture
def no_kernels_yet() -> Iterator[None]:
    """Forgets compiled kernels, before the test and after it."""

    def forget() -> None:
        mixture_divergence._kernel.cache_clear()
        mixture_divergence._without_compiler.clear()

    forget()
    yield
    forget()


@pytest.mark.parametrize("d", WIDTHS)
def test_kernel_matches_all_pairs_for_any_rows_and_actions(d: int) -> None:
    compiled = counters["stats"]["unique_graphs"]
    for k in (2, 5, 16, 64, 128):
        for spread in (0.0, 0.01, 0.3, 1.0, 5.0, 40.0):
            for log_var in (0.0, 0.1, 1.0, 3.0):
                loc, var = gaussians(7, k, d, spread=spread, log_var=log_var)
                for approximation in APPROXIMATIONS:
                    score = causal_action_influence(
                        loc, var, approximation=approximation, compile=True
                    )
                    assert agrees(score, all_pairs(loc, var, approximation))
    # At most one kernel; none if another test compiled it.
    assert counters["stats"]["unique_graphs"] <= compiled + 1


@pytest.mark.parametrize("approximation", APPROXIMATIONS)
def test_kernel_matches_the_stepwise_computation(approximation: Any) -> None:
    loc, var = gaussians(50, 33, 3)
    options: dict[str, Any] = {"approximation": approximation}
    slow = causal_action_influence(loc, var, compile=False, **options)
    # Each limit gives parts of other sizes; the smallest is below one row.
    for max_memory in (1, 50_000, 2**28):
        options["max_memory"] = max_memory
        fused = causal_action_influence(loc, var, compile=True, **options)
        torch.testing.assert_close(fused, slow, atol=1e-6, rtol=1e-5)
    batch = (loc.reshape(5, 10, 33, 3), var.reshape(5, 10, 33, 3))
    fused = causal_action_influence(*batch, compile=True, **options)
    torch.testing.assert_close(fused.flatten(), slow, atol=1e-6, rtol=1e-5)


def test_kernel_keeps_extreme_numbers_finite_and_in_range() -> None:
    loc = torch.tensor([[0.0], [1e4], [-1e4], [0.0]])
    for variances in ([1e-8, 200.0, 1e-8, 1.0], [1e-30, 1.0, 1e-20, 1e10]):
        var = torch.tensor(variances)[:, None]
        for d in WIDTHS:
            case = (loc.expand(2, 4, d), var.expand(2, 4, d))
            for approximation in APPROXIMATIONS:
                fused, slow = (
                    causal_action_influence(
                        *case, approximation=approximation, compile=c
                    )
                    for c in (True, False)
                )
                assert ((fused >= 0) & (fused <= math.log(4))).all()
                torch.testing.assert_close(fused, slow, atol=1e-5, rtol=1e-4)


def test_entities_of_several_widths() -> None:
    widths = [3, 1, 20, 3, 7, 1]  # 20 columns are too many for a kernel
    edges = [sum(widths[:i]) for i in range(len(widths) + 1)]
    slices = [slice(*edges[i : i + 2]) for i in range(len(widths))]
    loc, var = gaussians(9, 12, edges[-1])
    for fused in (True, False):
        scores = mixture_influence(
            loc, var, slices, approximation="bounds", max_memory=2**28, fused=fused
        )
        assert scores.shape == (9, 6)
        for i, where in enumerate(slices):
            expected = all_pairs(loc[..., where], var[..., where], "bounds")
            assert agrees(scores[:, i], expected)


@pytest.mark.parametrize("batch", [(), (1,), (0,), (2, 0)])
def test_unsupported_input_is_computed_step_by_step(batch: Any) -> None:
    loc, var = gaussians(*batch, 6, 3)
    for case in ((loc, var), (loc.double(), var.double())):
        score = causal_action_influence(*case, compile=True)
        assert torch.equal(score, causal_action_influence(*case, compile=False))


def test_compiles_the_kernel_for_many_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    requested = []

    def kernel(*args: Any) -> None:
        requested.append(args)

    monkeypatch.setattr(mixture_divergence, "_kernel", kernel)
    monkeypatch.setattr(mixture_divergence, "_LEAST_PAIRS", 10 * 36)
    causal_action_influence(*gaussians(9, 6, 3))
    causal_action_influence(*gaussians(10, 6, 3), compile=False)
    assert not requested
    causal_action_influence(*gaussians(10, 6, 3))
    assert requested == [(3, "cpu")]


def test_warns_once_without_a_compiler(no_kernels_yet: None) -> None:
    loc, var = gaussians(8, 6, 1)
    with fresh_cache(), config.patch({"cpp.cxx": ("no-such-compiler",)}):
        with pytest.warns(RuntimeWarning, match=r"ten times slower.*C\+\+ compiler"):
            score = causal_action_influence(loc, var, compile=True)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for d in WIDTHS:
                causal_action_influence(*gaussians(8, 6, d), compile=True)
    assert torch.equal(score, causal_action_influence(loc, var, compile=False))
