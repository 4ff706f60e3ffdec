from __future__ import annotations

import math
import pickle
from typing import ClassVar

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac import EntityLayout
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.envs.kitchen import KitchenEnv
from torchrl_caiac.envs.kitchen.expert import KitchenExpert
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.influence.estimator_digest import estimator_digest
from torchrl_caiac.influence.truth import (
    SimulatorInfluence,
    draw_actions,
    oracle_score,
    true_influence,
)


class Box:
    low, high = np.array([-1.0, -1.0]), np.array([1.0, 1.0])


class Table:
    """A hand drags a cup that it holds; a ball rolls on by itself.

    State: hand, cup, ball, ball velocity, held (0 or 1).
    """

    layout = EntityLayout({"hand": [0], "cup": [1], "ball": [2, 3]}, fixed=("hand",))
    action_space = Box()

    def outcomes(self, state, actions, *, horizon=1):
        after = np.tile(np.asarray(state, dtype=np.float64), (len(actions), 1))
        for _ in range(horizon):
            after[:, 0] += actions[:, 0]
            after[:, 1] += after[:, 4] * actions[:, 0]
            after[:, 2] += after[:, 3]
        return after


HELD = [0.0, 0.0, 0.0, 5.0, 1.0]
FREE = [0.0, 0.0, 0.0, 5.0, 0.0]


class TestTrueInfluence:
    def test_a_held_entity_is_influenced(self):
        truth = true_influence(Table(), [HELD, FREE], progress=False)
        assert truth.influenced.dtype == torch.bool
        assert truth.influenced.tolist() == [[True, True, False], [True, False, False]]
        assert truth.displacement.dtype == torch.float32
        actions = draw_actions(Box.low, Box.high, 16)
        spread = float(np.ptp(actions[:, 0]))
        assert truth.displacement[0, 1].item() == pytest.approx(spread)
        # moves by 5 under any action: not influenced
        assert truth.displacement[:, 2].tolist() == [0.0, 0.0]

    def test_threshold(self):
        for threshold, expected in ((1e-3, True), (3.0, False)):
            truth = true_influence(Table(), [HELD], threshold=threshold, progress=False)
            assert truth.influenced[0].tolist() == [True, expected, False]
        truth = true_influence(
            Table(), [HELD], threshold={"cup": 3.0, "ball": 1e-3}, progress=False
        )
        assert truth.influenced[0].tolist() == [True, False, False]

    def test_horizon(self):
        one = true_influence(Table(), [HELD], progress=False).displacement
        three = true_influence(Table(), [HELD], horizon=3, progress=False).displacement
        assert torch.allclose(three, 3 * one)

    def test_arrays_tensors_lists_and_factories(self):
        states = np.array([HELD, FREE])
        expected = true_influence(Table(), states, progress=False)
        for same in (torch.tensor(states), states.tolist(), [np.array(HELD), FREE]):
            truth = true_influence(Table(), same, progress=False)
            assert torch.equal(truth.displacement, expected.displacement)
        made = true_influence(Table, states, progress=False)
        assert torch.equal(made.displacement, expected.displacement)

    def test_seed(self):
        def displacement(seed):
            return true_influence(
                Table(), [HELD], seed=seed, progress=False
            ).displacement

        assert torch.equal(displacement(1), displacement(1))
        assert not torch.equal(displacement(1), displacement(2))

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"states": np.zeros((0, 5))}, "empty"),
            ({"states": np.array([HELD, [np.nan] * 5])}, "1 rows, the first at 1"),
            ({"num_actions": 1}, "at least 2"),
            ({"num_workers": -1}, "0 or more"),
            ({"num_workers": 1}, "picklable function"),
            ({"threshold": 0.0}, "positive distance"),
            ({"threshold": float("nan")}, "positive distance"),
            ({"threshold": {"cup": 1.0}}, r"\['cup'\], expected.*\['ball', 'cup'\]"),
        ],
    )
    def test_rejects_bad_input(self, changes, message):
        states = changes.pop("states", [HELD])
        with pytest.raises(ValueError, match=message):
            true_influence(Table(), states, progress=False, **changes)

    def test_rejects_unbounded_actions(self):
        with pytest.raises(ValueError, match="finite"):
            draw_actions([-np.inf], [1.0], 4)


