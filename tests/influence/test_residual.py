"""Influence read from the recording: what an entity alone does not explain."""

from __future__ import annotations

import logging
import math
import pickle

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac import EntityLayout
from torchrl_caiac.influence import MotionInfluence, ResidualInfluence

# A hand and a ball on a line: positions and velocities.
LAYOUT = EntityLayout(
    {"hand": [0, 1], "ball": [2, 3]},
    fixed=["hand"],
    positions={"hand": [0], "ball": [2]},
)
TOLERANCE = {"hand": 0.01, "ball": 0.01}


def rolling(rows: int = 20_000, seed: int = 0) -> tuple[TensorDict, torch.Tensor]:
    """The ball rolls with friction; in a tenth of the rows the hand hits it."""
    generator = torch.Generator().manual_seed(seed)
    hand, hand_speed, ball, speed = torch.randn(4, rows, generator=generator)
    speed[::3] = 0
    hit = torch.rand(rows, generator=generator) < 0.1
    hand = torch.where(hit, ball, hand)
    push = 0.05 + torch.rand(rows, generator=generator)
    after_speed = 0.9 * speed + torch.where(hit, push, 0)
    state = torch.stack([hand, hand_speed, ball, speed], 1)
    after = torch.stack(
        [hand + hand_speed, hand_speed, ball + after_speed, after_speed], 1
    )
    td = TensorDict({"observation": state, ("next", "observation"): after}, [rows])
    return td, hit


def test_rolling_is_not_influence() -> None:
    data, hit = rolling()
    estimator = ResidualInfluence(LAYOUT, TOLERANCE).fit(
        data, steps=500, progress=False
    )
    new, hit = rolling(seed=1)
    found = estimator(new)[:, 1] > 0
    assert float((found == hit).double().mean()) > 0.98
    moves = MotionInfluence(LAYOUT, TOLERANCE)(new)[:, 1] > 0
    assert float((moves == hit).double().mean()) < 0.5


def test_scores_are_residuals_in_tolerances() -> None:
    data, _ = rolling(2000)
    estimator = ResidualInfluence(LAYOUT, TOLERANCE).fit(data, steps=50, progress=False)
    expected = estimator.expected_change(data["observation"])
    change = (data["next", "observation"] - data["observation"])[:, [0, 2]]
    ratio = (change - expected).abs() / 0.01
    torch.testing.assert_close(estimator(data), torch.where(ratio > 1, ratio, 0))


def test_equal_seeds_give_equal_networks() -> None:
    data, _ = rolling(1000)
    before = torch.get_rng_state()

    def scores(seed: int) -> torch.Tensor:
        estimator = ResidualInfluence(LAYOUT, TOLERANCE)
        return estimator.fit(data, steps=20, seed=seed, progress=False)(data)

    assert torch.equal(scores(0), scores(0))
    assert not torch.equal(scores(0), scores(1))
    assert torch.equal(torch.get_rng_state(), before)


def test_a_pickled_estimator_has_equal_scores() -> None:
    data, _ = rolling(1000)
    estimator = ResidualInfluence(LAYOUT).fit(data, steps=20, progress=False)
    copy = pickle.loads(pickle.dumps(estimator))
    assert copy.tolerance == estimator.tolerance
    assert torch.equal(copy(data), estimator(data))


def test_fitting_again_starts_anew() -> None:
    data, _ = rolling(1000)
    estimator = ResidualInfluence(LAYOUT, TOLERANCE)
    first = estimator.fit(data, steps=20, progress=False)(data)
    assert torch.equal(estimator.fit(data, steps=20, progress=False)(data), first)


