from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.layouts import layout_names, matching_layouts, ready_layout
from torchrl_caiac.layouts.ready import describe_layout


def observations(name: str, count: int = 200) -> torch.Tensor:
    """Random rows with the properties that the environment of a layout has."""
    description = describe_layout(name)
    value = 0.3 * torch.randn(count, description.width)
    for part, place in description.places:
        columns = value[:, place.start : place.stop]
        if part.is_unit:
            columns /= columns.norm(dim=-1, keepdim=True)
        if part.bounds is not None:
            low, high = part.bounds
            columns.uniform_(low, high) if low < high else columns.fill_(low)
    for part, place in description.places:
        if part.difference is not None:
            a, b = part.difference
            w = part.width
            value[:, place.start : place.stop] = (
                value[:, a : a + w] - value[:, b : b + w]
            )
    return value


def as_data(name: str, value: torch.Tensor) -> TensorDict:
    data = TensorDict({}, value.shape[:-1])
    data[ready_layout(name).observation_key] = value
    return data


def meaning(name: str) -> Any:
    description = describe_layout(name)
    parts = [replace(part, entity=None, what="") for part in description.columns]
    return parts, description.observation_key


@pytest.mark.parametrize("name", layout_names())
def test_data_match_their_own_layout_and_no_other(name: str) -> None:
    torch.manual_seed(0)
    found = matching_layouts(as_data(name, observations(name)))
    assert found == [n for n in layout_names() if meaning(n) == meaning(name)]


@pytest.mark.parametrize(("bad", "fits"), [(4, True), (30, False)])
@pytest.mark.parametrize(
    ("name", "column"), [("ogbench/cube-double", 22), ("fetch/push", 6)]
)
def test_some_rows_may_be_odd(name: str, column: int, bad: int, fits: bool) -> None:
    value = observations(name)
    value[:bad, column] += 5
    assert (name in matching_layouts(as_data(name, value))) == fits


def test_values_that_are_not_finite_do_not_match() -> None:
    value = observations("ogbench/scene")
    value[::2, 0] = torch.nan
    assert matching_layouts(as_data("ogbench/scene", value)) == []


@pytest.mark.parametrize("name", layout_names())
def test_zeros_match_nothing(name: str) -> None:
    zeros = torch.zeros(10, describe_layout(name).width)
    assert matching_layouts(as_data(name, zeros)) == []


def test_goals_of_another_width_do_not_match() -> None:
    data = as_data("fetch/push", observations("fetch/push"))
    assert "fetch/push" in matching_layouts(
        data.set("desired_goal", torch.zeros(200, 3))
    )
    assert matching_layouts(data.set("desired_goal", torch.zeros(200, 6))) == []


def test_any_batch_and_many_rows() -> None:
    value = observations("ogbench/scene", 5000)
    for shape in ((5000,), (50, 100)):
        data = as_data("ogbench/scene", value.view(*shape, -1))
        assert matching_layouts(data) == ["ogbench/scene"]


@pytest.mark.parametrize(
    "data",
    [
        TensorDict({}, [4]),
        TensorDict({"observation": torch.zeros(0, 37)}, [0]),
        TensorDict({"observation": torch.zeros(4)}, [4]),
        TensorDict({"observation": torch.zeros(4, 37, 1)}, [4]),
        TensorDict({"observation": {"other": torch.zeros(4, 37)}}, [4]),
    ],
)
def test_other_data_match_nothing(data: TensorDict) -> None:
    assert matching_layouts(data) == []


def test_widths_that_several_layouts_have_are_told_apart() -> None:
    # Else the other tests would pass by their widths alone.
    widths = [describe_layout(name).width for name in layout_names()]
    pairs = itertools.combinations(layout_names(), 2)
    same = [p for p in pairs if len({describe_layout(n).width for n in p}) == 1]
    assert len(set(widths)) < len(widths)
    assert any(meaning(a) != meaning(b) for a, b in same)
