from __future__ import annotations

import functools

import gymnasium
import torch
from torchrl.envs import SerialEnv, check_env_specs

from torchrl_caiac.envs.kitchen import (
    KITCHEN_ENV_ID,
    KITCHEN_TASKS,
    KitchenEnv,
    make_kitchen_env,
    register_kitchen,
)


def test_gymnasium_make():
    register_kitchen()
    env = gymnasium.make(KITCHEN_ENV_ID, task="kettle")
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert env.unwrapped.task == "kettle"
    env.step(env.action_space.sample())
    env.close()


def test_torchrl():
    env = make_kitchen_env("kettle", max_episode_steps=4, open=("slide_cabinet",))
    check_env_specs(env)
    env.set_seed(0)
    rollout = env.rollout(10)
    assert rollout.shape == (4,)
    for key in ("observation", "achieved_goal", "desired_goal"):
        assert rollout[key].dtype == torch.float32
    assert rollout["observation"].shape == (4, 30)
    assert torch.equal(
        KitchenEnv.layout.achieved_goal(rollout), rollout["achieved_goal"]
    )
    for key in ("success", "task_success"):
        assert rollout["next", key].shape == (4, 1)
        assert rollout["next", key].dtype == torch.bool
    assert rollout["next", "wrong_tasks"].shape == (4, 7)
    assert (rollout["next", "task"] == KITCHEN_TASKS.index("kettle")).all()
    assert rollout["is_init"].flatten().tolist() == [True, False, False, False]
    assert rollout["next", "truncated"].flatten().tolist() == [False] * 3 + [True]
    assert not rollout["next", "terminated"].any()
    assert abs(rollout["observation"][0, 19] - 0.37) < 1e-3
    env.close()


def test_torchrl_batched():
    env = SerialEnv(2, functools.partial(make_kitchen_env, "kettle"))
    rollout = env.rollout(3)
    assert rollout["next", "wrong_tasks"].shape == (2, 3, 7)
    assert rollout["is_init"][..., 0].tolist() == [[True, False, False]] * 2
    env.close()


def test_torchrl_reports_success():
    env = make_kitchen_env("microwave")
    # already done at the start: pays on the first step
    td = env.reset(options={"open": "microwave"})
    assert td["task_success"].item()
    td = env.rand_step(td)
    assert td["next", "success"].item() and td["next", "reward"].item() == 1
    assert td["next", "terminated"].item()
    env.close()
