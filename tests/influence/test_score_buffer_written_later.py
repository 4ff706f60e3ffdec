"""Buffers that are written to after, or while, they are scored."""

from __future__ import annotations

import threading

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.envs import MultiStepTransform

from tests.influence.scoring import (
    KEY,
    LAYOUT,
    Read,
    definition,
    episodes,
    filled,
    scores,
    square,
    storage_of,
)
from torchrl_caiac import CAIACTransform
from torchrl_caiac.influence import score_buffer


def assert_unscored(rb, expected):
    """Exactly these rows neither swap nor donate, and raise by default."""
    transform = CAIACTransform(LAYOUT, unscored="keep")
    transform(rb.storage[:])
    assert transform.unscored_count == len(expected)
    for row in range(len(rb.storage)):
        raises = row in expected
        try:
            CAIACTransform(LAYOUT)(rb.storage[row : row + 1])
        except ValueError as error:
            assert raises and "score_buffer" in str(error)
        else:
            assert not raises


@pytest.mark.parametrize("kind", ["memory", "memmap"])
@pytest.mark.parametrize("cls", [ReplayBuffer, TensorDictReplayBuffer])
def test_rows_written_later_are_unscored_until_the_next_call(kind, cls, tmp_path):
    rows = episodes([5, 7])
    rb = cls(storage=storage_of(kind, 20, tmp_path), batch_size=4)
    rb.extend(rows)
    score_buffer(rb, Read(), 4, smoothing=3, progress=False)
    later = episodes([3], seed=9, first_id=7)
    before = later.clone()
    rb.extend(later)
    assert (later.exclude("index") == before).all()  # the caller's rows do not change
    rb.add(episodes([1], seed=10, first_id=8)[0])
    rb.extend(rows[:2].clone().set(KEY, torch.ones(2, 3)))
    assert_unscored(rb, set(range(12, 18)))
    estimator = Read()
    score_buffer(rb, estimator, 4, smoothing=3, progress=False)
    assert_unscored(rb, set())
    torch.testing.assert_close(scores(rb), definition(rb.storage[:], square, 3, 1))
    assert sum(estimator.rows) < 18 + 5  # the first rows are not scored again


WRITES = {
    "storage.set": lambda rb, td: rb.storage.set(range(3, 5), td),
    "rb[:]": lambda rb, td: rb.__setitem__(slice(3, 5), td),
    "set_at_": lambda rb, td: rb.storage[:].set_at_(
        "observation", td["observation"], slice(3, 5)
    ),
    "update_": lambda rb, td: rb.storage[:][3:5].update_(td.select("observation")),
    "next": lambda rb, td: rb.storage[:][3:5].update_(
        td.select(("next", "observation"))
    ),
    "raw": lambda rb, td: rb.storage[:]["observation"][3:5].copy_(td["observation"]),
}


@pytest.mark.parametrize("kind", ["memory", "memmap"])
@pytest.mark.parametrize("way", WRITES)
def test_any_way_of_writing_is_noticed(kind, way, tmp_path):
    rb = filled(episodes([5, 7]), kind, tmp_path=tmp_path)
    score_buffer(rb, Read(), progress=False)
    assert_unscored(rb, set())
    WRITES[way](rb, episodes([2], seed=8))
    assert_unscored(rb, {3, 4})
    score_buffer(rb, Read(), check=False, progress=False)
    assert_unscored(rb, set())
    torch.testing.assert_close(scores(rb), definition(rb.storage[:], square, 1, 1))


def test_few_new_rows_cost_few_evaluations():
    rows = episodes([100] * 100)
    rb = filled(rows)
    score_buffer(rb, Read(), 512, smoothing=3, lookahead=10, progress=False)
    rb.extend(episodes([20], seed=5, first_id=500))
    estimator = Read()
    score_buffer(rb, estimator, 512, smoothing=3, lookahead=10, progress=False)
    assert sum(estimator.rows) < 100
    order = [*range(20, 10_000), *range(20)]
    expected = definition(rb.storage[:], square, 3, 10, order)
    torch.testing.assert_close(scores(rb), expected)


