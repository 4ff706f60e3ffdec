"""The selection of successful trajectories against a slow search."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import LazyStackedTensorDict, NonTensorData, NonTensorStack, TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_caiac.data import load_transitions, select_successful


def make_rows(episode: list[int], success: list[bool]) -> TensorDict:
    """Rows that are numbered in ``"row"``, none of which ends its trajectory."""
    rows = len(episode)
    flags = {
        name: torch.zeros(rows, 1, dtype=torch.bool)
        for name in ("done", "terminated", "truncated")
    }
    return TensorDict(
        {
            "row": torch.arange(rows),
            "action": torch.zeros(rows, 2),
            "episode": torch.tensor(episode),
            "next": {"success": torch.tensor(success, dtype=torch.bool), **flags},
        },
        [rows],
    )


#: Two interleaved episodes, the first of which succeeds in its second row.
EPISODE, SUCCESS = [0, 1, 0, 1, 0, 1], [False, False, True, False, True, False]


def flags(rows: TensorDict, *key: str) -> list[int]:
    return rows[("next", *key)].reshape(-1).int().tolist()


def slow_rows(
    episode: list[int], success: list[bool], cut: bool, most: int | None
) -> list[int]:
    """Looks at each episode, in the order of their first rows."""
    found: list[list[int]] = []
    for own in dict.fromkeys(episode):
        rows = [r for r in range(len(episode)) if episode[r] == own]
        first = next((n for n, r in enumerate(rows) if success[r]), None)
        if first is not None:
            found.append(rows[: first + 1] if cut else rows)
    return [row for rows in found[:most] for row in rows]


@given(
    st.lists(st.tuples(st.integers(0, 3), st.booleans()), min_size=1, max_size=30),
    st.booleans(),
    st.sampled_from([None, 1, 2]),
)
@settings(max_examples=60, deadline=None)
def test_rows_are_those_of_a_slow_search(drawn, cut, most) -> None:
    episode, success = [e for e, _ in drawn], [s for _, s in drawn]
    data = make_rows(episode, success)
    expected = slow_rows(episode, success, cut, most)
    solved = {e for e, s in drawn if s}
    if len(solved) < (most or 1):
        with pytest.raises(ValueError, match=f"{len(solved)} of .* succeed"):
            select_successful(data, cut=cut, trajectories=most)
        return
    found = select_successful(data, cut=cut, trajectories=most)
    assert found["row"].tolist() == expected
    ids = [episode[row] for row in expected]
    ends = [int(a != b) for a, b in zip(ids, [*ids[1:], None], strict=True)]
    assert flags(found, "done") == flags(found, "truncated")
    assert flags(found, "done") == (ends if cut else [0] * len(ends))
    assert not any(flags(data, "done"))  # the input is not changed


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int64, torch.float32])
@pytest.mark.parametrize("shape", [(-1,), (-1, 1)])
def test_flags_keep_their_type_and_shape(dtype, shape) -> None:
    data = make_rows(EPISODE, SUCCESS)
    data["next"] = data["next"].apply(lambda leaf: leaf.to(dtype).reshape(shape))
    found = select_successful(data)
    assert found["row"].tolist() == [0, 2]
    done = found["next", "done"]
    assert done.dtype == dtype and done.shape == data["next", "done"][:2].shape
    assert flags(found, "done") == [0, 1]


def test_what_ended_before_is_not_truncated() -> None:
    data = make_rows([0, 0, 1, 1], [False, True, True, False])
    for name in ("done", "terminated"):
        data["next", name][1] = True
    found = select_successful(data)
    assert found["row"].tolist() == [0, 1, 2]
    assert flags(found, "done") == [0, 1, 1]
    assert flags(found, "terminated") == [0, 1, 0]
    assert flags(found, "truncated") == [0, 0, 1]


def test_end_flags_may_be_nested_and_alone() -> None:
    data = make_rows(EPISODE, SUCCESS)
    flag = data["next", "done"]
    data["next"] = {"agent": {"done": flag, "truncated": flag.clone()}}
    data["next", "info", "success"] = torch.tensor(SUCCESS)
    found = select_successful(
        data, ("next", "info", "success"), done_key=("next", "agent", "done")
    )
    assert flags(found, "agent", "done") == flags(found, "agent", "truncated") == [0, 1]
    alone = make_rows([0] * 6, SUCCESS).exclude("episode")
    alone["next", "done"][[2, 5]] = True  # two trajectories of three rows
    found = select_successful(alone, trajectory_key=None)
    assert found["row"].tolist() == [0, 1, 2, 3, 4]
    assert flags(found, "done") == [0, 0, 1, 0, 1]


def test_entries_of_all_kinds_are_kept() -> None:
    data = make_rows(EPISODE, SUCCESS)
    data["agents"] = TensorDict({"x": torch.rand(6, 3, 1)}, [6, 3])
    data["task"] = NonTensorStack(*[NonTensorData(f"task {n}") for n in range(6)])
    found = select_successful(data)
    assert found["agents"].batch_size == (2, 3)
    assert torch.equal(found["agents", "x"], data["agents", "x"][[0, 2]])
    assert list(found["task"]) == ["task 0", "task 2"]
    stack = LazyStackedTensorDict(*make_rows(EPISODE, SUCCESS).unbind(0))
    assert select_successful(stack)["row"].tolist() == [0, 2]


def test_memory_mapped_data_are_read_and_written(tmp_path) -> None:
    data = make_rows(EPISODE, SUCCESS).memmap_(tmp_path / "all")
    inside = select_successful(data)
    inside["row"][0] = 9  # a copy in memory
    assert data["row"].tolist() == list(range(6)) and not flags(data, "done")[2]
    select_successful(data, path=tmp_path / "part")
    found = load_transitions(tmp_path / "part")
    assert found["row"].tolist() == [0, 2] and flags(found, "truncated") == [0, 1]
    with pytest.raises(FileExistsError):
        select_successful(data, path=tmp_path / "part")


def test_many_rows_are_written_in_parts(tmp_path) -> None:
    number = torch.arange(200_000)
    success = number % 100 == 90
    data = make_rows((number // 100).tolist(), success.tolist())
    whole = select_successful(data)
    found = select_successful(data, path=tmp_path / "part")
    assert len(whole) == 182_000
    assert all(torch.equal(leaf, found[key]) for key, leaf in whole.items(True, True))


def test_numbers_are_compared() -> None:
    data = make_rows(EPISODE, SUCCESS)
    data["next", "reward"] = torch.tensor(SUCCESS).float() - 1.0
    found = select_successful(data, ("next", "reward"), above=-0.5)
    assert found["row"].tolist() == [0, 2]
    assert select_successful(data, above=0.5)["row"].tolist() == [0, 2]
    with pytest.raises(ValueError, match=r"values from -1 to 0.*pass above="):
        select_successful(data, ("next", "reward"))
    data["next", "reward"][3] = torch.nan
    with pytest.raises(ValueError, match=r"'reward'\) in row 3 is nan.*unknown"):
        select_successful(data, ("next", "reward"), above=-0.5)
    with pytest.raises(ValueError, match="above is nan"):
        select_successful(data, above=float("nan"))
    with pytest.raises(TypeError, match="above must be a number, got '0'"):
        select_successful(data, above="0")


def test_other_data_are_refused() -> None:
    data = make_rows(EPISODE, SUCCESS)
    with pytest.raises(ValueError, match=r"batch size \[0\], no transitions"):
        select_successful(data[:0])
    assert select_successful(data[2:3])["row"].tolist() == [2]
    rb = ReplayBuffer(storage=LazyTensorStorage(6))
    rb.extend(data)
    with pytest.raises(TypeError, match=r"ReplayBuffer.*from_replay_buffer"):
        select_successful(rb)
    with pytest.raises(ValueError, match=r"trajectories must be .* at least 1, got 0"):
        select_successful(data, trajectories=0)
    with pytest.raises(KeyError, match="name the one they have with key="):
        select_successful(data, "solved")
    with pytest.raises(ValueError, match=r"\[6, 2\], expected \[T\] or \[T, 1\]"):
        select_successful(data, "action")
