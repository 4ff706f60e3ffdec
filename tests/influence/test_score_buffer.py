"""Scores of whole buffers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    SliceSampler,
)

from tests.influence.scoring import (
    KEY,
    LAYOUT,
    Failing,
    Graph,
    Read,
    definition,
    episodes,
    filled,
    ready,
    scores,
    square,
)
from torchrl_caiac import EntityLayout
from torchrl_caiac._torchrl import storage_data
from torchrl_caiac.check import DatasetError
from torchrl_caiac.influence import (
    CAI,
    score_buffer,
)
from torchrl_caiac.modules import GaussianWorldModel


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=6),
    smoothing=st.integers(1, 7),
    lookahead=st.integers(0, 4),
    batch_size=st.integers(1, 12),
)
def test_values_match_the_definition(lengths, smoothing, lookahead, batch_size):
    rows = episodes(lengths)
    rb = filled(rows)
    score_buffer(rb, Read(), batch_size, smoothing, lookahead=lookahead, progress=False)
    expected = definition(rows, square, smoothing, lookahead)
    torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    written=st.lists(st.integers(1, 7), min_size=3, max_size=8),
    smoothing=st.integers(1, 5),
    lookahead=st.integers(0, 3),
    batch_size=st.integers(1, 9),
    split=st.integers(0, 7),
)
def test_values_of_an_overwritten_ring(
    written, smoothing, lookahead, batch_size, split
):
    size = 11
    rb = filled(episodes([size]), size=size)
    settings_ = {"lookahead": lookahead, "progress": False}
    for i, n in enumerate(written):
        rb.extend(episodes([n], seed=i + 1, first_id=i + 1))
        if i == split:  # so that only the rest is scored at the end
            score_buffer(rb, Read(), batch_size, smoothing, **settings_)
    score_buffer(rb, Read(), batch_size, smoothing, **settings_)
    cursor = (size + sum(written)) % size
    order = [(cursor + i) % size for i in range(size)]
    expected = definition(rb.storage[:], square, smoothing, lookahead, order)
    torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-6)


def test_lookahead_0_gives_the_score_of_the_own_state():
    rows = episodes([5, 1, 3])
    rb = filled(rows)
    score_buffer(rb, Read(), lookahead=0, progress=False)
    assert torch.equal(scores(rb), rows["observation"].square())


def test_scores_each_state_once_for_any_window():
    rows = episodes([50, 30])
    estimator = Read()
    score_buffer(filled(rows), estimator, 8, 5, lookahead=3, progress=False)
    assert sum(estimator.rows) == 80 + 2  # and two next states
    assert max(estimator.rows) <= 8


def test_end_flags_alone_and_ids_alone_separate_trajectories():
    rows = episodes([4, 6])
    expected = definition(rows, square, 3, 1)
    for without, keys in (
        ("episode", {"trajectory_key": None}),
        (("next", "done"), {"done_key": None}),
    ):
        rb = filled(rows.exclude(without))
        score_buffer(rb, Read(), smoothing=3, progress=False, **keys)
        torch.testing.assert_close(scores(rb), expected)


def test_ids_without_end_flags_and_ids_of_collectors():
    rows = episodes([4, 6])
    expected = definition(rows, square, 3, 1)
    for data in (
        rows.exclude(("next", "done")),
        rows.clone().rename_key_("episode", ("collector", "traj_ids")),
    ):
        rb = filled(data)
        score_buffer(rb, Read(), smoothing=3, progress=False)
        torch.testing.assert_close(scores(rb), expected)


def test_end_flags_separate_trajectories_with_equal_ids():
    rows = episodes([4, 6])
    rows["episode"].zero_()
    rb = filled(rows)
    score_buffer(rb, Read(), smoothing=3, progress=False)
    torch.testing.assert_close(scores(rb), definition(rows, square, 3, 1))


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


def test_graph_estimator_that_reads_the_action():
    rows = episodes([4, 3])
    rb = filled(rows)
    key = ("coda", "graph")
    score_buffer(rb, Graph(), key=key, lookahead=1, progress=False)
    raw = rows["observation"][:, None, :].expand(7, 4, 3)
    raw = raw + rows["action"][:, :1, None]
    expected = raw.clone()
    for t in (0, 1, 2, 4, 5):  # the state after a last row has no action
        expected[t] = torch.maximum(raw[t], raw[t + 1])
    torch.testing.assert_close(scores(rb, key), expected)
    assert scores(rb, key).shape == (7, 4, 3)


def test_learned_estimator():
    model = ready(GaussianWorldModel(LAYOUT, 2, (16, 16)))
    rows = episodes([6, 5])
    rb = filled(rows)
    estimator = CAI(model, num_actions=8)
    score_buffer(rb, estimator, batch_size=4, progress=False)
    after = TensorDict({"observation": rows["next", "observation"]}, [11])
    expected = torch.maximum(estimator(rows), estimator(after))
    torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-5)


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=6),
    smoothing=st.integers(1, 4),
    lookahead=st.integers(0, 4),
    every=st.integers(2, 6),
    batch_size=st.integers(1, 12),
)
def test_every_fills_the_states_between(
    lengths, smoothing, lookahead, every, batch_size
):
    rows = episodes(lengths)
    rb = filled(rows)
    estimator = Read()
    options = {"lookahead": lookahead, "every": every, "progress": False}
    score_buffer(rb, estimator, batch_size, smoothing, **options)
    # The same by hand: replace the observations by those of the scored states.
    observation, after = rows["observation"].square(), rows["next", "observation"]
    filled_in, count, start = observation.clone(), 0, 0
    after = after.square()
    for n in lengths:
        states = torch.cat([observation[start : start + n], after[start + n - 1 :][:1]])
        known = list(range(0, n + 1, every))
        count += len(known)
        for k in range(n + 1):
            around = {k // every * every, -(-k // every) * every} & set(known)
            value = states[list(around)].amax(0)
            (filled_in if k < n else after)[start + min(k, n - 1)] = value
        start += n
    rows["observation"], rows["next", "observation"] = filled_in, after
    expected = definition(rows, float, smoothing, lookahead)
    torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-6)
    assert sum(estimator.rows) == count


def test_every_is_a_setting_and_resumes(tmp_path):
    rows = episodes([11, 9, 20])
    whole, rb = filled(rows), filled(rows, "memmap", tmp_path=tmp_path)
    options = {"smoothing": 3, "every": 4, "progress": False}
    score_buffer(whole, Read(), 8, **options)
    with pytest.raises(KeyboardInterrupt):
        score_buffer(rb, Failing(4), 8, **options)
    score_buffer(rb, Failing(-1), 8, **options)
    assert torch.equal(scores(rb), scores(whole))
    with pytest.raises(ValueError, match="every was 4, is 1"):
        score_buffer(rb, Failing(-1), 8, smoothing=3, progress=False)
    with pytest.raises(ValueError, match="every was 4, is 2"):
        score_buffer(rb, Failing(-1), 8, **{**options, "every": 2})


def test_every_does_without_next_states_that_data_lack():
    rows = episodes([5, 8]).exclude(("next", "observation"))
    rb = filled(rows)
    score_buffer(rb, Read(), lookahead=0, every=3, progress=False)
    states = rows["observation"].square()
    expected = [
        states[start + k] if k == n - 1 and n % 3 == 0 else states[around].amax(0)
        for start, n in ((0, 5), (5, 8))
        for k in range(n)
        for low in [k - k % 3]
        for high in [low if k % 3 == 0 else low + 3]
        for around in [[start + i for i in {low, high} if i < n]]
    ]
    torch.testing.assert_close(scores(rb), torch.stack(expected))


def test_every_needs_whole_trajectories():
    rb = filled(episodes([11]))
    rb.extend(episodes([3], first_id=1))
    with pytest.raises(ValueError, match=r"every is 2.*overwritten.*every=1"):
        score_buffer(rb, Read(), every=2, progress=False)


@pytest.mark.parametrize("kind", ["memory", "memmap", "memmap without a folder"])
@pytest.mark.parametrize("size", [12, 20])
def test_full_and_partly_filled_storages(kind, size, tmp_path):
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
    assert rb.storage[:].is_memmap() == (kind != "memory")
    torch.testing.assert_close(scores(rb), definition(rows, square, 3, 1))
    assert storage_data(rb.storage)[KEY][12:].isnan().all()
    for _ in range(3):
        batch = rb.sample()
        assert batch[KEY].shape == (4, 3)
        assert not batch[KEY].isnan().any()
        where = (batch["observation"][:, None] == rows["observation"]).all(-1)
        assert torch.equal(batch[KEY], scores(rb)[where.float().argmax(-1)])
    assert torch.equal(rb.storage[:]["observation"], rows["observation"])


def test_prefetched_batches_are_dropped():
    rb = filled(episodes([5, 7]), prefetch=3)
    rb.sample()
    score_buffer(rb, Read(), progress=False)
    for _ in range(4):
        assert not rb.sample()[KEY].isnan().any()


@pytest.mark.parametrize("kind", ["memory", "memmap"])
def test_an_interrupted_call_resumes(kind, tmp_path):
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
    model = GaussianWorldModel(layout, 2, (32, 32))
    model.fit_statistics(torch.tensor([[-1.0], [1.0]]).expand(2, 3))
    model.set_action_bounds(-1.0, 1.0)
    estimator = Slow(model, num_actions=8)
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
                assert time.monotonic() < end, "the child did not reach its wait"
                time.sleep(0.05)
            assert child.poll() is None, "the child ended before it was killed"
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


def test_a_killed_process_resumes_to_the_same_bytes(tmp_path):
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


def test_batch_size_may_change_on_resuming():
    rows = episodes([11, 9])
    rb = filled(rows)
    with pytest.raises(KeyboardInterrupt):
        score_buffer(rb, Failing(2), 6, progress=False)
    score_buffer(rb, Failing(-1), 4, progress=False)
    torch.testing.assert_close(scores(rb), definition(rows, square, 1, 1))


def test_rejects_bad_buffers():
    with pytest.raises(TypeError, match="scores a ReplayBuffer, got TensorDict"):
        score_buffer(episodes([3]), Read())
    with pytest.raises(ValueError, match="storage is empty"):
        score_buffer(ReplayBuffer(storage=LazyTensorStorage(3)), Read())
    with pytest.raises(TypeError, match="ListStorage"):
        score_buffer(ReplayBuffer(storage=ListStorage(3)), Read())
    rb = ReplayBuffer(storage=LazyTensorStorage(3))
    rb.extend(torch.zeros(3, 2))
    with pytest.raises(TypeError, match="contains a Tensor"):
        score_buffer(rb, Read())


def test_rejects_bad_arguments():
    rb = filled(episodes([5]))
    for bad in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="smoothing must be an int"):
            score_buffer(rb, Read(), smoothing=bad)
        with pytest.raises(ValueError, match="batch_size must be an int"):
            score_buffer(rb, Read(), batch_size=bad)
    with pytest.raises(ValueError, match="lookahead must be an int"):
        score_buffer(rb, Read(), lookahead=-1)
    with pytest.raises(ValueError, match="every must be an int"):
        score_buffer(rb, Read(), every=0)
    with pytest.raises(TypeError, match="has no `layout`"):
        score_buffer(rb, lambda td: td["observation"])
    with pytest.raises(KeyError, match="trajectory_key=None"):
        score_buffer(rb, Read(), trajectory_key="traj")
    with pytest.raises(KeyError, match=r"lack the end flags .*over.*done_key"):
        score_buffer(rb, Read(), trajectory_key=None, done_key="over")
    with pytest.raises(ValueError, match="both None"):
        score_buffer(rb, Read(), trajectory_key=None, done_key=None)
    with pytest.raises(ValueError, match="is a tensor in the storage"):
        score_buffer(rb, Read(), key=("observation", "score"))
    with pytest.raises(ValueError, match="give another key"):
        score_buffer(rb, Read(), key="next")
    wide = EntityLayout({"arm": [0], "cup": [9]})
    with pytest.raises(ValueError, match="needs at least 10"):
        score_buffer(rb, Read(layout=wide), check=False)
    with pytest.raises(KeyError, match=r"the layout reads .*next"):
        score_buffer(
            filled(episodes([5]).exclude(("next", "observation"))), Read(), check=False
        )


class Outcomes(Read):
    """Reads the state of a simulator; its layout is not that of the observations."""

    in_keys = ("physics",)

    def forward(self, td):
        return td["physics"][:, :1].expand(-1, 3)


def test_data_are_checked_by_a_layout_of_their_own_states(caplog):
    # The second column is a function of the first one, an error for the layout.
    rows = episodes([30] * 8)
    rows["observation"][:, 1] = 2 * rows["observation"][:, 0]
    rows["next", "observation"][:, 1] = 2 * rows["next", "observation"][:, 0]
    for td in (rows, rows["next"]):
        td["physics"] = td["observation"][:, 2:]
    for estimator, warnings in ((Outcomes(), 0), (Read(), 1)):
        caplog.clear()
        score_buffer(filled(rows.clone()), estimator, progress=False)
        found = [m for m in caplog.messages if m.startswith("mixed_columns")]
        assert len(found) == warnings
    rows["physics"][3] = torch.nan
    with pytest.raises(ValueError, match="NaN"):
        score_buffer(filled(rows), Outcomes(), progress=False)


class Part(Read):
    """Reads a part of a nested state."""

    def __init__(self, layout, in_keys):
        super().__init__(layout=layout)
        self.in_keys = in_keys

    def forward(self, td):
        return torch.zeros(len(td), 2)


@pytest.mark.parametrize(
    "key", [("s", "cup"), ("s", "cup", "x"), "s", ("next", "s", "cup", "x")]
)
def test_data_are_checked_for_an_estimator_that_reads_a_part(key):
    states = torch.randn(20, 2, 1)
    nested = {"s": {"arm": states[:, 0], "cup": {"x": states[:, 1]}}}
    rows = TensorDict(
        {
            **nested,
            "episode": torch.zeros(20, dtype=torch.int64),
            "next": {**nested, "done": torch.zeros(20, 1, dtype=torch.bool)},
        },
        [20],
    )
    layout = EntityLayout.from_keys({"arm": ("s", "arm"), "cup": ("s", "cup")})
    with pytest.raises(DatasetError, match="next_equals_state"):
        score_buffer(filled(rows), Part(layout, [key]), smoothing=3)


def test_the_last_next_state_is_scored_by_a_part_of_it():
    states = torch.arange(21.0).view(-1, 1)
    before, after = (
        {"s": {"arm": x, "cup": {"x": x}}} for x in (states[:-1], states[1:])
    )
    done = torch.zeros(20, 1, dtype=torch.bool)
    rows = TensorDict({**before, "next": {**after, "done": done}}, [20])
    layout = EntityLayout.from_keys({"arm": ("s", "arm"), "cup": ("s", "cup")})

    class Cup(Part):
        def forward(self, td):
            return td["s", "cup", "x"].expand(-1, 2)

    found = []
    for keys in (layout.in_keys, [("s", "cup")], [("s", "cup", "x")]):
        rb = filled(rows.clone())
        score_buffer(rb, Cup(layout, keys), smoothing=3, trajectory_key=None)
        found.append(rb[:]["caiac", "score"])
    assert found[0][-1, 0] > 19  # the mean of the last states
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


def test_the_progress_bar_counts_rows(capsys):
    score_buffer(filled(episodes([5, 7])), Read(), 4)
    assert "12/12" in capsys.readouterr().err


@pytest.mark.parametrize("lookahead", [0, 1])
def test_the_state_after_the_last_row_is_one_of_every_few(lookahead: int) -> None:
    class Height:
        layout = EntityLayout({"cup": [0]})
        in_keys = ("observation",)

        def __call__(self, td: TensorDict) -> torch.Tensor:
            return td["observation"]

    state = torch.tensor([0.0, 0, 0, 1, 1, 1, 9]).unsqueeze(-1)
    data = TensorDict(
        {
            "observation": state[:-1],
            "episode": torch.zeros(6, dtype=torch.int64),
            "next": {"observation": state[1:]},
        },
        [6],
    )
    rb = ReplayBuffer(storage=LazyTensorStorage(6), batch_size=2)
    rb.extend(data)
    score_buffer(
        rb,
        Height(),
        every=3,
        lookahead=lookahead,
        done_key=None,
        progress=False,
        check=False,
    )
    scores = rb[:]["caiac", "score"].flatten().tolist()
    assert scores == ([0, 1, 1, 1, 9, 9] if lookahead == 0 else [1, 1, 1, 9, 9, 9])
