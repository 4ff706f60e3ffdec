"""Tests of how many different actions data hold from similar states."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import Bounded

from torchrl_caiac.data import load_transitions
from torchrl_caiac.data.write_transitions import write_transitions
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence import action_coverage

LAYOUT = EntityLayout(
    {"arm": [0, 1], "cup": [2, 3]},
    fixed=["arm"],
    positions={"arm": [0, 1], "cup": [2, 3]},
)
SPEC = Bounded(-1.0, 1.0, (2,))


def transitions(
    *, noise: float, episodes: int = 40, seed: int = 0, first: int = 0
) -> TensorDict:
    """Reaches for the cup, with noise; a noise of infinity is random actions."""
    rng = np.random.default_rng(seed)
    state = rng.uniform(-1, 1, (episodes, 1, 4))
    rows = []
    for _ in range(25):
        action = np.clip(2 * (state[..., 2:] - state[..., :2]), -1, 1)
        uniform = rng.uniform(-1, 1, action.shape)
        if np.isinf(noise):
            action = uniform
        else:
            action = np.clip(action + noise * uniform, -1, 1)
        rows.append((state, action))
        state = state.copy()
        state[..., :2] = np.clip(state[..., :2] + 0.2 * action, -1, 1)
    states, actions = (np.concatenate(x, 1) for x in zip(*rows, strict=True))
    return TensorDict(
        {
            "observation": torch.from_numpy(states).float().flatten(0, 1),
            "action": torch.from_numpy(actions).float().flatten(0, 1),
            "episode": torch.arange(first, first + episodes).repeat_interleave(25),
        },
        [episodes * 25],
    )


def test_expert_data_are_told_from_those_with_random_actions() -> None:
    expert, chance = transitions(noise=0.05), transitions(noise=float("inf"), seed=1)
    alone = action_coverage(expert, LAYOUT, action_spec=SPEC)
    assert alone.verdict == "few" and alone.narrow > 0.9
    assert alone.predictability > 0.8 and alone.spread < 0.25 < alone.seen
    assert "random_transitions" in alone.advice and "MotionInfluence" in alone.advice
    both = action_coverage([expert, chance], LAYOUT, action_spec=SPEC)
    assert both.verdict == "many" and both.rows == 2000
    assert both.spread > alone.spread + 0.3 and both.seen > alone.seen
    only = action_coverage(chance, LAYOUT, action_spec=SPEC)
    assert only.verdict == "many" and only.predictability < 0.1
    assert only.spread > 0.95 and only.rank > 1.9 and only.narrow == 0.0
    noisy = action_coverage(transitions(noise=0.5), LAYOUT, action_spec=SPEC)
    assert alone.spread < noisy.spread < both.spread
    assert noisy.verdict == "some" and "extrapolates" in noisy.advice


def test_a_column_that_never_varies_is_seen_in_its_number() -> None:
    data = transitions(noise=float("inf"))
    data["action"][:, 1] = 0.5
    report = action_coverage(data, LAYOUT, action_spec=SPEC)
    assert report.column_spread[0] > 0.9 and report.column_spread[1] < 1e-6
    assert report.rank < 1.01
    torch.testing.assert_close(report.seen, 0.5 * (1 + 1 / 8), atol=0.06, rtol=0)


@settings(max_examples=6, deadline=None)
@given(
    st.floats(0.01, 100.0),
    st.floats(-10.0, 10.0),
    st.permutations(range(4)),
)
def test_units_and_the_order_of_columns_do_not_matter(
    scale: float, shift: float, order: list[int]
) -> None:
    data = transitions(noise=0.2, episodes=12)
    one = action_coverage(data, LAYOUT, action_spec=SPEC)
    other = data.clone()
    other["action"] = data["action"].double() * scale + shift
    other["observation"] = data["observation"].double()[:, order] * scale
    layout = EntityLayout(
        {
            "arm": [order.index(0), order.index(1)],
            "cup": [order.index(2), order.index(3)],
        },
        fixed=["arm"],
        positions={
            "arm": [order.index(0), order.index(1)],
            "cup": [order.index(2), order.index(3)],
        },
    )
    spec = Bounded(shift - scale, shift + scale, (2,), dtype=torch.float64)
    two = action_coverage(other, layout, action_spec=spec)
    np.testing.assert_allclose(
        [two.spread, two.seen, two.rank, two.predictability],
        [one.spread, one.seen, one.rank, one.predictability],
        atol=0.03,
    )


def test_nested_keys_stored_bounds_and_the_number_of_rows(tmp_path: Path) -> None:
    data = transitions(noise=0.05)
    expected = action_coverage(data, LAYOUT, action_spec=SPEC, max_rows=500)
    assert expected.rows == 500 and expected.regions <= 25
    nested = TensorDict(
        {
            "arm": data["observation"][:, :2],
            "things": {"cup": data["observation"][:, 2:]},
            "agent": {"move": data["action"], "trip": data["episode"].unsqueeze(-1)},
        },
        data.batch_size,
    )
    keys = EntityLayout.from_keys(
        {"arm": "arm", "cup": ("things", "cup")},
        fixed=["arm"],
        positions={"arm": [0, 1], "cup": [0, 1]},
    )
    found = action_coverage(
        nested,
        keys,
        action_spec=SPEC,
        action_key=("agent", "move"),
        trajectory_key=("agent", "trip"),
        max_rows=500,
    )
    assert found == expected
    # With bounds of [-2, 2], the same actions are less spread.
    path = tmp_path / "data"
    low, high = -2 * torch.ones(2), 2 * torch.ones(2)
    write_transitions(_complete(data), path, action_bounds=(low, high))
    stored = action_coverage(load_transitions(path), LAYOUT, max_rows=500)
    assert stored.spread < 0.6 * expected.spread


def _complete(data: TensorDict) -> TensorDict:
    flags = torch.zeros(len(data), 1, dtype=torch.bool)
    flags[24::25] = True
    after = {
        "observation": data["observation"],
        "reward": torch.zeros(len(data), 1),
        "done": flags,
        "terminated": torch.zeros_like(flags),
        "truncated": flags,
    }
    return data.clone().set("next", TensorDict(after, data.batch_size))


def test_the_report_is_readable_and_json() -> None:
    report = action_coverage(transitions(noise=0.05), LAYOUT, action_spec=SPEC)
    found = json.loads(json.dumps(report.to_dict()))
    assert found["verdict"] == "few" and len(found["column_spread"]) == 2
    text = str(report)
    assert text.startswith(f"1000 rows in {report.regions} regions of similar states\n")
    assert "% of the standard deviation of random actions" in text
    assert text.endswith(report.advice)


@pytest.mark.parametrize(
    ("change", "kwargs", "error", "message"),
    [
        (lambda td: td[:40], {}, ValueError, "have 40 rows, expected at least 50"),
        (lambda td: td[:0], {}, ValueError, "have 0 rows"),
        (lambda td: td.reshape(40, 25), {}, ValueError, r"size \[40, 25\].*reshape"),
        (lambda td: td.exclude("action"), {}, KeyError, "data lack the action"),
        (lambda td: td.exclude("episode"), {}, KeyError, "lack the trajectory key"),
        (
            lambda td: td.set("episode", torch.zeros(1000, dtype=torch.int64)),
            {},
            ValueError,
            "a single trajectory",
        ),
        (
            lambda td: td.set("action", torch.zeros(1000, 2)),
            {},
            ValueError,
            "all rows have the same 'action'",
        ),
        (
            lambda td: td.set("action", 90 * td["action"]),
            {},
            ValueError,
            r"expected \[-1, 1\]",
        ),
        (
            lambda td: td.set("action", td["action"] / 0),
            {},
            ValueError,
            "'action' is not finite in row 0",
        ),
        (
            lambda td: td.set("observation", td["observation"] / 0),
            {},
            ValueError,
            "the state is not finite in row 0",
        ),
        (lambda td: td, {"num_regions": 0}, ValueError, "num_regions must be"),
        (lambda td: td, {"max_rows": 10}, ValueError, "max_rows must be"),
        (lambda td: td, {"action_spec": SPEC[0:1]}, ValueError, "action_spec"),
    ],
)
def test_what_does_not_fit_is_named(
    change: Any, kwargs: Any, error: type[Exception], message: str
) -> None:
    data = change(transitions(noise=0.05))
    with pytest.raises(error, match=message):
        action_coverage(data, LAYOUT, **{"action_spec": SPEC, **kwargs})


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.ensemble", None)
    with pytest.raises(ImportError, match=r"torchrl-caiac\[report\]"):
        action_coverage(transitions(noise=0.05), LAYOUT, action_spec=SPEC)
