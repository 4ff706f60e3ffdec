from __future__ import annotations

import numpy as np
import pytest

from torchrl_caiac.envs.fetch_push import FetchPushCubes

# A cube next to the gripper's way down, and one out of the way.
PUSHED = {"cubes": [[1.30, 0.75], [1.45, 0.90]], "goals": [[1.45, 0.75], [1.2, 0.65]]}


@pytest.fixture(scope="module")
def env():
    """Fetch-Push with two cubes."""
    env = FetchPushCubes(2)
    yield env
    env.close()


@pytest.fixture
def pushed() -> dict:
    """Options of ``reset``: a cube next to the gripper's way down, another far away."""
    return PUSHED


@pytest.fixture
def behind():
    """Moves the gripper next to the first cube of ``pushed``, on the robot's side."""

    def move(env: FetchPushCubes) -> None:
        env.reset(seed=0, options=PUSHED)
        _drive(env, [1.25, 0.75, 0.5], 12)
        _drive(env, [1.25, 0.75, 0.425], 5)

    return move


def _drive(env: FetchPushCubes, target: list[float], steps: int) -> None:
    for _ in range(steps):
        place = env.data.site("robot0:grip").xpos
        move = np.clip((np.array(target) - place) / 0.033, -1, 1)
        env.step([*move, 0.0])
