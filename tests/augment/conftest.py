"""Scored datasets for the tests of augmentation."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from tests.pushes import LAYOUT, push_transitions
from torchrl_caiac import EntityLayout
from torchrl_caiac.data import offline_buffer, write_transitions
from torchrl_caiac.influence import MotionInfluence, score_buffer
from torchrl_caiac.scored import ScoredDataset, write_scored

GOALS = EntityLayout(
    LAYOUT.columns,
    fixed=["hand"],
    positions=LAYOUT.positions,
    variance_floor=1e-3,
    goal={"cup": [0], "box": [1]},
    achieved={"cup": [2], "box": [4]},
)
TOLERANCE = 0.1


NAMES = ("cup", "box")
# The same threshold for both cups.
THRESHOLDS = SimpleNamespace(
    thresholds=dict.fromkeys(NAMES, 0.5),
    confidence=dict.fromkeys(NAMES, "chosen"),
    reasons=dict.fromkeys(NAMES, "chosen"),
    free=dict.fromkeys(NAMES, 0.5),
)


def score(folder: Path, data: TensorDict, layout: EntityLayout) -> ScoredDataset:
    stored = write_transitions(data, folder / "data", action_bounds=([-1], [1]))
    rb = offline_buffer(stored)
    score_buffer(rb, MotionInfluence(layout), check=False, progress=False)
    return write_scored(folder, layout, THRESHOLDS, estimator="motion", settings={})


def with_goals(data: TensorDict) -> TensorDict:
    """Goals of both cups, and the sparse reward of each being near its own."""
    data = data.clone()
    ends = data["next", "done"].squeeze(-1).nonzero()[:, 0]
    last = ends[torch.searchsorted(ends, torch.arange(len(data)))]
    goal = data["next", "observation"][last][:, [2, 4]]
    noise = torch.rand(len(ends), 2, generator=torch.Generator().manual_seed(0))
    goal = goal + 0.2 * noise[data["episode"]]
    data["desired_goal"] = goal
    data["achieved_goal"] = data["observation"][:, [2, 4]].clone()
    data["next", "achieved_goal"] = data["next", "observation"][:, [2, 4]].clone()
    near = (data["next", "achieved_goal"] - goal).abs() <= TOLERANCE
    data["next", "reward"] = near.all(-1, keepdim=True).float() - 1
    return data


@pytest.fixture
def plain(tmp_path: Path) -> ScoredDataset:
    return score(tmp_path / "scored", push_transitions(), LAYOUT)


@pytest.fixture
def goals(tmp_path: Path) -> ScoredDataset:
    return score(tmp_path / "scored", with_goals(push_transitions()), GOALS)
