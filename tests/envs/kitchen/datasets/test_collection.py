from __future__ import annotations

import numpy as np
import pytest

from torchrl_caiac.envs.kitchen.datasets.collection import (
    KitchenSource,
    collect_expert_dataset,
    make_franka_kitchen,
)


def test_episodes_outlast_their_tasks():
    env = make_franka_kitchen(["kettle"])
    assert env.spec.max_episode_steps == 450
    env.reset(seed=0)
    robot = env.unwrapped.robot_env
    qpos = robot.data.qpos.copy()
    qpos[23:26] = (-0.23, 0.75, 1.62)
    robot.set_state(qpos, np.zeros(29))
    robot._get_obs()
    # The task is done in both steps and pays in both.
    assert [env.step(np.zeros(9))[1:3] for _ in range(2)] == [(1.0, False)] * 2
    env.close()


def test_what_moved_apart_from_the_task():
    source = KitchenSource(["kettle"])
    qpos = np.tile(source.simulator_state()["qpos"], (3, 1))
    qpos[1, :9] += 1.0  # the robot
    qpos[1, 22] += 0.3
    assert source.others_moved(qpos, [23, 24])
    assert not source.others_moved(qpos, [22])
    qpos[2, 19] += 0.01
    assert not source.others_moved(qpos, [22])
    qpos[2, 19] += 0.02
    assert source.others_moved(qpos, [22])
    source.close()


def test_nothing_to_collect(tmp_path):
    options = {
        "root": tmp_path,
        "work": None,
        "seed": 0,
        "workers": 1,
        "overwrite": False,
        "progress": False,
        "description": "",
    }
    with pytest.raises(ValueError, match="no demonstrations requested"):
        collect_expert_dataset("a/b-v0", KitchenSource, [], tasks=["kettle"], **options)
    with pytest.raises(KeyError, match="toaster"):
        collect_expert_dataset(
            "a/b-v0", KitchenSource, [{}], tasks=["toaster"], **options
        )
    assert not any(tmp_path.iterdir())
