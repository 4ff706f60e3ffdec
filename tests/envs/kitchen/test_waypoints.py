"""The tables of waypoints against the model and against gymnasium-robotics."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import (
    OBS_ELEMENT_GOALS,
    OBS_ELEMENT_INDICES,
)

from torchrl_caiac.envs.kitchen import KitchenExpert, set_kitchen_start
from torchrl_caiac.envs.kitchen.waypoints import (
    TASKS,
    Waypoint,
    get_task,
    tool_rotation,
)


@pytest.mark.parametrize("name", TASKS)
def test_tables_are_well_formed(franka_kitchen, name):
    table = TASKS[name]
    assert table.name == name
    assert list(table.columns) == list(OBS_ELEMENT_INDICES[name])
    np.testing.assert_array_equal(table.goal, OBS_ELEMENT_GOALS[name])
    franka_kitchen.reset(seed=0)
    set_kitchen_start(franka_kitchen)
    for variant in (table, table.alternative):
        if variant is None:
            continue
        assert (variant.name, variant.columns, variant.goal) == (
            table.name,
            table.columns,
            table.goal,
        )
        expert = KitchenExpert(franka_kitchen, variant, waypoint_noise=0, rng=0)
        assert expert.goal_distance > 0.3
        posture = np.array(variant.posture)
        low, high = expert.ik.limits.T
        assert ((posture >= low - 1e-9) & (posture <= high + 1e-9)).all()
        configuration = expert.data.qpos.copy()
        configuration[:7] = posture
        assert not expert.ik.in_collision(configuration)
        first = variant.waypoints[0]
        assert first.move == "reach"
        anchor = np.zeros(3)
        if first.anchor is not None:
            anchor = expert.data.site(first.anchor).xpos
        reached = expert.ik.solve(
            configuration,
            anchor + first.offset,
            tool_rotation(first.yaw, first.pitch, first.roll),
            iterations=30,
        )
        assert reached.position_error < 5e-3
        assert reached.rotation_error < 0.05
        for waypoint in variant.waypoints:
            if waypoint.until is not None:
                joint = franka_kitchen.unwrapped.robot_env.model.joint(waypoint.joint)
                assert joint.qposadr[0] in variant.columns
                at = variant.columns.index(joint.qposadr[0])
                assert abs(waypoint.until - variant.goal[at]) < 0.1
                assert waypoint.lead * variant.goal[at] > 0
        whole = variant.with_retreat()
        assert whole.waypoints[: len(variant.waypoints)] == variant.waypoints
        stages = whole.waypoints[len(variant.waypoints) :]
        assert stages and {stage.move for stage in stages} == {"back"}
        assert {stage.gripper for stage in stages} == {first.gripper}


def test_tool_rotation_points_where_the_angles_say():
    right = tool_rotation(yaw=0.4)[:, 2]
    assert right[0] == pytest.approx(np.sin(0.4))
    down = tool_rotation(pitch=-0.4)[:, 2]
    assert down[2] == pytest.approx(-np.sin(0.4))
    rolled = tool_rotation(0.2, -0.3, 0.5)
    np.testing.assert_allclose(rolled @ rolled.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rolled[:, 2], tool_rotation(0.2, -0.3)[:, 2])


def test_bad_input():
    with pytest.raises(ValueError, match="needs joint, anchor and until"):
        Waypoint("follow")
    with pytest.raises(KeyError, match="no expert for task 'toaster'"):
        get_task("toaster")
    assert get_task("kettle") is get_task(TASKS["kettle"])
