from __future__ import annotations

import functools
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from torchrl_caiac.data import (
    action_bounds,
    load_transitions,
    mix_trajectories,
)
from torchrl_caiac.envs import FetchPushCubes, random_transitions
from torchrl_caiac.envs.fetch_push import RestorableFetchPush
from torchrl_caiac.envs.random_transitions import random_episodes

OPTIONS: dict[str, Any] = {"num_workers": 1, "progress": False}
STATES = np.linspace([-1.0, 0.5, 0.0], [1.0, -0.5, 2.0], 7)


class Point:
    """A point that an action moves; the third number of a state has no effect."""

    def __init__(self, end: float = np.inf) -> None:
        self.action_space = gymnasium.spaces.Box(-2.0, 3.0, (2,), np.float32)
        self.end = end
        self.noise = np.random.default_rng(0)

    def seed(self, seed: int) -> None:
        self.noise = np.random.default_rng(seed)

    def restore(self, state):
        self.state = np.array(state)
        return self.state[:2]

    def step(self, action):
        assert action.dtype == np.float32
        self.state[:2] += action
        over = bool(np.abs(self.state[:2]).max() > self.end)
        return self.state[:2], -1.0, over, False, {}

    def record(self):
        return {"state": self.state}


class Goals(Point):
    """Observes a mapping, has no rewards and records nothing."""

    has_rewards = False
    record = None

    def _observe(self, place):
        return {"observation": place, "goal": self.noise.normal(size=1)}

    def restore(self, state):
        return self._observe(super().restore(state))

    def step(self, action):
        place, *rest = super().step(action)
        return self._observe(place), *rest


def test_rows_follow_the_actions_from_the_states():
    rows = random_transitions(Point, STATES, 3, steps=2, states_per_file=4, **OPTIONS)
    assert rows.batch_size == (7 * 3 * 2,)
    assert rows["episode"].tolist() == np.repeat(np.arange(21), 2).tolist()
    states = torch.from_numpy(STATES[:, :2]).float().repeat_interleave(3, 0)
    assert torch.equal(rows["observation"][::2], states)
    assert torch.equal(rows["observation"][1::2], rows["next", "observation"][::2])
    moved = rows["next", "observation"] - rows["observation"]
    torch.testing.assert_close(moved, rows["action"])
    assert rows["next", "done"].flatten().tolist() == [False, True] * 21
    assert torch.equal(rows["next", "done"], rows["next", "truncated"])
    assert not rows["next", "terminated"].any()
    assert (rows["next", "reward"] == -1).all()
    assert rows["info", "state"].dtype == torch.float64
    assert np.array_equal(rows["info", "state"][::6], STATES)


def test_actions_are_uniform_in_the_box_and_differ():
    rows = random_transitions(Point, STATES, 400, **OPTIONS)
    action = rows["action"].double()
    assert action.min() >= -2 and action.max() <= 3
    assert len(action.unique(dim=0)) == len(action)
    # Of a uniform distribution: mean 0.5 and deviation 5 / sqrt(12).
    assert (action.mean(0) - 0.5).abs().max() < 5 * 1.45 / np.sqrt(len(action))
    assert (action.std(0) - 5 / np.sqrt(12)).abs().max() < 0.1


def test_equal_seeds_give_equal_rows():
    rows = random_transitions(Point, STATES, 2, states_per_file=2, seed=4, **OPTIONS)
    again = random_transitions(Point, STATES, 2, states_per_file=2, seed=4, **OPTIONS)
    other = random_transitions(Point, STATES, 2, states_per_file=2, **OPTIONS)
    assert (rows == again).all()
    assert not np.isin(rows["action"], other["action"]).any()


def test_trajectories_may_terminate():
    env = functools.partial(Point, 2.5)
    rows = random_transitions(env, STATES, 5, steps=4, **OPTIONS)
    ends = rows["next", "done"].flatten().nonzero().flatten()
    ids = rows["episode"]
    assert ids[ends].tolist() == list(range(35))
    assert ids.diff().min() == 0 and ids.diff().max() == 1
    over = rows["next", "observation"].abs().amax(1) > 2.5
    assert torch.equal(over, rows["next", "terminated"].flatten())
    assert over.any() and not over.all()


def test_mappings_become_entries_and_rewards_may_be_missing():
    rows = random_transitions(Goals, STATES, states_per_file=3, **OPTIONS)
    assert set(rows.keys(True, True)) == {
        "action",
        "episode",
        "goal",
        "observation",
        ("next", "done"),
        ("next", "goal"),
        ("next", "observation"),
        ("next", "terminated"),
        ("next", "truncated"),
    }
    # seed() was called: the noise of two files differs from that of seed 0.
    assert not np.isin(rows["goal"], np.random.default_rng(0).normal(size=4)).any()


