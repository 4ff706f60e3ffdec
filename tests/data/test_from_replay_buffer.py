from __future__ import annotations

import logging

import minari
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from minari.data_collector import EpisodeBuffer
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyStackStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.data.datasets import MinariExperienceReplay

from torchrl_caiac.data import (
    action_bounds,
    from_replay_buffer,
    load_transitions,
    write_transitions,
)


def transitions(lengths, seed=0, ids=None):
    """Transitions of trajectories, one after another."""
    rng = np.random.default_rng(seed)
    parts = []
    for number, length in enumerate(lengths):
        states = torch.from_numpy(rng.normal(size=(length + 1, 3)))
        last = torch.arange(length)[:, None] == length - 1
        terminated = last & (number % 2 == 0)
        parts.append(
            TensorDict(
                {
                    "observation": states[:-1],
                    "action": torch.from_numpy(rng.normal(size=(length, 2))),
                    "episode": torch.full(
                        (length,), number if ids is None else ids[number]
                    ),
                    "log_prob": torch.from_numpy(rng.normal(size=length)),
                    "done": torch.zeros(length, 1, dtype=torch.bool),
                    "next": {
                        "observation": states[1:],
                        "reward": torch.from_numpy(rng.normal(size=(length, 1))),
                        "terminated": terminated,
                        "truncated": last & ~terminated,
                        "done": last,
                    },
                },
                [length],
            )
        )
    return torch.cat(parts)


def assert_same(data, expected):
    """The rows are those of transitions [T], which are sorted."""
    assert len(data) == len(expected)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        assert torch.equal(data[key], expected[key].float()), key
    for key in ("terminated", "truncated", "done"):
        assert torch.equal(data["next", key], expected["next", key])
    _, ids = expected["episode"].unique_consecutive(return_inverse=True)
    assert torch.equal(data["episode"], ids)
    assert torch.equal(data["info", "log_prob"], expected["log_prob"])
    assert torch.equal(data["info", "episode"], expected["episode"])


@pytest.mark.parametrize("kind", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("room", [0, 5])
def test_a_buffer(kind, room, tmp_path):
    rows = transitions([4, 1, 6])
    rb = TensorDictReplayBuffer(storage=kind(len(rows) + room), batch_size=4)
    rb.extend(rows)
    data = from_replay_buffer(rb, tmp_path / "a", progress=False)
    assert_same(data, rows)
    assert data["info", "log_prob"].dtype == torch.float64
    assert set(data.keys()) - {"info", "next"} == {
        "observation",
        "action",
        "episode",
    }
    again = from_replay_buffer(rb, tmp_path / "a", progress=False)
    assert (again == data).all()
    assert (load_transitions(tmp_path / "a", verify=True) == data).all()
    storage = from_replay_buffer(rb.storage, tmp_path / "b", progress=False)
    assert (storage == data).all()


@settings(max_examples=30, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 5), min_size=1, max_size=6),
    capacity=st.integers(1, 30),
    sizes=st.lists(st.integers(1, 4), min_size=30, max_size=30),
)
def test_a_ring_gives_the_newest_rows_in_order(
    lengths, capacity, sizes, tmp_path_factory
):
    rows = transitions(lengths)
    rb = ReplayBuffer(storage=LazyTensorStorage(capacity))
    done = 0
    for size in sizes:
        if done < len(rows):
            rb.extend(rows[done : done + min(size, capacity)])
            done += min(size, capacity)
    if done < len(rows):
        return
    path = tmp_path_factory.mktemp("ring") / "a"
    expected = rows[-capacity:].clone()
    assert_same(from_replay_buffer(rb, path, progress=False), expected)


def test_several_environments_and_ids_of_a_collector(tmp_path):
    first, second = transitions([6], seed=1), transitions([2, 4], seed=2)
    rb = ReplayBuffer(storage=LazyTensorStorage(12, ndim=2), dim_extend=0)
    both = torch.stack([first, second], 1).exclude("episode")
    both["collector", "traj_ids"] = torch.tensor(
        [[0, 0, 0, 0, 0, 0], [1, 1, 2, 2, 2, 2]]
    ).T
    rb.extend(both)
    data = from_replay_buffer(rb, tmp_path / "a", progress=False)
    expected = torch.cat([first, second])
    assert torch.equal(data["observation"], expected["observation"].float())
    assert data["episode"].tolist() == [0] * 6 + [1] * 2 + [2] * 4
    assert data["info", "collector", "traj_ids"].tolist() == data["episode"].tolist()


