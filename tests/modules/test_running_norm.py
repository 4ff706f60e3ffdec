"""Tests of the exact running normalisation."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.modules import running_norm as module
from torchrl_caiac.modules.running_norm import RunningNorm, gather_statistics


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
    norm = RunningNorm(4).to(dtype)
    out = norm(torch.randn(shape, dtype=dtype))
    assert out.shape == shape and out.dtype == dtype and torch.isfinite(out).all()


def test_the_result_has_the_dtype_of_the_layer() -> None:
    norm = RunningNorm(2, floor=0.1, frozen=True)
    assert norm.dtype == torch.float32
    assert norm(torch.zeros(3, 2, dtype=torch.float64)).dtype == torch.float32
    assert norm.double().dtype == torch.float64
    assert norm(torch.zeros(3, 2)).dtype == torch.float64


def test_frozen_statistics_change_by_update_only() -> None:
    norm = RunningNorm(2, frozen=True)
    x = torch.randn(50, 2) * 3 + 1
    assert norm.training and torch.equal(norm(x), x) and norm.count == 0
    norm.update(x)
    y = norm(x + 5)
    torch.testing.assert_close(y, (x + 5 - x.mean(0)) / x.std(0, correction=0))
    assert norm.count == 50 and torch.equal(norm(x + 5), y)


def test_no_deviation_is_below_the_floor() -> None:
    x = torch.tensor([[1.0, 0.0, 7.0], [1.2, 4.0, 7.0]])
    norm = RunningNorm(3, floor=0.5, frozen=True)
    assert torch.equal(norm(x), x)  # until there are statistics
    norm.update(x)
    scale = torch.tensor([0.5, 2.0, 0.5]).double()
    torch.testing.assert_close(norm.scale, scale, rtol=1e-7, atol=0)
    want = (x - torch.tensor([1.1, 2.0, 7.0])) / scale.float()
    torch.testing.assert_close(norm(x), want)
    for floor in (-0.1, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="floor must be finite and not negative"):
            RunningNorm(3, floor=floor)


def test_statistics_are_taken_over_under_the_own_floor() -> None:
    gathered, norm = RunningNorm(2), RunningNorm(2, floor=0.5)
    gathered.update(torch.tensor([[1.0, 0.0], [1.2, 4.0]]))
    norm.update(torch.full((9, 2), 100.0))
    norm.replace(gathered)
    torch.testing.assert_close(norm.mean, gathered.mean)
    assert norm.count == 2
    torch.testing.assert_close(norm.scale, torch.tensor([0.5, 2.0]).double())


@pytest.mark.parametrize("floor", [0.0, 0.5])
def test_ignored_features_are_zero(floor: float) -> None:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(20, 3, generator=generator)
    norm, whole = (RunningNorm(3, floor=floor, frozen=True) for _ in range(2))
    mask = torch.tensor([False, True, False])
    norm.ignore(mask)
    assert torch.equal(norm(x), x.masked_fill(mask, 0.0))
    for layer in (norm, whole):
        layer.update(x)
    assert torch.equal(norm(x + 9), whole(x + 9).masked_fill(mask, 0.0))
    twin = RunningNorm(3, floor=floor, frozen=True)
    twin.load_state_dict(norm.state_dict())
    assert torch.equal(twin(x), norm(x))
    norm.replace(whole)
    assert torch.equal(norm(x), whole(x))
    for bad in (mask.float(), mask[:2]):
        with pytest.raises(ValueError, match=r"expected a bool mask \[3\], got"):
            norm.ignore(bad)


@settings(max_examples=25, deadline=None)
@given(
    rows=st.integers(1, 40),
    chunk=st.integers(1, 50),
    masked=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_gathered_statistics_do_not_depend_on_the_chunks(
    rows: int, chunk: int, masked: bool, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(rows, 2, generator=generator).double() * 3 + 7
    mask = torch.rand(rows, generator=generator) < 0.5
    mask[0] = True
    valid = x[mask] if masked else x
    if masked:
        x = x.masked_fill(~mask[:, None], float("nan"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_ROWS_PER_CHUNK", chunk)
        found = gather_statistics(x, "x", mask=mask if masked else None)
    assert found.count == len(valid)
    torch.testing.assert_close(found.mean, valid.mean(0))
    torch.testing.assert_close(found.var, valid.var(0, correction=0))


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


@pytest.mark.parametrize(
    "dtype", [torch.uint8, torch.int8, torch.uint16, torch.int64, torch.bool]
)
@pytest.mark.parametrize("frozen", [False, True])
def test_integers_and_flags_are_normalised_as_the_numbers_that_they_are(dtype, frozen):
    x = torch.tensor([[0, 1], [1, 0], [1, 100], [0, 100]]).to(dtype)
    norms = []
    for value in (x, x.double()):
        norm = RunningNorm(2, frozen=frozen)
        norm.replace(gather_statistics(value, "x", bound=None))
        norms.append(norm(value))
    torch.testing.assert_close(norms[0], norms[1])
    with pytest.raises(ValueError, match=r"'x' has values up to 128"):
        low = torch.tensor([[-128]], dtype=torch.int8)  # whose int8 abs() is -128
        gather_statistics(low, "x", bound=1.0)
