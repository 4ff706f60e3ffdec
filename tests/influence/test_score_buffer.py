from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    SliceSampler,
    TensorDictReplayBuffer,
    TensorStorage,
)

from torchrl_caiac import EntityLayout
from torchrl_caiac.influence import AttentionInfluence, DistanceInfluence
from torchrl_caiac.influence.cai import CAI
from torchrl_caiac.influence.score_buffer import (
    MarkUnscored,
    score_buffer,
    score_file,
)
from torchrl_caiac.modules import TransformerWorldModel
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel

KEY = ("caiac", "score")
LAYOUT = EntityLayout({"arm": [0], "cup": [1], "pot": [2]})


class Read(nn.Module):
    """Each entity's score is a simple function of its column, row by row."""

    def __init__(self, scale=1.0, layout=LAYOUT):
        super().__init__()
        self.layout = layout
        self.register_buffer("scale", torch.tensor(float(scale)))
        self.rows = []

    def forward(self, td):
        self.rows.append(len(td))
        return (self.layout.read(td).float() * self.scale).square()


class Graph(Read):
    in_keys = ("observation", "action")

    def forward(self, td):
        x = self.layout.read(td)
        return x[:, None, :] * torch.ones(4, 1) + td["action"][:, :1, None]


def episodes(lengths, *, width=3, seed=0, first_id=0):
    g = torch.Generator().manual_seed(seed)
    out = []
    for i, n in enumerate(lengths):
        x = torch.randn(n + 1, width, generator=g)
        done = torch.zeros(n, 1, dtype=torch.bool)
        done[-1] = True
        out.append(
            TensorDict(
                {
                    "observation": x[:-1],
                    "action": torch.randn(n, 2, generator=g),
                    "episode": torch.full((n,), first_id + i),
                    "next": {"observation": x[1:], "done": done},
                },
                [n],
            )
        )
    return torch.cat(out)


def storage_of(kind, size, tmp_path):
    if kind == "memory":
        return LazyTensorStorage(size)
    if kind == "memmap":
        return LazyMemmapStorage(size, scratch_dir=tmp_path / "data")
    return LazyMemmapStorage(size)


def filled(rows, kind="memory", size=None, tmp_path=None, **kwargs):
    rb = ReplayBuffer(
        storage=storage_of(kind, size or len(rows), tmp_path), batch_size=4, **kwargs
    )
    rb.extend(rows)
    return rb


def trajectories_of(rows, order=None):
    """Lists of row numbers, split by id and done, in the order given."""
    order = list(range(len(rows))) if order is None else order
    result = [[]]
    for t in order:
        if result[-1]:
            last = result[-1][-1]
            if (
                rows["episode"][last] != rows["episode"][t]
                or rows["next", "done"][last]
            ):
                result.append([])
        result[-1].append(t)
    return result


def oracle(rows, score, smoothing, lookahead, order=None):
    """The definition in the docstring, one number at a time."""
    out = [None] * len(rows)
    for trajectory in trajectories_of(rows, order):
        states = [rows["observation"][t].tolist() for t in trajectory]
        states.append(rows["next", "observation"][trajectory[-1]].tolist())
        n = len(trajectory)
        raw = [[score(x) for x in state] for state in states]
        smooth = []
        for k in range(n + 1):
            window = [
                m
                for m in range(n + 1)
                if k - smoothing // 2 <= m <= k + (smoothing - 1) // 2
            ]
            smooth.append(
                [sum(raw[m][j] for m in window) / len(window) for j in range(3)]
            )
        for i, t in enumerate(trajectory):
            ahead = range(i, min(i + lookahead, n) + 1)
            out[t] = [max(smooth[k][j] for k in ahead) for j in range(3)]
    return torch.tensor(out)


def square(x):
    return x * x


def scores(rb, key=KEY):
    return rb.storage[:][key].clone()


