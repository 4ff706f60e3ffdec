"""Augmented datasets against what their definition says, row by row."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from tests.augment.conftest import GOALS, TOLERANCE, score, with_goals
from tests.pushes import LAYOUT, push_transitions
from torchrl_caiac.augment import augment_dataset, needs_reward
from torchrl_caiac.data import (
    action_bounds,
    load_transitions,
    verify_digests,
    write_digests,
)
from torchrl_caiac.scored import ScoredDataset
from torchrl_caiac.trajectories import trajectory_index


def flags(data: TensorDict) -> torch.Tensor:
    return data["caiac", "counterfactual"].squeeze(-1)


def transition_rows(
    data: TensorDict, columns: list[int]
) -> dict[tuple[float, ...], list[int]]:
    """Where each pair of a state and a next state of some columns occurs."""
    pair = torch.cat(
        [data["observation"][:, columns], data["next", "observation"][:, columns]], -1
    )
    found: dict[tuple[float, ...], list[int]] = {}
    for row, values in enumerate(pair.tolist()):
        found.setdefault(tuple(values), []).append(row)
    return found


def check_rows(scored: ScoredDataset, made: TensorDict) -> None:
    """Each entity of a counterfactual row is its own, or one that was uninfluenced."""
    free = scored.is_free
    hands = transition_rows(scored.data, [0, 1])
    homes = {n: transition_rows(scored.data, list(LAYOUT.columns[n])) for n in homes_of}
    for row in flags(made).nonzero()[:, 0].tolist():
        state, after = made["observation"][row], made["next", "observation"][row]
        own = hands[tuple(torch.cat([state[:2], after[:2]]).tolist())]
        assert any(
            torch.equal(made["action"][row], scored.data["action"][o]) for o in own
        )
        for place, name in ((1, "cup"), (2, "box")):
            columns = list(LAYOUT.columns[name])
            values = tuple(torch.cat([state[columns], after[columns]]).tolist())
            found = homes[name][values]
            if made["caiac", "swapped"][row, place]:
                assert any(free[f, place] for f in found)
                assert any(free[o, place] for o in own)
            else:
                assert set(found) & set(own)


homes_of = ("cup", "box")


def test_transitions(plain: ScoredDataset, tmp_path: Path) -> None:
    made = augment_dataset(plain, tmp_path / "made", 0.4, progress=False)
    assert len(made) == 240 + 160 and int(flags(made).sum()) == 160
    for key in ("observation", "action", ("next", "observation"), ("next", "done")):
        assert torch.equal(made[key][:240], plain.data[key])
    assert made["caiac", "swapped"][240:].any(-1).all()
    assert not made["caiac", "swapped"][:, 0].any()
    assert not made["caiac", "swapped"][:240].any()
    check_rows(plain, made)
    # Each counterfactual transition is an episode of one step, that was cut off.
    assert made["episode"][240:].tolist() == list(range(6, 166))
    assert made["next", "truncated"][240:].all() and made["next", "done"][240:].all()
    assert len(trajectory_index(made).ends) == 6 + 160


def test_trajectories(plain: ScoredDataset, tmp_path: Path) -> None:
    made = augment_dataset(
        plain, tmp_path / "made", 0.5, kind="trajectories", progress=False
    )
    index, before = trajectory_index(made), trajectory_index(plain.data)
    assert len(index.ends) == 12
    check_rows(plain, made)
    free = plain.is_free
    starts, lengths = before.starts.tolist(), before.lengths.tolist()
    for start, length in zip(
        index.starts[6:].tolist(), index.lengths[6:].tolist(), strict=True
    ):
        rows = slice(start, start + length)
        # Next states are the states of the following rows, as in a recording.
        assert torch.equal(
            made["next", "observation"][rows][:-1], made["observation"][rows][1:]
        )
        swapped = made["caiac", "swapped"][rows]
        assert (swapped == swapped[0]).all() and swapped.any()
        own = [
            e
            for e in range(6)
            if lengths[e] == length
            and torch.equal(
                made["action"][rows], plain.data["action"][starts[e] :][:length]
            )
        ]
        assert own
        for place, name in ((1, "cup"), (2, "box")):
            columns = list(LAYOUT.columns[name])
            donors = [
                e
                for e in range(6)
                if lengths[e] >= length
                and torch.equal(
                    made["observation"][rows][:, columns],
                    plain.data["observation"][starts[e] :][:length, columns],
                )
            ]
            if swapped[0, place]:
                (donor,) = donors
                assert donor not in own
                assert free[starts[donor] :][:length, place].all()
                assert free[starts[own[0]] :][:length, place].all()
            else:
                assert donors == own


def test_counterfactuals_alone(plain: ScoredDataset, tmp_path: Path) -> None:
    made = augment_dataset(
        plain, tmp_path / "made", 0.5, originals=False, progress=False
    )
    assert len(made) == 240 and flags(made).all()
    assert made["episode"].tolist() == list(range(240))


@pytest.mark.parametrize("kind", ["transitions", "trajectories"])
def test_ids_are_those_of_no_original(
    plain: ScoredDataset, tmp_path: Path, kind: str
) -> None:
    data = plain.data.exclude("caiac").to_tensordict()
    data["episode"] = torch.tensor([3, 9, 4, 70, -5, 8])[data["episode"]]
    scored = score(tmp_path / "others", data, LAYOUT)
    made = augment_dataset(scored, tmp_path / "made", kind=kind, progress=False)
    assert torch.equal(made["episode"][:240], data["episode"])
    new = made["episode"][240:].unique()
    assert new.tolist() == list(range(71, 71 + len(new)))
    assert len(trajectory_index(made).ends) == 6 + len(new)


def test_no_room_for_more_ids(plain: ScoredDataset, tmp_path: Path) -> None:
    data = plain.data.exclude("caiac").to_tensordict()
    data["episode"] += 2**63 - 100
    scored = score(tmp_path / "others", data, LAYOUT)
    with pytest.raises(ValueError, match="cannot hold the 240 ids that follow"):
        augment_dataset(scored, tmp_path / "made", progress=False)


@pytest.mark.parametrize("kind", ["transitions", "trajectories"])
def test_goals_and_rewards_follow(
    goals: ScoredDataset, tmp_path: Path, kind: str
) -> None:
    made = augment_dataset(
        goals, tmp_path / "made", kind=kind, reward="sparse", progress=False
    )
    columns = [2, 4]
    assert torch.equal(made["achieved_goal"], made["observation"][:, columns])
    after = made["next", "observation"][:, columns]
    assert torch.equal(made["next", "achieved_goal"], after)
    near = ((after - made["desired_goal"]).abs() <= TOLERANCE).all(-1)
    assert torch.equal(made["next", "reward"].squeeze(-1), near.float() - 1)
    kept = augment_dataset(
        goals, tmp_path / "kept", kind=kind, reward="stored", progress=False
    )
    assert torch.equal(kept["desired_goal"], made["desired_goal"])
    assert not torch.equal(kept["next", "reward"], made["next", "reward"])


def ending_tasks() -> TensorDict:
    """Episodes that end in the first row that reaches the goals, if any does."""
    data = with_goals(push_transitions((40, 30, 50, 40, 35, 45) * 4))
    reached = data["next", "reward"].squeeze(-1) == 0
    kept = []
    for rows in torch.arange(len(data)).split((40, 30, 50, 40, 35, 45) * 4):
        hits = reached[rows].nonzero()[:, 0]
        kept.append(rows[: int(hits[0]) + 1] if len(hits) else rows)
    ends = torch.tensor([int(rows[-1]) for rows in kept])
    data["next", "done"][ends] = True
    data["next", "terminated"] = data["next", "done"] & reached.unsqueeze(-1)
    data["next", "truncated"] = data["next", "done"] & ~data["next", "terminated"]
    return data[torch.cat(kept)].clone()


@pytest.mark.parametrize("kind", ["transitions", "trajectories"])
@pytest.mark.filterwarnings("error")
def test_ends_of_the_task_follow_the_goals(tmp_path: Path, kind: str) -> None:
    data = ending_tasks()
    scored = score(tmp_path / "scored", data, GOALS)
    assert int(data["next", "terminated"].sum()) >= 5
    made = augment_dataset(
        scored, tmp_path / "made", 0.8, kind=kind, reward="sparse", progress=False
    )
    after = made["next"]
    gap = after["observation"][:, [2, 4]] - made["desired_goal"]
    near = (gap.abs() <= TOLERANCE).all(-1, keepdim=True)
    assert torch.equal(after["terminated"], near)
    assert torch.equal(after["reward"], near.float() - 1)
    last = torch.ones(len(made), 1, dtype=torch.bool)
    last[:-1, 0] = made["episode"].diff() != 0
    assert torch.equal(after["done"], last)
    assert torch.equal(after["truncated"], last & ~near)
    # Some ends of originals are no ends any more.
    new = made[flags(made)]
    assert new["next", "truncated"].any() and new["next", "terminated"].any()
    if kind == "trajectories":
        inside = ~last[:-1, 0]
        assert torch.equal(
            after["observation"][:-1][inside], made["observation"][1:][inside]
        )


def test_ends_of_the_task_that_do_not_follow_from_the_goals(
    goals: ScoredDataset, tmp_path: Path
) -> None:
    data = goals.data.exclude("caiac").to_tensordict()
    data["next", "terminated"] = data["next", "done"].clone()
    data["next", "truncated"].zero_()
    scored = score(tmp_path / "ends", data, GOALS)
    before = {path.name for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match="rows that reach them do not end it"):
        augment_dataset(scored, tmp_path / "made", reward="sparse", progress=False)
    assert {path.name for path in tmp_path.iterdir()} == before
    kept = augment_dataset(scored, tmp_path / "made", reward="stored", progress=False)
    assert kept["next", "terminated"].any()


def test_rewards_must_be_chosen(goals: ScoredDataset, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'stored' rewards, or get 'sparse'"):
        augment_dataset(goals, tmp_path / "made", progress=False)
    with pytest.raises(ValueError, match=r"expected at least 99\.9%"):
        augment_dataset(
            goals, tmp_path / "made", reward="sparse", tolerance=0.01, progress=False
        )
    assert not (tmp_path / "made").exists()


def test_rewards_without_goals_in_the_data_are_kept(
    plain: ScoredDataset, tmp_path: Path
) -> None:
    data = plain.data.exclude("caiac").to_tensordict()
    data["next", "reward"] = torch.rand(len(data), 1)
    scored = score(tmp_path / "rewarded", data, GOALS)
    assert not needs_reward(scored)
    made = augment_dataset(scored, tmp_path / "made", progress=False)
    assert torch.isin(made["next", "reward"], data["next", "reward"]).all()


def test_what_does_not_follow_is_left_out(goals: ScoredDataset, tmp_path: Path) -> None:
    made = augment_dataset(goals, tmp_path / "made", reward="stored", progress=False)
    assert ("info", "step") in goals.data.keys(True)
    expected = {
        "observation", "action", "episode", "desired_goal", "achieved_goal",
        ("next", "observation"), ("next", "achieved_goal"), ("next", "reward"),
        ("next", "done"), ("next", "terminated"), ("next", "truncated"),
        ("caiac", "counterfactual"), ("caiac", "swapped"),
    }  # fmt: skip
    assert set(made.keys(True, True)) == expected


def test_the_folder_is_complete(plain: ScoredDataset, tmp_path: Path) -> None:
    augment_dataset(plain, tmp_path / "made", progress=False)
    verify_digests(tmp_path / "made")
    low, high = action_bounds(tmp_path / "made")
    assert (low.item(), high.item()) == (-1, 1)
    with pytest.raises(FileExistsError):
        augment_dataset(plain, tmp_path / "made", progress=False)


@pytest.mark.parametrize("kind", ["transitions", "trajectories"])
def test_the_same_seed_gives_the_same_data(
    plain: ScoredDataset, tmp_path: Path, kind: str
) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        augment_dataset(plain, tmp_path / name, kind=kind, seed=seed, progress=False)
    a, b, c = (load_transitions(tmp_path / name)["observation"] for name in "abc")
    assert torch.equal(a, b)
    assert a.shape != c.shape or not torch.equal(a, c)


@pytest.mark.parametrize("kind", ["transitions", "trajectories"])
def test_nothing_to_swap(plain: ScoredDataset, tmp_path: Path, kind: str) -> None:
    strict = ScoredDataset(**{**vars(plain), "thresholds": {"cup": -1.0, "box": -1.0}})
    with pytest.raises(ValueError, match=r"nothing was swapped|no trajectory has"):
        augment_dataset(strict, tmp_path / "made", kind=kind, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == ["scored"]


@pytest.mark.parametrize("ratio", [0.0, 1.0, -1.0, float("nan")])
def test_a_ratio_out_of_range(
    plain: ScoredDataset, tmp_path: Path, ratio: float
) -> None:
    with pytest.raises(ValueError, match="ratio must be between"):
        augment_dataset(plain, tmp_path / "made", ratio, progress=False)


@pytest.mark.parametrize("kind", ["transitions", "trajectories"])
def test_more_than_the_disk_has_space_for(
    plain: ScoredDataset, tmp_path: Path, kind: str
) -> None:
    with pytest.raises(OSError, match=r"at the ratio 0\.99.* GB left: lower the ratio"):
        augment_dataset(plain, tmp_path / "made", 1 - 1e-13, kind=kind, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == ["scored"]


def test_the_result_of_a_faster_call_stays(
    plain: ScoredDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tmp_path / "made"

    def slow(folder: Path, **options: object) -> None:
        write_digests(folder, **options)
        made.mkdir()
        (made / "other").touch()

    monkeypatch.setitem(augment_dataset.__globals__, "write_digests", slow)
    with pytest.raises(FileExistsError):
        augment_dataset(plain, made, progress=False)
    assert [p.name for p in made.iterdir()] == ["other"]
    assert {p.name for p in tmp_path.iterdir()} == {"made", "scored"}


@pytest.mark.parametrize("place", ["source", "source/more", "", "scored", "scored/a"])
def test_a_place_of_the_dataset_itself(
    plain: ScoredDataset, tmp_path: Path, place: str
) -> None:
    (tmp_path / "source").mkdir()
    source = {"source": str(tmp_path / "source")}
    scored = ScoredDataset(**{**vars(plain), "source": source})
    with pytest.raises(ValueError, match="write elsewhere"):
        augment_dataset(scored, tmp_path / place, overwrite=True, progress=False)
    assert {p.name for p in tmp_path.iterdir()} == {"source", "scored"}
