"""Successful trajectories against a slow search, episode by episode."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_caiac.data import (
    action_bounds,
    load_transitions,
    select_successful,
    verify_digests,
    write_transitions,
)

REWARD = ("next", "reward")


def make_rows(episode: list[int], success: list[bool]) -> TensorDict:
    """Rows that know their places, with a reward of 0 at success and -1 elsewhere."""
    rows = len(episode)
    none = torch.zeros(rows, 1, dtype=torch.bool)
    return TensorDict(
        {
            "row": torch.arange(rows),
            "action": torch.zeros(rows, 2),
            "episode": torch.tensor(episode),
            "next": {
                "reward": torch.tensor(success).float().view(rows, 1) - 1,
                "success": torch.tensor(success),
                "done": none,
                "truncated": none.clone(),
                "terminated": none.clone(),
            },
        },
        [rows],
    )


def slow_selection(
    episode: list[int], success: list[bool], cut: bool, count: int | None
) -> list[list[int]]:
    """Goes through the rows of each episode, one by one."""
    found = []
    for own in dict.fromkeys(episode):
        rows = [row for row, other in enumerate(episode) if other == own]
        first = next((n for n, row in enumerate(rows) if success[row]), None)
        if first is not None:
            found.append(rows[: first + 1] if cut else rows)
    return found[:count]


@st.composite
def recordings(draw: st.DrawFn) -> tuple[list[int], list[bool]]:
    rows = draw(st.integers(1, 30))
    episode = draw(st.lists(st.integers(0, 4), min_size=rows, max_size=rows))
    success = draw(st.lists(st.booleans(), min_size=rows, max_size=rows))
    return episode, success


@given(recordings(), st.booleans(), st.none() | st.integers(1, 3))
@settings(max_examples=80, deadline=None)
def test_rows_are_those_of_a_slow_search(recording, cut, count) -> None:
    episode, success = recording
    rows = make_rows(episode, success)
    expected = slow_selection(episode, success, cut, count)
    if len(expected) < (count or 1):
        with pytest.raises(ValueError, match=r"trajectories succeed according to"):
            select_successful(rows, cut=cut, trajectories=count)
        return
    found = select_successful(rows, cut=cut, trajectories=count)
    assert found["row"].tolist() == [row for part in expected for row in part]
    ends = {part[-1] for part in expected} if cut else set()
    for name in ("done", "truncated"):
        assert set(found["row"][found["next", name][:, 0]].tolist()) == ends
    assert not found["next", "terminated"].any()
    by_reward = select_successful(rows, REWARD, above=-0.5, cut=cut, trajectories=count)
    assert torch.equal(by_reward["row"], found["row"])
    assert not rows["next", "done"].any()  # the data stay


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.float32])
def test_flags_keep_their_dtype(dtype) -> None:
    rows = make_rows([0, 0, 0], [False, True, False])
    for name in ("success", "done", "truncated"):
        rows["next", name] = rows["next", name].to(dtype)
    found = select_successful(rows)
    assert found["next", "done"].dtype is dtype
    assert found["next", "done"][:, 0].tolist() == [0, 1]


def test_a_folder_has_digests_and_action_bounds(tmp_path) -> None:
    rows = make_rows([0, 0, 1], [False, True, False])
    stored = write_transitions(rows, tmp_path / "a", action_bounds=([-2, -1], [2, 1]))
    found = select_successful(stored, path=tmp_path / "b")
    assert found.is_memmap() and found["row"].tolist() == [0, 1]
    verify_digests(tmp_path / "b")
    low, high = action_bounds(load_transitions(tmp_path / "b"))
    assert low.tolist() == [-2, -1] and high.tolist() == [2, 1]
    with pytest.raises(FileExistsError, match=r"overwrite=True"):
        select_successful(stored, path=tmp_path / "b")
    select_successful(stored, cut=False, path=tmp_path / "b", overwrite=True)


def test_wrong_data_are_refused() -> None:
    rows = make_rows([0, 0], [False, True])
    with pytest.raises(KeyError, match=r"lack .*nothing.*key="):
        select_successful(rows, "nothing")
    with pytest.raises(ValueError, match=r"from -1 to 0, expected a flag.*above="):
        select_successful(rows, REWARD)
    rows["next", "reward"] = torch.tensor([float("nan"), 0.0])
    with pytest.raises(ValueError, match=r"is NaN in 1 of 2"):
        select_successful(rows, REWARD, above=-0.5)
    rows["next", "success"] = torch.zeros(2, 3)
    with pytest.raises(ValueError, match=r"shape \[2, 3\], expected \[T\]"):
        select_successful(rows)
    with pytest.raises(ValueError, match="trajectories"):
        select_successful(make_rows([0], [True]), trajectories=0)
    with pytest.raises(KeyError, match="trajectory ids"):
        select_successful(make_rows([0], [True]).exclude("episode"))


def test_end_flags_alone_mark_trajectories() -> None:
    rows = make_rows([0, 0, 0, 0], [False, True, False, False]).exclude("episode")
    rows["next", "done"][1] = True
    found = select_successful(rows, trajectory_key=None)
    assert found["row"].tolist() == [0, 1]