# --- values ----------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=6),
    smoothing=st.integers(1, 7),
    lookahead=st.integers(0, 4),
    batch_size=st.integers(1, 12),
)
def test_values_agree_with_the_definition(lengths, smoothing, lookahead, batch_size):
    rows = episodes(lengths)
    rb = filled(rows)
    score_buffer(rb, Read(), batch_size, smoothing, lookahead=lookahead, progress=False)
    expected = oracle(rows, square, smoothing, lookahead)
    torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    written=st.lists(st.integers(1, 7), min_size=3, max_size=8),
    smoothing=st.integers(1, 5),
    lookahead=st.integers(0, 3),
    batch_size=st.integers(1, 9),
    split=st.integers(0, 7),
)
def test_a_ring_that_was_overwritten(written, smoothing, lookahead, batch_size, split):
    size = 11
    rb = filled(episodes([size]), size=size)
    settings_ = {"lookahead": lookahead, "progress": False}
    for i, n in enumerate(written):
        rb.extend(episodes([n], seed=i + 1, first_id=i + 1))
        if i == split:  # scored half-way, so that only the rest is scored at the end
            score_buffer(rb, Read(), batch_size, smoothing, **settings_)
    score_buffer(rb, Read(), batch_size, smoothing, **settings_)
    cursor = (size + sum(written)) % size
    order = [(cursor + i) % size for i in range(size)]
    expected = oracle(rb.storage[:], square, smoothing, lookahead, order)
    torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-6)


def test_lookahead_0_is_the_score_of_the_rows_own_state():
    rows = episodes([5, 1, 3])
    rb = filled(rows)
    score_buffer(rb, Read(), lookahead=0, progress=False)
    assert torch.equal(scores(rb), rows["observation"].square())


def test_every_state_is_scored_once_whatever_the_windows_are():
    rows = episodes([50, 30])
    estimator = Read()
    score_buffer(filled(rows), estimator, 8, 5, lookahead=3, progress=False)
    assert sum(estimator.rows) == 80 + 2  # and the two last next states
    assert max(estimator.rows) <= 8


def test_done_alone_and_ids_alone_tell_trajectories_apart():
    rows = episodes([4, 6])
    expected = oracle(rows, square, 3, 1)
    for without, keys in (
        ("episode", {"trajectory_key": None}),
        (("next", "done"), {"done_key": None}),
    ):
        rb = filled(rows.exclude(without))
        score_buffer(rb, Read(), smoothing=3, progress=False, **keys)
        torch.testing.assert_close(scores(rb), expected)


def test_equal_ids_beside_each_other_are_told_apart_by_done():
    rows = episodes([4, 6])
    rows["episode"].zero_()
    rb = filled(rows)
    score_buffer(rb, Read(), smoothing=3, progress=False)
    torch.testing.assert_close(scores(rb), oracle(rows, square, 3, 1))


def test_nested_layout_and_double_precision():
    x = torch.randn(7, 3, dtype=torch.float64)
    layout = EntityLayout.from_keys({"arm": ("world", "arm"), "cup": ("world", "cup")})
    rows = TensorDict(
        {
            "world": {"arm": x[:-1, :1], "cup": x[:-1, 1:2]},
            "episode": torch.zeros(6, dtype=torch.long),
            "next": {
                "world": {"arm": x[1:, :1], "cup": x[1:, 1:2]},
                "done": torch.zeros(6, 1, dtype=torch.bool),
            },
        },
        [6],
    )
    rb = filled(rows)
    score_buffer(rb, Read(layout=layout), progress=False)
    expected = torch.maximum(x[:-1, :2].square(), x[1:, :2].square())
    expected = torch.maximum(x[:-1, :2].float() ** 2, x[1:, :2].float() ** 2)
    torch.testing.assert_close(scores(rb), expected)
    assert scores(rb).dtype == torch.float32


def test_an_estimator_of_graphs_that_reads_the_action():
    rows = episodes([4, 3])
    rb = filled(rows)
    key = ("coda", "graph")
    score_buffer(rb, Graph(), key=key, lookahead=1, progress=False)
    raw = rows["observation"][:, None, :].expand(7, 4, 3)
    raw = raw + rows["action"][:, :1, None]
    expected = raw.clone()
    for t in (0, 1, 2, 4, 5):  # the next state of a last row has no action
        expected[t] = torch.maximum(raw[t], raw[t + 1])
    torch.testing.assert_close(scores(rb, key), expected)
    assert scores(rb, key).shape == (7, 4, 3)


