"""Chains of tasks in the real simulator."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_caiac.envs.kitchen import KitchenChain, KitchenEnv, set_kitchen_start
from torchrl_caiac.envs.kitchen.chain import random_chain_start
from torchrl_caiac.envs.kitchen.waypoints import TASKS


def begin_chain(franka_kitchen, tasks, seed, positions=None, **kwargs):
    franka_kitchen.reset(seed=seed)
    set_kitchen_start(franka_kitchen, positions)
    chain = KitchenChain(franka_kitchen, tasks, rng=seed, **kwargs)
    chain.reset()
    return chain


def run_chain(franka_kitchen, chain, meddle=lambda step: None, steps=900):
    played = []
    for step in range(steps):
        action = chain()
        assert np.abs(action).max() <= 1
        if chain.finished:
            break
        played.append((chain.task, chain.attempts[chain.task]))
        franka_kitchen.step(action)
        meddle(step)
    return list(dict.fromkeys(played))


@pytest.mark.parametrize(
    ("tasks", "seed"),
    [
        (("microwave", "kettle", "light switch", "slide cabinet"), 0),
        (("hinge cabinet", "slide cabinet", "bottom burner", "microwave"), 1),
        (("top burner", "hinge cabinet", "kettle", "light switch"), 2),
    ],
)
def test_chains_of_four(franka_kitchen, tasks, seed):
    chain = begin_chain(franka_kitchen, tasks, seed, speed_range=0.4)
    played = run_chain(franka_kitchen, chain)
    assert chain.finished
    assert chain.success
    assert chain.wrong_tasks == ()
    assert set(tasks) == set(chain.solved)
    assert [name for name, attempt in played if attempt == 1] == list(tasks)
    # Further actions keep the hand in place.
    hand, _ = chain.expert.ik.pose(chain.expert.data.qpos)
    for _ in range(5):
        franka_kitchen.step(chain())
    after, _ = chain.expert.ik.pose(chain.expert.data.qpos)
    assert np.linalg.norm(after - hand) < 0.03


def test_chain_from_a_random_start(franka_kitchen):
    kitchen = KitchenEnv()
    tasks = ["light switch", "microwave", "kettle", "bottom burner"]
    franka_kitchen.reset(seed=3)
    start = random_chain_start(kitchen, tasks, rng=np.random.default_rng(3))
    set_kitchen_start(franka_kitchen, qpos=start)
    chain = KitchenChain(franka_kitchen, tasks, rng=3)
    chain.reset()
    run_chain(franka_kitchen, chain)
    assert chain.success


def test_a_failed_task_is_tried_again(franka_kitchen):
    chain = begin_chain(franka_kitchen, ["slide cabinet"], 0)
    model = chain.expert.model
    column = model.joint("slide_cabinet").qposadr[0]
    meddled = []

    def close(step):
        if chain.expert.success and len(meddled) < 1:
            meddled.append(step)
            qpos = chain.expert.data.qpos.copy()
            qpos[column] = 0.0
            set_kitchen_start(franka_kitchen, qpos=qpos)

    # The hand is past the handle by then: this attempt moves it no more.
    first = run_chain(franka_kitchen, chain, close)
    assert meddled
    assert first == [("slide cabinet", 1), ("slide cabinet", 2)]
    assert chain.success
    meddled.clear()
    chain = begin_chain(franka_kitchen, ["slide cabinet"], 0, retries=0)
    assert run_chain(franka_kitchen, chain, close) == [("slide cabinet", 1)]
    assert chain.finished
    assert not chain.success


def test_an_undone_task_is_repaired(franka_kitchen):
    chain = begin_chain(franka_kitchen, ["kettle", "light switch"], 1)
    meddled = []

    def push_back(step):
        # The hand is at the switch, out of the kettle's way.
        if "light switch" in chain.solved and not meddled:
            meddled.append(step)
            qpos = chain.expert.data.qpos.copy()
            qpos[23:30] = KitchenEnv.default_state()[23:30]
            set_kitchen_start(franka_kitchen, qpos=qpos)

    played = run_chain(franka_kitchen, chain, push_back)
    assert played == [("kettle", 1), ("light switch", 1), ("kettle", 2)]
    assert chain.success


def test_solved_tasks_are_not_played_and_wrong_ones_count(franka_kitchen):
    solved = {"slide_cabinet": 0.37}
    chain = begin_chain(franka_kitchen, ["slide cabinet", "kettle"], 0, solved)
    assert chain.solved == ("slide cabinet",)
    assert chain.task == "kettle"
    assert run_chain(franka_kitchen, chain) == [("kettle", 1)]
    assert chain.attempts == {"slide cabinet": 0, "kettle": 1}
    assert chain.success
    set_kitchen_start(franka_kitchen, {"light_switch": -0.69})
    assert chain.wrong_tasks == ("light switch",)
    assert not chain.success
    # Nothing is left to do: the hand stays in place.
    chain.reset(["slide cabinet", "light switch"])
    assert chain.finished
    assert chain.success
    before, _ = chain.expert.ik.pose(chain.expert.data.qpos)
    for _ in range(5):
        franka_kitchen.step(chain())
    after, _ = chain.expert.ik.pose(chain.expert.data.qpos)
    np.testing.assert_allclose(after, before, atol=0.02)


def test_an_open_door_selects_the_alternative_table(franka_kitchen):
    chain = begin_chain(franka_kitchen, ["slide cabinet"], 0)
    posture = chain.expert.task.posture
    assert posture == TASKS["slide cabinet"].posture
    for angle in (0.6, 1.45):
        door = {"right_hinge_cabinet": angle}
        chain = begin_chain(franka_kitchen, ["slide cabinet"], 0, door)
        assert chain.expert.task.posture == TASKS["slide cabinet"].alternative.posture
        run_chain(franka_kitchen, chain)
        assert chain.success
        assert chain.expert.data.qpos[21] == pytest.approx(angle, abs=0.01)


def test_chains_repeat_with_their_seed(franka_kitchen):
    def actions(seed):
        chain = begin_chain(franka_kitchen, ["kettle"], seed)
        taken = []
        for _ in range(20):
            taken.append(chain())
            franka_kitchen.step(taken[-1])
        return np.stack(taken)

    first = actions(4)
    np.testing.assert_array_equal(first, actions(4))
    assert not np.array_equal(first, actions(5))


def test_random_chain_start():
    kitchen = KitchenEnv()
    default = kitchen.default_state()
    rng = np.random.default_rng(0)
    tasks = ["hinge cabinet", "kettle", "top burner"]
    own = [column for name in tasks for column in TASKS[name].columns]
    starts = np.stack([random_chain_start(kitchen, tasks, rng=rng) for _ in range(12)])
    np.testing.assert_array_equal(starts[:, own], np.tile(default[own], (12, 1)))
    np.testing.assert_array_equal(starts[:, :9], np.tile(default[:9], (12, 1)))
    assert (starts[:, [17, 19, 22]].std(axis=0) > 0).all()
    again = random_chain_start(kitchen, tasks, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(again, starts[0])
    with pytest.raises(KeyError, match="toaster"):
        random_chain_start(kitchen, ["toaster"], rng=rng)
    with pytest.raises(ValueError, match="no tasks"):
        random_chain_start(kitchen, [], rng=rng)


def test_bad_input(franka_kitchen):
    env = franka_kitchen
    with pytest.raises(ValueError, match="no tasks given"):
        KitchenChain(env, [])
    with pytest.raises(KeyError, match="no expert for task 'toaster'"):
        KitchenChain(env, ["kettle", "toaster"])
    with pytest.raises(ValueError, match="each at most once"):
        KitchenChain(env, ["kettle", "kettle"])
    with pytest.raises(ValueError, match="retries is -1"):
        KitchenChain(env, ["kettle"], retries=-1)
    with pytest.raises(RuntimeError, match="reset"):
        KitchenChain(env, ["kettle"])()
    with pytest.raises(KeyError, match="toaster"):
        KitchenChain(env, ["kettle"]).reset(["toaster"])
