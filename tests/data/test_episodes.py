from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_caiac.data import episode_transitions

ACT = np.zeros((3, 2))


def convert(observations=None, actions=ACT, **given):
    observations = np.zeros((4, 2)) if observations is None else observations
    return episode_transitions(observations, actions, where="episode 5 of x", **given)


def test_rows_of_an_episode():
    observations = np.arange(8.0).reshape(4, 2)
    rows = convert(
        observations,
        rewards=[1, 2, 3],
        terminated=[0, 0, 1],
        info={"deep": {"clock": np.arange(4.0)}, "step": [7, 8, 9]},
    )
    assert rows["observation"].tolist() == observations[:-1].tolist()
    assert rows["next", "observation"].tolist() == observations[1:].tolist()
    assert rows["next", "reward"].tolist() == [[1], [2], [3]]
    assert rows["next", "terminated"].tolist() == [[False], [False], [True]]
    assert not rows["next", "truncated"].any()
    assert torch.equal(rows["next", "done"], rows["next", "terminated"])
    assert rows["info", "deep", "clock"].tolist() == [0, 1, 2]
    assert rows["info", "deep", "clock"].dtype == torch.float64
    assert rows["info", "step"].tolist() == [7, 8, 9]
    # The arrays are copied, and the two states of a row are two.
    observations += 1
    rows["observation"][1] = 9
    assert rows["next", "observation"][0].tolist() == [2, 3]


def test_a_part_of_an_episode_has_no_end():
    assert not convert(ends=False)["next", "done"].any()
    assert convert(truncated=[1, 0, 0])["next", "done"].tolist() == [[1], [0], [1]]


def test_next_observations():
    states = {"observation": np.zeros((3, 2)), "achieved_goal": np.zeros((3, 1))}
    after = {"observation": np.ones((3, 2)), "achieved_goal": np.ones((3, 1))}
    rows = convert(states, next_observations=after)
    assert rows["next", "achieved_goal"].all()
    with pytest.raises(ValueError, match=r"only one of .* has \['achieved_goal'\]"):
        convert(states, next_observations=np.ones((3, 2)))
    after["achieved_goal"] = np.ones((3, 2))
    with pytest.raises(ValueError, match=r"'achieved_goal' .*\[3, 1\].*\[3, 2\]"):
        convert(states, next_observations=after)
    nested = {"observation": {"a": np.ones((3, 2))}, "achieved_goal": np.ones((3, 1))}
    with pytest.raises(ValueError, match=r"'observation' .* has shape \[3, 2\].*\['a'"):
        convert(states, next_observations=nested)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"actions": ACT[:0]}, "episode 5 of x has no steps: remove the episode"),
        ({"observations": ACT}, r"'observation' .* 3 entries, expected 4.*next_obs"),
        ({"rewards": [1, 2]}, "'reward' in episode 5 of x has 2 entries, expected 3"),
        ({"rewards": np.zeros((3, 2))}, r"'reward' .* has \[3, 2\]"),
        ({"terminated": [0, 0.5, 1]}, "'terminated' .* value 0.5, expected flags"),
        ({"truncated": [0, np.nan, 1]}, "'truncated' .* value nan"),
        ({"info": {"a": np.zeros(5)}}, r"\('info', 'a'\) .* 5 .* expected 3 or 4"),
        (
            {"info": {"a": np.zeros(5) > 0}, "leave_out": "drop {key!r}"},
            "expected 3 or 4",
        ),
        (
            {"info": {"a": ["x"] * 3}, "leave_out": "drop {key!r}"},
            r"drop \('info', 'a'\)",
        ),
        ({"info": {"a": [np.nan] * 3}, "remove": "skip it"}, "NaN .*float64.*skip it"),
        ({"observations": {}}, "'observation' in .* has no entries"),
        ({"observations": {"a": {3: ACT}}}, "named 3, a int"),
        ({"observations": (np.zeros((4, 1)), np.zeros((4, 1)))}, "tuple of spaces"),
        ({"observations": [[1], [1, 2], [3], [4]]}, "Python objects"),
        ({"observations": np.zeros((4, 2), "M8[s]")}, "expected numbers"),
    ],
)
def test_what_is_refused(given, match):
    with pytest.raises(ValueError, match=match):
        convert(**given)
