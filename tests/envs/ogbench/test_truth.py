from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.envs.ogbench.names import NAMES
from torchrl_caiac.envs.ogbench import OGBenchTruth
from torchrl_caiac.influence import SimulatorInfluence, true_influence


@pytest.fixture(scope="module")
def truths():
    made = {name: OGBenchTruth(name) for name in NAMES}
    yield made
    for truth in made.values():
        truth.close()


@pytest.mark.parametrize("name", NAMES)
def test_the_entities_are_those_of_the_observations(name, truths, simulators):
    layout = truths[name].layout
    assert layout.names == simulators[name].layout.names
    assert layout.fixed == simulators[name].layout.fixed


def test_a_cube_in_the_hand_is_influenced_and_the_other_is_not(arrays, states, truths):
    own = arrays["cube-double"]["qpos"]
    moves = np.abs(np.diff(own[:61, [16, 23]], axis=0))  # up or down
    row, cube = np.unravel_index(moves.argmax(), moves.shape)
    assert moves[row, cube] > 5e-3
    state = states["cube-double"][row]
    far = state.copy()  # where no hand is
    far[[14, 21][1 - cube] : [17, 24][1 - cube]] = (0.3, -0.3, 0.02)
    found = true_influence(
        truths["cube-double"], far[None], num_actions=6, threshold=1e-3, progress=False
    )
    expected = [True, cube == 0, cube == 1]
    assert found.influenced[0].tolist() == expected


def test_a_press_counts_for_the_neighbours_too(arrays, states, truths):
    own = arrays["puzzle-3x3"]
    changed = (np.diff(own["button_states"], axis=0) != 0) & ~own["terminals"][
        :-1, None
    ]
    [row] = np.flatnonzero(changed.any(1))[:1]
    truth = truths["puzzle-3x3"]
    # The recorded action presses; to pull the hand back does not.
    actions = np.stack([own["actions"][row], [0, 0, 1, 0, 0]])
    outcomes = truth.outcomes(states["puzzle-3x3"][row], actions)
    gap = np.abs(outcomes[0] - outcomes[1])
    columns = truth.layout.columns
    for button in range(9):
        state = columns[f"button{button}"][1]
        assert gap[state] == changed[row, button]
    assert changed[row].sum() >= 3


@pytest.mark.parametrize("name", NAMES)
def test_what_is_out_of_reach_does_not_move(name, states, truths):
    truth, rng = truths[name], np.random.default_rng(0)
    corners = rng.choice([-1.0, 1.0], (4, 5))
    skipped = 0
    for state in states[name][::20]:
        reach = truth.in_reach(state)
        assert reach[0]
        after = truth.outcomes(state, corners)
        for entity, near in zip(truth.layout.names, reach, strict=True):
            own = list(truth.layout.columns[entity])
            if not near:
                skipped += 1
                assert np.ptp(after[:, own], 0).max() < 1e-6
    assert skipped


def test_scores_from_the_entries_of_loaded_data(arrays, states, truths):
    rows = slice(0, 60, 20)
    keys = [("info", key) for key in ("qpos", "qvel", "button_states")]
    data = TensorDict(
        {key: torch.from_numpy(arrays["scene"][key[1]][rows]) for key in keys}, [3]
    )
    oracle = SimulatorInfluence(
        functools.partial(OGBenchTruth, "scene"),
        state_key=keys,
        num_actions=4,
        threshold=1e-3,
    )
    expected = true_influence(
        truths["scene"],
        states["scene"][rows],
        num_actions=4,
        threshold=1e-3,
        progress=False,
    )
    assert torch.equal(oracle(data), expected.influenced.float())