class Fenced(Table):
    """A hand that can only reach what it holds."""

    horizons: ClassVar[set[int]] = set()

    def in_reach(self, state, *, horizon=1):
        self.horizons.add(horizon)
        return np.array([True, state[4] > 0, False])

    def outcomes(self, state, actions, *, horizon=1):
        assert state[4] > 0, "simulated although everything is out of reach"
        return super().outcomes(state, actions, horizon=horizon)


def test_states_out_of_reach_are_not_simulated():
    states = [HELD, FREE, HELD, FREE]
    expected = true_influence(Table(), states, horizon=2, progress=False)
    spared = true_influence(Fenced(), states, horizon=2, progress=False)
    assert torch.equal(spared.influenced, expected.influenced)
    assert torch.equal(spared.displacement[::2], expected.displacement[::2])
    assert (spared.displacement[1::2] == 0).all()
    assert Fenced.horizons == {2}


class Interrupted(Table):
    """Records the states of its queries, and is interrupted at one of them."""

    queried: ClassVar[list[float]] = []
    last = math.inf

    def outcomes(self, state, actions, *, horizon=1):
        if state[0] >= self.last:
            raise KeyboardInterrupt
        self.queried.append(float(state[0]))
        return super().outcomes(state, actions, horizon=horizon)


@pytest.fixture
def rows(generator):
    """Two trajectories, numbered by the hand's position; held at random."""
    number = torch.arange(9)
    state = torch.zeros(9, 5, dtype=torch.float64)
    state[:, 0] = number
    state[:, 3] = 5
    state[:, 4] = torch.randint(2, (9,), generator=generator)
    assert 0 < state[:, 4].sum() < 9
    return TensorDict(
        {
            "observation": state,
            "info": {"simulator": state},
            "episode": number // 5,
            "next": {
                "observation": state + 1,
                "done": ((number == 4) | (number == 8))[:, None],
            },
        },
        [9],
    )


def test_masks_as_scores():
    mask = torch.tensor([[True, False]])
    assert torch.equal(oracle_score(mask) > 0.3, mask)
    assert oracle_score(mask).dtype == torch.float32
    with pytest.raises(ValueError, match=r"torch\.bool"):
        oracle_score(torch.ones(2, 3))


