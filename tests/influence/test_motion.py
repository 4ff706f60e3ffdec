"""Influence read from the recording."""

from __future__ import annotations

import logging
import math
import pickle
import re
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.influence import MotionInfluence, score_buffer

LAYOUT = EntityLayout(
    {"arm": [0, 4], "cup": [3, 1, 2]}, fixed=["arm"], positions={"cup": [2, 3]}
)


def episodes(layout: EntityLayout, *, length: int = 50, count: int = 4) -> TensorDict:
    """The arm moves always, the cup in the steps 20 to 29 of each episode."""
    generator = torch.Generator().manual_seed(0)
    change = torch.zeros(count, length, 5)
    change[..., [0, 4]] = 0.05 * torch.randn(count, length, 2, generator=generator)
    change[:, 20:30, 1:4] = 0.1
    change[..., 1:4] += 1e-5 * torch.randn(count, length, 3, generator=generator)
    states = torch.cat([torch.zeros(count, 1, 5), change.cumsum(1)], 1)
    done = torch.zeros(count, length, 1, dtype=torch.bool)
    done[:, -1] = True
    return TensorDict(
        {
            "observation": states[:, :-1],
            "action": torch.zeros(count, length, 2),
            "episode": torch.arange(count).view(-1, 1).expand(count, length),
            "next": {"observation": states[:, 1:], "done": done},
        },
        [count, length],
    ).reshape(-1)


def oracle(
    layout: EntityLayout, td: TensorDict, tolerance: dict[str, Any]
) -> torch.Tensor:
    """The scores, entity by entity and row by row."""
    scores = torch.zeros(len(td), len(layout))
    for row in range(len(td)):
        now = td["observation"][row].tolist()
        after = td["next", "observation"][row].tolist()
        for number, (name, own) in enumerate(layout.columns.items()):
            for place, column in enumerate(own):
                if column not in layout.positions.get(name, own):
                    continue
                limit = tolerance[name]
                limit = limit[place] if isinstance(limit, tuple) else limit
                ratio = abs(after[column] - now[column]) / limit
                if ratio > 1:
                    scores[row, number] = max(float(scores[row, number]), ratio)
    return scores


@given(
    st.integers(0, 1000),
    st.sampled_from([0.5, {"arm": 0.5, "cup": (0.25, 1.0, 2.0)}]),
)
def test_scores_equal_those_of_a_loop(seed: int, tolerance: Any) -> None:
    generator = torch.Generator().manual_seed(seed)
    now, after = torch.randn(2, 20, 5, generator=generator)
    td = TensorDict({"observation": now, ("next", "observation"): after}, [20])
    limits = (
        tolerance
        if isinstance(tolerance, dict)
        else dict.fromkeys(LAYOUT.names, tolerance)
    )
    found = MotionInfluence(LAYOUT, tolerance)(td)
    torch.testing.assert_close(found, oracle(LAYOUT, td, limits))
    assert found.dtype == torch.float32
    square = MotionInfluence(LAYOUT, tolerance)(td.reshape(4, 5))
    assert torch.equal(square.reshape(20, 2), found)


def test_the_tolerance_is_measured() -> None:
    data = episodes(LAYOUT)
    estimator = MotionInfluence(LAYOUT)
    assert not estimator.fitted
    with pytest.raises(RuntimeError, match=re.escape("call fit(data) first")):
        estimator(data)
    assert estimator.fit(data) is estimator
    moves = estimator(data)[:, 1] > 0
    expected = (torch.arange(50) // 10 == 2).repeat(4)
    assert torch.equal(moves, expected)


def test_how_the_tolerance_was_found_is_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.INFO, logger="torchrl_caiac"):
        MotionInfluence(LAYOUT).fit(episodes(LAYOUT))
    assert "'cup' rests in 80.0 % of 200 rows" in caplog.text


def test_the_floor_of_the_layout_is_the_tolerance() -> None:
    layout = EntityLayout(
        LAYOUT.columns, fixed=["arm"], variance_floor={"arm": 1, "cup": [1, 2, 3]}
    )
    estimator = MotionInfluence(layout)
    assert estimator.fitted
    assert estimator.tolerance == {"arm": 1.0, "cup": (1.0, 2.0, 3.0)}
    data = episodes(LAYOUT)
    assert estimator.fit(data).tolerance == {"arm": 1.0, "cup": (1.0, 2.0, 3.0)}


def test_nested_layouts_have_the_same_scores() -> None:
    data = episodes(LAYOUT)
    nested = data.exclude("observation", ("next", "observation"))
    for key in ("arm", "cup"):
        columns = list(LAYOUT.columns[key])
        nested[key] = data["observation"][:, columns]
        nested["next", key] = data["next", "observation"][:, columns]
    layout = EntityLayout.from_keys(
        {"arm": "arm", "cup": "cup"}, positions={"cup": [2, 0]}
    )
    expected = MotionInfluence(LAYOUT, 0.01)(data)
    assert torch.equal(MotionInfluence(layout, 0.01)(nested), expected)


def test_a_buffer_is_scored_and_augmented_with_the_default_threshold() -> None:
    data = episodes(LAYOUT)
    rb = ReplayBuffer(storage=LazyTensorStorage(len(data)), batch_size=64)
    rb.extend(data)
    score_buffer(rb, MotionInfluence(LAYOUT).fit(rb), lookahead=5, progress=False)
    step = torch.arange(50).repeat(4)
    expected = (step >= 15) & (step < 30)  # moves within the next 5 steps
    assert torch.equal(rb.storage[:]["caiac", "score"][:, 1] > 0, expected)
    rb.append_transform(CAIACTransform(LAYOUT, counterfactual_ratio=1.0))
    batch = rb.sample()
    moves = batch["caiac", "score"][:, 1] > 0
    assert torch.equal(batch["caiac", "swapped"][:, 1], ~moves)


def test_another_tolerance_means_other_scores() -> None:
    data = episodes(LAYOUT)
    rb = ReplayBuffer(storage=LazyTensorStorage(len(data)))
    rb.extend(data)
    score_buffer(rb, MotionInfluence(LAYOUT, 0.01), progress=False)
    with pytest.raises(ValueError, match="overwrite=True"):
        score_buffer(rb, MotionInfluence(LAYOUT, 0.02), progress=False)


def test_it_can_be_pickled() -> None:
    data = episodes(LAYOUT)
    estimator = MotionInfluence(LAYOUT).fit(data)
    expected = estimator(data)
    copy = pickle.loads(pickle.dumps(estimator))
    assert torch.equal(copy(data), expected)


def test_what_cannot_be_scored_is_refused() -> None:
    data = episodes(LAYOUT)
    estimator = MotionInfluence(LAYOUT, 0.01)
    data["next", "observation"][7, 3] = math.nan
    with pytest.raises(ValueError, match=r"\['cup'\] have NaN or infinite"):
        estimator(data)
    with pytest.raises(KeyError, match="next"):
        estimator(data.exclude("next"))
    with pytest.raises(ValueError, match="tolerance must be 'auto'"):
        MotionInfluence(LAYOUT, "small")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"tolerance lacks \['cup'\]"):
        MotionInfluence(LAYOUT, {"arm": 0.1})
    with pytest.raises(TypeError, match="layout must be an EntityLayout"):
        MotionInfluence("kitchen")  # type: ignore[arg-type]
    nested = EntityLayout.from_keys({"arm": "observation"})
    with pytest.raises(ValueError, match="has 2 numbers, expected one for each of its"):
        MotionInfluence(nested, {"arm": [1, 2]})(episodes(LAYOUT))
