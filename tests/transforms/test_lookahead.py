"""Lookahead against a slow search along trajectories."""

from __future__ import annotations

import copy
import pickle
import threading

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    PrioritizedSampler,
    RandomSampler,
    ReplayBuffer,
    ReplayBufferEnsemble,
    SamplerWithoutReplacement,
    SliceSampler,
    SliceSamplerWithoutReplacement,
    TensorDictReplayBuffer,
)

from tests.pretend_cuda import nothing_waits
from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac.evaluation import swap_shares
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.trajectories import trajectory_index
from torchrl_caiac.transforms import TransformKeys, WindowGoal
from torchrl_caiac.transforms.lookahead import (
    NEVER,
    hold_entities,
    locked_entities,
    steps_to_influence,
)

LAYOUT = EntityLayout({"arm": [0], "cup": [1], "lid": [2]}, fixed=["arm"])


def slow_steps(influenced: list[list[bool]], episode: list[int]) -> list[list[int]]:
    """Looks at each later row with the same episode, one by one."""
    found = []
    for row, own in enumerate(episode):
        later = [r for r in range(row, len(episode)) if episode[r] == own]
        found.append(
            [
                next((n for n, r in enumerate(later) if influenced[r][entity]), NEVER)
                for entity in range(len(influenced[0]))
            ]
        )
    return found


def slow_locked(steps: list[int], rule: int | str, fixed: set[int]) -> list[bool]:
    """Says of one row what it locks."""
    if rule == "next":
        known = [s for n, s in enumerate(steps) if n not in fixed and s < NEVER]
        return [s == 0 or s in [min(known, default=-1)] for s in steps]
    return [s <= rule for s in steps]


@st.composite
def recordings(draw: st.DrawFn) -> tuple[list[list[bool]], list[int]]:
    """Draws which entities are influenced, and the episode of each row, interleaved."""
    rows = draw(st.integers(1, 25))
    row = st.lists(st.booleans(), min_size=3, max_size=3)
    influenced = draw(st.lists(row, min_size=rows, max_size=rows))
    episode = draw(st.lists(st.integers(0, 2), min_size=rows, max_size=rows))
    return influenced, episode


@given(recordings())
@settings(max_examples=60, deadline=None)
def test_steps_are_those_of_a_slow_search(recording) -> None:
    influenced, episode = recording
    index = trajectory_index(
        TensorDict({"episode": torch.tensor(episode)}, [len(episode)])
    )
    found = steps_to_influence(torch.tensor(influenced), index)
    assert found.tolist() == slow_steps(influenced, episode)


@given(recordings(), st.sampled_from(["next", 0, 1, 5]))
@settings(max_examples=60, deadline=None)
def test_locked_entities_are_those_of_a_slow_search(recording, rule) -> None:
    influenced, episode = recording
    steps = slow_steps(influenced, episode)
    found = locked_entities(torch.tensor(steps), rule, ~LAYOUT.fixed_mask)
    assert found.tolist() == [slow_locked(row, rule, {0}) for row in steps]


@given(recordings(), st.integers(0, 6))
@settings(max_examples=60, deadline=None)
def test_what_is_influenced_before_the_goal_is_locked(recording, goal) -> None:
    steps = slow_steps(*recording)
    goals = torch.full((len(steps), 1), goal)
    found = locked_entities(torch.tensor(steps), goals, ~LAYOUT.fixed_mask)
    assert found.tolist() == [
        [
            a or b
            for a, b in zip(
                slow_locked(row, "next", {0}), slow_locked(row, goal, {0}), strict=True
            )
        ]
        for row in steps
    ]


def make_rows(influenced: torch.Tensor, episode: torch.Tensor) -> TensorDict:
    """Rows whose states name their places, with scores of 1 where influenced."""
    state = torch.arange(float(3 * len(episode))).view(-1, 3)
    return TensorDict(
        {
            "observation": state,
            ("next", "observation"): state + 3,
            "episode": episode,
            ("caiac", "score"): influenced.float(),
        },
        [len(episode)],
    )


def make_influenced(rows: int = 120, length: int = 20) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(0)
    influenced = torch.rand(rows, 3, generator=generator) < 0.1
    return influenced, torch.arange(rows) // length


