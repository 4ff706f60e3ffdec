"""Fetch-Push as an environment of gymnasium and of TorchRL."""

from __future__ import annotations

import functools

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs import SerialEnv, check_env_specs

from torchrl_caiac.envs.fetch_push import (
    FETCH_PUSH_ENV_ID,
    FetchPushCubes,
    make_fetch_push_env,
    register_fetch_push,
)


class TestGymnasium:
    def test_checker(self):
        env = gymnasium.make(FETCH_PUSH_ENV_ID, num_cubes=2, disable_env_checker=True)
        check_env(env.unwrapped)
        assert isinstance(env.unwrapped, FetchPushCubes)

    def test_registered_by_import(self):
        register_fetch_push()
        gymnasium.registry.pop(FETCH_PUSH_ENV_ID)
        register_fetch_push()
        env = gymnasium.make(f"torchrl_caiac.envs:{FETCH_PUSH_ENV_ID}", num_cubes=1)
        assert env.reset(seed=0)[0]["observation"].shape == (22,)

    def test_works_in_spawned_workers(self):
        env = gymnasium.make_vec(
            f"torchrl_caiac.envs:{FETCH_PUSH_ENV_ID}",
            num_envs=1,
            vectorization_mode="async",
            vector_kwargs={"context": "spawn"},
            num_cubes=1,
        )
        try:
            observation, _ = env.reset(seed=3)
            alone, _ = FetchPushCubes(1).reset(seed=3)
            assert np.array_equal(observation["observation"][0], alone["observation"])
        finally:
            env.close()


class TestTorchRL:
    def test_specs(self):
        check_env_specs(make_fetch_push_env(2))

    def test_flags(self):
        env = make_fetch_push_env(3, max_episode_steps=4, cube_range=0.2)
        rollout = env.rollout(6)
        assert rollout.batch_size == (4,)
        for key, width in (("success", 1), ("cube_success", 3), ("truncated", 1)):
            assert rollout["next", key].shape == (4, width)
            assert rollout["next", key].dtype == torch.bool
        assert rollout["observation"].dtype == torch.float32
        assert rollout["observation"].shape == (4, 46)
        assert rollout["next", "reward"].shape == (4, 1)
        assert rollout["next", "truncated"].flatten().tolist() == [False] * 3 + [True]
        assert rollout["is_init"].flatten().tolist() == [True] + [False] * 3

    def test_options_and_seeds(self, pushed):
        env = make_fetch_push_env(2)
        env.set_seed(0)
        state = env.reset(options=pushed)
        assert state["achieved_goal"][:2].tolist() == pytest.approx([1.3, 0.75])
        assert not state["cube_success"].any()

    def test_batches(self):
        env = SerialEnv(2, functools.partial(make_fetch_push_env, 2))
        env.set_seed(0)
        rollout = env.rollout(3)
        assert rollout["observation"].shape == (2, 3, 34)
        goals = rollout["desired_goal"][:, 0]
        assert not torch.equal(goals[0], goals[1])
        env.close()