def test_the_learned_estimator():
    model = GaussianWorldModel(LAYOUT, 2, (16, 16))
    rows = episodes([6, 5])
    rb = filled(rows)
    estimator = CAI(model, num_actions=8)
    score_buffer(rb, estimator, batch_size=4, progress=False)
    after = TensorDict({"observation": rows["next", "observation"]}, [11])
    expected = torch.maximum(estimator(rows), estimator(after))
    torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-5)


# --- storages --------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["memory", "memmap", "memmap without a folder"])
@pytest.mark.parametrize("size", [12, 20])
def test_storages_full_and_partly_filled(kind, size, tmp_path):
    rows = episodes([5, 7])
    rb = filled(
        rows,
        kind,
        size,
        tmp_path,
        sampler=SliceSampler(slice_len=4, traj_key="episode", cache_values=True),
    )
    rb.sample()
    score_buffer(rb, Read(), 5, smoothing=3, progress=False)
    assert rb.storage._storage.is_memmap() == (kind != "memory")
    torch.testing.assert_close(scores(rb), oracle(rows, square, 3, 1))
    assert rb.storage._storage[KEY][12:].isnan().all()
    for _ in range(3):
        batch = rb.sample()
        assert batch[KEY].shape == (4, 3)
        assert not batch[KEY].isnan().any()
        where = (batch["observation"][:, None] == rows["observation"]).all(-1)
        assert torch.equal(batch[KEY], scores(rb)[where.float().argmax(-1)])
    assert torch.equal(rb.storage[:]["observation"], rows["observation"])


@pytest.mark.parametrize("kind", ["memory", "memmap"])
def test_dumps_and_loads_keep_the_scores(kind, tmp_path):
    rb = filled(episodes([5, 7]), kind, 20, tmp_path)
    score_buffer(rb, Read(), progress=False)
    rb.dumps(tmp_path / "saved")
    for other in (LazyTensorStorage(20), LazyMemmapStorage(20)):
        loaded = ReplayBuffer(storage=other, batch_size=4)
        loaded.loads(tmp_path / "saved")
        assert torch.equal(scores(loaded), scores(rb))
        assert not loaded.sample()[KEY].isnan().any()
        with pytest.raises(ValueError, match="without a record"):
            score_buffer(loaded, Read(), progress=False)
        score_buffer(loaded, Read(), overwrite=True, progress=False)
        assert torch.equal(scores(loaded), scores(rb))


def test_a_folder_that_was_loaded_stays_a_memmap(tmp_path):
    rows = episodes([5, 7])
    rows.memmap(tmp_path / "data")
    rb = ReplayBuffer(
        storage=TensorStorage(TensorDict.load_memmap(tmp_path / "data")),
        writer=ImmutableDatasetWriter(),
        batch_size=4,
    )
    score_buffer(rb, Read(), progress=False)
    again = TensorDict.load_memmap(tmp_path / "data")
    torch.testing.assert_close(again[KEY], oracle(rows, square, 1, 1))
    assert torch.equal(again["observation"], rows["observation"])
    assert score_file(tmp_path / "data").exists()
    # Known again in another process: nothing is left to do.
    estimator = Read()
    score_buffer(ReplayBuffer(storage=TensorStorage(again)), estimator, progress=False)
    assert estimator.rows == []


def test_samples_that_were_drawn_ahead_are_thrown_away():
    rb = filled(episodes([5, 7]), prefetch=3)
    rb.sample()
    score_buffer(rb, Read(), progress=False)
    for _ in range(4):
        assert not rb.sample()[KEY].isnan().any()


# --- rows written later ----------------------------------------------------------


