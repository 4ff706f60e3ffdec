"""The index of eligible donor windows against plain Python."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorStorage

from tests.transforms.oracle import (
    FLAT,
    NESTED,
    STRIDE,
    N,
    leaf,
    small,
)
from torchrl_caiac import EntityLayout
from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index
from torchrl_caiac.transforms import CAIACTransform, WindowGoal
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


# --- donor buffers -------------------------------------------------------------------


def test_index_of_donors_is_rebuilt_only_after_writes() -> None:
    donors = small()
    transform = CAIACTransform(FLAT, donors=donors, counterfactual_ratio=1.0)
    td = small(batch=4).sample()
    transform(td)
    torch.manual_seed(0)
    built = transform(td)
    torch.manual_seed(0)
    assert (transform(td) == built).all()
    data = donors.storage[:].clone()
    data["caiac", "score"] = torch.full((20, N), 1.0)
    donors.extend(data)
    assert not transform(td)["caiac", "swapped"].any()
    assert transform.no_donor_count.tolist() == [0, 4, 4]
    transform.reset_no_donor_count()
    assert transform.no_donor_count.tolist() == [0, 0, 0]
    donors.storage[:]["caiac", "score"].zero_()  # behind the storage's back
    transform.refresh_donors()
    assert transform(td)["caiac", "swapped"].any()


def test_unscored_donors_are_not_eligible() -> None:
    donors = small()
    score = donors.storage[:]["caiac", "score"]
    score[1:, 1] = math.nan
    transform = CAIACTransform(FLAT, donors=donors, counterfactual_ratio=1.0)
    draw = transform.generate_parameters(torch.zeros(50, N))
    assert (draw.donors[:, 1] == 0).all()
    assert draw.swapped[:, 1].all()


def test_alone_in_the_batch_there_is_no_donor() -> None:
    rb = small(batch=1)
    transform = CAIACTransform(FLAT, counterfactual_ratio=1.0)
    raw = rb.sample()
    out = transform(raw)
    assert torch.equal(out["observation"], raw["observation"])
    assert not out["caiac", "swapped"].any()
    assert out["caiac", "counterfactual"].all()
    assert transform.no_donor_count.tolist() == [0, 1, 1]


def test_donor_storage_that_is_not_contiguous() -> None:
    data = small().storage[:].clone()
    wide = torch.cat([data["observation"], data["observation"]], -1)
    data["observation"] = wide[:, :8]  # a view
    rb = small(batch=6)
    transform = CAIACTransform(
        FLAT, donors=TensorStorage(data), counterfactual_ratio=1.0
    )
    out = transform(rb.sample())
    assert torch.equal(out["observation"][:, 7] % STRIDE, torch.full((6,), 7.0))


@pytest.mark.parametrize("layout", [FLAT, NESTED])
@pytest.mark.parametrize("window", [1, 3])
def test_goals_of_donor_windows(layout: EntityLayout, window: int) -> None:
    donors = small(layout)
    # a donor buffer needs no stored desired goals when they are drawn
    data = donors.storage[:].exclude("desired_goal", "goal")
    data = data.exclude(("next", "desired_goal"), ("next", "goal"))
    donors = ReplayBuffer(storage=LazyTensorStorage(20))
    donors.extend(data)
    goals = WindowGoal(layout, window, mixture={"last": 1.0})
    rb = small(layout, window=window, batch=6)
    transform = CAIACTransform(
        layout, donors=donors, goals=goals, window=window, counterfactual_ratio=1.0
    )
    batch = rb.sample()
    draw = transform.generate_parameters(batch["caiac", "score"])
    out = transform.apply_parameters(batch, draw)
    assert draw.goal_rows is not None
    # the donor trajectory's last row, whose next state is the goal
    last = torch.where(draw.donors < 10, 9, 19)
    assert torch.equal(draw.goal_rows[:, 1:], last[:, 1:])
    if layout is FLAT:
        # goal column 2, 0 of the cup mirror observation columns 1, 2
        for column, mirrored, entity in ((2, 1, 1), (0, 2, 1), (1, 7, 2)):
            wanted = (last[:, entity] + 1.0) * STRIDE + mirrored
            wanted = wanted.repeat_interleave(window)
            assert torch.equal(out["desired_goal"][:, column], wanted)
            assert torch.equal(out["next", "desired_goal"][:, column], wanted)
    else:
        wanted = leaf(last[:, 1] + 1, 2, first=10).float()
        wanted = wanted.repeat_interleave(window, 0)
        assert torch.equal(out["goal", "cup"], wanted)


def test_goals_need_a_donor_buffer_and_the_same_window() -> None:
    goals = WindowGoal(FLAT, 2)
    with pytest.raises(ValueError, match="there is none"):
        CAIACTransform(FLAT, window=2, goals=goals)
    with pytest.raises(ValueError, match="goals has window 2"):
        CAIACTransform(FLAT, donors=small(), goals=goals)
    with pytest.raises(TypeError, match="goals must be a WindowGoal"):
        CAIACTransform(FLAT, donors=small(), goals="last")


def test_donor_buffer_errors() -> None:
    td = small(batch=4).sample()

    def transform(data: TensorDict, **kwargs) -> CAIACTransform:
        donors = ReplayBuffer(storage=LazyTensorStorage(20))
        donors.extend(data)
        return CAIACTransform(FLAT, donors=donors, **kwargs)

    good = small().storage[:]
    with pytest.raises(ValueError, match="donor buffer is empty"):
        CAIACTransform(FLAT, donors=ReplayBuffer(storage=LazyTensorStorage(3)))(td)
    with pytest.raises(TypeError, match="donors must be a ReplayBuffer"):
        CAIACTransform(FLAT, donors=good)
    with pytest.raises(KeyError, match="donor buffer has no scores"):
        transform(good.exclude("caiac"))(td)
    bad = good.clone()
    bad["caiac", "score"] = torch.zeros(20, 2)
    with pytest.raises(ValueError, match=r"shape \[20, 2\], expected \[20, 3\]"):
        transform(bad)(td)
    bad = good.clone()
    bad["caiac", "score"][4, 1] = -math.inf
    with pytest.raises(ValueError, match="infinite in row 4"):
        transform(bad)(td)
    bad = good.clone()
    bad["observation"] = torch.zeros(20, 9)
    with pytest.raises(ValueError, match=r"'observation' has rows of \[9\].*\[8\]"):
        transform(bad)(td)
    bad = good.clone()
    bad["observation"] = bad["observation"].double()
    with pytest.raises(ValueError, match=r"float64.*float32"):
        transform(bad)(td)
    with pytest.raises(KeyError, match=r"no 'desired_goal'.*WindowGoal"):
        transform(good.exclude("desired_goal"))(td)
    with pytest.raises(KeyError, match="no 'achieved_goal'"):
        transform(good.exclude("achieved_goal"))(td)
    windows = small(window=2, batch=2).sample()
    with pytest.raises(KeyError, match=r"lack the trajectory ids .*episode"):
        transform(good.exclude("episode", ("next", "done")), window=2)(windows)
    bad = good.clone()
    bad["observation"][:, 5] = math.nan
    with pytest.raises(ValueError, match="'observation' is not finite"):
        transform(bad)(td)


def test_donors_are_not_read_where_nothing_is_swapped() -> None:
    td = small(batch=4).sample()
    donors = ReplayBuffer(storage=LazyTensorStorage(20))
    donors.extend(small().storage[:].exclude("desired_goal"))
    out = CAIACTransform(FLAT, donors=donors, counterfactual_ratio=0.0)(td)
    assert not out["caiac", "counterfactual"].any()
