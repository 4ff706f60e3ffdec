"""Simulated environments and their scripted experts."""

from __future__ import annotations

# First: if mujoco cannot be imported, this import explains why.
from torchrl_caiac.envs.rendering import RenderingUnavailable

# isort: split
from torchrl_caiac.envs.fetch_push import (
    FETCH_PUSH_ENV_ID,
    FetchPushCubes,
    FetchPushExpert,
    FetchPushState,
    FetchPushTruth,
    RestorableFetchPush,
    create_fetch_push_expert,
    create_fetch_push_random,
    fetch_push_distances,
    fetch_push_layout,
    fetch_push_reward,
    make_fetch_push_env,
)
from torchrl_caiac.envs.kitchen import (
    KITCHEN_ENV_ID,
    KITCHEN_TASKS,
    KitchenChain,
    KitchenEnv,
    KitchenExpert,
    KitchenState,
    KitchenTruth,
    RestorableKitchen,
    create_kitchen_demonstrations,
    create_kitchen_play,
    create_kitchen_random,
    kitchen_reward,
    kitchen_transitions,
    load_d4rl_kitchen,
    make_kitchen_env,
)
from torchrl_caiac.envs.ogbench import (
    OGBENCH_ENVS,
    OGBenchSimulator,
    OGBenchTruth,
    create_ogbench_play,
    make_ogbench_env,
    make_ogbench_task,
    ogbench_cube_reward,
    ogbench_states,
    resimulate_swaps,
)
from torchrl_caiac.envs.random_transitions import RestorableEnv, random_transitions

__all__ = [
    "FETCH_PUSH_ENV_ID",
    "KITCHEN_ENV_ID",
    "KITCHEN_TASKS",
    "OGBENCH_ENVS",
    "FetchPushCubes",
    "FetchPushExpert",
    "FetchPushState",
    "FetchPushTruth",
    "KitchenChain",
    "KitchenEnv",
    "KitchenExpert",
    "KitchenState",
    "KitchenTruth",
    "OGBenchSimulator",
    "OGBenchTruth",
    "RenderingUnavailable",
    "RestorableEnv",
    "RestorableFetchPush",
    "RestorableKitchen",
    "create_fetch_push_expert",
    "create_fetch_push_random",
    "create_kitchen_demonstrations",
    "create_kitchen_play",
    "create_kitchen_random",
    "create_ogbench_play",
    "fetch_push_distances",
    "fetch_push_layout",
    "fetch_push_reward",
    "kitchen_reward",
    "kitchen_transitions",
    "load_d4rl_kitchen",
    "make_fetch_push_env",
    "make_kitchen_env",
    "make_ogbench_env",
    "make_ogbench_task",
    "ogbench_cube_reward",
    "ogbench_states",
    "random_transitions",
    "resimulate_swaps",
]