@pytest.mark.parametrize("lookahead", ["next", 0, 3])
@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("window", [1, 4])
@pytest.mark.parametrize("buffer", [False, True])
def test_swaps_keep_what_is_locked(lookahead, storage, window, buffer) -> None:
    influenced, episode = make_influenced()
    steps = slow_steps(influenced.tolist(), episode.tolist())
    locked = torch.tensor([slow_locked(row, lookahead, {0}) for row in steps])
    rows = make_rows(influenced, episode)
    options = {"batch_size": 64}
    if window > 1:
        options["sampler"] = SliceSampler(slice_len=window, traj_key="episode")
    rb = TensorDictReplayBuffer(storage=storage(len(rows)), **options)
    rb.extend(rows)
    donors = None
    if buffer:
        donors = ReplayBuffer(storage=LazyTensorStorage(len(rows)))
        donors.extend(rows)
    transform = CAIACTransform(
        LAYOUT,
        counterfactual_ratio=1.0,
        lookahead=lookahead,
        window=window,
        donors=donors,
    )
    rb.append_transform(transform)
    swaps = 0
    for _ in range(15):
        batch = rb.sample()
        place = (batch["observation"] / 3).floor().long()  # the row of each column
        own = place[:, 0]  # the arm stays
        changed = place != own.unsqueeze(-1)
        assert not (changed & ~batch["caiac", "swapped"]).any()
        # Neither the row nor the donor locks the entity, in any row of the window.
        mine, theirs = locked[own], locked.gather(0, place)
        assert not (changed & (mine | theirs)).any()
        assert not (changed & influenced[own]).any()
        swaps += int(changed.sum())
    assert swaps > 0


def test_windows_are_free_until_the_lookahead_after_them() -> None:
    influenced = torch.zeros(20, 3, dtype=torch.bool)
    influenced[10, 1] = True
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(20),
        sampler=SliceSampler(slice_len=4, traj_key="episode"),
        batch_size=400,
    )
    rb.extend(make_rows(influenced, torch.zeros(20, dtype=torch.long)))
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead=2, window=4))
    batch = rb.sample()
    first = (batch["observation"][::4, 0] / 3).long()
    swapped = batch["caiac", "swapped"][::4, 1]
    # The last row of a window that starts at row 5 is row 8, two before the influence.
    assert set(first[swapped].tolist()) == {0, 1, 2, 3, 4, 11, 12, 13, 14, 15, 16}


def test_graphs_lock_whole_components() -> None:
    rows = 40
    graph = torch.zeros(rows, 4, 3)
    graph[30, 3, 1] = 1.0  # the action moves the cup
    graph[:, 1, 2] = 1.0  # on which the lid lies
    data = make_rows(torch.zeros(rows, 3), torch.arange(rows) // 20)
    data["coda", "graph"] = graph
    rb = ReplayBuffer(storage=LazyTensorStorage(rows), batch_size=64)
    rb.extend(data)
    rb.append_transform(CoDATransform(LAYOUT, 0.2, 1.0, lookahead="next"))
    batch = rb.sample()
    own = (batch["observation"][:, 0] / 3).long()
    swapped = batch["caiac", "swapped"]
    assert not swapped[(own >= 20) & (own <= 30)].any()
    assert swapped[own < 20][:, 1:].all() and swapped[own > 30][:, 1:].all()


def test_an_entity_that_is_never_swapped_does_not_come_next() -> None:
    influenced, episode = torch.zeros(10, 3, dtype=torch.bool), torch.zeros(10).long()
    influenced[9, 2] = True
    rb = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=64)
    rb.extend(make_rows(influenced, episode))
    thresholds = {"cup": -1.0, "lid": 0.05}
    rb.append_transform(CAIACTransform(LAYOUT, thresholds, 1.0, lookahead="next"))
    assert not rb.sample()["caiac", "swapped"].any()  # the lid comes next in all rows


def score_by(rb: ReplayBuffer, lookahead: int) -> None:
    class Height:
        layout = LAYOUT

        def __call__(self, td: TensorDict) -> torch.Tensor:
            return (td["observation"] == 30).float()  # the arm's column of row 10

    score_buffer(rb, Height(), lookahead=lookahead, progress=False, check=False)


