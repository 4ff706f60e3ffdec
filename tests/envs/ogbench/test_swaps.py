from __future__ import annotations

import numpy as np
import pytest

from tests.envs.ogbench.names import NAMES, STEPS
from torchrl_caiac.envs.ogbench import OGBenchTruth, resimulate_swaps


@pytest.fixture
def rows(arrays, states):
    """The parts of some transitions: states, actions and next states."""

    def take(name: str, numbers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        numbers = np.asarray(numbers)
        return (
            states[name][numbers],
            arrays[name]["actions"][numbers],
            states[name][numbers + 1],
        )

    return take


@pytest.mark.parametrize("name", NAMES)
def test_real_transitions_are_possible(name, rows, simulators):
    own = rows(name, range(1, STEPS, 4))
    nothing = np.zeros((len(own[0]), len(simulators[name].layout)), bool)
    donors = np.zeros(len(own[0]), int)
    errors = resimulate_swaps(simulators[name], *own, nothing, donors, progress=False)
    assert errors.shape == nothing.shape
    assert errors.max() < 1e-4


def test_a_cube_can_be_swapped_to_a_free_place_alone(arrays, rows, simulators):
    qpos = arrays["cube-double"]["qpos"]
    rises = np.diff(qpos[: STEPS + 1, [16, 23]], axis=0)
    lifted, cube = np.unravel_index(rises.argmax(), rises.shape)
    # The first rows of the other episode, where its cubes lie on the table.
    before, actions, after = rows("cube-double", [lifted, STEPS + 3])
    other = 1 - cube
    free = before[1, [14, 21][other] : [17, 24][other]]
    held = before[0, [14, 21][cube] : [17, 24][cube]]
    assert np.linalg.norm(free - held) > 0.08
    swapped = np.zeros((2, 3), bool)
    swapped[0, 1 + other] = True
    simulator = simulators["cube-double"]
    possible = resimulate_swaps(
        simulator, before, actions, after, swapped, [1, 0], progress=False
    )
    assert possible.max() < 1e-3
    # A cube swapped into the other one flies off.
    overlap = before.copy()
    overlap[1, [14, 21][other] : [17, 24][other]] = held
    swapped[0] = [False, other == 0, other == 1]
    flung = resimulate_swaps(
        simulator, overlap, actions, after, swapped, [1, 0], progress=False
    )
    assert flung[0].max() > 1e-2


def test_donors_may_differ_between_entities(rows, simulators):
    own = rows("cube-double", [2, 8, STEPS + 9])
    swapped = np.array([[False, True, True], [False] * 3, [False] * 3])
    each = np.array([[0, 1, 2], [0, 0, 0], [0, 0, 0]])
    both = resimulate_swaps(
        simulators["cube-double"], *own, swapped, each, progress=False
    )
    # The same by hand: cube0 of row 1, cube1 of row 2.
    start, claim = own[0][0].copy(), own[2][0].copy()
    for state, source in ((start, own[0]), (claim, own[2])):
        state[14:21], state[28 + 14 : 28 + 20] = source[1, 14:21], source[1, 42:48]
        state[21:28], state[28 + 20 : 28 + 26] = source[2, 21:28], source[2, 48:54]
    truth = OGBenchTruth("cube-double")
    [after] = truth.outcomes(start, own[1][:1])
    expected = [
        np.linalg.norm(after[3:6] - claim[14:17]),
        np.linalg.norm(after[6:9] - claim[21:24]),
    ]
    assert np.allclose(both[0, 1:], expected, atol=1e-6)
    truth.close()


def test_buttons_take_their_state_along(rows, simulators):
    before, actions, after = rows("scene", [5, 6])
    before[0, -2], before[1, -2] = 0, 1
    after[0, -2], after[1, -2] = 0, 1
    swapped = np.zeros((2, 6), bool)
    swapped[0, 2] = True  # button0
    errors = resimulate_swaps(
        simulators["scene"], before, actions, after, swapped, [1, 0], progress=False
    )
    assert errors[0, 2] < 1e-3
    after[1, -2] = 0  # the claim is wrong
    errors = resimulate_swaps(
        simulators["scene"], before, actions, after, swapped, [1, 0], progress=False
    )
    assert errors[0, 2] == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"states": np.zeros((3, 54))}, "next_states have shape"),
        ({"actions": np.zeros((2, 4))}, "actions have shape"),
        ({"swapped": np.zeros((2, 2), bool)}, "swapped have shape"),
        ({"swapped": np.zeros((2, 3))}, "expected bool"),
        ({"swapped": [[True, False, False]] * 2}, "has the robot"),
        ({"donors": [0.0, 1.0]}, "expected integers"),
        ({"donors": [0, 2]}, "outside of 0 to 1"),
    ],
)
def test_bad_input(change, match, rows, simulators):
    before, actions, after = rows("cube-double", [1, 2])
    arguments = {
        "states": before,
        "actions": actions,
        "next_states": after,
        "swapped": np.array([[False, True, False]] * 2),
        "donors": [1, 0],
        **change,
    }
    with pytest.raises(ValueError, match=match):
        resimulate_swaps(simulators["cube-double"], **arguments, progress=False)
