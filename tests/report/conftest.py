from __future__ import annotations

import pytest

from tests.report.walks import LAYOUT, scored_dataset, transitions
from torchrl_caiac.scored import ScoredDataset


@pytest.fixture(scope="session")
def walks() -> ScoredDataset:
    """A robot and two objects in space: 20 trajectories of 40 steps."""
    return scored_dataset(transitions(20, 40, 11), LAYOUT)
