"""Influence by distance."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence import DistanceInfluence, score_buffer

LAYOUT = EntityLayout(
    {"arm": [0, 1, 2], "cup": [6, 4, 5], "box": [8, 9]}, fixed=["arm"]
)
PLACES: dict[str, Any] = {"arm": [1, 2], "cup": [5, 6], "box": [9, 8]}


@given(st.integers(0, 2**31), st.sampled_from([(), (4,), (2, 3)]), st.booleans())
def test_links_match_the_distances_of_all_pairs(
    seed: int, batch: tuple[int, ...], double: bool
) -> None:
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(*batch, 10, generator=generator) * 0.3
    x = x.double() if double else x
    rule = DistanceInfluence(LAYOUT, PLACES, distance=0.15)
    graph = rule(TensorDict({"observation": x}, batch))
    assert graph.shape == (*batch, 4, 3) and graph.dtype == torch.float32
    flat, rows = x.reshape(-1, 10), graph.reshape(-1, 4, 3)
    for values, row in zip(flat.tolist(), rows.tolist(), strict=True):
        place = {n: [values[c] for c in columns] for n, columns in PLACES.items()}
        for i, one in enumerate(("arm", "cup", "box", "arm")):  # the action is the arm
            for j, other in enumerate(("arm", "cup", "box")):
                apart = math.dist(place[one], place[other])
                if abs(apart - 0.15) > 1e-6:
                    assert row[i][j] == (apart < 0.15)
    only = DistanceInfluence(LAYOUT, PLACES, "arm", 0.15, action_only=True)
    action = only(TensorDict({"observation": x}, batch))
    assert torch.equal(action, graph[..., 3, :])


def test_nested_layouts_and_named_agents() -> None:
    layout = EntityLayout.from_keys({"arm": ("s", "arm"), "cup": ("s", "cup")})
    rule = DistanceInfluence(layout, {"arm": [1], "cup": [0]}, agent="cup")
    td = TensorDict(
        {"s": {"arm": torch.tensor([[5.0, 0.0]]), "cup": torch.tensor([[0.3]])}}, [1]
    )
    assert rule(td).tolist() == [[[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]]
    with pytest.raises(ValueError, match=r"'cup' the features \[3\], but it has 1"):
        DistanceInfluence(layout, {"arm": [1], "cup": [3]}, agent="cup")(td)


def test_positions_of_the_layout() -> None:
    layout = EntityLayout(LAYOUT.columns, fixed=["arm"], positions=PLACES)
    x = TensorDict({"observation": torch.rand(20, 10) * 0.3}, [20])
    rule = DistanceInfluence(layout)
    assert torch.equal(rule(x), DistanceInfluence(LAYOUT, PLACES)(x))
    with pytest.raises(ValueError, match=r"the layout's positions name \[\], expected"):
        DistanceInfluence(LAYOUT)


def test_scores_the_state_after_the_last_row() -> None:
    layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])
    rule = DistanceInfluence(layout, {"arm": [0], "cup": [1]})
    far, near = torch.tensor([[0.0, 1.0]]), torch.tensor([[0.0, 0.05]])
    rb = ReplayBuffer(storage=LazyTensorStorage(2), batch_size=2)
    rb.extend(
        TensorDict(
            {
                "observation": torch.cat([far, far]),
                "episode": torch.zeros(2, dtype=torch.int64),
                "next": {"observation": torch.cat([far, near])},
            },
            [2],
        )
    )
    score_buffer(rb, rule, key="graph", done_key=None, progress=False)
    assert rb.storage[:]["graph"][:, 2].tolist() == [[1.0, 0.0], [1.0, 1.0]]
    further = DistanceInfluence(layout, rule.positions, distance=0.2)
    with pytest.raises(ValueError, match="other settings: estimator"):
        score_buffer(rb, further, key="graph", done_key=None, progress=False)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"positions": {"arm": [0]}}, r"positions name \['arm'\], expected all"),
        ({"positions": {**PLACES, "box": [8]}}, "expected the same number"),
        ({"positions": dict.fromkeys(PLACES, ())}, "at least 1, for all"),
        ({"positions": {**PLACES, "box": [8, 4]}}, r"'box' the columns \[4\], which"),
        ({"agent": "pot"}, "agent is 'pot', which is not an entity"),
        ({"distance": 0.0}, "distance must be positive and finite, got 0.0"),
        ({"distance": math.nan}, "distance must be positive"),
        (
            {"layout": EntityLayout(LAYOUT.columns)},
            r"0 fixed entities \[\]: pass the one that the action moves",
        ),
    ],
)
def test_rejects_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DistanceInfluence(**{"layout": LAYOUT, "positions": PLACES, **kwargs})


def test_rejects_positions_that_are_not_finite() -> None:
    x = torch.zeros(2, 10)
    x[1, 5], x[0, 0] = torch.nan, torch.nan  # column 0 is no position
    rule = DistanceInfluence(LAYOUT, PLACES)
    with pytest.raises(ValueError, match=r"positions of \['cup'\] have NaN"):
        rule(TensorDict({"observation": x}, [2]))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int64])
def test_integers_do_not_wrap_around(dtype: torch.dtype) -> None:
    layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])
    rule = DistanceInfluence(layout, {"arm": [0], "cup": [1]}, distance=3)
    state = torch.tensor([[5, 7], [7, 5], [0, 9]]).to(dtype)
    action = rule(TensorDict({"observation": state}, [3]))[:, -1]
    assert action.tolist() == [[1.0, 1.0], [1.0, 1.0], [1.0, 0.0]]