def test_interleaved_trajectories_are_sorted(tmp_path):
    rows = transitions([3, 3], ids=[7, 5])
    mixed = rows[torch.tensor([0, 3, 1, 4, 2, 5])]
    assert_same(from_replay_buffer(mixed, tmp_path / "a", progress=False), rows)


def test_data_with_end_flags_alone(tmp_path):
    rows = transitions([2, 3]).exclude(
        "episode", ("next", "terminated"), ("next", "truncated")
    )
    data = from_replay_buffer(rows, tmp_path / "a", progress=False)
    assert data["episode"].tolist() == [0, 0, 1, 1, 1]
    # As in TorchRL, done counts as terminated.
    assert torch.equal(data["next", "terminated"], rows["next", "done"])
    assert not data["next", "truncated"].any()


def test_other_keys_goals_and_bounds(tmp_path):
    rows = transitions([4, 2])
    rows["achieved_goal"] = torch.ones(6, 2)
    rows["next", "achieved_goal"] = torch.zeros(6, 2)
    stored = write_transitions(
        rows.exclude("done"), tmp_path / "source", action_bounds=([-3, -3], [3, 3])
    )
    data = from_replay_buffer(stored, tmp_path / "a", progress=False)
    assert not data["next", "achieved_goal"].any()
    assert data["achieved_goal"].all()
    assert torch.equal(action_bounds(data)[1], torch.tensor([3.0, 3.0]))
    renamed = TensorDict(
        {
            "state": {"arm": rows["observation"]},
            "control": rows["action"],
            "run": rows["episode"],
            "phase": torch.arange(6).to(torch.uint16),
            "next": {
                "state": {"arm": rows["next", "observation"]},
                "gain": rows["next", "reward"],
                "over": rows["next", "done"],
            },
        },
        [6],
    )
    data = from_replay_buffer(
        renamed,
        tmp_path / "b",
        observation_key="state",
        action_key="control",
        reward_key="gain",
        trajectory_key="run",
        done_key=("next", "over"),
        progress=False,
    )
    assert torch.equal(
        data["next", "state", "arm"], rows["next", "observation"].float()
    )
    assert torch.equal(data["next", "reward"], rows["next", "reward"].float())
    assert data["info", "phase"].dtype == torch.int32
    assert ("next", "over") not in data.keys(True)


