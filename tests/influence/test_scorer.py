"""What estimators are given, and what they may return."""

from __future__ import annotations

import pytest
import torch
from torchrl.data import (
    LazyTensorStorage,
    ReplayBuffer,
)

from tests.influence.scoring import (
    KEY,
    LAYOUT,
    Read,
    episodes,
    filled,
    ready,
    scores,
)
from torchrl_caiac import EntityLayout
from torchrl_caiac.influence import (
    CAI,
    AttentionInfluence,
    DistanceInfluence,
    score_buffer,
)
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel


def test_the_estimator_gets_at_most_batch_size_states():
    most = []

    class Watch(Read):
        def forward(self, td):
            most.append(len(td))
            return super().forward(td)

    rows = episodes([400])  # one trajectory, longer than any chunk
    score_buffer(filled(rows), Watch(), 16, 5, lookahead=2, progress=False)
    assert max(most) == 16


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_rejects_scores_that_are_not_finite(value):
    class Bad(Read):
        def forward(self, td):
            out = super().forward(td)
            out[td["observation"][:, 1] == 77.0, 1] = value
            return out

    rows = episodes([5, 7])
    rows["observation"][9, 1] = 77.0
    rb = filled(rows)
    with pytest.raises(ValueError, match=r"\['cup'\] in the state of the rows \[9\]"):
        score_buffer(rb, Bad(), 4, check=False, progress=False)
    assert not scores(rb)[:4].isnan().any()  # a finished chunk
    assert scores(rb)[4:].isnan().all()


def test_rejects_observations_that_are_not_finite():
    rows = episodes([5, 7])
    rows["observation"][3, 0] = torch.nan
    with pytest.raises(ValueError, match=r"'observation'.*the state of the rows \[3\]"):
        score_buffer(filled(rows), Read(), check=False, progress=False)
    rows = episodes([5, 7])
    rows["next", "observation"][11, 0] = torch.inf
    with pytest.raises(ValueError, match=r"the next state of the rows \[11\]"):
        score_buffer(filled(rows), Read(), check=False, progress=False)


class Prepared(Read):
    """Keeps what it is shown before it scores."""

    def __init__(self):
        super().__init__()
        self.shown = []

    def __getstate__(self):
        return {}  # what it was shown is no setting

    def prepare(self, states, num_states, *, smoothing):
        assert not self.rows
        # Tensors would count as a part of the model.
        self.shown.append((states["observation"].tolist(), num_states, smoothing))


def test_prepare_gets_states_of_the_whole_buffer():
    rows = episodes([4000, 4191])
    rb = filled(rows, size=9000)
    estimator = Prepared()
    score_buffer(rb, estimator, 4096, smoothing=3, progress=False)
    ((shown, num_states, smoothing),) = estimator.shown
    assert shown == rows["observation"][::2].tolist()
    assert (num_states, smoothing) == (8191, 3)
    # There is nothing left to score.
    score_buffer(rb, estimator, 4096, smoothing=3, progress=False)
    assert len(estimator.shown) == 1


def test_interrupted_fast_scores_resume_to_the_same_bytes(monkeypatch):
    layout = EntityLayout({"arm": [0], "cup": [1, 2]})
    torch.manual_seed(0)
    model = ready(GaussianWorldModel(layout, 2, (8,)))
    rows = episodes([60, 60, 60])

    def estimator():
        return CAI(model, mode="fast", threshold=1e-4)

    once, twice = filled(rows), filled(rows)
    score_buffer(once, estimator(), 32, 3, progress=False)
    score, calls = CAI._score, []

    def fails(self, states, near):
        calls.append(len(states))
        if len(calls) > 6:  # two to prepare, four blocks and their next states
            raise KeyboardInterrupt
        return score(self, states, near)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(CAI, "_score", fails)
        score_buffer(twice, estimator(), 32, 3, progress=False)
    assert 0 < scores(twice).isnan().float().mean() < 1
    score_buffer(twice, estimator(), 32, 3, progress=False)
    assert torch.equal(scores(twice), scores(once))


def test_rows_that_are_not_finite_are_named_in_the_fast_mode():
    layout = EntityLayout({"arm": [0], "cup": [1, 2]})
    rows = episodes([20, 20])
    rows["observation"][33, 1] = torch.nan
    model = ready(GaussianWorldModel(layout, 2, (8,)))
    fast = CAI(model, mode="fast", threshold=1e-4)
    with pytest.raises(ValueError, match=r"state of the rows \[33\]"):
        score_buffer(filled(rows), fast, check=False, progress=False)


def model_cai(**kwargs):
    return CAI(ready(GaussianWorldModel(LAYOUT, 2, (16, 16))), 32, **kwargs)


def attention(**kwargs):
    model = ready(TransformerWorldModel(LAYOUT, 2, 2, 2, 8))
    return AttentionInfluence(model, **kwargs)


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
def test_scores_on_a_gpu_match_the_cpu(make, where):
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
