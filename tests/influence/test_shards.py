"""Scores of a folder that several processes write together."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.data import ReplayBuffer

from tests.influence.scoring import (
    KEY,
    Failing,
    Read,
    definition,
    episodes,
    filled,
    scores,
    square,
)
from torchrl_caiac._files import claim_folder
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.influence.shards import scoring_progress
    Failing,
    definition,
    episodes,
    scores,
    square,
)
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence import score_buffer

PARTS = "caiac.score.parts"


def opened(folder: Path) -> ReplayBuffer:
    return offline_buffer(load_transitions(folder))


def leaf_bytes(folder: Path) -> list[bytes]:
    names = ("caiac/score.memmap", "caiac/score_fingerprint.memmap", "caiac.score.json")
    return [(folder / name).read_bytes() for name in names]


@settings(max_examples=25, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 30), min_size=1, max_size=6),
    smoothing=st.integers(1, 4),
    lookahead=st.integers(0, 3),
    every=st.integers(1, 3),
    batch_size=st.integers(1, 9),
    calls=st.lists(
        st.tuples(st.integers(0, 4), st.integers(1, 5), st.integers(1, 12)), max_size=4
    ),
    alone=st.booleans(),
)
def test_any_split_and_interruption_gives_the_bytes_of_one_process(
    lengths, smoothing, lookahead, every, batch_size, calls, alone
):
    rows = episodes(lengths)
    options = {"lookahead": lookahead, "every": every, "progress": False}
    with tempfile.TemporaryDirectory() as name:
        whole, shared = Path(name, "whole"), Path(name, "shared")
        for folder in (whole, shared):
            rows.memmap(folder)
        score_buffer(opened(whole), Failing(-1), batch_size, smoothing, **options)
        for i, n, count in calls:  # processes that end after a few calls
            # An interrupted call is repeated without shard, if n is 5.
            shard = None if n == 5 else (i % n, n)
            estimator = Failing(count)
            try:
                score_buffer(
                    opened(shared),
                    estimator,
                    batch_size,
                    smoothing,
                    shard=shard,
                    **options,
                )
            except KeyboardInterrupt:
                record = shared / "caiac.score.json"
                if record.exists():
                    assert json.loads(record.read_text())["state"] != "scored"
        rb = opened(shared)
        shard = None if alone else (0, 1)
        estimator = Failing(-1)
        score_buffer(rb, estimator, batch_size, smoothing, shard=shard, **options)
        assert not (shared / PARTS).exists()
        assert leaf_bytes(shared) == leaf_bytes(whole)
        if every == 1:
            expected = definition(rows, square, smoothing, lookahead)
            torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-6)


CHILD = """
    import sys, time
    import torch
    from pathlib import Path
    from torchrl_caiac.data import load_transitions, offline_buffer
    from torchrl_caiac import EntityLayout
    from torchrl_caiac.influence import CAI, score_buffer
    from torchrl_caiac.modules import GaussianWorldModel

    root, calls, shard = Path(sys.argv[1]), int(sys.argv[2]), eval(sys.argv[3])

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
    for name in sys.argv[4:]:
        rb = offline_buffer(load_transitions(root / name))
        arguments = {"shard": shard if name == "shared" else None}
        score_buffer(rb, estimator, 16, smoothing=3, progress=False, **arguments)