@pytest.mark.parametrize("kind", ["memory", "memmap"])
@pytest.mark.parametrize("cls", [ReplayBuffer, TensorDictReplayBuffer])
def test_rows_written_later_are_unscored_until_they_are_scored(kind, cls, tmp_path):
    rows = episodes([5, 7])
    rb = cls(storage=storage_of(kind, 20, tmp_path), batch_size=4)
    rb.extend(rows)
    score_buffer(rb, Read(), 4, smoothing=3, progress=False)
    later = episodes([3], seed=9, first_id=7)
    before = later.clone()
    rb.extend(later)
    assert (later.exclude("index") == before).all()  # the caller's rows stay theirs
    assert KEY not in later.keys(include_nested=True)
    rb.add(episodes([1], seed=10, first_id=8)[0])
    stale = rows[:2].clone().set(KEY, torch.ones(2, 3))
    rb.extend(stale)
    assert scores(rb)[12:].isnan().all()
    assert not scores(rb)[:12].isnan().any()
    estimator = Read()
    score_buffer(rb, estimator, 4, smoothing=3, progress=False)
    torch.testing.assert_close(scores(rb), oracle(rb.storage[:], square, 3, 1))
    assert sum(estimator.rows) < 18 + 5  # the first chunk is not scored again
    assert sum(isinstance(t, MarkUnscored) for t in rb.transform) == 1


def test_neighbours_of_later_rows_are_scored_again():
    rows = episodes([12])
    rows["next", "done"].zero_()
    whole = filled(rows)
    score_buffer(whole, Read(), 3, smoothing=4, lookahead=2, progress=False)
    grown = filled(rows[:7], size=12)
    score_buffer(grown, Read(), 3, smoothing=4, lookahead=2, progress=False)
    grown.extend(rows[7:])
    score_buffer(grown, Read(), 3, smoothing=4, lookahead=2, progress=False)
    torch.testing.assert_close(scores(grown), scores(whole))


def test_assigned_rows_are_unscored():
    rows = episodes([5, 7])
    rb = filled(rows)
    score_buffer(rb, Read(), progress=False)
    rb[3:5] = rows[3:5]
    assert scores(rb).isnan().any(-1).nonzero()[:, 0].tolist() == [3, 4]


# --- going on --------------------------------------------------------------------


class Failing(Read):
    """Fails on its ``calls``-th call; its repr and state are those of Read."""

    def __init__(self, calls):
        super().__init__()
        self.calls = calls

    def forward(self, td):
        if len(self.rows) == self.calls:
            raise KeyboardInterrupt
        return super().forward(td)


@pytest.mark.parametrize("kind", ["memory", "memmap"])
def test_going_on_after_an_interruption(kind, tmp_path):
    rows = episodes([11, 9, 20, 40, 30])
    whole = filled(rows)
    score_buffer(whole, Failing(-1), 6, 3, progress=False)
    rb = filled(rows, kind, tmp_path=tmp_path)
    with pytest.raises(KeyboardInterrupt):
        score_buffer(rb, Failing(15), 6, 3, progress=False)
    missing = scores(rb).isnan().any(-1)
    assert missing.any()
    assert not missing.all()
    estimator = Failing(-1)
    score_buffer(rb, estimator, 6, 3, progress=False)
    assert sum(estimator.rows) < 80
    assert torch.equal(scores(rb), scores(whole))
    estimator = Failing(-1)
    score_buffer(rb, estimator, 6, 3, progress=False)
    assert estimator.rows == []


CHILD = """
    import os, sys, time
    import torch
    from pathlib import Path
    from tensordict import TensorDict
    from torchrl.data import ReplayBuffer, TensorStorage
    from torchrl_caiac import EntityLayout
    from torchrl_caiac.influence.cai import CAI
    from torchrl_caiac.influence.score_buffer import score_buffer
    from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel

    root, calls = Path(sys.argv[1]), int(sys.argv[2])

    class Slow(CAI):
        count = 0

        def forward(self, td):
            if Slow.count == calls:
                (root / "waiting").touch()
                time.sleep(600)
            Slow.count += 1
            return super().forward(td)

    torch.manual_seed(0)
    layout = EntityLayout({"arm": [0], "cup": [1], "pot": [2]})
    estimator = Slow(GaussianWorldModel(layout, 2, (32, 32)), num_actions=8)
    for name in sys.argv[3:]:
        Slow.count = 0
        data = TensorDict.load_memmap(root / name)
        rb = ReplayBuffer(storage=TensorStorage(data))
        score_buffer(rb, estimator, 16, smoothing=3, progress=False)
        print(Slow.count)
"""


