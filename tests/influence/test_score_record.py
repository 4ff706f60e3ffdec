"""The record of how scores were computed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    TensorStorage,
)

from tests.influence.scoring import (
    KEY,
    Read,
    definition,
    episodes,
    filled,
    ready,
    scores,
    square,
)
from torchrl_caiac import EntityLayout
from torchrl_caiac.data import UnreadableFileError, load_transitions
from torchrl_caiac.influence import (
    CAI,
    score_buffer,
    score_file,
)
from torchrl_caiac.modules import GaussianWorldModel


@pytest.mark.parametrize("kind", ["memory", "memmap"])
@pytest.mark.parametrize("way", ["dumps", "state_dict", "Checkpoint"])
def test_saved_and_loaded_scores_are_good(kind, way, tmp_path):
    rb = filled(episodes([5, 7]), kind, 20, tmp_path)
    score_buffer(rb, Read(), progress=False)
    rb.dumps(tmp_path / "saved")
    Checkpoint(rb=rb).save(tmp_path / "checkpoint")
    for other in (LazyTensorStorage(20), LazyMemmapStorage(20)):
        loaded = ReplayBuffer(storage=other, batch_size=4)
        if way == "dumps":
            loaded.loads(tmp_path / "saved")
        elif way == "state_dict":
            loaded.load_state_dict(rb.state_dict())
        else:
            Checkpoint(rb=loaded).load(tmp_path / "checkpoint")
        assert torch.equal(scores(loaded), scores(rb))
        assert not loaded.sample()[KEY].isnan().any()
        estimator = Read()
        score_buffer(loaded, estimator, progress=False)
        assert estimator.rows == []
        with pytest.raises(ValueError, match="have other settings"):
            score_buffer(loaded, Read(2.0), progress=False)
        # A row that is written later is the only one that is scored again.
        loaded.extend(episodes([1], seed=3, first_id=9))
        score_buffer(loaded, estimator, progress=False)
        expected = definition(loaded.storage[:], square, 1, 1)
        torch.testing.assert_close(scores(loaded), expected)
        assert sum(estimator.rows) <= 4


def test_scores_that_another_handle_added_are_not_replaced(tmp_path):
    rows = episodes([5, 7])
    rows.memmap(tmp_path / "data")
    first, late = (
        ReplayBuffer(storage=TensorStorage(load_transitions(tmp_path / "data")))
        for _ in range(2)
    )
    score_buffer(first, Read(), progress=False)
    before = scores(first).clone()
    with pytest.raises(ValueError, match=r"added to .*data after these data were open"):
        score_buffer(late, Read(), smoothing=3, progress=False)
    assert torch.equal(scores(first), before)
    again = ReplayBuffer(storage=TensorStorage(load_transitions(tmp_path / "data")))
    estimator = Read()
    score_buffer(again, estimator, progress=False)
    assert not estimator.rows
    score_buffer(late, Read(), smoothing=3, overwrite=True, progress=False)
    torch.testing.assert_close(scores(late), definition(rows, square, 3, 1))


def test_interrupted_before_the_leaf_was_initialized(tmp_path):
    # Then the leaf on disk is all zeros, and the state in the record is "new".
    rows = episodes([5, 7])
    rb = filled(rows, "memmap", tmp_path=tmp_path)
    score_buffer(rb, Read(), progress=False)
    record = json.loads(score_file(tmp_path / "data").read_text())
    score_file(tmp_path / "data").write_text(json.dumps({**record, "state": "new"}))
    TensorDict.load_memmap(tmp_path / "data")[KEY].zero_()
    assert (scores(rb) == 0).all()
    score_buffer(rb, Read(), progress=False)
    torch.testing.assert_close(scores(rb), definition(rows, square, 1, 1))


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
def test_scores_with_other_settings_are_never_mixed(kind, change, named, tmp_path):
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


def test_modes_of_cai_are_never_mixed():
    layout = EntityLayout({"arm": [0], "cup": [1, 2]})
    model = ready(GaussianWorldModel(layout, 2, (8,)))
    rb = filled(episodes([20, 20]))
    fast = {"mode": "fast", "threshold": 1e-4}
    score_buffer(rb, CAI(model, **fast), progress=False)
    score_buffer(rb, CAI(model, compile=False, **fast), progress=False)
    for other in (CAI(model), CAI(model, mode="fast", threshold=1e-3)):
        with pytest.raises(ValueError, match="have other settings: estimator"):
            score_buffer(rb, other, progress=False)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('{"format": "torchrl_cai', "truncated or damaged"),
        ("", "truncated or damaged"),
        ('{"something": 1}', "not a score file"),
        ("[1]", "not a score file"),
        ('{"format": "torchrl_caiac.scores", "version": 99}', "version 99"),
        ('{"format": "torchrl_caiac.scores", "version": 2}', "incomplete"),
    ],
)
def test_rejects_a_bad_score_file(text, match, tmp_path):
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


def test_the_score_file_is_named_after_the_key():
    assert score_file("x", ("coda", "graph")) == Path("x/coda.graph.json")


@pytest.mark.parametrize("features", ["cup", [["cup"]], [3]])
def test_a_record_with_damaged_features_is_refused(features, tmp_path):
    rb = filled(episodes([5]), "memmap", tmp_path=tmp_path)
    score_buffer(rb, Read(), progress=False)
    (file,) = tmp_path.rglob("*score.json")
    file.write_text(json.dumps({**json.loads(file.read_text()), "features": features}))
    with pytest.raises(UnreadableFileError, match="incomplete"):
        score_buffer(rb, Read(), progress=False)
