"""Start states, against the default of gymnasium-robotics and the real simulator."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import (
    KitchenEnv as UpstreamKitchen,
)

from torchrl_caiac.envs.kitchen import KITCHEN_TASKS, KitchenEnv, set_kitchen_start
from torchrl_caiac.envs.kitchen.tasks import BURNER_RATIO, LIGHT_RATIO


def test_default_is_upstreams(env):
    env.reset(seed=0)
    upstream = UpstreamKitchen()
    upstream.reset(seed=0)
    assert np.array_equal(env.qpos, upstream.data.qpos)


def test_given_and_mapping_and_open(env):
    state = env.default_state()
    state[22] = -0.3
    env.reset(options={"start": state})
    assert np.array_equal(env.qpos, state)
    env.reset(options={"start": torch.from_numpy(state)})
    assert np.array_equal(env.qpos, state)
    env.reset(options={"start": {"microwave": -0.3}})
    assert np.array_equal(env.qpos, state)
    env.reset(options={"open": "slide_cabinet"})
    assert env.qpos[19] == 0.37
    env.reset(options={"start": {"slide_cabinet": [0.1]}, "open": ["microwave"]})
    assert env.qpos[19] == 0.1 and env.qpos[22] == -0.75
    env.reset()
    assert env.qpos[19] == env.default_state()[19]


def test_constructor_options_last():
    env = KitchenEnv("kettle", open=("slide_cabinet",), start={"microwave": -0.2})
    for _ in range(2):
        env.reset()
        assert env.qpos[19] == 0.37 and env.qpos[22] == -0.2
        assert env.task == "kettle"


@pytest.mark.parametrize("task", KITCHEN_TASKS)
def test_random_starts(env, task):
    rng = np.random.default_rng(0)
    default = env.default_state()
    starts = np.stack([env.random_start(task, rng=rng) for _ in range(60)])
    moved = {
        name: (starts != default)[:, list(env.layout.columns[name])].any(-1)
        for name in env.layout.names
    }
    assert not moved["robot"].any()
    assert not moved[task].any()
    for name in env.layout.names[1:]:
        if name != task:
            assert 0.25 < moved[name].mean() < 0.75
    for name in env.layout.names[1:]:
        own = starts[moved[name]][:, list(env.layout.columns[name])]
        if name.endswith("burner"):
            assert np.allclose(own[:, 0] / BURNER_RATIO, own[:, 1])
        elif name == "light_switch":
            assert np.allclose(own[:, 0] / LIGHT_RATIO, own[:, 1])
    # the kettle stands upright on the hob
    kettle = starts[:, 23:30]
    assert np.array_equal(kettle[:, 2:], np.tile(default[25:], (60, 1)))
    # all within the joints' ranges
    for joint in range(9, 23):
        low, high = env.model.jnt_range[joint]
        assert (starts[:, joint] > low - 1e-2).all()
        assert (starts[:, joint] < high + 1e-2).all()


def test_random_start_probability(env):
    rng = np.random.default_rng(0)
    never = env.random_start("kettle", p=0.0, rng=rng)
    assert np.array_equal(never, env.default_state())
    always = env.random_start("kettle", p=1.0, rng=rng)
    changed = always != env.default_state()
    assert changed[9:20].all() and changed[21:23].all()
    assert not changed[20] and not changed[23:].any()


def test_random_starts_stay_where_they_are(env):
    for seed, task in enumerate(KITCHEN_TASKS * 2):
        env.reset(seed=seed, options={"start": "random", "task": task})
        start = env.qpos
        for _ in range(4):
            info = env.step(np.zeros(9))[-1]
        # the default start itself settles by 7e-3
        assert np.abs(env.qpos - start)[9:].max() < 1e-2
        assert not info["wrong_tasks"].any()
        assert not info["success"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": "weird"}, "'default', 'random'"),
        ({"start": np.zeros(29)}, r"shape \(29,\)"),
        ({"start": np.full(30, np.nan)}, "non-finite"),
        ({"start": {"toaster": 1.0}}, "'toaster'"),
        ({"start": {"kettle": [1.0]}}, r"'kettle'.*\(7,\)"),
        ({"open": "robot"}, "'robot'"),
        ({"task": "wash up"}, "'wash up'"),
        ({"goal": "done"}, "'start', 'default'"),
        ({"goal": np.zeros(20)}, r"shape \(20,\)"),
        ({"tasks": "kettle"}, "'tasks'"),
    ],
)
def test_bad_options(env, options, message):
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)


def test_random_start_arguments(env):
    with pytest.raises(ValueError, match="probability"):
        env.random_start("kettle", p=1.5)
    with pytest.raises(ValueError, match="needs the task"):
        env.start_state("random")


def test_couplings_are_those_of_the_model(env):
    model = env.model
    ratios = {
        model.joint(first).name: coefficients[1]
        for first, coefficients in zip(model.eq_obj1id, model.eq_data, strict=True)
    }
    knobs = {f"knob_Joint_{number}": BURNER_RATIO for number in (1, 2, 3, 4)}
    assert ratios == {**knobs, "light_switch": LIGHT_RATIO}


@pytest.mark.parametrize("way", ["open", "set_kitchen_start"])
@pytest.mark.parametrize(
    ("entity", "joint"),
    [("light_switch", "light_switch"), ("bottom_burner", "knob_Joint_2")],
)
def test_coupled_joints_do_not_jump(env, franka_kitchen, way, entity, joint):
    env.reset(seed=0, options={"open": entity})
    data, step = env.data, env.step
    if way == "set_kitchen_start":
        franka_kitchen.reset(seed=0)
        set_kitchen_start(
            franka_kitchen, {joint: env.qpos[env.layout.columns[entity][0]]}
        )
        data, step = franka_kitchen.unwrapped.robot_env.data, franka_kitchen.step
    columns = list(env.layout.columns[entity])
    before = data.qpos[columns].copy()
    step(np.zeros(9))
    assert np.abs(data.qpos[columns] - before).max() < 1e-4


def test_set_kitchen_start(franka_kitchen):
    franka_kitchen.reset(seed=0)
    for _ in range(3):
        franka_kitchen.step(np.full(9, 0.5))
    observation = set_kitchen_start(
        franka_kitchen,
        {"knob_Joint_2": -0.87, "light_switch": -0.69, "slide_cabinet": 0.3},
    )
    data = franka_kitchen.unwrapped.robot_env.data
    assert data.qpos[11] == -0.87
    assert data.qpos[12] == pytest.approx(-0.005)
    assert data.qpos[18] == -0.69 / LIGHT_RATIO
    assert (data.qvel == 0).all()
    np.testing.assert_allclose(
        franka_kitchen.unwrapped.robot_env._last_robot_qpos, data.qpos[:9], atol=2e-3
    )
    np.testing.assert_allclose(
        observation["observation"][18:39], data.qpos[9:], atol=1e-3
    )
    qpos, qvel = data.qpos.copy(), np.linspace(0, 0.1, 29)
    set_kitchen_start(franka_kitchen, qpos=qpos, qvel=qvel)
    np.testing.assert_array_equal(data.qpos, qpos)
    np.testing.assert_array_equal(data.qvel, qvel)


def test_bad_kitchen_starts(franka_kitchen):
    env = franka_kitchen
    env.reset(seed=0)
    with pytest.raises(ValueError, match="no joint 'toaster'"):
        set_kitchen_start(env, {"toaster": 1.0})
    with pytest.raises(ValueError, match=r"qpos has shape \(3,\)"):
        set_kitchen_start(env, qpos=np.zeros(3))
    with pytest.raises(ValueError, match=r"not finite at positions \[19\]"):
        set_kitchen_start(env, {"slide_cabinet": np.nan})
    with pytest.raises(TypeError, match="KitchenEnv"):
        set_kitchen_start(gymnasium.Env())