def test_lookahead_counts_that_of_the_scores() -> None:
    rows = make_rows(torch.zeros(20, 3), torch.zeros(20).long()).exclude("caiac")
    rows["observation"][:, 1] = rows["next", "observation"][:, 1] = 0.0
    rows["observation"][10, 1] = rows["next", "observation"][9, 1] = 30.0
    rb = ReplayBuffer(storage=LazyTensorStorage(20), batch_size=200)
    rb.extend(rows)
    score_by(rb, 2)
    transform = CAIACTransform(LAYOUT, 0.05, 1.0, lookahead=4)
    rb.append_transform(transform)
    batch = rb.sample()
    own = (batch["observation"][:, 0] / 3).long()
    assert set(own[~batch["caiac", "swapped"][:, 1]].tolist()) == {6, 7, 8, 9, 10}
    other = ReplayBuffer(storage=rb.storage, batch_size=4)
    other.append_transform(CAIACTransform(LAYOUT, lookahead=1))
    with pytest.raises(ValueError, match=r"lookahead is 1.*those of 2 later states"):
        other.sample()


def test_new_rows_are_looked_at() -> None:
    influenced, episode = torch.zeros(10, 3, dtype=torch.bool), torch.zeros(10).long()
    rb = ReplayBuffer(storage=LazyTensorStorage(40), batch_size=200)
    rb.extend(make_rows(influenced, episode))
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
    assert rb.sample()["caiac", "swapped"][:, 1:].all()
    influenced[9, 1] = True
    later = make_rows(influenced, episode)
    later["observation"] += 1000.0
    rb.extend(later)  # the same trajectory goes on
    assert not rb.sample()["caiac", "swapped"][:, 1].any()


