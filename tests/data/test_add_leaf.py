from __future__ import annotations

import errno
import json
import os
import signal

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.killing import run_killed
from torchrl_caiac import EntityLayout
from torchrl_caiac.data import (
    add_leaf,
    from_arrays,
    load_transitions,
    offline_buffer,
    verify_digests,
)
from torchrl_caiac.data.add_leaf import store_leaves
from torchrl_caiac.influence import score_buffer


class Height:
    layout = EntityLayout({"arm": [0, 1], "cup": [2]})

    def __call__(self, td):
        return td["observation"][:, 1:]


@pytest.fixture
def data(tmp_path):
    rng = np.random.default_rng(0)
    return from_arrays(
        rng.normal(size=(7, 3)),
        rng.normal(size=(6, 2)),
        tmp_path / "rows",
        episode_lengths=[6],
        info={"clock": np.arange(6)},
        progress=False,
    )


class TestAddLeaf:
    def test_it_is_there_after_a_reload(self, data, tmp_path):
        leaf = add_leaf(data, "weight", np.arange(6.0))
        leaf[0] = 9
        add_leaf(data, ("info", "deep", "flag"), torch.ones(6, 2, dtype=torch.bool))
        assert data.is_memmap()
        assert data.is_locked
        for found in (data, load_transitions(tmp_path / "rows", verify=True)):
            assert found["weight"].tolist() == [9, 1, 2, 3, 4, 5]
            assert found["weight"].dtype == torch.float64
            assert found["info", "deep", "flag"].all()

    def test_in_memory(self):
        data = TensorDict({"action": torch.zeros(3, 1)}, [3]).lock_()
        add_leaf(data, ("info", "weight"), torch.ones(3))
        assert data["info", "weight"].tolist() == [1, 1, 1]
        assert data.is_locked

    @pytest.mark.parametrize(
        ("key", "values", "match"),
        [
            ("action", torch.zeros(6, 2), r"exists already: to change it.*data\[key\]"),
            ("info", torch.zeros(6), "exists already"),
            (("action", "x"), torch.zeros(6), "cannot be below a tensor"),
            ("weight", torch.zeros(5), r"shape \[5\], expected \[6\]"),
            ("weight", ["a"] * 6, "are no numbers"),
            ("shape", torch.zeros(6), "reserve: rename it"),
            ("info.clock", torch.zeros(6), "have the same name with dots"),
        ],
    )
    def test_what_is_refused(self, key, values, match, data, tmp_path):
        with pytest.raises(ValueError, match=match):
            add_leaf(data, key, values)
        assert (load_transitions(tmp_path / "rows") == data).all()

    def test_a_full_disk(self, small_disk):
        rows = TensorDict(
            {
                "action": torch.zeros(1000, 1),
                "episode": torch.zeros(1000, dtype=torch.int64),
                "next": {"done": torch.ones(1000, 1, dtype=torch.bool)},
            },
            [1000],
        )
        rows.memmap(small_disk / "rows")
        data = load_transitions(small_disk / "rows")
        with pytest.raises(OSError, match="disk is full"):
            add_leaf(data, "large", torch.zeros(1000, 5000))
        assert "large" not in data
        data.unlock_()
        data["large"] = torch.ones(1000, 5000)
        data["small"] = torch.ones(1000)
        with pytest.raises(OSError, match="disk is full"):
            offline_buffer(data)
        assert data["large"].all()  # it is still in memory
        del data["large"]
        offline_buffer(data)
        assert load_transitions(small_disk / "rows")["small"].all()


