from __future__ import annotations

import numpy as np
import pytest

from tests.envs.ogbench.names import NAMES
from torchrl_caiac.envs.ogbench import OGBENCH_ENVS
from torchrl_caiac.envs.ogbench.entities import entity_joints, ogbench_layout


@pytest.mark.parametrize("name", NAMES)
def test_a_moved_entity_changes_its_own_columns_alone(name, simulators):
    simulator = simulators[name]
    state = simulator.reset(seed=1)
    before = simulator.restore(state)
    layout = simulator.layout
    assert sum(len(own) for own in layout.columns.values()) == len(before)
    for entity, place in simulator.places.items():
        moved = state.copy()
        moved[place.start] -= 0.01
        changed = np.flatnonzero(simulator.restore(moved) != before)
        assert len(changed)
        assert set(changed) <= set(layout.columns[entity])


@pytest.mark.parametrize("name", OGBENCH_ENVS)
def test_every_environment_has_a_layout(name):
    assert ogbench_layout(name).names == ("robot", *entity_joints(name))