def run_child(root, calls, *names, kill):
    script = root / "child.py"
    script.write_text(textwrap.dedent(CHILD))
    child = subprocess.Popen(
        [sys.executable, str(script), str(root), str(calls), *names],
        env={**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        if kill:
            waiting = root / "waiting"
            end = time.monotonic() + 120
            while not waiting.exists() and child.poll() is None:
                assert time.monotonic() < end, "the child does not come to its wait"
                time.sleep(0.05)
            assert child.poll() is None, "the child ended by itself"
            child.send_signal(signal.SIGKILL)
            child.wait(60)
            waiting.unlink()
            return []
        out, _ = child.communicate(timeout=120)
        assert child.returncode == 0
        return [int(line) for line in out.splitlines() if line.isdigit()]
    finally:
        child.kill()
        child.wait(60)


def test_killed_and_called_again_it_ends_with_the_same_bytes(tmp_path):
    rows = episodes([30, 25, 140, 5])
    for name in ("killed", "whole"):
        rows.memmap(tmp_path / name)
    run_child(tmp_path, 9, "killed", kill=True)
    missing = TensorDict.load_memmap(tmp_path / "killed")[KEY].isnan().any(-1)
    assert missing.any()
    assert not missing.all()
    rest, whole = run_child(tmp_path, -1, "killed", "whole", kill=False)
    assert rest < whole
    for name in ("caiac/score.memmap", "caiac.score.json"):
        killed, whole = (tmp_path / n / name for n in ("killed", "whole"))
        assert killed.read_bytes() == whole.read_bytes(), name


def test_killed_before_the_leaf_was_marked_unscored(tmp_path):
    # What is on disk then: the leaf full of zeros, and a record that says "new".
    rows = episodes([5, 7])
    rb = filled(rows, "memmap", tmp_path=tmp_path)
    score_buffer(rb, Read(), progress=False)
    record = json.loads(score_file(tmp_path / "data").read_text())
    score_file(tmp_path / "data").write_text(json.dumps({**record, "state": "new"}))
    rb.storage._storage[KEY].zero_()
    score_buffer(rb, Read(), progress=False)
    torch.testing.assert_close(scores(rb), oracle(rows, square, 1, 1))


# --- other settings --------------------------------------------------------------


@pytest.mark.parametrize("kind", ["memory", "memmap", "memmap without a folder"])
@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"estimator": Read(2.0)}, "estimator was"),
        ({"smoothing": 3}, "smoothing was 1, is 3"),
        ({"lookahead": 0}, "lookahead was 1, is 0"),
        ({"done_key": None}, "done_key was"),
    ],
)
def test_scores_made_otherwise_are_never_mixed(kind, change, named, tmp_path):
    rows = episodes([5, 7])
    rb = filled(rows, kind, tmp_path=tmp_path)
    score_buffer(rb, Read(), progress=False)
    before = scores(rb)
    kwargs = {"estimator": Read(), "progress": False, **change}
    with pytest.raises(ValueError, match=named):
        score_buffer(rb, **kwargs)
    assert torch.equal(scores(rb), before)
    score_buffer(rb, overwrite=True, **kwargs)
    score_buffer(rb, **kwargs)
    expected = filled(rows)
    score_buffer(expected, **kwargs)
    assert torch.equal(scores(rb), scores(expected))


def test_two_leaves_with_different_settings_live_side_by_side(tmp_path):
    rb = filled(episodes([5, 7]), "memmap", tmp_path=tmp_path)
    score_buffer(rb, Read(), progress=False)
    score_buffer(rb, Read(2.0), key="other", progress=False)
    torch.testing.assert_close(scores(rb, "other"), 4 * scores(rb))
    rb.extend(episodes([12], first_id=50))
    assert scores(rb).isnan().all()
    assert scores(rb, "other").isnan().all()