def test_scores_of_other_states_count_as_influenced() -> None:
    rows = make_rows(torch.zeros(20, 3), torch.arange(20) // 10).exclude("caiac")
    rows["observation"][:, 1] = rows["next", "observation"][:, 1] = 0.0
    rb = ReplayBuffer(storage=LazyTensorStorage(20), batch_size=200)
    rb.extend(rows)
    score_by(rb, 0)
    rb.storage[:]["observation"][9, 2] += 0.5  # not through the buffer
    rb.append_transform(
        CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next", unscored="keep")
    )
    batch = rb.sample()
    own = (batch["observation"][:, 0] / 3).long()
    assert not batch["caiac", "swapped"][own < 10].any()
    assert batch["caiac", "swapped"][own >= 10][:, 1:].all()


def test_prefetched_batches_are_those_of_their_rows() -> None:
    influenced, episode = make_influenced()
    rb = ReplayBuffer(storage=LazyTensorStorage(120), batch_size=32, prefetch=3)
    rb.extend(make_rows(influenced, episode))
    rb.append_transform(CAIACTransform(LAYOUT, lookahead="next"))
    for _ in range(20):
        rb.sample()


@pytest.mark.parametrize("prefetch", [0, 3])
def test_rows_replaced_after_the_draw_are_kept(prefetch: int) -> None:
    # Their successors are gone, so that what they lock is unknown.
    rb = ReplayBuffer(
        storage=LazyTensorStorage(40),
        batch_size=200,
        **({"prefetch": prefetch} if prefetch else {}),
    )
    free = torch.zeros(40, 3, dtype=torch.bool)
    rb.extend(make_rows(free, torch.arange(40) // 10))
    once = threading.Lock()

    def write(td: TensorDict) -> TensorDict:
        """Replaces the first 10 rows, after the first batch was drawn."""
        if once.acquire(blocking=False):
            later = make_rows(free[:10], torch.full((10,), 4))
            later["observation"] += 1000.0
            thread = threading.Thread(target=rb.extend, args=(later,))
            thread.start()
            thread.join(timeout=60)
            assert not thread.is_alive()
        return td

    rb.append_transform(write)
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
    batches = [rb.sample() for _ in range(5)]
    # The arm tells from which row a state is. Old rows were replaced, and are kept.
    arms = [batch["observation"][:, 0] for batch in batches]
    first = batches[int(torch.stack([(arm < 30).any() for arm in arms]).nonzero()[0])]
    old = first["observation"][:, 0] < 30
    assert old.any()
    assert not first["caiac", "swapped"][old].any()
    assert first["caiac", "swapped"][~old][:, 1:].all()
    last = batches[-1]
    assert (last["observation"][:, 0] >= 30).all()
    assert last["caiac", "swapped"][:, 1:].all()


def test_a_full_ring_is_written_while_batches_are_prefetched() -> None:
    influenced, episode = make_influenced()
    rb = ReplayBuffer(storage=LazyTensorStorage(120), batch_size=64, prefetch=3)
    rb.extend(make_rows(influenced, episode))
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
    stop, failed = threading.Event(), []

    def write() -> None:
        number = 1
        while not stop.is_set():
            part = make_rows(influenced[:20], episode[:20] + 6 * number)
            part["observation"] += 360.0 * number
            try:
                rb.extend(part)
            except Exception as error:  # reported below, in the main thread
                failed.append(error)
                return
            number += 1

    thread = threading.Thread(target=write)
    thread.start()
    try:
        swapped = sum(int(rb.sample()["caiac", "swapped"].sum()) for _ in range(300))
    finally:
        stop.set()
        thread.join(timeout=60)
    assert not failed and not thread.is_alive()
    assert swapped > 0


def test_other_batches_are_refused() -> None:
    influenced, episode = make_influenced()
    rows = make_rows(influenced, episode)
    transform = CAIACTransform(LAYOUT, lookahead="next")
    with pytest.raises(RuntimeError, match=r"not sampled from a buffer.*rb.sample\(\)"):
        transform(rows)
    for change in (lambda td: td[:5], lambda td: td.flip(0)):
        rb = ReplayBuffer(storage=LazyTensorStorage(120), batch_size=32)
        rb.extend(rows)
        rb.append_transform(change)
        rb.append_transform(copy.deepcopy(transform))
        with pytest.raises(RuntimeError, match="the rows that the buffer drew"):
            rb.sample()
    rb = ReplayBuffer(storage=LazyTensorStorage(120), batch_size=32)
    rb.extend(rows.exclude("episode"))
    rb.append_transform(transform)
    with pytest.raises(KeyError, match="trajectory ids"):
        rb.sample()


def test_scores_changed_in_place_are_refused() -> None:
    influenced, episode = make_influenced()
    rb = ReplayBuffer(storage=LazyTensorStorage(120), batch_size=32)
    rb.extend(make_rows(influenced, episode))
    rb.append_transform(lambda td: td.set(("caiac", "score"), torch.rand(32, 3)))
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
    assert not rb.sample()["caiac", "swapped"].any()  # rows might have been replaced
    with pytest.raises(RuntimeError, match="not those of the storage"):
        rb.sample()


@pytest.mark.parametrize("lookahead", [1.5, True, "last", [1]])
def test_wrong_types_are_refused(lookahead) -> None:
    with pytest.raises(TypeError, match="lookahead must be"):
        CAIACTransform(LAYOUT, lookahead=lookahead)


def test_negative_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="lookahead is -1"):
        CAIACTransform(LAYOUT, lookahead=-1)


def test_copies_and_pickles_build_their_own_tables() -> None:
    influenced, episode = make_influenced()
    rb = ReplayBuffer(storage=LazyTensorStorage(120), batch_size=32)
    rb.extend(make_rows(influenced, episode))
    rb.append_transform(CAIACTransform(LAYOUT, lookahead="next"))
    rb.sample()
    for other in (copy.deepcopy(rb), pickle.loads(pickle.dumps(rb))):
        torch.manual_seed(0)
        assert other.sample()["caiac", "swapped"].any()
    assert "lookahead='next'" in repr(rb.transform[0])


def test_the_rule_needs_no_number() -> None:
    # Whatever the pace of a recording, the cup that the arm moves to is not swapped.
    for pace in (1, 5, 25):
        influenced = torch.zeros(3 * pace, 3, dtype=torch.bool)
        influenced[-1, 1] = True
        rb = ReplayBuffer(storage=LazyTensorStorage(3 * pace), batch_size=100)
        rb.extend(make_rows(influenced, torch.zeros(3 * pace).long()))
        rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
        swapped = rb.sample()["caiac", "swapped"]
        assert not swapped[:, 1].any() and swapped[:, 2].all()


def locks(influenced: torch.Tensor, episode: torch.Tensor) -> torch.Tensor:
    """What each row locks by the rule, found slowly."""
    steps = slow_steps(influenced.tolist(), episode.tolist())
    return torch.tensor([slow_locked(row, "next", {0}) for row in steps])


def assert_kept(batch: TensorDict, locked: torch.Tensor) -> None:
    """Neither row nor donor locks what a batch of some rows swapped."""
    place = (batch["observation"] / 3).floor().long()
    own = place[:, 0]
    changed = place != own.unsqueeze(-1)
    assert changed.any()
    assert not (changed & (locked[own] | locked.gather(0, place))).any()


@pytest.mark.parametrize(
    "make_sampler",
    [
        SamplerWithoutReplacement,
        lambda: PrioritizedSampler(120, 0.7, 0.5),
        lambda: SliceSampler(slice_len=4, traj_key="episode", strict_length=False),
        lambda: SliceSampler(
            slice_len=4, traj_key="episode", strict_length=False, pad_output=True
        ),
        lambda: SliceSamplerWithoutReplacement(slice_len=4, traj_key="episode"),
    ],
)
def test_samplers_of_all_kinds(make_sampler) -> None:
    influenced, episode = make_influenced()
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(120), sampler=make_sampler(), batch_size=60
    )
    rb.extend(make_rows(influenced, episode))
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
    for _ in range(4):
        assert_kept(rb.sample(), locks(influenced, episode))


def test_a_ring_that_is_written_between_samples() -> None:
    influenced, episode = make_influenced()
    rows = make_rows(influenced, episode)
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(50), batch_size=60)
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
    for end in range(15, 121, 15):
        rb.extend(rows[end - 15 : end])
        first = max(0, end - 50)
        locked = torch.ones(120, 3, dtype=torch.bool)
        locked[first:end] = locks(influenced[first:end], episode[first:end])
        assert_kept(rb.sample(), locked)


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("capacity", [60, 120, 180])
def test_storages_of_several_environments(storage, capacity) -> None:
    influenced, episode = make_influenced()
    rows = make_rows(influenced, episode).reshape(6, 20).transpose(0, 1).contiguous()
    rb = TensorDictReplayBuffer(
        storage=storage(capacity, ndim=2), batch_size=60, dim_extend=0
    )
    rb.extend(rows)
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
    # What a row locks depends on later rows alone, which a full ring keeps.
    assert_kept(rb.sample(), locks(influenced, episode))


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.float16])
@pytest.mark.parametrize("threshold", [0.5, {"cup": 0.5, "lid": 0.5}])
@pytest.mark.parametrize("buffer", [False, True])
def test_scores_of_all_types(dtype, threshold, buffer) -> None:
    influenced, episode = make_influenced()
    rows = make_rows(influenced, episode)
    rows["caiac", "score"] = rows["caiac", "score"].to(dtype)
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(120), batch_size=60)
    rb.extend(rows)
    donors = rb.storage if buffer else None
    rb.append_transform(
        CAIACTransform(LAYOUT, threshold, 1.0, lookahead="next", donors=donors)
    )
    assert_kept(rb.sample(), locks(influenced, episode))


