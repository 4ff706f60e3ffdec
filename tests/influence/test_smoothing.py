"""Windows over states of the same trajectory."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_caiac.influence.smoothing import fill_between, max_ahead, smooth

states = st.lists(
    st.tuples(st.floats(-2, 2, width=32), st.booleans(), st.booleans()),
    min_size=1,
    max_size=12,
)


def tensors(states):
    """Scores, trajectories and which states are scored, from (score, new, scored)."""
    score, new, scored = (torch.tensor(column) for column in zip(*states, strict=True))
    return score.float()[:, None], new.long().cumsum(0), scored


@given(states, st.integers(0, 3), st.integers(0, 3))
def test_windows_stay_within_trajectories(states, past, future):
    score, trajectory, _ = tensors(states)
    mean = smooth(score, trajectory, past, future)
    largest = max_ahead(score, trajectory, future)
    for i in range(len(score)):
        same = [j for j in range(len(score)) if trajectory[j] == trajectory[i]]
        window = [j for j in same if i - past <= j <= i + future]
        torch.testing.assert_close(mean[i], score[window].mean(0), atol=1e-6, rtol=0)
        ahead = [j for j in same if i <= j <= i + future]
        assert torch.equal(largest[i], score[ahead].amax(0))


@given(states)
def test_gaps_are_filled_from_the_scored_states_around(states):
    score, trajectory, scored = tensors(states)
    result = fill_between(score, trajectory, scored)
    for i in range(len(score)):
        known = [
            j for j in scored.nonzero()[:, 0].tolist() if trajectory[j] == trajectory[i]
        ]
        before = [j for j in known if j <= i][-1:]
        after = [j for j in known if j >= i][:1]
        if before or after:
            assert torch.equal(result[i], score[before + after].amax(0))