def test_batch_size_may_change():
    rows = episodes([11, 9])
    rb = filled(rows)
    with pytest.raises(KeyboardInterrupt):
        score_buffer(rb, Failing(2), 6, progress=False)
    score_buffer(rb, Failing(-1), 4, progress=False)
    torch.testing.assert_close(scores(rb), oracle(rows, square, 1, 1))


# --- bad input -------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["memory", "memmap"])
@pytest.mark.parametrize(
    "leaf",
    [
        torch.zeros(12, 4),
        torch.zeros(12, 3, dtype=torch.float64),
        torch.zeros(12, 3, dtype=torch.int64),
        torch.zeros(12),
    ],
)
def test_a_foreign_leaf(kind, leaf, tmp_path):
    rows = episodes([5, 7]).set(KEY, leaf)
    rb = filled(rows, kind, tmp_path=tmp_path)
    with pytest.raises(ValueError, match="overwrite=True"):
        score_buffer(rb, Read(), progress=False)
    assert torch.equal(scores(rb), leaf)
    score_buffer(rb, Read(), overwrite=True, progress=False)
    torch.testing.assert_close(scores(rb), oracle(rows, square, 1, 1))
    assert rb.storage._storage.is_memmap() == (kind == "memmap")
    if kind == "memmap":
        again = TensorDict.load_memmap(tmp_path / "data")
        assert torch.equal(again[KEY], scores(rb))
    rb.extend(rows)
    assert scores(rb).isnan().all()


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('{"format": "torchrl_cai', "truncated or damaged"),
        ("", "truncated or damaged"),
        ('{"something": 1}', "no score file"),
        ("[1]", "no score file"),
        ('{"format": "torchrl_caiac.scores", "version": 99}', "version 99"),
        ('{"format": "torchrl_caiac.scores", "version": 1}', "incomplete"),
    ],
)
def test_a_bad_score_file(text, match, tmp_path):
    rows = episodes([5, 7])
    rb = filled(rows, "memmap", tmp_path=tmp_path)
    score_buffer(rb, Read(), progress=False)
    before = scores(rb)
    score_file(tmp_path / "data").write_text(text)
    with pytest.raises(ValueError, match=match) as error:
        score_buffer(rb, Read(), progress=False)
    assert "overwrite=True" in str(error.value)
    assert torch.equal(scores(rb), before)
    score_buffer(rb, Read(), overwrite=True, progress=False)
    assert torch.equal(scores(rb), before)


def test_nothing_is_written_when_the_estimator_does_not_fit(tmp_path):
    rb = filled(episodes([5, 7]), "memmap", tmp_path=tmp_path)
    files = sorted(p.name for p in (tmp_path / "data").rglob("*"))

    class Wide(Read):
        def forward(self, td):
            return torch.zeros(len(td), 5)

    class Short(Read):
        def forward(self, td):
            return torch.zeros(len(td) - 1, 3)

    class Whole(Read):
        def forward(self, td):
            return torch.zeros(len(td), 3, dtype=torch.long)

    for bad, match in (
        (Wide(), r"shape \[12, 5\] for 12 states, wanted \[12, 3\]"),
        (Short(), r"shape \[11, 3\]"),
        (Whole(), "floating-point"),
    ):
        with pytest.raises(ValueError, match=match):
            score_buffer(rb, bad, progress=False)
    assert sorted(p.name for p in (tmp_path / "data").rglob("*")) == files
    assert KEY not in rb.storage[:].keys(include_nested=True)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_scores_that_are_not_finite(value):
    class Bad(Read):
        def forward(self, td):
            out = super().forward(td)
            out[td["observation"][:, 1] == 77.0, 1] = value
            return out

    rows = episodes([5, 7])
    rows["observation"][9, 1] = 77.0
    rb = filled(rows)
    with pytest.raises(ValueError, match=r"\['cup'\] in the state of the rows \[9\]"):
        score_buffer(rb, Bad(), 4, progress=False)
    assert not scores(rb)[:4].isnan().any()  # a finished chunk
    assert scores(rb)[4:].isnan().all()