@pytest.mark.parametrize("scores", [torch.zeros(2, 3), torch.zeros(2, 4, 3)])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float64, torch.int64])
def test_locked_entities_are_held_at_any_threshold(scores, dtype) -> None:
    locked = torch.tensor([[False, True, False], [False, False, True]])
    held = hold_entities(scores.to(dtype), locked)
    kind = CAIACTransform if scores.ndim == 2 else CoDATransform
    for threshold in (0.0, 1e30, 1e300):
        assert torch.equal(
            kind(LAYOUT, threshold).swappable(held) != 0, ~locked & ~LAYOUT.fixed_mask
        )


def test_reordered_rows_with_equal_scores_are_refused() -> None:
    rows = make_rows(torch.zeros(20, 3), torch.arange(20) // 10).exclude("caiac")
    rows["observation"][:, 1] = rows["next", "observation"][:, 1] = 0.0
    rb = ReplayBuffer(storage=LazyTensorStorage(20), batch_size=50)
    rb.extend(rows)
    score_by(rb, 0)
    rb.append_transform(lambda td: td.flip(0))
    rb.append_transform(CAIACTransform(LAYOUT, lookahead="next", unscored="keep"))
    with pytest.raises(RuntimeError, match="the rows that the buffer drew"):
        rb.sample()


def test_what_has_no_trajectories_is_refused() -> None:
    influenced, episode = make_influenced()
    rows = make_rows(influenced, episode)
    transform = CAIACTransform(LAYOUT, lookahead="next")
    with pytest.raises(RuntimeError, match="only the scores of a batch are given"):
        transform.generate_parameters(rows["caiac", "score"])
    with pytest.raises(ValueError, match="lookahead='next', which reads trajectories"):
        swap_shares(transform, rows["caiac", "score"], influenced)
    rb = ReplayBuffer(storage=LazyTensorStorage(120), batch_size=32)
    rb.extend(rows.exclude("caiac"))
    rb.append_transform(lambda td: td.set(("caiac", "score"), torch.zeros(32, 3)))
    rb.append_transform(transform)
    with pytest.raises(KeyError, match="of all rows of the storage, which lacks them"):
        rb.sample()
    parts = [ReplayBuffer(storage=LazyTensorStorage(120)) for _ in range(2)]
    for part in parts:
        part.extend(rows)
    ensemble = ReplayBufferEnsemble(*parts, batch_size=8)
    ensemble.append_transform(CAIACTransform(LAYOUT, lookahead="next"))
    with pytest.raises(RuntimeError, match=r"one buffer, but a ReplayBufferEnsemble"):
        ensemble.sample()


def test_refreshed_donors_are_looked_at_again() -> None:
    influenced, episode = torch.zeros(20, 3, dtype=torch.bool), torch.zeros(20).long()
    rb = ReplayBuffer(storage=LazyTensorStorage(20), batch_size=60)
    rb.extend(make_rows(influenced, episode))
    transform = CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next", donors=rb.storage)
    rb.append_transform(transform)
    assert rb.sample()["caiac", "swapped"][:, 1:].all()
    rb.storage[:]["caiac", "score"][19, 1] = 1.0  # not through the buffer
    transform.refresh_donors()
    assert not rb.sample()["caiac", "swapped"][:, 1].any()


@pytest.mark.gpu
@pytest.mark.parametrize("where", ["cpu", "cuda"])
def test_rows_on_a_gpu(where) -> None:
    influenced, episode = make_influenced()
    rb = ReplayBuffer(storage=LazyTensorStorage(120, device=where), batch_size=60)
    rb.extend(make_rows(influenced, episode).to(where))
    if where == "cpu":
        rb.append_transform(lambda td: td.to("cuda"))
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
    batch = rb.sample()
    assert batch["caiac", "swapped"].is_cuda
    assert_kept(batch.cpu(), locks(influenced, episode))


@pytest.mark.gpu
@pytest.mark.parametrize("unscored", ["raise", "keep"])
def test_reordered_rows_on_a_gpu_are_refused_late(unscored) -> None:
    influenced, episode = make_influenced()
    rb = ReplayBuffer(storage=LazyTensorStorage(120, device="cuda"), batch_size=60)
    rb.extend(make_rows(influenced, episode).to("cuda"))
    rb.append_transform(lambda td: td.flip(0))
    rb.append_transform(CAIACTransform(LAYOUT, lookahead="next", unscored=unscored))
    with pytest.raises(ValueError, match="other rows than the buffer drew"):
        for _ in range(20):
            rb.sample()
            torch.cuda.synchronize()


class RowsOnDevice(RandomSampler):
    """Draws rows on the device of the storage."""

    def sample(self, storage, batch_size):
        rows = torch.randint(len(storage), (batch_size,), device=storage.device)
        return rows, {}


@pytest.mark.gpu
def test_the_gpu_is_not_waited_for() -> None:
    influenced, episode = make_influenced()
    rb = ReplayBuffer(
        storage=LazyTensorStorage(120, device="cuda"),
        sampler=RowsOnDevice(),
        batch_size=60,
    )
    rb.extend(make_rows(influenced, episode).to("cuda"))
    rb.append_transform(CAIACTransform(LAYOUT, 0.05, 1.0, lookahead="next"))
    for _ in range(2):
        rb.sample()  # builds what is built once
    with nothing_waits():
        batch = rb.sample()
    assert_kept(batch.cpu(), locks(influenced, episode))


GOALS = EntityLayout(
    {"arm": [0], "cup": [1], "lid": [2]},
    goal={"cup": [0], "lid": [1]},
    achieved={"cup": [1], "lid": [2]},
    fixed=["arm"],
)


def make_moving(influenced: torch.Tensor, episode: torch.Tensor) -> TensorDict:
    """Rows in which an entity moves by 1 where it is influenced, and else stays."""
    moved = torch.cat([torch.zeros(1, 3), influenced.float().cumsum(0)])
    rows = make_rows(influenced, episode)
    base = 1000.0 * episode.unsqueeze(-1)
    return rows.update(
        {"observation": base + moved[:-1], ("next", "observation"): base + moved[1:]}
    )


def sample_windows(lookahead: str, window: int) -> list[TensorDict]:
    options = {}
    rows = make_moving(*make_influenced())
    goals = WindowGoal(GOALS, window, mixture={"uniform": 1.0})
    if window > 1:
        options["sampler"] = SliceSampler(slice_len=window, traj_key="episode")
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(rows)),
        batch_size=64,
        sample_unit=goals,
        **options,
    )
    rb.extend(rows)
    rb.append_transform(goals)
    rb.append_transform(
        CAIACTransform(
            GOALS, counterfactual_ratio=1.0, lookahead=lookahead, window=window
        )
    )
    return [rb.sample() for _ in range(20)]