@pytest.mark.parametrize("smoothing", [2, 5])
@pytest.mark.parametrize("new", [1, 2, 5])
def test_rows_that_lost_earlier_ones_are_scored_again(smoothing, new):
    """In a ring, whose environments write in turn, so that rows are no neighbors."""
    turns = [
        torch.stack(episodes([9, 9], seed=i, first_id=2 * i).split(9), 1).reshape(-1)
        for i in range(3)
    ]
    rows = torch.cat(turns)
    rb = filled(rows[:30])
    score_buffer(rb, Read(), 8, smoothing=smoothing, progress=False)
    for start in range(30, 54 - new, new):
        rb.extend(rows[start : start + new])
        score_buffer(rb, Read(), 8, smoothing=smoothing, progress=False)
        order = [(start + new + i) % 30 for i in range(30)]
        ids = rb.storage[:]["episode"].tolist()
        order.sort(key=lambda row: ids[row])  # stable: in the order of time
        expected = definition(rb.storage[:], square, smoothing, 1, order)
        torch.testing.assert_close(scores(rb), expected)


@pytest.mark.parametrize("options", [{"smoothing": 3}, {"every": 3}])
@pytest.mark.parametrize("key", ["episode", ("next", "done")])
def test_trajectories_that_are_split_later_are_scored_again(key, options):
    rb, expected = filled(episodes([9, 7])), filled(episodes([9, 7]))
    score_buffer(rb, Read(), progress=False, **options)
    for buffer in (rb, expected):
        leaf = buffer.storage[:].get(key)
        leaf[4:9] = 5 if key == "episode" else leaf[4:9].logical_not()
    score_buffer(rb, Read(), check=False, progress=False, **options)
    score_buffer(expected, Read(), check=False, progress=False, **options)
    torch.testing.assert_close(scores(rb), scores(expected))


def test_neighbors_of_later_rows_are_scored_again():
    rows = episodes([12])
    rows["next", "done"].zero_()
    whole = filled(rows)
    score_buffer(whole, Read(), 3, smoothing=4, lookahead=2, progress=False)
    grown = filled(rows[:7], size=12)
    score_buffer(grown, Read(), 3, smoothing=4, lookahead=2, progress=False)
    grown.extend(rows[7:])
    score_buffer(grown, Read(), 3, smoothing=4, lookahead=2, progress=False)
    torch.testing.assert_close(scores(grown), scores(whole))


def test_an_interrupted_update_is_taken_up():
    rows = episodes([40])
    rows["next", "done"].zero_()
    rb = filled(rows[:30], size=40)
    score_buffer(rb, Read(), 4, smoothing=5, lookahead=6, progress=False)
    rb.extend(rows[30:])

    # The call stops after some of the new rows, before their neighbors.
    class Stops(Read):
        def forward(self, td):
            if len(self.rows) == 2:
                raise KeyboardInterrupt
            return super().forward(td)

    stops = Stops()
    stops.__class__ = type("Read", (Stops,), {"__module__": Read.__module__})
    with pytest.raises(KeyboardInterrupt):
        score_buffer(rb, stops, 4, smoothing=5, lookahead=6, progress=False)
    score_buffer(rb, Read(), 4, smoothing=5, lookahead=6, progress=False)
    torch.testing.assert_close(scores(rb), definition(rows, square, 5, 6))


@pytest.mark.parametrize("lookahead", [0, 1, 3])
def test_rows_written_during_a_call_are_scored_too(lookahead):
    rb = filled(episodes([10] * 20))

    class Overtaken(Read):
        """Others write while it scores."""

        def forward(self, td):
            out = super().forward(td)
            if len(self.rows) in (2, 5, 9):
                seed = 100 + len(self.rows)
                rb.extend(episodes([15], seed=seed, first_id=seed))
            return out

    score_buffer(rb, Overtaken(), 16, lookahead=lookahead, progress=False)
    order = [*range(45, 200), *range(45)]
    expected = definition(rb.storage[:], square, 1, lookahead, order)
    torch.testing.assert_close(scores(rb), expected)
    assert_unscored(rb, set())


