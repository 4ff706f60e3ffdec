"""Fetch-Push with several cubes: environment, expert, ground truth and datasets."""

from __future__ import annotations

from torchrl_caiac.envs.fetch_push.datasets import (
    create_fetch_push_expert,
    create_fetch_push_random,
)
from torchrl_caiac.envs.fetch_push.env import FetchPushCubes, FetchPushState
from torchrl_caiac.envs.fetch_push.expert import FetchPushExpert
from torchrl_caiac.envs.fetch_push.registration import (
    FETCH_PUSH_ENV_ID,
    make_fetch_push_env,
    register_fetch_push,
)
from torchrl_caiac.envs.fetch_push.restorable import RestorableFetchPush
from torchrl_caiac.envs.fetch_push.task import (
    fetch_push_distances,
    fetch_push_layout,
    fetch_push_reward,
)
from torchrl_caiac.envs.fetch_push.truth import FetchPushTruth

__all__ = [
    "FETCH_PUSH_ENV_ID",
    "FetchPushCubes",
    "FetchPushExpert",
    "FetchPushState",
    "FetchPushTruth",
    "RestorableFetchPush",
    "create_fetch_push_expert",
    "create_fetch_push_random",
    "fetch_push_distances",
    "fetch_push_layout",
    "fetch_push_reward",
    "make_fetch_push_env",
    "register_fetch_push",
]