def test_observations_that_are_not_finite():
    rows = episodes([5, 7])
    rows["observation"][3, 0] = torch.nan
    with pytest.raises(ValueError, match=r"'observation'.*the state of the rows \[3\]"):
        score_buffer(filled(rows), Read(), progress=False)
    rows = episodes([5, 7])
    rows["next", "observation"][11, 0] = torch.inf
    with pytest.raises(ValueError, match=r"the next state of the rows \[11\]"):
        score_buffer(filled(rows), Read(), progress=False)


def test_bad_buffers():
    with pytest.raises(TypeError, match="scores a ReplayBuffer, got TensorDict"):
        score_buffer(episodes([3]), Read())
    with pytest.raises(ValueError, match="storage is empty"):
        score_buffer(ReplayBuffer(storage=LazyTensorStorage(3)), Read())
    with pytest.raises(TypeError, match="ListStorage"):
        score_buffer(ReplayBuffer(storage=ListStorage(3)), Read())
    rb = ReplayBuffer(storage=LazyTensorStorage(3))
    rb.extend(torch.zeros(3, 2))
    with pytest.raises(TypeError, match="holds a Tensor"):
        score_buffer(rb, Read())
    rb = ReplayBuffer(storage=LazyTensorStorage(6, ndim=2))
    rb.extend(episodes([6]).reshape(2, 3))
    with pytest.raises(ValueError, match="ndim=2"):
        score_buffer(rb, Read())


def test_bad_arguments():
    rb = filled(episodes([5]))
    for bad in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="smoothing must be an int"):
            score_buffer(rb, Read(), smoothing=bad)
        with pytest.raises(ValueError, match="batch_size must be an int"):
            score_buffer(rb, Read(), batch_size=bad)
    with pytest.raises(ValueError, match="lookahead must be an int"):
        score_buffer(rb, Read(), lookahead=-1)
    with pytest.raises(TypeError, match="has no `layout`"):
        score_buffer(rb, lambda td: td["observation"])
    with pytest.raises(KeyError, match="trajectory_key=None"):
        score_buffer(rb, Read(), trajectory_key="traj")
    with pytest.raises(KeyError, match="done_key=None"):
        score_buffer(rb, Read(), done_key="over")
    with pytest.raises(ValueError, match="both None"):
        score_buffer(rb, Read(), trajectory_key=None, done_key=None)
    with pytest.raises(ValueError, match="is a tensor in the storage"):
        score_buffer(rb, Read(), key=("observation", "score"))
    with pytest.raises(ValueError, match="give another key"):
        score_buffer(rb, Read(), key="next")
    wide = EntityLayout({"arm": [0], "cup": [9]})
    with pytest.raises(ValueError, match="needs at least 10"):
        score_buffer(rb, Read(layout=wide))
    with pytest.raises(KeyError, match=r"the layout reads .*next"):
        score_buffer(filled(episodes([5]).exclude(("next", "observation"))), Read())


def test_memory_does_not_grow_with_the_rows():
    most = []

    class Watch(Read):
        def forward(self, td):
            most.append(len(td))
            return super().forward(td)

    rows = episodes([400])  # one trajectory, longer than any chunk
    score_buffer(filled(rows), Watch(), 16, 5, lookahead=2, progress=False)
    assert max(most) == 16


def test_the_bar_counts_the_rows(capsys):
    score_buffer(filled(episodes([5, 7])), Read(), 4)
    assert "12/12" in capsys.readouterr().err


def test_the_folder_is_named_after_the_key():
    assert score_file("x", ("coda", "graph")) == Path("x/coda.graph.json")


# --- estimators that look at the data first ------------------------------------------


class Prepared(Read):
    """Keeps what it is told before it scores."""

    def __init__(self):
        super().__init__()
        self.told = []

    def prepare(self, states, num_states, *, smoothing):
        assert not self.rows
        self.told.append((states["observation"].clone(), num_states, smoothing))