class TestUnlocked:
    def test_locked_data_refuse_a_new_leaf(self, data):
        with pytest.raises(RuntimeError, match="locked"):
            data["weight"] = torch.ones(6)

    @pytest.mark.parametrize("lock", [False, True])
    @pytest.mark.parametrize("when", ["before the buffer", "before the scores"])
    def test_leaves_and_scores_are_written(self, lock, when, data, tmp_path):
        rb = offline_buffer(data, 4) if when == "before the scores" else None
        data.unlock_()
        data["weight"] = torch.arange(6.0)
        data["next", "weight"] = torch.arange(6.0)
        data["more"] = TensorDict(
            {"deep": {"a": torch.ones(6), "b": torch.ones(6)}}, [6]
        )
        if lock:
            data.lock_()
        rb = offline_buffer(data, 4) if rb is None else rb
        score_buffer(rb, Height(), lookahead=0, progress=False)
        assert data.is_memmap()
        assert data.is_locked
        opened = load_transitions(tmp_path / "rows", verify=True)
        assert (opened == data).all()
        assert opened["next", "weight"].tolist() == [0, 1, 2, 3, 4, 5]
        assert opened["more", "deep", "b"].all()
        assert torch.equal(opened["caiac", "score"], opened["observation"][:, 1:])
        assert "weight" in rb.sample()

    def test_without_a_new_leaf(self, data, tmp_path):
        data.unlock_()
        rb = offline_buffer(data, 4)
        score_buffer(rb, Height(), lookahead=0, progress=False)
        assert ("caiac", "score") in load_transitions(tmp_path / "rows").keys(True)
        with pytest.raises(RuntimeError, match="locked"):
            data["weight"] = torch.ones(6)

    @pytest.mark.parametrize("key", ["observation", ("next", "reward_like")])
    def test_a_leaf_in_another_file_is_copied(self, key, data, tmp_path):
        other = TensorDict({"x": torch.ones(6, 2)}, [6]).memmap(tmp_path / "other")
        data.unlock_()
        data[key] = other["x"]
        if key == "observation":
            with pytest.raises(ValueError, match=r"'observation' .* was replaced"):
                offline_buffer(data)
            return
        offline_buffer(data)
        assert load_transitions(tmp_path / "rows")[key].all()

    def test_a_replaced_leaf_is_refused(self, data, tmp_path):
        before = load_transitions(tmp_path / "rows")["observation"].clone()
        rb = offline_buffer(data, 4)
        data.unlock_()
        data["observation"] = data["observation"] * 2
        with pytest.raises(
            ValueError, match=r"'observation' .* was replaced.*in place"
        ):
            offline_buffer(data)
        with pytest.raises(ValueError, match=r"'observation' .* was replaced"):
            score_buffer(rb, Height(), lookahead=0, progress=False)
        verify_digests(tmp_path / "rows")
        assert torch.equal(load_transitions(tmp_path / "rows")["observation"], before)

    def test_texts_are_refused(self, data):
        data.unlock_()
        data["name"] = "cup"
        with pytest.raises(ValueError, match="'name' of the data opened from"):
            offline_buffer(data)


def test_a_killed_process_adds_a_leaf_as_a_whole_or_not(data, tmp_path):
    def killed():
        torch.Tensor.copy_ = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
        add_leaf(data, "weight", np.ones(6))
        yield

    run_killed(killed)
    again = load_transitions(tmp_path / "rows", verify=True)
    assert "weight" not in again
    assert add_leaf(again, "weight", np.ones(6)).tolist() == [1.0] * 6


def test_a_file_that_is_not_listed_is_written_again(tmp_path):
    """As a process leaves it that is killed after it has written the values."""
    rows = TensorDict({"action": torch.zeros(3, 2)}, [3])
    rows.memmap(tmp_path / "rows")
    data = load_transitions(tmp_path / "rows", keys=["action"])
    add_leaf(data, "weight", torch.zeros(3))
    meta = tmp_path / "rows" / "meta.json"
    listed = json.loads(meta.read_text())
    del listed["weight"]
    meta.write_text(json.dumps(listed))
    data = load_transitions(tmp_path / "rows", keys=["action"]).unlock_()
    data["weight"] = torch.ones(3)
    assert store_leaves(data) == ["weight"]
    again = load_transitions(tmp_path / "rows", keys=["action"])
    assert (again["weight"] == 1).all()


def test_file_systems_without_allocation(tmp_path, monkeypatch):
    def refuse(*args):
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    TensorDict({"action": torch.zeros(3, 2)}, [3]).memmap(tmp_path / "rows")
    data = load_transitions(tmp_path / "rows", keys=["action"])
    assert (add_leaf(data, "weight", torch.ones(3)) == 1).all()