def test_rows_with_the_agent_far_away_tell_what_an_entity_does_alone() -> None:
    """Where every near row is a push, pushes look like the ball's own motion."""
    generator = torch.Generator().manual_seed(0)
    ball = torch.rand(5000, generator=generator)
    near = ball > 0.4  # most demonstrations push the ball on from here
    hand = torch.where(near, ball, ball + 0.5)
    alone = torch.rand(5000, generator=generator) < 0.1  # the hand is away
    hand = torch.where(alone, ball + 0.5, hand)
    change = torch.where(near & ~alone, 0.1, 0.0)
    zero = torch.zeros(5000)
    data = TensorDict(
        {
            "observation": torch.stack([hand, zero, ball, zero], 1),
            ("next", "observation"): torch.stack([hand, zero, ball + change, zero], 1),
        },
        [5000],
    )
    pushed = near & ~alone
    fooled = ResidualInfluence(LAYOUT, TOLERANCE).fit(data, steps=500, progress=False)
    assert float((fooled(data)[pushed, 1] > 0).double().mean()) < 0.2
    right = ResidualInfluence(LAYOUT, TOLERANCE, far=0.3).fit(
        data, steps=500, progress=False
    )
    assert right.agent == "hand"
    assert torch.equal(right(data)[:, 1] > 0, pushed)


def test_the_log_says_what_is_explained(caplog: pytest.LogCaptureFixture) -> None:
    data, _ = rolling(5000)
    with caplog.at_level(logging.INFO, logger="torchrl_caiac"):
        ResidualInfluence(LAYOUT, TOLERANCE).fit(data, steps=500, progress=False)
    line = next(r.message for r in caplog.records if "'ball' moves" in r.message)
    share = float(line.split("explains ")[1].split(" %")[0])
    assert 80 < share < 92


def test_nested_layouts_have_equal_scores() -> None:
    data, _ = rolling(1000)
    nested = TensorDict({}, [1000])
    for entity, columns in LAYOUT.columns.items():
        nested[entity] = data["observation"][:, list(columns)]
        nested["next", entity] = data["next", "observation"][:, list(columns)]
    layout = EntityLayout.from_keys(
        {"hand": "hand", "ball": "ball"}, positions={"hand": [0], "ball": [0]}
    )
    flat = ResidualInfluence(LAYOUT, TOLERANCE).fit(data, steps=20, progress=False)
    other = ResidualInfluence(layout, TOLERANCE).fit(nested, steps=20, progress=False)
    assert torch.equal(other(nested), flat(data))


def test_what_cannot_be_fitted_is_refused() -> None:
    data, _ = rolling(100)
    estimator = ResidualInfluence(LAYOUT, TOLERANCE)
    with pytest.raises(RuntimeError, match="networks of ResidualInfluence are not"):
        estimator(data)
    with pytest.raises(ValueError, match="steps and batch_size must be at least 1"):
        estimator.fit(data, steps=0)
    with pytest.raises(ValueError, match="'hand' is never at least 1000"):
        ResidualInfluence(LAYOUT, TOLERANCE, far=1e3).fit(
            data, steps=500, progress=False
        )
    with pytest.raises(ValueError, match="far must be positive"):
        ResidualInfluence(LAYOUT, far=-1)
    with pytest.raises(ValueError, match="agent is 'foot', which is not an entity"):
        ResidualInfluence(LAYOUT, agent="foot", far=1)
    unknown = EntityLayout(LAYOUT.columns, fixed=["hand"])
    with pytest.raises(ValueError, match="far needs positions"):
        ResidualInfluence(unknown, far=1)
    data["observation"][3, 2] = math.nan
    with pytest.raises(ValueError, match=r"\['ball'\] have NaN or infinite"):
        ResidualInfluence(LAYOUT, TOLERANCE).fit(data, steps=500, progress=False)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", [MotionInfluence, ResidualInfluence])
def test_fits_data_on_a_gpu(kind: type) -> None:
    td, _ = rolling(500)
    options = {"steps": 3, "progress": False} if kind is ResidualInfluence else {}
    on_cpu = kind(LAYOUT).fit(td, **options)
    on_gpu = kind(LAYOUT).fit(td.to("cuda"), **options)
    assert on_gpu.tolerance == on_cpu.tolerance
    torch.testing.assert_close(on_gpu(td.to("cuda")).cpu(), on_cpu(td))