class TestDatasetsOfTorchRL:
    @pytest.fixture
    def replay(self, tmp_path, monkeypatch):
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
        rng = np.random.default_rng(0)
        minari.create_dataset_from_buffers(
            "caiac/zeros-v0",
            [
                EpisodeBuffer(
                    observations=rng.normal(size=(5, 3)),
                    actions=rng.normal(size=(4, 2)),
                    rewards=rng.normal(size=4),
                    terminations=np.zeros(4, bool),
                    truncations=np.arange(4) == 3,
                )
            ]
            * 2,
            observation_space=spaces.Box(-9, 9, (3,), np.float64),
            action_space=spaces.Box(-9, 9, (2,), np.float64),
        )
        return MinariExperienceReplay(
            "caiac/zeros-v0",
            batch_size=4,
            root=tmp_path / "torchrl",
            load_from_local_minari=True,
        )

    def test_the_zeros_of_minari_are_refused(self, replay, tmp_path):
        with pytest.raises(ValueError, match=r"zero in all of 8 rows.*use load_minari"):
            from_replay_buffer(replay, tmp_path / "a", progress=False)
        assert not (tmp_path / "a").exists()

    @pytest.mark.parametrize("key", ["observation", "action"])
    def test_zeros_in_one_of_them_are_refused(self, key, tmp_path):
        rows = transitions([4, 3])
        rows[key].zero_()
        with pytest.raises(ValueError, match=f"'{key}' of the source is zero in all"):
            from_replay_buffer(rows, tmp_path / "a", progress=False)

    def d4rl(self):
        """As D4RLExperienceReplay: without ids, zeros after each end."""
        rows = transitions([4, 3, 5]).exclude("episode")
        rows["next", "observation"][rows["next", "done"][:, 0]] = 0
        rows["done"][1:] = rows["next", "done"][:-1].clone()
        return rows

    def test_unknown_next_observations_are_left_out(self, tmp_path, caplog):
        rows = self.d4rl()
        data = from_replay_buffer(rows, tmp_path / "a", progress=False)
        assert "3 of 12 rows have a next observation of zeros" in caplog.text
        assert "cut there" not in caplog.text
        kept = rows[~rows["next", "done"][:, 0]]
        assert torch.equal(data["observation"], kept["observation"].float())
        assert torch.equal(
            data["next", "observation"], kept["next", "observation"].float()
        )
        assert data["episode"].tolist() == [0] * 3 + [1] * 2 + [2] * 4
        assert not data["next", "terminated"].any()
        assert data["next", "done"].sum() == 3
        data = from_replay_buffer(
            rows, tmp_path / "b", unknown_next="keep", progress=False
        )
        assert len(data) == 12

    def test_roboset(self, tmp_path, caplog):
        """As RobosetExperienceReplay: equal ids of two seeds, without end flags."""
        rows = transitions([4, 3, 5], ids=[0, 0, 1])
        for key in ("terminated", "truncated", "done"):
            rows["next", key].zero_()
        rows["seed"] = torch.tensor([0] * 4 + [1] * 3 + [0] * 5)
        rows["info"] = TensorDict({"x": torch.ones(12)}, [12])
        rows["next", "info"] = TensorDict({"x": torch.ones(12)}, [12])
        rows["next", "observation"][[3, 6, 11]] = 0
        data = from_replay_buffer(rows, tmp_path / "a", progress=False)
        assert "3 of 12 rows" in caplog.text
        assert "1 trajectories are cut there" in caplog.text
        assert data["episode"].tolist() == [0] * 3 + [1] * 2 + [2] * 4
        assert data["info", "x"].all()
        assert ("next", "info") not in data.keys(True)
        assert data["info", "seed"].tolist() == [0] * 3 + [1] * 2 + [0] * 4

    def test_zeros_that_the_next_row_confirms_are_true(self, tmp_path, caplog):
        rows = transitions([4])
        rows["observation"][2] = 0
        rows["next", "observation"][1] = 0
        data = from_replay_buffer(rows, tmp_path / "a", progress=False)
        assert len(data) == 4
        assert not caplog.records

    def test_zeros_everywhere_next(self, tmp_path):
        rows = transitions([4])
        rows["next", "observation"].zero_()
        with pytest.raises(ValueError, match="no row of the source has a next"):
            from_replay_buffer(rows, tmp_path / "a", progress=False)

    def test_padded_trajectories_are_refused(self, tmp_path):
        rows = torch.stack([transitions([3]), transitions([3])])
        rows["mask"] = torch.ones(2, 3, dtype=torch.bool)
        rb = ReplayBuffer(storage=LazyTensorStorage(2))
        rb.extend(rows)
        with pytest.raises(ValueError, match="split_trajs=False"):
            from_replay_buffer(rb, tmp_path / "a", progress=False)


