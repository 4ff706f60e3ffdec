"""Tests of the exact running normalisation."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.modules.running_norm import RunningNorm


@settings(max_examples=40, deadline=None)
@given(
    sizes=st.lists(st.integers(0, 9), min_size=1, max_size=6).filter(sum),
    offset=st.sampled_from([0.0, -3.0, 1e4]),
    scale=st.sampled_from([1e-3, 1.0, 50.0]),
    seed=st.integers(0, 1000),
)
def test_statistics_are_those_of_all_rows_whatever_the_batches(
    sizes: list[int], offset: float, scale: float, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randn(sum(sizes), 3, generator=generator).double() * scale + offset
    norm = RunningNorm(3)
    for part in rows.split(sizes):
        norm.update(part)
    assert norm.count == len(rows)
    torch.testing.assert_close(norm.mean, rows.mean(0))
    torch.testing.assert_close(
        norm.var, rows.var(0, correction=0), atol=1e-9 * scale**2, rtol=1e-7
    )


def test_many_batches_do_not_drift() -> None:
    norm = RunningNorm(1)
    rows = torch.tensor([[999.0], [1001.0]])
    for _ in range(5000):
        norm.update(rows)
    torch.testing.assert_close(norm.mean, torch.tensor([1000.0]).double())
    torch.testing.assert_close(norm.var, torch.tensor([1.0]).double())


def test_training_updates_and_evaluation_does_not() -> None:
    norm = RunningNorm(2)
    x = torch.randn(50, 2) * 3 + 1
    y = norm(x)
    torch.testing.assert_close(y.mean(0), torch.zeros(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(y.std(0, correction=0), torch.ones(2))
    before = norm.mean.clone()
    norm.eval()
    torch.testing.assert_close(norm(x), y)
    norm(x + 5)
    assert torch.equal(norm.mean, before) and norm.count == 50


@pytest.mark.parametrize("value", [0.0, 0.1, -1234.567])
def test_constant_columns_become_zero(value: float) -> None:
    norm = RunningNorm(1)
    for _ in range(20):
        out = norm(torch.full((7, 1), value))
    assert torch.isfinite(out).all() and out.abs().max() < 1e-3
    # Something new in that column passes unscaled, it is not blown up.
    step = norm.eval()(torch.tensor([[value + 2.0]]))
    torch.testing.assert_close(step, torch.tensor([[2.0]]), atol=1e-3, rtol=0)


@pytest.mark.parametrize("shape", [(4,), (5, 4), (2, 3, 4), (0, 4)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_batch_shape_and_dtype(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    norm = RunningNorm(4)
    out = norm(torch.randn(shape, dtype=dtype))
    assert out.shape == shape and out.dtype == dtype and torch.isfinite(out).all()


def test_no_parameters_and_state_dict_round_trip() -> None:
    norm, twin = RunningNorm(3), RunningNorm(3)
    norm(torch.randn(9, 3))
    assert not list(norm.parameters())
    twin.load_state_dict(norm.state_dict())
    x = torch.randn(4, 3)
    assert torch.equal(norm.eval()(x), twin.eval()(x))


def test_wrong_sizes_are_named() -> None:
    with pytest.raises(ValueError, match="at least 1, got 0"):
        RunningNorm(0)
    with pytest.raises(
        ValueError, match=r"\[\*B, 3\] features, got the shape \[5, 2\]"
    ):
        RunningNorm(3)(torch.zeros(5, 2))
