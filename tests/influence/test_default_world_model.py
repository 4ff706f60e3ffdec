"""Tests of the world model that suits most data."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import CAI, default_world_model, roc_auc
from torchrl_caiac.influence.default_world_model import DEFAULT_FIT
from torchrl_caiac.layouts import ready_layout


def test_positions_are_predicted_with_the_floor_of_the_layout() -> None:
    layout = ready_layout("ogbench/cube-double")
    model = default_world_model(layout, 5)
    assert {n: tuple(c) for n, c in model.config["predict"].items()} == layout.positions
    assert model.entity_floors()["cube0"] == [0.01] * 3  # 1 mm
    assert model.hidden_sizes == (256, 256, 256)
    inputs = model.config["inputs"]
    assert inputs["robot"] == [12, 13, 14]
    assert inputs["cube0"] == list(layout.columns["cube0"])
    plain = default_world_model(EntityLayout({"arm": [0, 1], "cup": [2]}), 2)
    assert plain.predict_dim == plain.input_dim == 3 and plain.auto_floor


@pytest.mark.parametrize("is_nested", [False, True])
def test_its_scores_tell_what_the_action_reaches(is_nested: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    place = torch.rand(3000, 4, generator=generator) * 2 - 1
    action = torch.rand(3000, 2, generator=generator) * 2 - 1
    touched = (place[:, :1] - place[:, 2:3]).abs() < 0.5
    change = 0.1 * torch.cat([action, action * touched], 1)
    other = torch.rand(3000, 2, generator=generator)  # a position does not tell it

    def state(x: torch.Tensor) -> TensorDict:
        parts = {"arm": x[:, :2], "cup": torch.cat([other, x[:, 2:]], 1)}
        if is_nested:
            return TensorDict(parts, [3000])
        return TensorDict({"observation": torch.cat([*parts.values()], 1)}, [3000])

    data = state(place).set("next", state(place + change))
    data["action"], data["episode"] = action, torch.arange(3000) // 20
    if is_nested:
        layout = EntityLayout.from_keys(
            {"arm": "arm", "cup": "cup"}, positions={"arm": [0, 1], "cup": [2, 3]}
        )
    else:
        layout = EntityLayout(
            {"arm": [0, 1], "cup": [2, 3, 4, 5]},
            positions={"arm": [0, 1], "cup": [4, 5]},
        )
    torch.manual_seed(0)
    model = default_world_model(
        layout, 2, widths={"arm": 2, "cup": 4} if is_nested else None
    )
    settings = {**DEFAULT_FIT, "steps": 200, "eval_every": 100}
    model.set_action_bounds(-1.0, 1.0)
    fit_world_model(model, data, progress=False, check=False, **settings)
    assert model.predict_dim == 4 and "rests" in model.floor_reasons["cup"]
    scores = CAI(model, 16)(data[:500])[:, 1]
    assert roc_auc(scores, touched[:500, 0]) > 0.9
