"""Ground truth from the simulator of the Franka-Kitchen."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_caiac.envs.kitchen import KitchenTruth


def draw_actions(steps: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (steps, 9)).astype(np.float32)


def test_the_episode_is_left_unchanged(env):
    env.reset(seed=0)
    for action in draw_actions(5):
        env.step(action)
    snapshot = env.get_state()
    state = np.concatenate((env.qpos, env.qvel))
    several = env.outcomes(state, draw_actions(3))
    assert several.shape == (3, 30)
    assert np.array_equal(env.outcomes(state, draw_actions(3)), several)
    assert np.array_equal(env.outcomes(state, draw_actions(3)[1:2])[0], several[1])
    assert not np.array_equal(env.outcomes(state, draw_actions(3), horizon=2), several)
    close = env.outcomes(snapshot, draw_actions(3))
    assert np.abs(close - several).max() < 1e-3
    assert np.array_equal(env.get_state().physics, snapshot.physics)
    # noise aside, a step leads where the outcomes say
    env.robot_env._last_robot_qpos = env.qpos[:9]
    env.step(draw_actions(3)[1])
    assert np.array_equal(env.qpos, close[1])


def test_the_environment_and_the_truth_agree(env):
    env.reset(seed=0)
    truth, actions = KitchenTruth(), draw_actions(3)
    state = np.concatenate((env.qpos, env.qvel))
    expected = env.outcomes(state, actions, horizon=2)
    assert np.array_equal(truth.outcomes(state, actions, horizon=2), expected)
    assert truth.layout == env.layout
    assert truth.action_space == env.action_space


@pytest.mark.parametrize(
    ("state", "actions", "horizon", "message"),
    [
        (np.zeros(31), np.zeros((1, 9)), 1, r"state has shape \(31,\)"),
        (np.zeros(30), np.zeros(9), 1, r"actions have shape \(9,\)"),
        (np.full(30, np.nan), np.zeros((1, 9)), 1, "finite"),
        (np.zeros(30), np.zeros((1, 9)), 0, "horizon is 0"),
    ],
)
def test_bad_input(state, actions, horizon, message):
    with pytest.raises(ValueError, match=message):
        KitchenTruth().outcomes(state, actions, horizon=horizon)
