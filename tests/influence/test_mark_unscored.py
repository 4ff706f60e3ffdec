"""Rows that are written after scores were computed."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    ReplayBuffer,
    TensorDictReplayBuffer,
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
from torchrl_caiac.influence import (
    MarkUnscored,
    score_buffer,
    set_unscored,
)


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
    assert KEY not in later.keys(include_nested=True)
    rb.add(episodes([1], seed=10, first_id=8)[0])
    stale = rows[:2].clone().set(KEY, torch.ones(2, 3))
    rb.extend(stale)
    assert scores(rb)[12:].isnan().all()
    assert not scores(rb)[:12].isnan().any()
    estimator = Read()
    score_buffer(rb, estimator, 4, smoothing=3, progress=False)
    torch.testing.assert_close(scores(rb), definition(rb.storage[:], square, 3, 1))
    assert sum(estimator.rows) < 18 + 5  # the first chunk is not scored again
    assert sum(isinstance(t, MarkUnscored) for t in rb.transform) == 1


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


def test_assigned_rows_are_unscored():
    rows = episodes([5, 7])
    rb = filled(rows)
    score_buffer(rb, Read(), progress=False)
    rb[3:5] = rows[3:5]
    assert scores(rb).isnan().any(-1).nonzero()[:, 0].tolist() == [3, 4]


def test_set_unscored_replaces_scores():
    td = TensorDict({"caiac": {"score": torch.ones(2, 3, 4, 3)}}, [2, 3])
    assert set_unscored(td, KEY, (4, 3)) is td
    assert td[KEY].shape == (2, 3, 4, 3)
    assert td[KEY].dtype == torch.float32
    assert td[KEY].isnan().all()
    assert set_unscored(TensorDict({}), "score", (2,))["score"].isnan().all()
