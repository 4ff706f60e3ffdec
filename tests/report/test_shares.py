from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_caiac.report.shares import choose_trajectories, entity_shares
from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index


def index_of(lengths: list[int]) -> TrajectoryIndex:
    ids = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    return trajectory_index(TensorDict({"episode": ids}, [len(ids)]))


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.integers(1, 6), min_size=1, max_size=6),
    st.integers(1, 7),
    st.integers(0, 1000),
)
def test_windows_are_counted_one_by_one(
    lengths: list[int], window: int, seed: int
) -> None:
    influenced = torch.rand(sum(lengths), 2, generator=torch.manual_seed(seed)) < 0.3
    found = entity_shares(influenced, index_of(lengths), [window])
    for entity in range(2):
        flags = influenced[:, entity].tolist()
        free, start = [], 0
        for length in lengths:
            own = flags[start : start + length]
            free += [not any(own[i : i + window]) for i in range(length - window + 1)]
            start += length
        assert found[entity].rows == pytest.approx(flags.count(False) / len(flags))
        if free:
            assert found[entity].windows == {
                window: pytest.approx(sum(free) / len(free))
            }
        else:
            assert found[entity].windows == {}


def test_interleaved_trajectories() -> None:
    index = trajectory_index(
        TensorDict({"episode": torch.tensor([0, 1, 0, 1, 0, 1])}, [6])
    )
    influenced = torch.tensor([False, True, False, False, False, False])[:, None]
    # Trajectory 0 is free throughout, trajectory 1 after its first step.
    assert entity_shares(influenced, index, [2])[0].windows == {2: 3 / 4}


def test_chosen_trajectories_show_every_entity() -> None:
    index = index_of([5] * 200)
    influenced = torch.zeros(1000, 3, dtype=torch.bool)
    influenced[17 * 5 + 2, 0] = True
    influenced[140 * 5, 1] = True
    chosen = choose_trajectories(influenced, index, 4, seed=0)
    assert {17, 140} <= set(chosen)
    assert len(set(chosen)) == 4 and chosen == sorted(chosen)
    assert choose_trajectories(influenced, index, 4, seed=0) == chosen
    assert choose_trajectories(influenced, index, 4, seed=1) != chosen
    assert len(choose_trajectories(influenced, index, 500, seed=0)) == 200
    assert choose_trajectories(influenced, index, 0, seed=0) == []
