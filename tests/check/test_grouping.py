"""Columns that the layout gives to the wrong entity, or to none."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.check.pushing import ENTITIES, clean
from torchrl_caiac import EntityLayout, check_dataset

GOALS = [
    *("desired_goal", "achieved_goal"),
    *(("next", "desired_goal"), ("next", "achieved_goal")),
]
CODES = {"moves_with_other", "unowned_columns_move"}


def found(data: TensorDict, layout: EntityLayout) -> dict[str, tuple[str, ...]]:
    """The findings of this check: the numbers of the columns of each."""
    report = check_dataset(data.exclude(*GOALS), layout)
    assert report.ok
    return {f.code: f.columns for f in report.findings if f.code in CODES}


def layout_of(columns: dict[str, Any]) -> EntityLayout:
    return EntityLayout(columns, fixed=["robot"])


def objects(colour: bool) -> TensorDict:
    """Pushed objects with three columns that move: position and heading."""
    data = clean()
    for key in ("observation", ("next", "observation")):
        state = data[key].clone()
        for first in (4, 7):
            heading = torch.atan2(state[:, first + 1], state[:, first])
            state[:, first + 2] = state[:, first + 2] if colour else heading
        data[key] = state
    return data


def test_an_object_whose_columns_are_off_by_one() -> None:
    shifted = {"robot": range(0, 5), "left": range(5, 8), "right": range(8, 10)}
    assert found(objects(colour=False), layout_of(shifted)) == {
        "moves_with_other": ("robot (column 4)", "left (column 7)")
    }


def test_objects_whose_columns_alternate() -> None:
    mixed = {"robot": range(4), "left": [4, 6, 8], "right": [5, 7, 9]}
    (columns,) = found(objects(colour=False), layout_of(mixed)).values()
    assert set(columns) >= {"right (column 5)", "left (column 8)"}


@pytest.mark.parametrize("missing", [(7,), (7, 8), (7, 8, 9), (4, 5)])
def test_columns_of_an_object_that_the_layout_leaves_out(missing: Any) -> None:
    columns = {
        name: [c for c in own if c not in missing] for name, own in ENTITIES.items()
    }
    layout = layout_of({name: own for name, own in columns.items() if own})
    answer = found(objects(colour=False), layout)
    assert answer == {
        "unowned_columns_move": tuple(f"'observation' (column {c})" for c in missing)
    }


def test_columns_without_an_entity_that_do_not_move() -> None:
    columns = {"robot": range(4), "left": [4, 5], "right": [7, 8]}
    assert not found(objects(colour=True), layout_of(columns))


def test_columns_without_an_entity_that_follow_the_robot() -> None:
    data = clean()
    for key in ("observation", ("next", "observation")):
        data[key] = torch.cat([data[key], 2 * data[key][:, :2]], 1)
    assert not found(data, layout_of(ENTITIES))


@settings(max_examples=20, deadline=None)
@given(order=st.permutations(range(10)), seed=st.integers(0, 5), colour=st.booleans())
def test_right_layouts_in_any_order_of_the_columns(
    order: list[int], seed: int, colour: bool
) -> None:
    data = objects(colour)
    for key in ("observation", ("next", "observation")):
        data[key] = data[key][:, order]
    places = {name: [order.index(c) for c in own] for name, own in ENTITIES.items()}
    assert not found(data, layout_of(places))


def test_linked_objects_may_be_two_entities() -> None:
    data = clean()
    for key in ("observation", ("next", "observation")):
        lid = torch.cat([data[key][:, 4:6] + 0.1, data[key][:, 4:5].square()], 1)
        data[key] = torch.cat([data[key], lid], 1)
    report = check_dataset(data, layout_of({**ENTITIES, "lid": range(10, 13)}))
    assert "moves_with_other" not in {f.code for f in report.findings}


def test_goals_without_a_layout_hide_nothing() -> None:
    shifted = {"robot": range(0, 5), "left": range(5, 8), "right": range(8, 10)}
    report = check_dataset(objects(colour=False), layout_of(shifted))
    assert [f.code for f in report.errors] == ["goals_not_mapped"]
    assert "moves_with_other" in {f.code for f in report.warnings}


def test_goals_of_another_width_hide_nothing() -> None:
    columns = {"robot": range(4), "left": range(4, 7)}
    goals = {"goal": {"left": [0, 1]}, "achieved": {"left": [4, 5]}}
    layout = EntityLayout(columns, fixed=["robot"], **goals)
    report = check_dataset(objects(colour=False), layout)
    assert {f.code for f in report.errors} == {"wrong_shape"}
    assert "unowned_columns_move" in {f.code for f in report.warnings}


def test_a_robot_that_is_not_fixed() -> None:
    data = clean().exclude(*GOALS)
    for fixed in (["left"], []):
        report = check_dataset(data, EntityLayout(ENTITIES, fixed=fixed))
        codes = {f.code for f in report.findings}
        assert "robot_not_fixed" in codes and "always_moves" not in codes
