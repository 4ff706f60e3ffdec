"""The leaf that holds the scores."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    ImmutableDatasetWriter,
    ReplayBuffer,
    TensorStorage,
)

from tests.influence.scoring import (
    KEY,
    Read,
    definition,
    episodes,
    filled,
    scores,
    square,
    storage_of,
)
from tests.killing import run_killed
from torchrl_caiac._fingerprints import fingerprint_key
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence import (
    score_buffer,
    score_file,
)


def test_a_loaded_folder_stays_memory_mapped(tmp_path):
    rows = episodes([5, 7])
    rows.memmap(tmp_path / "data")
    rb = ReplayBuffer(
        storage=TensorStorage(TensorDict.load_memmap(tmp_path / "data")),
        writer=ImmutableDatasetWriter(),
        batch_size=4,
    )
    score_buffer(rb, Read(), progress=False)
    again = TensorDict.load_memmap(tmp_path / "data")
    torch.testing.assert_close(again[KEY], definition(rows, square, 1, 1))
    assert torch.equal(again["observation"], rows["observation"])
    assert score_file(tmp_path / "data").exists()
    # As in another process: nothing is left to do.
    estimator = Read()
    score_buffer(ReplayBuffer(storage=TensorStorage(again)), estimator, progress=False)
    assert estimator.rows == []


def test_two_leaves_with_different_settings(tmp_path):
    rb = filled(episodes([5, 7]), "memmap", tmp_path=tmp_path)
    score_buffer(rb, Read(), progress=False)
    score_buffer(rb, Read(2.0), key="other", progress=False)
    torch.testing.assert_close(scores(rb, "other"), 4 * scores(rb))
    rb.extend(episodes([12], first_id=50, seed=5))
    score_buffer(rb, Read(), progress=False)
    torch.testing.assert_close(scores(rb), definition(rb.storage[:], square, 1, 1))
    estimator = Read(2.0)
    score_buffer(rb, estimator, key="other", progress=False)
    assert sum(estimator.rows) == 13


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
def test_a_leaf_of_another_origin_is_replaced_only_on_request(kind, leaf, tmp_path):
    rows = episodes([5, 7]).set(KEY, leaf)
    rb = filled(rows, kind, tmp_path=tmp_path)
    with pytest.raises(ValueError, match="overwrite=True"):
        score_buffer(rb, Read(), progress=False)
    assert torch.equal(scores(rb), leaf)
    score_buffer(rb, Read(), overwrite=True, progress=False)
    torch.testing.assert_close(scores(rb), definition(rows, square, 1, 1))
    assert rb.storage[:].is_memmap() == (kind == "memmap")
    if kind == "memmap":
        again = TensorDict.load_memmap(tmp_path / "data")
        assert torch.equal(again[KEY], scores(rb))


def test_scores_without_fingerprints_are_not_taken_for_ones_of_this_package():
    rb = filled(episodes([5, 7]).set(KEY, torch.zeros(12, 3)))
    with pytest.raises(ValueError, match=r"without fingerprints .*overwrite=True"):
        score_buffer(rb, Read(), progress=False)
    rb.storage[:][KEY].fill_(torch.nan)  # none of them is one
    score_buffer(rb, Read(), progress=False)
    torch.testing.assert_close(scores(rb), definition(rb.storage[:], square, 1, 1))


def test_another_leaf_in_the_place_of_the_fingerprints():
    rb = filled(episodes([5, 7]).set(fingerprint_key(KEY), torch.zeros(12)))
    rb.storage[:][KEY] = torch.zeros(12, 3)
    with pytest.raises(ValueError, match=r"score_fingerprint.*float32 \[12\].*int64"):
        score_buffer(rb, Read(), progress=False)


def test_a_storage_with_two_dimensions(tmp_path):
    columns = [episodes([4, 3], seed=i, first_id=10 * i) for i in range(3)]
    for kind in ("memory", "memmap"):
        rb = ReplayBuffer(
            storage=storage_of(kind, 21, tmp_path, ndim=2), dim_extend=0, batch_size=4
        )
        rb.extend(torch.stack(columns, 1))
        score_buffer(rb, Read(), 4, smoothing=3, lookahead=2, progress=False)
        assert rb.storage[:][KEY].shape == (7, 3, 3)
        for i, column in enumerate(columns):
            found = rb.storage[:][KEY][:, i]
            torch.testing.assert_close(found, definition(column, square, 3, 2))
        # Two more steps of each environment, over the oldest ones.
        rb.extend(torch.stack([episodes([2], seed=i + 7) for i in range(3)], 1))
        score_buffer(rb, Read(), 4, smoothing=3, lookahead=2, progress=False)
        order = [*range(2, 7), 0, 1]
        for i in range(3):
            stored = rb.storage[:][:, i]
            expected = definition(stored, square, 3, 2, order)
            torch.testing.assert_close(stored[KEY][:2], expected[:2])
    again = TensorDict.load_memmap(tmp_path / "data")
    assert torch.equal(again[KEY], rb.storage[:][KEY])


def test_nothing_is_written_if_the_estimator_does_not_fit(tmp_path):
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
        (Wide(), r"shape \[12, 5\] for 12 states, expected \[12, 3\]"),
        (Short(), r"shape \[11, 3\]"),
        (Whole(), "floating-point"),
    ):
        with pytest.raises(ValueError, match=match):
            score_buffer(rb, bad, progress=False)
    assert sorted(p.name for p in (tmp_path / "data").rglob("*")) == files
    assert KEY not in rb.storage[:].keys(include_nested=True)


class TestMachines:
    def opened(self, folder):
        return offline_buffer(load_transitions(folder, keys=["episode"]), 4)

    def test_finished_scores_in_a_read_only_folder(self, tmp_path, read_only):
        rows = episodes([5, 7])
        rows.memmap(tmp_path / "data")
        score_buffer(self.opened(tmp_path / "data"), Read(), progress=False)
        read_only(tmp_path / "data")
        rb, estimator = self.opened(tmp_path / "data"), Read()
        score_buffer(rb, estimator, progress=False)
        assert estimator.rows == []
        torch.testing.assert_close(scores(rb), definition(rows, square, 1, 1))

    def test_a_full_disk_is_an_error_and_leaves_the_data_as_they_were(self, small_disk):
        rows = episodes([100_000])
        rows.exclude("action").memmap(small_disk / "data")
        free = (4 << 20) - sum(
            file.stat().st_size for file in (small_disk / "data").rglob("*.memmap")
        )
        assert 0 < free < 100_000 * 20  # of 8 bytes a fingerprint and 12 for scores
        rb = self.opened(small_disk / "data")
        with pytest.raises(OSError, match=r"the disk is full: .*\.memmap needs \d+"):
            score_buffer(rb, Read(), progress=False)
        again = load_transitions(small_disk / "data", keys=["episode"])
        assert torch.equal(again["observation"], rows["observation"])
        assert KEY not in again.keys(include_nested=True)

    def test_a_kill_while_the_leaf_is_added_is_undone(self, tmp_path, monkeypatch):
        rows = episodes([5, 7])
        rows.memmap(tmp_path / "data")

        def work():
            # tensordict empties meta.json before it writes it again.
            original = Path.open

            def stop(self, *args, **kwargs):
                file = original(self, *args, **kwargs)
                if self.name == "meta.json" and "w" in str(
                    args + tuple(kwargs.items())
                ):
                    os.kill(os.getpid(), signal.SIGKILL)
                return file

            monkeypatch.setattr(Path, "open", stop)
            monkeypatch.setattr(
                "builtins.open",
                lambda file, *args, **kwargs: stop(Path(file), *args, **kwargs),
            )
            score_buffer(self.opened(tmp_path / "data"), Read(), progress=False)
            yield

        run_killed(work)
        assert any(
            not file.stat().st_size for file in (tmp_path / "data").rglob("meta.json")
        )
        rb = self.opened(tmp_path / "data")
        score_buffer(rb, Read(), progress=False)
        torch.testing.assert_close(scores(rb), definition(rows, square, 1, 1))
