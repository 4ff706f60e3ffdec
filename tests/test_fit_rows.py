"""Tests of which rows a world model is fitted to and validated on."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac._fit_rows import split_rows, trajectory_numbers


def test_same_trajectory_number_in_two_data_sets_is_two_trajectories() -> None:
    ids = torch.tensor([3, 3, 3, 9])
    td = TensorDict({"episode": ids}, [4])
    shaped = TensorDict({"episode": ids.unsqueeze(-1)}, [4])
    numbers = trajectory_numbers([td, td[:0], shaped], "episode")
    assert numbers.tolist() == [0, 0, 0, 1, 2, 2, 2, 3]


def test_transitions_of_one_id_stay_together() -> None:
    """Parallel environments interleave their transitions."""
    td = TensorDict({"episode": torch.tensor([7, 2, 7, 2, 7])}, [5])
    assert trajectory_numbers([td], "episode").tolist() == [1, 0, 1, 0, 1]


@pytest.mark.parametrize("fraction", [0.01, 0.1, 0.5, 0.99])
def test_split_holds_out_whole_trajectories(fraction: float) -> None:
    trajectory = torch.randint(0, 13, (300,)).unique(return_inverse=True)[1]
    train, validation = split_rows(
        trajectory, fraction, 10**6, torch.Generator().manual_seed(0)
    )
    assert sorted([*train.tolist(), *validation.tolist()]) == list(range(300))
    left, right = set(trajectory[train].tolist()), set(trajectory[validation].tolist())
    assert not left & right and left and right
    assert len(right) == min(max(1, round(fraction * 13)), 12)
    _, few = split_rows(trajectory, fraction, 5, torch.Generator().manual_seed(0))
    assert len(few) == 5 and set(few.tolist()) <= set(validation.tolist())