def test_recorded_observations_replace_those_of_the_restored_states():
    given = STATES[:, :2] + 10
    rows = random_transitions(
        Point, STATES, 2, steps=2, observations=given, info_key=None, **OPTIONS
    )
    known = torch.from_numpy(given).float().repeat_interleave(2, 0)
    assert torch.equal(rows["observation"][::2], known)
    assert torch.equal(rows["observation"][1::2], rows["next", "observation"][::2])
    assert "info" not in rows


def test_a_folder_has_bounds_and_is_mixed_with_other_data(tmp_path):
    rows = random_transitions(Point, STATES, path=tmp_path / "data", **OPTIONS)
    assert rows.is_memmap()
    assert (load_transitions(tmp_path / "data") == rows).all()
    low, high = action_bounds(rows)
    assert (low.tolist(), high.tolist()) == ([-2.0, -2.0], [3.0, 3.0])
    mixed = mix_trajectories([rows, random_transitions(Point, STATES, **OPTIONS)])
    assert len(mixed) == 14
    with pytest.raises(FileExistsError, match="overwrite=True"):
        random_transitions(Point, STATES, path=tmp_path / "data", **OPTIONS)


def test_an_interrupted_call_resumes_with_its_own_parts_only(tmp_path, monkeypatch):
    options = {**OPTIONS, "states_per_file": 2, "work": tmp_path / "work"}
    whole = random_transitions(Point, STATES, states_per_file=2, **OPTIONS)

    restore, calls = Point.restore, []

    def interrupted(self, state):
        calls.append(state)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return restore(self, state)

    with monkeypatch.context() as patch:
        patch.setattr(Point, "restore", interrupted)
        with pytest.raises(KeyboardInterrupt):
            random_transitions(Point, STATES, **options)
    calls.clear()
    rows = random_transitions(Point, STATES, **options)
    assert (rows == whole).all()
    with pytest.raises(ValueError, match="other states"):
        random_transitions(Point, STATES + 1, **options)
    with pytest.raises(ValueError, match="another collection"):
        random_transitions(Point, STATES, 2, **options)
    with pytest.raises(ValueError, match="another collection"):
        random_transitions(Goals, STATES, **options)
    with pytest.raises(TypeError, match="cannot be pickled"):
        random_transitions(lambda: Point(), STATES, **options)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"states": np.zeros(3)}, r"states have shape \(3,\)"),
        ({"states": np.zeros((0, 3))}, "states have shape"),
        (
            {"states": [[0.0, np.nan, 0.0]]},
            "non-finite values in 1 rows, the first at 0",
        ),
        ({"actions_per_state": 0}, "actions_per_state is 0"),
        ({"steps": 0}, "steps is 0"),
        ({"states_per_file": 0}, "states_per_file is 0"),
        ({"observations": STATES[:3, :2]}, r"observations have shape \(3, 2\)"),
        ({"observations": STATES}, "the environment's are"),
        ({"env": functools.partial(gymnasium.make, "Acrobot-v1")}, "Discrete"),
    ],
)
def test_bad_input(change, match, tmp_path):
    arguments = {"env": Point, "states": STATES, **change}
    with pytest.raises(ValueError, match=match):
        random_transitions(
            arguments.pop("env"),
            arguments.pop("states"),
            path=tmp_path / "data",
            **arguments,
            **OPTIONS,
        )
    assert not list(tmp_path.iterdir())


def test_unbounded_actions_are_refused():
    env = Point()
    env.action_space = gymnasium.spaces.Box(-np.inf, 1, (2,))
    with pytest.raises(ValueError, match="expected finite ones"):
        next(random_episodes(env, STATES, steps=1, rng=np.random.default_rng(0)))


def test_fetch_push_continues_from_the_recorded_state():
    env = FetchPushCubes(2)
    env.reset(seed=0)
    states = []
    for _ in range(3):
        env.step(np.full(4, 0.3))
        states.append(env.simulator_state())
    rows = random_transitions(RestorableFetchPush, states, 2, **OPTIONS)
    assert np.array_equal(rows["info", "simulator"][::2], states)
    for row in rows:
        [expected] = env.outcomes(row["info", "simulator"], row["action"][None])
        found = row["next", "observation"].numpy()
        assert np.array_equal(found, expected.astype(np.float32))
    assert rows["desired_goal"].shape == (6, 6)