class TestSimulatorInfluence:
    def oracle(self, factory=Table, **kwargs):
        return SimulatorInfluence(factory, state_key=("info", "simulator"), **kwargs)

    def test_scores_are_the_ground_truth(self, rows):
        states = rows["info", "simulator"]
        truth = true_influence(Table(), states, progress=False)
        score = self.oracle()(rows)
        assert score.dtype == torch.float32
        assert torch.equal(score, oracle_score(truth.influenced))
        assert torch.equal(score[:, 1], states[:, 4].float())
        strict = self.oracle(threshold={"cup": 3.0, "ball": 1e-3})(rows)
        assert torch.equal(strict, torch.tensor([[1.0, 0, 0]]).expand(9, 3))

    def test_the_state_of_the_simulator_is_no_setting(self, rows):
        class Remembering(Table):
            last = None

            def outcomes(self, state, actions, *, horizon=1):
                self.last = [np.array(state)]
                return super().outcomes(state, actions, horizon=horizon)

        oracle = self.oracle(Remembering)
        before = estimator_digest(oracle)
        oracle(rows)
        assert estimator_digest(oracle) == before

    def test_pickling_makes_a_new_simulator(self, rows):
        oracle = self.oracle()
        again = pickle.loads(pickle.dumps(oracle))
        assert torch.equal(again(rows), oracle(rows))

    def test_processes_get_the_factory(self, rows, monkeypatch):
        calls = []

        def recorder(env, states, **kwargs):
            calls.append((env, kwargs["num_workers"]))
            return true_influence(env, states, **{**kwargs, "num_workers": 0})

        oracles = [self.oracle(num_workers=n) for n in (0, 3)]
        monkeypatch.setattr("torchrl_caiac.influence.truth.true_influence", recorder)
        scores = [oracle(rows) for oracle in oracles]
        assert torch.equal(*scores)
        assert isinstance(calls[0][0], Table) and calls[0][1] == 0
        assert calls[1] == (Table, 3)
        # The number of processes does not change the scores, so it may change.
        assert repr(oracles[0]) == repr(oracles[1])

    def test_an_interrupted_call_resumes(self, rows, tmp_path, monkeypatch):
        rows.memmap(tmp_path / "rows")
        options = {"key": ("oracle", "score"), "batch_size": 2, "lookahead": 0}
        monkeypatch.setattr(Interrupted, "queried", [])

        def score(**kwargs):
            data = TensorDict.load_memmap(tmp_path / "rows")
            score_buffer(
                offline_buffer(data),
                self.oracle(Interrupted, **kwargs),
                progress=False,
                **options,
            )
            return data["oracle", "score"]

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Interrupted, "last", 5)
            score()
        assert Interrupted.queried == [0, 1, 2, 3, 4]
        Interrupted.queried.clear()
        result = score()
        # Only the interrupted chunk is queried again.
        assert Interrupted.queried == [4, 5, 6, 7, 8]
        assert torch.equal(result, self.oracle()(rows))
        Interrupted.queried.clear()
        assert torch.equal(score(num_workers=0), result)
        assert not Interrupted.queried
        with pytest.raises(ValueError, match="estimator was"):
            score(num_actions=7)
        with pytest.raises(ValueError, match="estimator was"):
            score(threshold=1e-4)

    def test_state_of_several_leaves(self, rows):
        whole = rows["info", "simulator"]
        rows["sim"] = TensorDict({"q": whole[:, :2], "v": whole[:, 2:]}, [9])
        parts = SimulatorInfluence(Table, state_key=[("sim", "q"), ("sim", "v")])
        assert parts.in_keys == [("sim", "q"), ("sim", "v")]
        assert torch.equal(parts(rows), self.oracle()(rows))
        assert "[('sim', 'q'), ('sim', 'v')]" in repr(parts)
        with pytest.raises(KeyError, match=r"state of the simulator.*they have"):
            parts(rows.exclude("sim"))

    @pytest.mark.parametrize("every", [1, 2, 3, 7])
    @pytest.mark.parametrize("lookahead", [0, 4, 100])
    def test_every_and_lookahead(self, every, lookahead, monkeypatch):
        # Against masks that are filled in and looked ahead by hand.
        lengths, generator = [1, 5, 8, 9, 20], torch.Generator().manual_seed(1)
        episode = torch.arange(5).repeat_interleave(torch.tensor(lengths))
        position = torch.cat([torch.arange(n) for n in lengths])
        count = len(position)
        state = torch.zeros(count, 5, dtype=torch.float64)
        state[:, 0] = torch.arange(count)
        state[:, 4] = torch.rand(count, generator=generator) < 0.2
        data = TensorDict(
            {
                "observation": state,
                "simulator": state,
                "episode": episode,
                "next": {"observation": state},
            },
            [count],
        )
        queried = position % every == 0
        known = true_influence(Table(), state[queried], progress=False).influenced
        mask = torch.zeros(count, 3, dtype=torch.bool)
        mask[queried] = known
        before = torch.arange(count) - position % every
        after = (before + every).clamp(max=count - 1)
        alone = queried | (episode[after] != episode)
        mask = mask[before] | mask[before.where(alone, after)]
        expected = torch.stack(
            [
                mask[t : t + lookahead + 1][episode[t : t + lookahead + 1] == e].any(0)
                for t, e in enumerate(episode)
            ]
        )
        monkeypatch.setattr(Interrupted, "queried", [])
        rb = offline_buffer(data)
        options = {"lookahead": lookahead, "every": every, "progress": False}
        score_buffer(rb, SimulatorInfluence(Interrupted), 6, check=False, **options)
        score = rb.storage[:]["caiac", "score"]
        assert torch.equal(score, expected.float())
        assert 0 < score[:, 1].mean() < 1
        assert Interrupted.queried == queried.nonzero()[:, 0].tolist()


