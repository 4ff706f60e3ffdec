from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.envs.ogbench.names import NAMES, STEPS
from torchrl_caiac.envs.ogbench import OGBenchSimulator, ogbench_states

CONTACT = 18  # the gripper's contact, which depends on what files do not have


@pytest.mark.parametrize("name", NAMES)
def test_a_recorded_action_leads_to_the_recorded_next_state(
    name, arrays, states, simulators
):
    own, simulator = arrays[name], simulators[name]
    robot = slice(0, CONTACT)
    entities = slice(CONTACT + 1, None)
    # Not from the start: the rounding to float32 decides whether a cube that is put on
    # the table, or into another cube, touches it.
    for row in [*range(1, STEPS, 3), *range(STEPS + 2, 2 * STEPS, 3)]:
        found = simulator.restore(states[name][row])
        known = np.delete(np.arange(len(found)), CONTACT)
        assert np.allclose(found[known], own["observations"][row][known], atol=2e-6)
        following, *_ = simulator.step(own["actions"][row])
        error = np.abs(following - own["observations"][row + 1])
        # In units of the data, where a millimetre of a cube is 0.01.
        assert error[robot].max() < 1e-2
        assert error[entities].max() < 2e-3


@pytest.mark.parametrize("name", NAMES)
def test_a_state_that_is_not_rounded_is_restored_exactly(name, simulators):
    simulator, action = simulators[name], np.array([0.3, 0.2, -0.5, 0.1, 0.4])
    state = simulator.reset(seed=11)
    expected, *_ = simulator.step(action)
    simulator.restore(state)
    found, *_ = simulator.step(action)
    assert np.array_equal(found, expected)


def test_without_the_hidden_place_of_the_hand_it_would_not(arrays, states, simulators):
    # As a naive restore does, with all places computed in the state itself.
    import mujoco

    own, simulator = arrays["cube-double"], simulators["cube-double"]
    naive, exact = [], []
    for row in range(5, 40, 5):
        simulator.restore(states["cube-double"][row])
        following, *_ = simulator.step(own["actions"][row])
        exact.append(np.abs(following - own["observations"][row + 1])[:6].max())
        simulator.restore(states["cube-double"][row])
        mujoco.mj_forward(simulator.model, simulator.data)
        following, *_ = simulator.step(own["actions"][row])
        naive.append(np.abs(following - own["observations"][row + 1])[:6].max())
    assert max(exact) < 1e-5 < 1e-4 < np.median(naive)


@pytest.mark.parametrize("name", NAMES)
def test_outcomes_do_not_depend_on_what_was_simulated_before(name, states, simulators):
    simulator = simulators[name]
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 5))
    first = simulator.outcomes(states[name][20], actions)
    simulator.outcomes(states[name][50], actions[:1], horizon=2)
    backwards = simulator.outcomes(states[name][20], actions[::-1])
    assert np.array_equal(first, backwards[::-1])
    assert first.shape == (3, len(simulator.observation()))


def test_horizon_repeats_the_action(states, simulators):
    simulator, action = simulators["scene"], np.full(5, 0.5)
    state = states["scene"][20]
    simulator.restore(state)
    for _ in range(3):
        found, *_ = simulator.step(action)
    [expected] = simulator.outcomes(state, action[None], horizon=3)
    assert np.array_equal(found, expected.astype(np.float32))


def test_the_state_round_trips(simulators):
    simulator = simulators["scene"]
    state = simulator.reset(seed=5)
    assert set(state[-2:]) <= {0.0, 1.0}
    simulator.restore(state)
    assert np.array_equal(simulator.state(), state)
    record = simulator.record()
    assert np.array_equal(
        np.concatenate(list(record.values())), state.astype(np.float32)
    )
    assert not np.array_equal(simulator.reset(seed=6), state)
    assert np.array_equal(simulator.reset(seed=5), state)


def test_positions_are_where_the_observation_says(simulators):
    simulator = simulators["scene"]
    observation = simulator.restore(simulator.reset(seed=5))
    places = simulator.positions()
    assert list(places) == list(simulator.layout.names)
    centre = np.array([0.425, 0, 0])
    columns = simulator.layout.columns
    assert np.allclose(observation[12:15], (places["robot"] - centre) * 10, atol=1e-5)
    cube = observation[list(columns["cube0"])][:3]
    assert np.allclose(cube, (places["cube0"] - centre) * 10, atol=1e-5)
    for name, scale, column in (
        ("drawer", 18, 0),
        ("window", 15, 0),
        ("button1", 120, 2),
    ):
        value = observation[columns[name][column]]
        assert np.allclose(value, places[name][0] * scale, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda s: s[:-1], r"expected \(51,\)"),
        (lambda s: np.where(np.arange(len(s)) == 3, np.nan, s), r"not finite at \[3\]"),
        (lambda s: np.where(np.isin(np.arange(51), range(17, 21)), 0, s), "quaternion"),
        (lambda s: np.where(np.arange(51) == 50, 0.5, s), "button states"),
    ],
)
def test_bad_states(change, match, states, simulators):
    with pytest.raises(ValueError, match=match):
        simulators["scene"].restore(change(states["scene"][0]))


@pytest.mark.parametrize(
    ("actions", "horizon", "match"),
    [
        (np.zeros(5), 1, r"expected \[K, 5\]"),
        (np.zeros((0, 5)), 1, r"expected \[K, 5\]"),
        (np.full((1, 5), np.inf), 1, "not finite"),
        (np.zeros((1, 5)), 0, "horizon is 0"),
    ],
)
def test_bad_actions(actions, horizon, match, states, simulators):
    with pytest.raises(ValueError, match=match):
        simulators["scene"].outcomes(states["scene"][0], actions, horizon=horizon)


def test_an_unknown_environment():
    with pytest.raises(ValueError, match="no OGBench environment 'antmaze'"):
        OGBenchSimulator("antmaze")


def test_states_of_transitions(arrays, states):
    own = arrays["scene"]
    data = TensorDict(
        {
            "info": {
                key: torch.from_numpy(own[key])
                for key in ("qpos", "qvel", "button_states")
            }
        },
        [len(own["qpos"])],
    )
    assert np.array_equal(ogbench_states(data).numpy(), states["scene"])
    moved = TensorDict({"sim": data["info"]}, data.batch_size)
    keys = [("sim", key) for key in ("qpos", "qvel", "button_states")]
    assert torch.equal(ogbench_states(moved, keys=keys), ogbench_states(data))
    with pytest.raises(KeyError, match="lack the simulator"):
        ogbench_states(moved)