class TestRefused:
    @pytest.mark.parametrize(
        ("change", "error", "match"),
        [
            (lambda r: r.exclude("action"), KeyError, "lacks .*action.*action_key="),
            (lambda r: r.exclude("observation"), KeyError, "lacks .*observation"),
            (
                lambda r: r.exclude(("next", "observation")),
                KeyError,
                r"lacks \(.*next.*, .*observation",
            ),
            (lambda r: r[:0], ValueError, "the source is empty"),
            (lambda r: r.reshape(1, 5), ValueError, "expected \\[T\\]"),
            (lambda r: r.set("text", "a"), ValueError, "'text' of the source"),
            (
                lambda r: r.set("steps_to_next_obs", torch.full((5,), 2)),
                ValueError,
                "several steps",
            ),
            (
                lambda r: r.set("action", r["action"] * torch.nan),
                ValueError,
                "'action' of trajectory 0 .* NaN",
            ),
            (
                lambda r: r.set("action", r["action"] * 1e300),
                ValueError,
                "'action' of trajectory 0 .* infinite",
            ),
            (
                lambda r: r.set(("next", "reward"), torch.ones(5, 2)),
                ValueError,
                r"\('next', 'reward'\) of .* shape",
            ),
            (
                lambda r: r.set(("next", "terminated"), torch.ones(5, 1).bool()),
                ValueError,
                r"terminated or truncated, but \('next', 'done'\) is not set",
            ),
        ],
    )
    def test_data(self, change, error, match, tmp_path):
        with pytest.raises(error, match=match):
            from_replay_buffer(
                change(transitions([2, 3])), tmp_path / "a", progress=False
            )
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize(
        ("rows", "row", "follows"),
        [
            ([3, 1, 0, 2, 4, 5], 1, 0),
            ([5, 4, 3, 2, 1, 0], 1, 0),
            ([0, 1, 2, 4, 5], 3, 2),  # a gap
            ([0, 1, 2, 3, 3, 4, 5], 4, 3),  # twice
            ([0, 1, 2, 3, 4, 5, 0, 1], 6, 5),  # the id comes back
        ],
    )
    @pytest.mark.parametrize("nested", [False, True])
    def test_rows_that_do_not_follow_each_other(
        self, rows, row, follows, nested, tmp_path
    ):
        data = transitions([6])
        for name in ("terminated", "truncated", "done"):
            data["next", name].zero_()
        if nested:
            for root in (data, data["next"]):
                root["observation"] = TensorDict({"x": root["observation"]}, [6])
        given = from_replay_buffer(data, tmp_path / "whole", progress=False)
        assert len(given) == 6
        with pytest.raises(
            ValueError, match=f"row {row} of the source does not follow row {follows},"
        ):
            from_replay_buffer(data[torch.tensor(rows)], tmp_path / "a", progress=False)
        assert not (tmp_path / "a").exists()

    def test_an_id_that_comes_back(self, tmp_path):
        data = transitions([6])
        for name in ("terminated", "truncated", "done"):
            data["next", name].zero_()
        data["episode"] = torch.tensor([0, 0, 1, 1, 0, 0])
        with pytest.raises(ValueError, match=r"row 4 .* does not follow row 1,"):
            from_replay_buffer(data, tmp_path / "a", progress=False)
        data["next", "done"][1] = data["next", "truncated"][1] = True
        data = from_replay_buffer(data, tmp_path / "a", progress=False)
        assert data["episode"].tolist() == [0, 0, 1, 1, 2, 2]

    def test_a_gap_in_a_later_part_of_a_long_trajectory(self, tmp_path):
        data = transitions([40_000])
        data["next", "observation"][16_383] += 1  # the last row of a part
        with pytest.raises(ValueError, match=r"row 16384 .* does not follow row 16383"):
            from_replay_buffer(data, tmp_path / "a", progress=False)

    def test_sources(self, tmp_path):
        for source, error, match in (
            ([1, 2], TypeError, "is a list, expected a replay buffer"),
            (ReplayBuffer(storage=ListStorage(5)), TypeError, "is a ListStorage"),
            (ReplayBuffer(storage=LazyStackStorage(5)), TypeError, "LazyStackStorage"),
            (ReplayBuffer(storage=LazyTensorStorage(5)), ValueError, "is empty"),
        ):
            with pytest.raises(error, match=match):
                from_replay_buffer(source, tmp_path / "a")

    def test_arguments(self, tmp_path):
        rows = transitions([3])
        with pytest.raises(ValueError, match="unknown_next is 'fill'"):
            from_replay_buffer(rows, tmp_path / "a", unknown_next="fill")
        with pytest.raises(KeyError, match=r"absent.*correct exclude="):
            from_replay_buffer(rows, tmp_path / "a", exclude=["absent"])
        rows["name"] = "cup"
        data = from_replay_buffer(
            rows, tmp_path / "a", exclude=["name", "log_prob"], progress=False
        )
        assert "log_prob" not in data["info"]
        rows["observation"] += 1
        rows["next", "observation"] += 1
        with pytest.raises(FileExistsError, match=r"'observation'.*overwrite=True"):
            from_replay_buffer(
                rows, tmp_path / "a", exclude=["name", "log_prob"], progress=False
            )


def test_rounding_and_goals_of_hindsight_are_no_gaps(tmp_path):
    rows = transitions([5, 3])
    rows["next", "observation"] = rows["next", "observation"].half().double()
    rows["observation"] = rows["observation"].half()
    rows["desired_goal"], rows["next", "desired_goal"] = torch.rand(2, 8, 2)
    assert len(from_replay_buffer(rows, tmp_path / "a", progress=False)) == 8
    for root in (rows, rows["next"]):
        names = ("observation", "desired_goal")
        root["state"] = root.select(*names)
    data = from_replay_buffer(
        rows, tmp_path / "b", observation_key="state", progress=False
    )
    assert len(data) == 8


def test_long_trajectories_are_read_in_parts(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    rows = transitions([40_000, 3])
    data = from_replay_buffer(rows, tmp_path / "a", progress=False)
    assert_same(data, rows)