@pytest.mark.parametrize("window", [1, 4])
def test_swaps_until_the_goal_leave_nothing_to_do(window: int) -> None:
    share = {}
    for lookahead in ("goal", "next"):
        batch = torch.cat(sample_windows(lookahead, window))
        swapped = batch["caiac", "swapped"][:, 1:]
        left = batch["desired_goal"] != batch["next", "observation"][:, 1:]
        assert swapped.any()
        share[lookahead] = (left & swapped).sum() / swapped.sum()
    assert share["goal"] == 0
    assert share["next"] > 0  # what the donors still have to do


def test_steps_to_the_goal_are_those_of_the_goal_row() -> None:
    rows = make_rows(*make_influenced())
    goals = WindowGoal(GOALS, 4, mixture={"uniform": 1.0})
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(rows)),
        batch_size=64,
        sampler=SliceSampler(slice_len=4, traj_key="episode"),
        sample_unit=goals,
    )
    rb.extend(rows)
    rb.append_transform(goals)
    batch = rb.sample()
    # States name their rows: a row is 3 further, and its next state 3 more.
    ahead = batch["desired_goal"][:, :1] - batch["next", "observation"][:, 1:2]
    assert torch.equal(batch["hindsight", "steps"], (ahead / 3).long())


def sample_with_goals(rows: TensorDict, goal_keys: TransformKeys | None) -> TensorDict:
    """Samples with keys of ``WindowGoal``, or without one."""
    options = {}
    if goal_keys is not None:
        goals = options["sample_unit"] = WindowGoal(GOALS, 1, keys=goal_keys)
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(rows)), batch_size=64, **options
    )
    rb.extend(rows)
    if goal_keys is not None:
        rb.append_transform(goals)
    rb.append_transform(CAIACTransform(GOALS, lookahead="goal"))
    return rb.sample()