"""


def start(root: Path, calls: int, shard: tuple[int, int], *names: str):
    script = root / "child.py"
    script.write_text(textwrap.dedent(CHILD))
    return subprocess.Popen(
        [sys.executable, str(script), str(root), str(calls), str(shard), *names],
        env={**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"},
    )


def test_a_killed_process_is_replaced_by_the_other_one(tmp_path):
    rows = episodes([30, 25, 140, 5])
    for name in ("shared", "whole"):
        rows.memmap(tmp_path / name)
    first = start(tmp_path, 6, (0, 2), "shared")
    second = None
    try:
        end = time.monotonic() + 60
        while not (tmp_path / "waiting").exists():
            assert time.monotonic() < end and first.poll() is None
            time.sleep(0.05)
        # It has scored a part, and is at work: the folder is no other process's own.
        assert 0 < scoring_progress(tmp_path / "shared").done < len(rows)
        with pytest.raises(RuntimeError, match=f"process {first.pid} on .* together"):
            score_buffer(opened(tmp_path / "shared"), Read(), progress=False)
        with pytest.raises(ValueError, match=r"smoothing was 3, is 1.*batch_size"):
            score_buffer(
                opened(tmp_path / "shared"), Read(), 8, progress=False, shard=(1, 2)
            )
        data = load_transitions(tmp_path / "shared")
        assert data[KEY].isnan().all()
        assert (data["caiac", "score_fingerprint"] == 0).all()
        second = start(tmp_path, -1, (1, 2), "shared", "whole")
        # The second one scores all but what the first has claimed, and then waits.
        while scoring_progress(tmp_path / "shared").done < len(rows) - 16:
            assert time.monotonic() < end and second.poll() is None
            time.sleep(0.05)
        first.send_signal(signal.SIGKILL)
        first.wait(60)
        assert second.wait(60) == 0
    finally:
        for process in (first, second):
            if process is not None:
                process.kill()
                process.wait(60)
    assert leaf_bytes(tmp_path / "shared") == leaf_bytes(tmp_path / "whole")
    assert not (tmp_path / "shared" / PARTS).exists()


def test_rows_around_new_ones_are_scored_as_by_one_process(tmp_path):
    found = []
    for shard in (None, (0, 2)):
        rb = filled(episodes([20, 30]), "memmap", tmp_path=tmp_path / str(shard))
        options = {"smoothing": 3, "shard": shard, "progress": False}
        score_buffer(rb, Read(), 8, **options)
        rb.extend(episodes([7], seed=1, first_id=2))
        estimator = Read()
        score_buffer(rb, estimator, 8, **options)
        assert sum(estimator.rows) < 40
        found.append(scores(rb))
    assert torch.equal(*found)


def test_a_damaged_part_is_scored_again(tmp_path):
    rows = episodes([20, 30])
    rows.memmap(tmp_path / "data")
    whole = filled(rows)
    score_buffer(whole, Failing(-1), 6, progress=False)
    options = {"shard": (0, 2), "progress": False}
    with pytest.raises(KeyboardInterrupt):
        score_buffer(opened(tmp_path / "data"), Failing(5), 6, **options)
    parts = sorted((tmp_path / "data" / PARTS).glob("*.npz"))
    content = bytearray(parts[0].read_bytes())
    content[len(content) // 3] ^= 1
    parts[0].write_bytes(content)
    parts[1].write_bytes(b"")
    rb = opened(tmp_path / "data")
    score_buffer(rb, Failing(-1), 6, **options)
    assert torch.equal(scores(rb), scores(whole))


def test_scores_of_other_settings_are_replaced_on_request_alone(tmp_path):
    episodes([20, 30]).memmap(tmp_path / "data")
    options = {"shard": (0, 2), "progress": False}
    with pytest.raises(KeyboardInterrupt):
        score_buffer(opened(tmp_path / "data"), Failing(3), 6, **options)
    for shard in (None, (1, 2)):
        with pytest.raises(ValueError, match=r"smoothing was 1, is 3.*overwrite=True"):
            score_buffer(
                opened(tmp_path / "data"),
                Failing(-1),
                6,
                3,
                shard=shard,
                progress=False,
            )
    rb = opened(tmp_path / "data")
    score_buffer(rb, Failing(-1), 6, 3, overwrite=True, **options)
    # A process that comes late has nothing to do.
    late = Failing(0)
    score_buffer(opened(tmp_path / "data"), late, 6, 3, overwrite=True, **options)
    expected = definition(episodes([20, 30]), square, 3, 1)
    torch.testing.assert_close(scores(rb), expected, atol=1e-6, rtol=1e-6)


def test_other_batch_sizes_resume_what_ended(tmp_path):
    rows = episodes([20, 30])
    rows.memmap(tmp_path / "data")
    options = {"shard": (0, 2), "progress": False}
    with pytest.raises(KeyboardInterrupt):
        score_buffer(opened(tmp_path / "data"), Failing(5), 6, **options)
    rb, estimator = opened(tmp_path / "data"), Failing(-1)
    score_buffer(rb, estimator, 4, **options)
    assert sum(estimator.rows) < len(rows)
    torch.testing.assert_close(scores(rb), definition(rows, square, 1, 1))


def test_a_process_that_scores_alone_refuses_others(tmp_path):
    episodes([20]).memmap(tmp_path / "data")
    with (
        claim_folder(tmp_path / "data"),
        pytest.raises(RuntimeError, match=f"process {os.getpid()} on .* is using"),
    ):
        score_buffer(opened(tmp_path / "data"), Read(), shard=(0, 2), progress=False)
    assert not (tmp_path / "data" / PARTS).exists()


@pytest.mark.parametrize("shard", [(2, 2), (-1, 2), (0, 0), (0, 1, 2), 1, (0.0, 2)])
def test_rejects_bad_shards(shard, tmp_path):
    episodes([5]).memmap(tmp_path / "data")
    with pytest.raises(ValueError, match="shard"):
        score_buffer(opened(tmp_path / "data"), Read(), shard=shard)


@pytest.mark.parametrize("kind", ["memory", "memmap without a folder"])
def test_needs_a_folder(kind):
    with pytest.raises(ValueError, match=r"shard needs data in a folder.*load_trans"):
        score_buffer(filled(episodes([5]), kind), Read(), shard=(0, 2))
