"""The index of eligible donor windows against plain Python."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index
from torchrl_caiac.transforms import donors as module
from torchrl_caiac.transforms.donors import eligible_starts
from torchrl_caiac.transforms.draws import draw_buffer_donors


@st.composite
def storages(draw: st.DrawFn) -> tuple[ReplayBuffer, list[int]]:
    """A buffer, perhaps a ring, and the time order of its rows."""
    lengths = draw(st.lists(st.integers(1, 7), min_size=1, max_size=6))
    total = sum(lengths)
    size = draw(st.integers(max(1, total // 2), total + 2))
    done = torch.zeros(total, 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    data = TensorDict(
        {
            "time": torch.arange(total),
            "episode": torch.repeat_interleave(
                # ids come back: only neighbours tell trajectories apart
                torch.arange(len(lengths)) % 2,
                torch.tensor(lengths),
            ),
            ("next", "done"): done,
        },
        [total],
    )
    rb = ReplayBuffer(storage=LazyTensorStorage(size))
    step = draw(st.integers(1, size))
    for begin in range(0, total, step):
        rb.extend(data[begin : begin + step])
    order = torch.argsort(rb.storage[:]["time"]).tolist()
    return rb, order


@settings(deadline=None)
@given(
    case=storages(),
    window=st.integers(1, 5),
    seed=st.integers(0, 1000),
    chunk=st.sampled_from([1, 3, 1 << 20]),
)
def test_eligible_starts(case, window: int, seed: int, chunk: int) -> None:
    rb, order = case
    generator = torch.Generator().manual_seed(seed)
    length = len(order)
    scores = torch.rand(length, 3, generator=generator)
    scores[torch.rand(length, 3, generator=generator) < 0.1] = math.nan
    trajectories = trajectory_index(rb.storage)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_CHUNK", chunk)
        index = eligible_starts(
            scores,
            0.7,
            torch.tensor([True, False, True]),
            window=window,
            trajectories=trajectories,
        )
    episode = rb.storage[:]["next", "done"].squeeze(-1)
    for entity in range(3):
        wanted = []
        for i in range(length - window + 1):
            rows = order[i : i + window]
            if (
                entity != 1
                and not episode[rows[:-1]].any()
                and all(scores[r, entity] <= 0.7 for r in rows)
            ):
                wanted.append(rows[0])
        begin = int(index.offset[entity])
        found = index.starts[begin : begin + int(index.size[entity])]
        assert sorted(found.tolist()) == sorted(wanted)


def test_infinite_scores_and_missing_trajectories() -> None:
    swappable = torch.tensor([True])
    with pytest.raises(ValueError, match="infinite in row 1"):
        eligible_starts(torch.tensor([[0.0], [-math.inf]]), 0.1, swappable)
    with pytest.raises(ValueError, match="need the trajectories"):
        eligible_starts(torch.zeros(3, 1), 0.1, swappable, window=2)
    short = eligible_starts(
        torch.zeros(3, 1),
        0.1,
        swappable,
        window=4,
        trajectories=TrajectoryIndex(3, 0, torch.tensor([2]), torch.arange(3).flip(0)),
    )
    assert short.size.tolist() == [0]
    assert not draw_buffer_donors(
        torch.ones(2, 1, dtype=torch.bool), short
    ).swapped.any()