@pytest.mark.parametrize(
    ("goal_keys", "message"),
    [
        (None, "append WindowGoal before this transform"),
        (TransformKeys(goal_steps="steps"), "same keys= to WindowGoal"),
        (TransformKeys(done=None), "same keys= to WindowGoal"),
    ],
)
def test_goals_are_those_that_the_buffer_draws(goal_keys, message) -> None:
    rows = make_rows(*make_influenced())
    rows["hindsight", "steps"] = torch.zeros(len(rows), 1, dtype=torch.int64)  # stale
    with pytest.raises(RuntimeError, match=message):
        sample_with_goals(rows, goal_keys)
    assert len(sample_with_goals(rows, TransformKeys())) == 64


def test_goals_of_several_steps_are_refused() -> None:
    rows = make_rows(*make_influenced())
    rows["steps_to_next_obs"] = torch.ones(len(rows), 1, dtype=torch.int64)
    with pytest.raises(ValueError, match="'steps_to_next_obs'"):
        sample_with_goals(rows, TransformKeys())


def test_goals_are_not_drawn_for_a_donor_buffer() -> None:
    rb = ReplayBuffer(storage=LazyTensorStorage(5))
    with pytest.raises(ValueError, match="donors is a buffer, whose rows have none"):
        CAIACTransform(LAYOUT, lookahead="goal", donors=rb)


def test_tables_of_long_trajectories_keep_their_order() -> None:
    steps = torch.tensor([[0, 32766, 32767], [5, 7, 32767]], dtype=torch.int16)
    competing = torch.tensor([True, True, True])
    far = torch.full((2, 1), 10**9)
    assert locked_entities(steps, far, competing).tolist() == [
        [True, True, False],
        [True, True, False],
    ]
