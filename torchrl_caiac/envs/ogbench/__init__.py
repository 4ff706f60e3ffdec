"""OGBench's manipulation environments: datasets, simulator and ground truth."""

from __future__ import annotations

from torchrl_caiac.envs.ogbench.datasets import create_ogbench_play
from torchrl_caiac.envs.ogbench.registration import (
    OGBENCH_ENVS,
    make_ogbench_env,
    make_ogbench_task,
)
from torchrl_caiac.envs.ogbench.rewards import ogbench_cube_reward
from torchrl_caiac.envs.ogbench.simulator import OGBenchSimulator, ogbench_states
from torchrl_caiac.envs.ogbench.swaps import resimulate_swaps
from torchrl_caiac.envs.ogbench.truth import OGBenchTruth

__all__ = [
    "OGBENCH_ENVS",
    "OGBenchSimulator",
    "OGBenchTruth",
    "create_ogbench_play",
    "make_ogbench_env",
    "make_ogbench_task",
    "ogbench_cube_reward",
    "ogbench_states",
    "resimulate_swaps",
]