def test_a_buffer_that_never_rests(caplog):
    rb = filled(episodes([10] * 4))

    class Restless(Read):
        def forward(self, td):
            seed = 100 + len(self.rows)
            out = super().forward(td)
            rb.extend(episodes([2], seed=seed, first_id=seed))
            return out

    score_buffer(rb, Restless(), progress=False)
    assert "written to during all of" in caplog.text


def test_a_writing_thread():
    rb = filled(episodes([20] * 100))
    stop = threading.Event()

    def write():
        seed = 1000
        while not stop.is_set():
            rb.extend(episodes([20], seed=seed, first_id=seed))
            seed += 1

    writer = threading.Thread(target=write)
    writer.start()
    try:
        score_buffer(rb, Read(), 256, lookahead=0, progress=False)
    finally:
        stop.set()
        writer.join()
    # Whatever counts as scored has the score of its own state.
    data = rb.storage[:]
    keep = CAIACTransform(LAYOUT, unscored="keep", counterfactual_ratio=0.0)
    for row in range(0, len(data), 7):
        before = keep.unscored_count
        keep(data[row : row + 1])
        if keep.unscored_count == before:
            assert torch.equal(data[KEY][row], data["observation"][row].square())
    score_buffer(rb, Read(), 256, lookahead=0, progress=False)
    assert torch.equal(scores(rb), data["observation"].square())


def test_rows_of_n_steps_need_their_lookahead():
    rows = episodes([12, 9])
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(40),
        transform=MultiStepTransform(n_steps=3, gamma=0.9),
        batch_size=4,
    )
    rows["next", "reward"] = torch.zeros(21, 1)
    rows["next", "terminated"] = torch.zeros(21, 1, dtype=torch.bool)
    rb.extend(rows[:14])
    with pytest.raises(ValueError, match=r"up to 3 steps later.*Use lookahead=3"):
        score_buffer(rb, Read(), progress=False)
    score_buffer(rb, Read(), lookahead=3, progress=False)
    rb.append_transform(CAIACTransform(LAYOUT))
    rb.sample()
    # Both orders of transforms take rows, also fewer than the steps.
    for part in rows[14:].split(2):
        rb.extend(part)
    with pytest.raises(ValueError, match="score_buffer"):
        rb.sample(512)
    score_buffer(rb, Read(), lookahead=3, progress=False)
    rb.sample(512)
    # Of the last rows, the states up to their next states are not stored yet.
    stored = rb.storage[:]
    assert stored["observation"].shape[0] == 18
    expected = torch.stack(
        [
            torch.cat([rows[t : min(t + 4, 12)]["observation"], after]).square().amax(0)
            for t, after in ((t, rows[11:12]["next", "observation"]) for t in range(12))
            if t + 4 > 12
        ]
    )
    torch.testing.assert_close(stored[KEY][9:12], expected)
    for t in (*range(9), 12, 13, 14):
        ahead = rows["observation"][t : t + 4].square().amax(0)
        torch.testing.assert_close(stored[KEY][t], ahead)
    assert (stored[KEY][15:] > 1e20).all()


def test_transforms_that_return_nothing_may_come_first():
    rows = episodes([12])
    rows["next", "reward"] = torch.zeros(12, 1)
    rows["next", "terminated"] = torch.zeros(12, 1, dtype=torch.bool)
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(40), batch_size=4)
    rb.append_transform(CAIACTransform(LAYOUT))
    rb.append_transform(MultiStepTransform(n_steps=3, gamma=0.9))
    for part in rows.split(1):
        rb.extend(part)
    score_buffer(rb, Read(), lookahead=3, progress=False)
    assert rb.sample()["caiac", "swapped"].shape == (4, 3)


def test_finished_scores_are_not_written_again(tmp_path):
    rb = filled(episodes([5, 7]), "memmap", tmp_path=tmp_path)
    score_buffer(rb, Read(), progress=False)
    files = [p for p in (tmp_path / "data").rglob("*") if p.name != ".lock"]
    before = {p: p.stat().st_mtime_ns for p in files}
    again = ReplayBuffer(
        storage=TensorStorage(TensorDict.load_memmap(tmp_path / "data"))
    )
    score_buffer(again, Read(), progress=False)
    assert {p: p.stat().st_mtime_ns for p in files} == before