def test_an_estimator_is_shown_states_of_the_whole_buffer(monkeypatch):
    module = sys.modules["torchrl_caiac.influence.score_buffer"]
    monkeypatch.setattr(module, "_SAMPLE", 5)
    rows = episodes([40, 41])
    rb = filled(rows, size=100)
    estimator = Prepared()
    score_buffer(rb, estimator, 8, smoothing=3, progress=False)
    ((shown, num_states, smoothing),) = estimator.told
    assert torch.equal(shown, rows["observation"][::20])
    assert (num_states, smoothing) == (81, 3)
    # There is nothing left to score.
    score_buffer(rb, estimator, 8, smoothing=3, progress=False)
    assert len(estimator.told) == 1


def test_modes_of_cai_are_never_mixed():
    layout = EntityLayout({"arm": [0], "cup": [1, 2]})
    model = GaussianWorldModel(layout, 2, (8,))
    rb = filled(episodes([20, 20]))
    fast = {"mode": "fast", "threshold": 1e-4}
    score_buffer(rb, CAI(model, **fast), progress=False)
    score_buffer(rb, CAI(model, compile=False, **fast), progress=False)
    for other in (CAI(model), CAI(model, mode="fast", threshold=1e-3)):
        with pytest.raises(ValueError, match="made with other settings: estimator"):
            score_buffer(rb, other, progress=False)


def test_fast_scores_that_were_taken_up_again_are_the_same():
    layout = EntityLayout({"arm": [0], "cup": [1, 2]})
    torch.manual_seed(0)
    model = GaussianWorldModel(layout, 2, (8,))
    rows = episodes([60, 60, 60])

    def estimator():
        return CAI(model, mode="fast", threshold=1e-4)

    once, twice = filled(rows), filled(rows)
    score_buffer(once, estimator(), 32, 3, progress=False)
    killed = estimator()
    score, calls = killed._score, []

    def dies(states, near):
        calls.append(len(states))
        if len(calls) > 6:  # two to look around, four blocks and their last states
            raise KeyboardInterrupt
        return score(states, near)

    killed._score = dies
    with pytest.raises(KeyboardInterrupt):
        score_buffer(twice, killed, 32, 3, progress=False)
    assert 0 < scores(twice).isnan().float().mean() < 1
    score_buffer(twice, estimator(), 32, 3, progress=False)
    assert torch.equal(scores(twice), scores(once))


def test_rows_that_are_not_finite_are_named_by_their_place():
    layout = EntityLayout({"arm": [0], "cup": [1, 2]})
    rows = episodes([20, 20])
    rows["observation"][33, 1] = torch.nan
    fast = CAI(GaussianWorldModel(layout, 2, (8,)), mode="fast", threshold=1e-4)
    with pytest.raises(ValueError, match=r"state of the rows \[33\]"):
        score_buffer(filled(rows), fast, progress=False)


# --- on a GPU ------------------------------------------------------------------------


def model_cai(**kwargs):
    return CAI(GaussianWorldModel(LAYOUT, 2, (16, 16)), 32, **kwargs)


def attention(**kwargs):
    return AttentionInfluence(TransformerWorldModel(LAYOUT, 2, 2, 2, 8), **kwargs)


@pytest.mark.gpu
@pytest.mark.parametrize("where", ["cpu", "cuda"])
@pytest.mark.parametrize(
    "make",
    [
        lambda: model_cai(compile=False),
        lambda: model_cai(compile=False, mode="fast", threshold=0.05),
        lambda: attention(),
        lambda: attention(action_only=True),
        lambda: DistanceInfluence(LAYOUT, {"arm": [0], "cup": [1], "pot": [2]}, "arm"),
    ],
    ids=["exact", "fast", "graph", "action", "distance"],
)
def test_scores_of_a_gpu_are_those_of_the_cpu(make, where):
    rows = episodes([9, 14, 8])
    torch.manual_seed(0)
    estimator = make().eval()
    found = []
    for device, storage in (("cpu", "cpu"), ("cuda", where)):
        rb = ReplayBuffer(storage=LazyTensorStorage(len(rows), device=storage))
        rb.extend(rows.to(storage))
        score_buffer(rb, estimator.to(device), smoothing=3, lookahead=2, progress=False)
        scores = rb.storage[:][KEY]
        assert scores.device.type == storage
        found.append(scores.cpu())
    torch.testing.assert_close(found[1], found[0], atol=1e-5, rtol=1e-4)
