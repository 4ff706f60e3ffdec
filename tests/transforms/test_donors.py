"""The index of eligible donor windows against plain Python."""

from __future__ import annotations

import math
import threading

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
    make_data,
    score,
    small,
    stored,
    write_later,
)
from torchrl_caiac import EntityLayout
from torchrl_caiac._torchrl import storage_data
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.data.write_transitions import write_transitions
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index
from torchrl_caiac.transforms import CAIACTransform, WindowGoal
from torchrl_caiac.transforms import donors as module
from torchrl_caiac.transforms.donors import BufferDonors, eligible_starts
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


def test_index_of_donors_is_rebuilt_for_another_storage() -> None:
    donors, other = small(), small()
    transform = CAIACTransform(FLAT, donors=donors, counterfactual_ratio=1.0)
    td = small(batch=4).sample()
    assert transform(td)["caiac", "swapped"].any()
    other.storage[:]["caiac", "score"].fill_(1.0)
    donors.set_storage(other.storage)  # as many writes, rows and the same newest row
    assert not transform(td)["caiac", "swapped"].any()


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


# --- donor buffers of any form -------------------------------------------------------

# Rows of two environments that wrote in turn, each one trajectory.
IN_TURN = torch.stack([torch.arange(10), 10 + torch.arange(10)], 1).flatten()


def donors_of(form: str, layout: EntityLayout = FLAT, capacity: int = 20):
    """The donors of :func:`small`, in another order, in two dimensions, or with ids."""
    data = small(layout).storage[:]
    if form == "parallel":
        rb = ReplayBuffer(storage=LazyTensorStorage(capacity, ndim=2))
        rb.extend(data.view(2, 10))
        return rb
    if form == "interleaved":
        data = data[IN_TURN]
    elif form == "collector ids":
        data["collector", "traj_ids"] = data.pop("episode")
    rb = ReplayBuffer(storage=LazyTensorStorage(capacity))
    rb.extend(data)
    return rb


