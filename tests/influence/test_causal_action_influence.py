"""Causal action influence against plain Python, bounds and Monte Carlo."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.influence.plain_influence import plain_influence
from torchrl_caiac.influence import (
    causal_action_influence,
)

APPROXIMATIONS: tuple[Any, ...] = ("bounds", "product")


def monte_carlo(
    loc: torch.Tensor, var: torch.Tensor, draws: int = 20_000
) -> tuple[float, float]:
    """The exact value of eq. 3 for ``[K, d]`` in float64, and its standard error."""
    k, d = loc.shape
    generator = torch.Generator().manual_seed(0)
    values = []
    for i in range(k):
        noise = torch.randn(draws, d, generator=generator, dtype=loc.dtype)
        x = loc[i] + var[i].sqrt() * noise
        logs = -0.5 * ((x[:, None] - loc).square() / var + var.log()).sum(-1)
        values.append(logs[:, i] - torch.logsumexp(logs, -1) + math.log(k))
    stacked = torch.stack(values)
    error = (stacked.var(1) / draws).sum().sqrt() / k
    return stacked.mean().item(), error.item()


def gaussians(
    seed: int, k: int, d: int, spread: float, log_var: float, *batch: int
) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, k, d)
    loc = spread * torch.randn(shape, generator=generator, dtype=torch.float64)
    var = (log_var * torch.randn(shape, generator=generator, dtype=torch.float64)).exp()
    return loc, var


mixtures = st.builds(
    gaussians,
    st.integers(0, 10_000),
    st.integers(1, 9),
    st.integers(1, 7),
    st.sampled_from([0.0, 0.01, 0.3, 1.0, 5.0, 40.0]),
    st.sampled_from([0.0, 0.1, 1.0, 3.0]),
)


@settings(max_examples=80, deadline=None)
@given(mixture=mixtures, approximation=st.sampled_from(APPROXIMATIONS))
def test_matches_plain_python_and_stays_in_range(
    mixture: Any, approximation: Any
) -> None:
    loc, var = mixture
    score = causal_action_influence(loc, var, approximation=approximation)
    expected = plain_influence(loc.tolist(), var.tolist(), approximation)
    k = loc.shape[0]
    expected = min(expected, math.log(k))
    assert abs(score.item() - expected) < 1e-9
    assert 0 <= score <= math.log(k) + 1e-12
    single = causal_action_influence(
        loc.float(), var.float(), approximation=approximation
    )
    assert single.dtype == torch.float32
    assert abs(single.item() - expected) <= max(1e-5, 1e-4 * expected)


@settings(max_examples=40, deadline=None)
@given(
    mixture=mixtures,
    approximation=st.sampled_from(APPROXIMATIONS),
    scale=st.sampled_from([1e-4, 0.5, 1.0, 300.0]),
    shift=st.sampled_from([-50.0, 0.0, 2.0]),
    seed=st.integers(0, 100),
)
def test_invariant_under_affine_maps_and_permutations(
    mixture: Any, approximation: Any, scale: float, shift: float, seed: int
) -> None:
    loc, var = mixture
    score = causal_action_influence(loc, var, approximation=approximation)
    generator = torch.Generator().manual_seed(seed)
    k, d = loc.shape
    # Another map for each column, signs included.
    a = scale * (torch.rand(d, generator=generator).double() + 0.5)
    a[::2] *= -1
    b = shift * torch.rand(d, generator=generator).double()
    actions = torch.randperm(k, generator=generator)
    columns = torch.randperm(d, generator=generator)
    mapped = causal_action_influence(
        (a * loc + b)[actions][:, columns],
        (a.square() * var)[actions][:, columns],
        approximation=approximation,
    )
    torch.testing.assert_close(mapped, score, atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize("approximation", APPROXIMATIONS)
@pytest.mark.parametrize("d", [1, 4, 9])
def test_no_influence_is_exactly_zero(approximation: Any, d: int) -> None:
    loc, var = gaussians(0, 1, d, 30.0, 2.0, 5)
    loc, var = loc.expand(5, 64, d), var.expand(5, 64, d)
    for dtype in (torch.float32, torch.float64):
        score = causal_action_influence(
            loc.to(dtype), var.to(dtype), approximation=approximation
        )
        assert score.abs().max() < 1e-6


@pytest.mark.parametrize("d", [1, 3, 7])
def test_far_apart_actions_reach_log_k(d: int) -> None:
    loc = torch.arange(16.0)[:, None].expand(16, d) * 1000
    var = torch.ones(16, d)
    product = causal_action_influence(loc, var, approximation="product")
    torch.testing.assert_close(product, torch.tensor(math.log(16)))
    # There one part is a lower bound; the score is its mean with log K.
    bounds = causal_action_influence(loc, var)
    gap = d * (1 - math.log(2)) / 4
    torch.testing.assert_close(bounds, torch.tensor(math.log(16) - gap))


@pytest.mark.parametrize("d", [1, 2, 7])
@pytest.mark.parametrize("spread", [0.05, 0.2, 0.5, 1.0, 3.0])
@pytest.mark.parametrize("log_var", [0.0, 0.3])
def test_near_float64_monte_carlo(d: int, spread: float, log_var: float) -> None:
    loc, var = gaussians(1, 12, d, spread, log_var)
    exact, error = monte_carlo(loc, var)
    score = causal_action_influence(loc, var).item()
    # Its two parts enclose the exact value.
    upper = variational(loc, var)
    lower = 2 * score - upper
    assert lower - 4 * error <= exact <= upper + 4 * error
    assert abs(score - exact) <= 0.25 * exact + 0.02
    product = causal_action_influence(loc, var, approximation="product").item()
    assert exact - 4 * error - 1e-3 <= product <= 1.7 * exact + 0.05


def variational(loc: torch.Tensor, var: torch.Tensor) -> float:
    """The upper bound, which is one of the two parts of the score."""
    kl = (
        (var[None].log() - var[:, None].log())
        + (var[:, None] + (loc[:, None] - loc[None]).square()) / var[None]
        - 1
    ).sum(-1) / 2
    return (math.log(len(loc)) - torch.logsumexp(-kl, -1)).mean().item()


@pytest.mark.parametrize("groups", [1, 4, 16])
@pytest.mark.parametrize("d", [1, 7])
def test_groups_of_actions_against_monte_carlo(groups: int, d: int) -> None:
    loc = torch.zeros(64, d, dtype=torch.float64)
    loc[:groups] = 20.0  # these actions touch the entity, the others do not
    var = torch.ones_like(loc)
    exact, error = monte_carlo(loc, var, 500)
    product = causal_action_influence(loc, var, approximation="product").item()
    assert abs(product - exact) <= 4 * error + 1e-6
    assert 0 < causal_action_influence(loc, var).item() <= exact + 1e-9


@pytest.mark.parametrize("batch", [(), (1,), (7,), (3, 2), (0,), (2, 0, 3)])
@pytest.mark.parametrize("approximation", APPROXIMATIONS)
def test_batch_shapes_and_chunks(batch: Any, approximation: Any) -> None:
    loc, var = gaussians(3, 10, 3, 1.0, 0.5, *batch)
    score = causal_action_influence(loc, var, approximation=approximation)
    assert score.shape == batch and score.dtype == torch.float64
    # 1 byte forces one row and one action at a time.
    for max_memory in (1, 2_000, 20_000):
        small = causal_action_influence(
            loc, var, approximation=approximation, max_memory=max_memory
        )
        torch.testing.assert_close(small, score)
    view = causal_action_influence(
        loc.flip(-1), var.flip(-1), approximation=approximation
    )
    torch.testing.assert_close(view, score)


def test_extreme_numbers_stay_finite() -> None:
    loc = torch.tensor([[0.0], [1e4], [-1e4], [0.0]])
    for var in ([1e-8, 200.0, 1e-8, 1.0], [1e-30, 1.0, 1e-20, 1e10]):
        for approximation in APPROXIMATIONS:
            score = causal_action_influence(
                loc.expand(4, 6),
                torch.tensor(var)[:, None].expand(4, 6).contiguous(),
                approximation=approximation,
            )
            assert torch.isfinite(score) and 0 <= score <= math.log(4)


def test_no_gradient_and_unchanged_inputs() -> None:
    loc, var = gaussians(4, 5, 2, 1.0, 0.5, 3)
    loc.requires_grad_()
    before = (loc.detach().clone(), var.clone())
    score = causal_action_influence(loc, var)
    assert not score.requires_grad
    assert torch.equal(loc.detach(), before[0]) and torch.equal(var, before[1])


@pytest.mark.parametrize(
    ("loc", "var", "message"),
    [
        (torch.zeros(3, 2), torch.ones(3, 1), r"\[3, 2\] and \[3, 1\]"),
        (torch.zeros(3), torch.ones(3), "K and d at least 1"),
        (torch.zeros(0, 2), torch.ones(0, 2), "K and d at least 1"),
        (torch.zeros(3, 0), torch.ones(3, 0), "K and d at least 1"),
        (torch.full((3, 1), math.nan), torch.ones(3, 1), "loc has NaN"),
        (torch.zeros(3, 1), torch.zeros(3, 1), "not positive"),
        (torch.zeros(3, 1), torch.full((3, 1), math.inf), "not positive and finite"),
        (torch.zeros(3, 1).long(), torch.ones(3, 1).long(), "one floating dtype"),
        (torch.zeros(3, 1), torch.ones(3, 1).double(), "one floating dtype"),
    ],
)
def test_rejects_bad_gaussians(loc: Any, var: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        causal_action_influence(loc, var)


def test_rejects_bad_options() -> None:
    loc, var = torch.zeros(3, 1), torch.ones(3, 1)
    with pytest.raises(ValueError, match="'mean'"):
        causal_action_influence(loc, var, approximation="mean")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="max_memory"):
        causal_action_influence(loc, var, max_memory=0)