@pytest.fixture(scope="module")
def env():
    return KitchenEnv()


class TestKitchen:
    """The simulator of the kitchen: why the default threshold is 2 mm."""

    def test_actions_make_no_difference_out_of_reach(self, env):
        # The noise of the solver: the arm in its default posture touches nothing, so
        # whatever differs between actions does so by noise alone.
        rng = np.random.default_rng(0)
        starts = np.stack([env.random_start("microwave", rng=rng) for _ in range(12)])
        truth = true_influence(env, starts, num_actions=6, progress=False)
        assert truth.influenced[:, 0].all()
        assert not truth.influenced[:, 1:].any()
        assert truth.displacement[:, 1:].max() < 1e-8
        assert truth.displacement[:, 0].min() > 0.05

    def test_motion_without_the_robot_is_no_influence(self, env):
        # A door that swings: far moved, but the same under every action.
        velocity = np.zeros(29)
        velocity[22] = -3.0
        state = np.concatenate((env.default_state(), velocity))
        after = env.outcomes(state, np.zeros((1, 9)))
        assert abs(after[0, 22] - state[22]) > 0.02
        truth = true_influence(env, state[None], num_actions=4, progress=False)
        assert not truth.influenced[0, 1:].any()

    def test_contact_is_influence(self, env):
        # The kettle against the hand.
        state = env.default_state()
        hand = env.data
        env.reset(seed=0, options={"start": state})
        state[23:26] = hand.site("end_effector").xpos
        truth = true_influence(env, state[None], num_actions=6, progress=False)
        kettle = env.layout.index("kettle")
        assert truth.influenced[0, kettle]
        assert truth.displacement[0, kettle] > 10 * 2e-3
        others = [i for i in range(1, 10) if i != kettle]
        assert not truth.influenced[0, others].any()

    def test_masks_hardly_depend_on_the_threshold(self):
        # Along a demonstration: nothing at first, then the kettle, never another
        # object; and a threshold far from 2 mm gives the same answer.
        env = KitchenEnv("kettle", terminate_on_success=False)
        expert = KitchenExpert(env, "kettle", rng=0)
        env.reset(seed=0)
        expert.reset()
        states = []
        for _ in range(17):
            states.append(np.concatenate((env.qpos, env.qvel)))
            env.step(expert())
        truth = true_influence(env, states[::2], num_actions=8, progress=False)
        kettle = env.layout.index("kettle")
        contacts = truth.influenced[:, kettle]
        assert not contacts[0] and contacts[-3:].any()
        others = [i for i in range(1, 10) if i != kettle]
        assert truth.displacement[:, others].max() < 1e-8
        for threshold in (3e-4, 1e-3, 4e-3):
            assert torch.equal(truth.displacement[:, kettle] > threshold, contacts)

    def test_processes_give_the_same_result(self, env):
        rng = np.random.default_rng(1)
        starts = np.stack([env.random_start("kettle", rng=rng) for _ in range(9)])
        velocity = rng.normal(0, 0.5, (9, 29))
        velocity[:, 9:] = 0
        states = np.concatenate((starts, velocity), axis=1)
        alone = true_influence(env, states, num_actions=3, progress=False)
        shared = true_influence(
            KitchenEnv, states, num_actions=3, num_workers=1, progress=False
        )
        assert torch.equal(alone.influenced, shared.influenced)
        assert torch.equal(alone.displacement, shared.displacement)
        backwards = true_influence(
            env, states[::-1].copy(), num_actions=3, progress=False
        )
        assert torch.equal(backwards.displacement.flip(0), alone.displacement)

    def test_snapshots(self, env):
        env.reset(seed=0)
        env.step(np.ones(9))
        truth = true_influence(env, [env.get_state()], num_actions=3, progress=False)
        assert truth.influenced[0].tolist() == [True] + [False] * 9

    def test_wrong_state_width(self, env):
        with pytest.raises(ValueError, match=r"state has shape \(31,\)"):
            true_influence(env, np.zeros((1, 31)), progress=False)
