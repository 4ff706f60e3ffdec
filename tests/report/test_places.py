from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_caiac import EntityLayout
from torchrl_caiac.report.places import entity_places


def test_flat_layout_in_any_order_of_columns() -> None:
    layout = EntityLayout(
        {"arm": [5, 0], "cup": [2, 1, 4], "box": [3]},
        positions={"cup": [4, 1]},
        goal={"arm": [], "cup": [], "box": [0]},
        achieved={"arm": [], "cup": [], "box": [3]},
        variance_floor={"arm": 1.0, "cup": [0.2, 0.1, 0.4], "box": 3.0},
    )
    data = TensorDict({"observation": torch.arange(12.0).view(2, 6)}, [2])
    places = entity_places(layout, data)
    read = layout.read(data)
    assert read[0, list(places["cup"].features)].tolist() == [4.0, 1.0]
    assert places["cup"].labels == ("observation[4]", "observation[1]")
    assert places["cup"].floors == (0.4, 0.1)
    assert places["box"].known and places["box"].text == "observation[3]"
    assert not places["arm"].known
    assert read[0, list(places["arm"].features)].tolist() == [5.0, 0.0]


def test_nested_layout() -> None:
    layout = EntityLayout.from_keys(
        {"arm": ("observation", "arm"), "cup": ("observation", "cup")},
        positions={"cup": [1, 2, 3]},
    )
    data = TensorDict(
        {"observation": {"arm": torch.zeros(3, 2), "cup": torch.zeros(3, 2, 2)}}, [3]
    )
    places = entity_places(layout, data)
    assert places["cup"].features == (3, 4, 5) and places["cup"].is_point
    assert places["cup"].text == "observation/cup[1:4]"
    assert places["arm"].features == (0, 1) and not places["arm"].is_point
