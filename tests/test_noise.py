"""The noise of entities at rest."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, ReplayBuffer

from torchrl_caiac import EntityLayout
from torchrl_caiac.noise import resting_noise

ROWS = 20_000


def transitions(change: torch.Tensor, start: torch.Tensor | None = None) -> TensorDict:
    start = torch.zeros_like(change) if start is None else start
    return TensorDict(
        {"observation": start, ("next", "observation"): start + change}, [len(change)]
    )


def moves(share: float, generator: torch.Generator) -> torch.Tensor:
    return torch.rand(ROWS, 1, generator=generator) < share


@given(
    st.integers(0, 1000),
    st.floats(0.005, 0.5),
    st.floats(-7, -4),
    st.floats(-2, 1),
)
def test_rest_and_motion_are_told_apart(
    seed: int, share: float, quiet: float, fast: float
) -> None:
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(2, ROWS, 1, generator=generator, dtype=torch.float64)
    moving = moves(share, generator)
    noise, motion = 10**quiet, 10**fast
    change = torch.where(moving, motion * (1 + 0.2 * normal[0]), noise * normal[1])
    found = resting_noise(transitions(change), EntityLayout({"cup": [0]}))["cup"]
    assert abs(1 - found.rest_share - float(moving.double().mean())) < 0.01
    assert 0.9 * noise < found.noise[0] < 1.1 * noise
    # Of few moving rows the slowest are not counted: 1.29 at most for 1,001 seeds.
    assert 0.75 * motion < found.moving[0] < 1.35 * motion
    assert found.floor[0] == pytest.approx(max(found.noise[0], found.moving[0] / 10))
    # Nearly every row is told apart by the tolerance, with what the mask needs.
    wrong = (change.abs() > found.tolerance[0]) != moving
    assert float(wrong.double().mean()) < 0.01


def test_an_entity_that_never_moves() -> None:
    data = transitions(torch.zeros(100, 1), torch.full((100, 1), 3.0))
    found = resting_noise(data, EntityLayout({"cup": [0]}))["cup"]
    assert found.reason == "never moves in 100 rows"
    assert found.rest_share == 1
    assert 0 < found.floor[0] < 1e-5


def test_an_entity_that_always_moves_counts_as_moving() -> None:
    change = torch.randn(ROWS, 1, generator=torch.Generator().manual_seed(0))
    found = resting_noise(transitions(change), EntityLayout({"arm": [0]}))["arm"]
    assert found.rest_share < 0.05
    assert found.floor[0] == pytest.approx(0.067, abs=0.005)  # a tenth of the median


@pytest.mark.parametrize("noise", [0.0, 2e-5])
@pytest.mark.parametrize("slow", [0.05, 0.2, 0.3])
def test_slow_motion_is_seen_beside_fast_motion(noise: float, slow: float) -> None:
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(2, ROWS, 1, generator=generator)
    draw = torch.rand(ROWS, 1, generator=generator)
    is_slow, is_fast = draw < slow, draw > 0.95
    change = noise * normal[0] + (1 + 0.2 * normal[1]) * (
        0.002 * is_slow + 0.05 * is_fast
    )
    found = resting_noise(transitions(change), EntityLayout({"cup": [0]}))["cup"]
    moves = change.abs() > found.tolerance[0]
    assert float(moves[is_slow].double().mean()) > 0.85
    assert float(moves[~(is_slow | is_fast)].double().mean()) < 0.01
    assert moves[is_fast].all()


def test_jitter_is_no_motion_beside_an_entity_that_moves() -> None:
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(2, ROWS, 1, generator=generator)
    change = torch.cat([0.05 * normal[0], 1e-6 * normal[1]], 1)
    change = torch.cat([change, 3 * change[:, 1:]], 1)  # of another unit
    columns = {"arm": [0], "door": [1]}
    alone = resting_noise(transitions(change), EntityLayout(columns))["door"]
    assert alone.floor[0] < 1e-5
    layout = EntityLayout({"arm": [0], "door": [1, 2]}, positions=columns)
    found = resting_noise(transitions(change), layout)
    assert found["door"].floor[1] == pytest.approx(3 * found["door"].floor[0], rel=1e-3)
    assert found["door"].floor[0] == pytest.approx(0.05 * found["arm"].moving[0])
    assert found["door"].tolerance[0] == pytest.approx(0.002 * found["arm"].moving[0])
    assert found["door"].reason.endswith("a twentieth of the median change of 'arm'")
    assert (
        found["arm"].floor
        == resting_noise(transitions(change), EntityLayout(columns))["arm"].floor
    )


def test_the_tolerance_covers_the_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(2, ROWS, 1, generator=generator)
    change = torch.where(moves(0.3, generator), 20 + normal[0], normal[1])
    found = resting_noise(transitions(change), EntityLayout({"cup": [0]}))["cup"]
    assert found.noise[0] == pytest.approx(1, abs=0.1)
    assert found.tolerance[0] == 4 * found.noise[0]
    assert found.floor[0] == pytest.approx(2, abs=0.05)


def test_values_on_a_grid_have_its_step_as_floor() -> None:
    generator = torch.Generator().manual_seed(0)
    steps = torch.randint(0, 4, (ROWS, 1), generator=generator)
    change = torch.where(moves(0.2, generator), 0.25 * steps, 0)
    found = resting_noise(transitions(change), EntityLayout({"dial": [0]}))["dial"]
    assert found.floor[0] == 0.25
    assert "the resolution 0.25 is the floor" in found.reason


def test_a_flag_moves_when_it_changes() -> None:
    change = torch.zeros(1000, 1)
    change[::50] = 1
    found = resting_noise(transitions(change), EntityLayout({"light": [0]}))["light"]
    assert found.floor[0] == pytest.approx(0.1)
    assert found.rest_share == 0.98


def test_positions_tell_whether_an_entity_moves() -> None:
    generator = torch.Generator().manual_seed(0)
    position = torch.zeros(1000, 1)
    position[::10] = 0.5
    speed = torch.randn(1000, 1, generator=generator)
    data = transitions(torch.cat([speed, position], 1))
    layout = EntityLayout({"cup": [0, 1]}, positions={"cup": [1]})
    assert resting_noise(data, layout)["cup"].rest_share == 0.9
    assert resting_noise(data, EntityLayout({"cup": [0, 1]}))["cup"].rest_share < 0.1


def test_buffers_nested_layouts_and_samples(tmp_path: object) -> None:
    change = torch.zeros(1000, 2)
    change[::10] = 0.5
    data = transitions(change)
    flat = EntityLayout({"arm": [0], "cup": [1]})
    expected = resting_noise(data, flat)
    rb = ReplayBuffer(storage=LazyMemmapStorage(2000, scratch_dir=str(tmp_path)))
    rb.extend(data)
    assert resting_noise(rb, flat) == expected
    assert resting_noise(data.reshape(10, 100), flat) == expected
    nested = TensorDict({"arm": {"x": change[:, 0] * 0}}, [1000])
    nested["next"] = TensorDict({"arm": {"x": change[:, 0]}}, [1000])
    layout = EntityLayout.from_keys({"arm": "arm"}, positions={"arm": [0]})
    assert resting_noise(nested, layout)["arm"] == expected["arm"]
    few = resting_noise(data, flat, max_rows=100)
    assert "of 100 rows" in few["cup"].reason


def test_what_cannot_be_measured_is_refused() -> None:
    layout = EntityLayout({"arm": [0], "cup": [1]})
    data = transitions(torch.zeros(10, 2))
    data["observation"][3, 1] = math.nan
    with pytest.raises(ValueError, match=r"states of \['cup'\] have NaN"):
        resting_noise(data, layout)
    with pytest.raises(ValueError, match=r"batch size \[0\], expected at least one"):
        resting_noise(data[:0], layout)
    with pytest.raises(ValueError, match="max_rows must be an int"):
        resting_noise(data, layout, max_rows=0)
    with pytest.raises(KeyError, match="next"):
        resting_noise(data.exclude("next"), layout)


@pytest.mark.parametrize("offset", [0.0, 5e5])
def test_motion_far_from_zero(offset: float) -> None:
    """Positions in double precision, such as UTM coordinates in metres."""
    change = torch.zeros(400, 1, dtype=torch.float64)
    change[::4] = 0.05
    data = transitions(change, offset + change.cumsum(0))
    found = resting_noise(data, EntityLayout({"cup": [0]}))["cup"]
    assert found.rest_share == 0.75
    assert found.tolerance[0] < 0.05
    single = resting_noise(data.float(), EntityLayout({"cup": [0]}))["cup"]
    assert (single.tolerance[0] < 0.05) == (offset == 0)  # which cannot hold it


def test_integers_have_no_rounding() -> None:
    change = torch.zeros(400, 1, dtype=torch.int64)
    change[::4] = 3
    data = transitions(change, change.cumsum(0) + 10**9)
    found = resting_noise(data, EntityLayout({"cup": [0]}))["cup"]
    assert found.rest_share == 0.75 and found.tolerance[0] < 3


def test_joint_angles_are_not_compared_with_positions() -> None:
    generator = torch.Generator().manual_seed(0)
    change = torch.randn(2000, 5, generator=generator)  # degrees, and metres
    change[:, 2:] *= 3e-3 * moves(0.2, generator)[:2000]
    names = {"arm": [0, 1], "cup": [2, 3, 4]}
    layout = EntityLayout(names, fixed=["arm"], positions=names)
    found = resting_noise(transitions(change), layout)["cup"]
    assert max(found.floor) < 1e-3
    same = {"arm": [0, 1, 2], "cup": [3, 4]}  # as many numbers: maybe one frame
    other = EntityLayout(same, positions=same)
    assert max(resting_noise(transitions(change), other)["cup"].floor) > 3e-3


@pytest.mark.parametrize("dtype", [torch.int64, torch.float64])
def test_whole_numbers_far_from_zero_have_no_rounding(dtype: torch.dtype) -> None:
    """Those below 2**24 are single precision numbers too."""
    position = 15_000_000 + torch.zeros(200, dtype=dtype)
    position[100:] += 5 * torch.arange(100)
    data = TensorDict(
        {
            "observation": position[:-1, None],
            ("next", "observation"): position[1:, None],
        },
        [199],
    )
    cup = resting_noise(data, EntityLayout({"cup": [0]}))["cup"]
    assert cup.rest_share == pytest.approx(100 / 199) and cup.tolerance[0] < 5
