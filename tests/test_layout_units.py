"""Positions and variance floors of a layout."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch

from torchrl_caiac import EntityLayout
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel

UNITS: dict[str, Any] = {
    "positions": {"cup": [3, 2]},
    "variance_floor": {"arm": 0.5, "cup": [1, 2, 3]},
}


def layout(**kwargs: Any) -> EntityLayout:
    return EntityLayout({"arm": [0, 1], "cup": [2, 3, 4]}, **{**UNITS, **kwargs})


def test_units_are_kept() -> None:
    assert layout().positions == {"cup": (3, 2)}
    assert layout().variance_floor == {"arm": 0.5, "cup": (1.0, 2.0, 3.0)}
    assert layout(variance_floor=0.1).variance_floor == {"arm": 0.1, "cup": 0.1}
    nested = EntityLayout.from_keys(
        {"arm": "arm", "cup": "cup"}, positions={"arm": [0], "cup": [0]}
    )
    assert nested.positions == {"arm": (0,), "cup": (0,)}


def test_units_are_saved(tmp_path: Any) -> None:
    layout().save(tmp_path / "layout.json")
    loaded = EntityLayout.load(tmp_path / "layout.json")
    assert loaded == layout()
    assert loaded.variance_floor == layout().variance_floor
    assert loaded.positions == layout().positions
    assert loaded != layout(variance_floor=None)
    assert "positions" not in EntityLayout({"arm": [0]}).to_dict()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"positions": {"box": [1]}}, "positions names ['box']"),
        ({"positions": {"cup": [0]}}, "'cup' the columns [0], which it does not have"),
        ({"positions": {"cup": []}}, "'cup' no columns"),
        ({"variance_floor": {"arm": 1}}, "variance_floor lacks ['cup']"),
        ({"variance_floor": 0.0}, "positive and finite"),
        ({"variance_floor": {"arm": 1, "cup": [1, 2]}}, "has 2 numbers, expected one"),
    ],
)
def test_units_that_do_not_fit_are_refused(
    arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        layout(**arguments)


def test_a_floor_that_is_no_number_is_refused() -> None:
    with pytest.raises(TypeError, match="expected a number"):
        layout(variance_floor={"arm": "auto", "cup": 1})


@pytest.mark.parametrize("kind", [GaussianWorldModel, TransformerWorldModel])
def test_models_use_the_floor_of_the_layout(kind: Any) -> None:
    model = kind(layout(), action_dim=2, predict={"cup": [4, 2]})
    assert model.floor.tolist() == [0.5, 0.5, 3.0, 1.0]
    model = kind(layout(), action_dim=2, variance_floor=0.25)
    assert model.floor.tolist() == [0.25] * 5
    model = kind(layout(variance_floor=None), action_dim=2)
    assert torch.equal(model.floor, torch.full((5,), 1e-3, dtype=torch.float64))
