"""In which rows entities visibly move."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_caiac import EntityLayout
from torchrl_caiac.influence.threshold_motion import (
    motion_of_rows,
    position_tolerances,
    sample_blocks,
    without_near_rests,
)

LAYOUT = EntityLayout(
    {"cup": [2, 0], "lid": [1]}, positions={"cup": [0], "lid": [1]}, variance_floor=0.1
)
KEYS = {"trajectory_key": "episode", "done_key": None}


def data(changes: list[list[float]], lengths: list[int]) -> TensorDict:
    """Trajectories whose positions change by these numbers, and others by a lot."""
    change = torch.tensor(changes).view(-1, 2)
    state = torch.rand(len(change), 3)
    after = state + torch.cat([change, torch.full((len(change), 1), 9.0)], 1)
    episode = torch.repeat_interleave(torch.tensor(lengths))
    return TensorDict(
        {"observation": state, "next": {"observation": after}, "episode": episode},
        [len(change)],
    )


@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=5),
    lookahead=st.integers(0, 7),
    seed=st.integers(0, 999),
)
def test_it_matches_one_row_after_the_other(lengths, lookahead, seed) -> None:
    generator = torch.Generator().manual_seed(seed)
    kinds = torch.tensor([0.0, 0.05, 0.2, 0.5])
    change = kinds[torch.randint(4, (sum(lengths), 2), generator=generator)]
    td = data(change.tolist(), lengths)
    sampled = sample_blocks(td, len(td), lookahead=lookahead, max_rows=99, **KEYS)
    found = motion_of_rows(
        td, LAYOUT, sampled, position_tolerances(td, LAYOUT), lookahead=lookahead
    )
    for column, name in enumerate(("cup", "lid")):
        for row in range(len(td)):
            seen = [
                change[r, column].item()
                for r in range(row, min(row + lookahead + 1, len(td)))
                if td["episode"][r] == td["episode"][row]
            ]
            expected = 1 if max(seen) > 0.3 else 0 if max(seen) < 0.1 else -1
            assert found[name][row] == expected


def test_blocks_of_large_data_are_judged_by_rows_that_they_have() -> None:
    change = torch.zeros(6000, 2)
    change[::7, 0] = 1.0
    td = data(change.tolist(), [3000, 3000])
    whole, part = (
        sample_blocks(td, 6000, lookahead=3, max_rows=most, **KEYS)
        for most in (9000, 3000)
    )
    tolerances = position_tolerances(td, LAYOUT)
    every = motion_of_rows(td, LAYOUT, whole, tolerances, lookahead=3)["cup"]
    some = motion_of_rows(td, LAYOUT, part, tolerances, lookahead=3)["cup"]
    rows = part.rows.flatten()
    assert len(rows) == len(rows.unique()) == 3000
    known = some != -1
    assert torch.equal(some[known], every[rows][known]) and known.double().mean() > 0.99
    again = sample_blocks(td, 6000, lookahead=3, max_rows=3000, **KEYS)
    assert torch.equal(again.rows, part.rows)


def test_trajectories_are_needed_only_with_a_lookahead() -> None:
    td = data([[0.0, 0.0]], [1]).exclude("episode")
    assert sample_blocks(td, 1, lookahead=0, max_rows=9, **KEYS).rows.tolist() == [[0]]
    with pytest.raises(KeyError, match="episode"):
        sample_blocks(td, 1, lookahead=1, max_rows=9, **KEYS)


def test_nan_is_neither_motion_nor_rest() -> None:
    td = data([[0.0, 0.0], [float("nan"), 1.0]], [2])
    sampled = sample_blocks(td, 2, lookahead=0, max_rows=9, **KEYS)
    found = motion_of_rows(td, LAYOUT, sampled, position_tolerances(td, LAYOUT))
    assert found["cup"].tolist() == [0, -1] and found["lid"].tolist() == [0, 1]


def test_tolerances_of_nested_entities_and_single_ones() -> None:
    layout = EntityLayout.from_keys(
        {"cup": ("s", "cup"), "lid": ("s", "lid")},
        positions={"cup": [2, 0]},
        variance_floor={"cup": [0.1, 0.2, 0.3], "lid": 1.0},
    )
    found = position_tolerances(TensorDict(), layout)
    assert found["cup"].tolist() == pytest.approx([0.3, 0.1]) and list(found) == ["cup"]
    td = TensorDict(
        {
            "s": {"cup": torch.zeros(2, 3), "lid": torch.zeros(2, 1)},
            "next": {
                "s": {
                    "cup": torch.tensor([[0.0, 9.0, 0.0], [0.0, 0.0, 1.0]]),
                    "lid": torch.ones(2, 1),
                }
            },
        },
        [2],
    )
    sampled = sample_blocks(td, 2, lookahead=0, max_rows=9, **KEYS)
    assert motion_of_rows(td, layout, sampled, found)["cup"].tolist() == [0, 1]


def test_tolerances_that_are_given() -> None:
    td = TensorDict()
    assert position_tolerances(td, LAYOUT, 0.5)["lid"].tolist() == [0.5]
    assert list(position_tolerances(td, LAYOUT, {"lid": 0.5})) == ["lid"]


def test_tolerances_are_measured_where_the_layout_has_none() -> None:
    layout = EntityLayout({"cup": [0], "lid": [1, 2]}, positions={"cup": [0]})
    generator = torch.Generator().manual_seed(0)
    noise = 1e-3 * torch.randn(2000, 2, generator=generator)
    noise[::5, 0] += 0.5
    td = data(noise.tolist(), [2000])
    (tolerance,) = position_tolerances(td, layout)["cup"]
    assert 2e-3 < tolerance < 0.15
    sampled = sample_blocks(td, 2000, lookahead=0, max_rows=9000, **KEYS)
    found = motion_of_rows(td, layout, sampled, {"cup": tolerance.view(1)})["cup"]
    assert torch.equal(found == 1, torch.arange(2000) % 5 == 0)


@given(st.lists(st.sampled_from([0, 0, 0, 0, 0, 0, 1, -1]), min_size=1, max_size=60))
def test_rests_near_motion_are_left_out(values: list[int]) -> None:
    expected = [
        -1
        if own == 0 and any(near != 0 for near in values[max(i - 3, 0) : i + 4])
        else own
        for i, own in enumerate(values)
    ]
    if 2 * expected.count(0) < values.count(0):
        expected = values
    motion = torch.tensor([values, [0] * len(values)], dtype=torch.int8)
    left = without_near_rests(motion[:1])
    assert left.tolist() == [expected]
    # blocks do not touch
    assert without_near_rests(motion)[1].tolist() == [0] * len(values)


def test_no_positions_say_nothing() -> None:
    layout = EntityLayout({"cup": [0]})
    td = data([[0.0, 0.0]], [1])
    sampled = sample_blocks(td, 1, lookahead=0, max_rows=9, **KEYS)
    assert motion_of_rows(td, layout, sampled, position_tolerances(td, layout)) == {}


@pytest.mark.parametrize(
    ("tolerance", "message"),
    [(0, "'cup' is 0, expected"), ({"pan": 1.0}, "pan"), (float("nan"), "is nan")],
)
def test_tolerances_that_are_refused(tolerance: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        position_tolerances(TensorDict(), LAYOUT, tolerance)