FORMS = ["in order", "interleaved", "parallel", "collector ids"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("layout", [FLAT, NESTED])
@pytest.mark.parametrize("window", [1, 3])
@pytest.mark.parametrize("capacity", [20, 24])
@pytest.mark.parametrize("has_fingerprints", [False, True])
def test_donor_windows_and_their_goals_in_any_order(
    form: str, layout: EntityLayout, window: int, capacity: int, has_fingerprints: bool
) -> None:
    donors = donors_of(form, layout, capacity)
    if has_fingerprints:
        score(donors, layout, ("caiac", "score"))
    goals = WindowGoal(layout, window, mixture={"last": 1.0})
    transform = CAIACTransform(
        layout,
        counterfactual_ratio=1.0,
        window=window,
        donors=donors,
        goals=goals,
        generator=torch.Generator().manual_seed(0),
    )
    batch = small(layout, window=window, batch=240).sample()
    out = transform(batch)
    assert out["caiac", "swapped"][:, 1:].all()
    cup = out["observation"][:, 5] if layout is FLAT else out["state", "cup", "pos"]
    names = (cup.reshape(240, window, -1)[..., 0] // STRIDE).long()
    # Whole windows of one trajectory in the order of time, all of them.
    steps = names[:, :1] + torch.arange(window)
    assert torch.equal(names, steps)
    assert (names // 10 == names[:, :1] // 10).all()
    starts = [s for s in range(20) if s % 10 <= 10 - window]
    assert set(names[:, 0].tolist()) == set(starts)
    # The goal is the last state of the donor's trajectory, that after row 9 or 19.
    goal = out["desired_goal"][:, 2] if layout is FLAT else out["goal", "cup"][:, 0]
    last = 10 * (names // 10 + 1).flatten()
    assert torch.equal((goal // STRIDE).long(), last)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("window", [1, 2])
def test_donors_with_the_score_of_another_state_never_donate(
    form: str, window: int
) -> None:
    donors = donors_of(form)
    score(donors, FLAT, ("caiac", "score"))
    changed = {3, 10, 19}
    data = stored(donors)
    for place in range(20):  # behind the storage's back
        if int(data["row"][place]) in changed:
            data["observation"][place, 3] += 1  # nobody's column
    rest = set(range(20)) - changed
    transform = CAIACTransform(
        FLAT, counterfactual_ratio=1.0, window=window, donors=donors
    )
    batch = small(window=window, batch=200).sample()
    out = transform(batch)
    assert out["caiac", "swapped"][:, 1:].all()
    names = (out["observation"][:, 5] // STRIDE).long()
    if window == 1:
        assert set(names.tolist()) == rest
    else:
        starts = {s for s in rest if s + 1 in rest and s % 10 < 9}
        assert set(names[::2].tolist()) == starts


@pytest.mark.parametrize("has_goals", [False, True])
@pytest.mark.parametrize("rows", ["random", "last"])
@pytest.mark.parametrize("layout", [FLAT, NESTED])
@pytest.mark.parametrize("form", FORMS)
def test_verified_donors_give_what_others_give(
    form: str, layout: EntityLayout, rows: str, has_goals: bool
) -> None:
    """Rows that were compared are not read again; without checks all are read."""
    donors = donors_of(form, layout)
    score(donors, layout, ("caiac", "score"))
    batch = small(layout, batch=24).sample()
    outs = [
        CAIACTransform(
            layout,
            rows=rows,
            swap_prob=0.7,
            donors=donors,
            goals=WindowGoal(layout, 1) if has_goals else None,
            generator=torch.Generator().manual_seed(0),
            check=check,
        )(batch)
        for check in (False, True)
    ]
    assert outs[0]["caiac", "swapped"].any()
    assert set(outs[0].keys(True, True)) == set(outs[1].keys(True, True))
    assert (outs[0] == outs[1]).all()


def test_donors_written_later_donate_once_they_are_scored() -> None:
    donors = donors_of("in order", capacity=30)
    score(donors, FLAT, ("caiac", "score"))
    transform = CAIACTransform(FLAT, counterfactual_ratio=1.0, donors=donors)
    batch = small(batch=400).sample()

    def donated() -> set[int]:
        return set((transform(batch)["observation"][:, 5] // STRIDE).int().tolist())

    assert donated() == set(range(20))
    later = make_data(FLAT, 30 + torch.arange(5), [5], torch.Generator().manual_seed(0))
    write_later(donors, later, ("caiac", "score"), with_leaves=True)
    assert donated() == set(range(20))
    score(donors, FLAT, ("caiac", "score"))
    assert donated() == {*range(20), *range(30, 35)}


def test_no_donor_has_a_score_of_its_state() -> None:
    donors = donors_of("in order")
    score(donors, FLAT, ("caiac", "score"))
    storage_data(donors.storage)["next", "observation"].add_(1)
    transform = CAIACTransform(FLAT, counterfactual_ratio=1.0, donors=donors)
    out = transform(small(batch=4).sample())
    assert not out["caiac", "swapped"].any()
    assert transform.no_donor_count.tolist() == [0, 4, 4]


@pytest.mark.parametrize("window", [1, 3])
def test_donors_that_another_process_overwrites_do_not_donate(window, tmp_path):
    """Neither the storage nor the index of donors notices such a write."""
    count = 60
    state = torch.arange(count + 1.0).unsqueeze(-1).repeat(1, 2)
    rows = TensorDict(
        {
            "observation": state[:-1].clone(),
            "action": torch.zeros(count, 1),
            "episode": torch.arange(count) // 12,
            "next": {
                "observation": state[1:].clone(),
                "done": (torch.arange(count) % 12 == 11).unsqueeze(-1),
            },
        },
        [count],
    )
    layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])

    class Free:
        def __init__(self):
            self.layout = layout

        def __call__(self, td):
            return torch.zeros(len(td), 2)

    donors = offline_buffer(write_transitions(rows, tmp_path / "donors"))
    score_buffer(donors, Free(), progress=False)
    transform = CAIACTransform(
        layout, counterfactual_ratio=1.0, window=window, donors=donors
    )
    batch = rows[: 12 * window].clone()
    batch["caiac", "score"] = torch.zeros(len(batch), 2)
    assert transform(batch)["caiac", "swapped"][:, 1].all()
    # As in another process.
    other = load_transitions(tmp_path / "donors")
    other["observation"][24:48] = -1.0
    for _ in range(5):
        out = transform(batch)
        assert (out["observation"] >= 0).all()
    assert transform.no_donor_count[1] > 0
    assert out["caiac", "swapped"][:, 1].all()  # the index was built again


def test_donors_of_another_estimator_are_refused() -> None:
    layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])

    class Scaled:
        def __init__(self, scale: float) -> None:
            self.layout, self.scale = layout, scale

        def __call__(self, td: TensorDict) -> torch.Tensor:
            return self.scale * td["observation"].abs()

    def scored(scale: float) -> ReplayBuffer:
        state = torch.rand(40, 2)
        data = TensorDict(
            {
                "observation": state,
                "episode": torch.zeros(40, dtype=torch.int64),
                "next": {"observation": state, "done": torch.zeros(40, 1).bool()},
            },
            [40],
        )
        rb = ReplayBuffer(storage=LazyTensorStorage(40), batch_size=8)
        rb.extend(data)
        score_buffer(rb, Scaled(scale), check=False, progress=False)
        return rb

    rb = scored(1.0)
    rb.append_transform(CAIACTransform(layout, 0.5, donors=scored(1.0)))
    rb.sample()
    rb = scored(1.0)
    rb.append_transform(CAIACTransform(layout, 0.5, donors=scored(50.0)))
    with pytest.raises(ValueError, match="donors was computed by another estimator"):
        rb.sample()


@pytest.mark.parametrize("earlier", [0, 30])  # step by step, and like earlier batches
def test_nothing_is_written_between_drawing_and_reading(
    earlier: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])

    def rows(influence: float) -> TensorDict:
        state = torch.full((40, 2), influence)
        return TensorDict(
            {
                "observation": state,
                "episode": torch.zeros(40, dtype=torch.int64),
                "next": {"observation": state, "done": torch.zeros(40, 1).bool()},
                ("caiac", "score"): state,
            },
            [40],
        )

    donors = ReplayBuffer(storage=LazyTensorStorage(40), batch_size=8)
    donors.extend(rows(0.0))
    rb = ReplayBuffer(storage=LazyTensorStorage(40), batch_size=8)
    rb.extend(rows(0.0))
    rb.append_transform(CAIACTransform(layout, 0.5, donors=donors))
    for _ in range(earlier):
        rb.sample()
    writers: list[threading.Thread] = []
    index = BufferDonors.index

    def and_then_write(self: BufferDonors) -> object:
        found = index(self)
        if not writers:
            writers.append(threading.Thread(target=donors.extend, args=(rows(1.0),)))
            writers[0].start()
            writers[0].join(0.2)
        return found

    monkeypatch.setattr(BufferDonors, "index", and_then_write)
    out = rb.sample()
    writers[0].join()
    assert (donors[:]["observation"] == 1).all()
    assert out["caiac", "swapped"][:, 1].any()
    assert (out["observation"] == 0).all()
