"""Damped least squares against geometry that is known in closed form."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchrl_caiac.envs.kitchen.inverse_kinematics import InverseKinematics
from torchrl_caiac.envs.kitchen.rotations import rotation_vector

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="wall" pos="0 2.6 0"><geom type="box" size="1 .1 1"/></body>
    <body name="one">
      <joint name="a" axis="0 0 1" range="-2 2" limited="true"/>
      <geom type="capsule" fromto="0.2 0 0 .8 0 0" size=".05"/>
      <body name="two" pos="1 0 0">
        <joint name="b" axis="0 0 1" range="-2.5 2.5" limited="true"/>
        <geom type="capsule" fromto="0.2 0 0 .8 0 0" size=".05"/>
        <body name="three" pos="1 0 0">
          <joint name="c" axis="0 0 1" range="-2.5 2.5" limited="true"/>
          <geom type="capsule" fromto="0.2 0 0 .4 0 0" size=".05"/>
          <site name="tip" pos=".4 0 0"/>
        </body>
      </body>
    </body>
    <body name="free"><freejoint name="loose"/><geom size=".01" pos="0 0 5"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(ARM)


@pytest.fixture()
def solver(model):
    return InverseKinematics(
        model, "tip", ["a", "b", "c"], offset=(0.1, 0, 0), iterations=80
    )


def start(model, joints=(0.3, 0.4, 0.2)):
    qpos = mujoco.MjData(model).qpos.copy()
    qpos[:3] = joints
    return qpos


def tip(joints):
    angles = np.cumsum(joints)
    lengths = np.array([1.0, 1.0, 0.5])
    return np.array([lengths @ np.cos(angles), lengths @ np.sin(angles), 0.0])


def test_pose_is_forward_kinematics(model, solver):
    joints = (0.5, -0.7, 1.1)
    point, rotation = solver.pose(start(model, joints))
    np.testing.assert_allclose(point, tip(joints), atol=1e-9)
    assert rotation_vector(rotation)[2] == pytest.approx(sum(joints))


@settings(deadline=None, max_examples=25)
@given(
    st.tuples(
        st.floats(-1.2, 1.2), st.floats(0.3, 1.8), st.floats(0.3, 1.8), st.booleans()
    )
)
def test_reaches_what_can_be_reached_within_limits(case):
    *joints, oriented = case
    model = mujoco.MjModel.from_xml_string(ARM)
    solver = InverseKinematics(
        model, "tip", ["a", "b", "c"], offset=(0.1, 0, 0), iterations=300
    )
    target = tip(joints)
    angle = sum(joints)
    rotation = Rotation.from_euler("z", angle).as_matrix() if oriented else None
    near = np.array(joints) + 0.2
    solution = solver.solve(start(model, near), target, rotation)
    assert solution.position_error < 5e-3
    assert solution.rotation_error < 2e-2
    np.testing.assert_allclose(tip(solution.joints), target, atol=5e-3)
    low, high = solver.limits.T
    assert (solution.joints >= low).all() and (solution.joints <= high).all()


def test_a_joint_at_its_limit_is_frozen_and_the_others_solve(model):
    limits = [(-2, 2), (-2.5, 0.4), (-2.5, 2.5)]
    solver = InverseKinematics(
        model, "tip", ["a", "b", "c"], offset=(0.1, 0, 0), limits=limits, iterations=300
    )
    target = tip((0.1, 0.2, 1.5))
    solution = solver.solve(start(model, (0.3, 0.4, 0.2)), target)
    assert solution.joints[1] <= 0.4
    assert solution.position_error < 5e-3


def test_out_of_reach_reports_the_error_that_is_left(model, solver):
    solution = solver.solve(start(model), (5.0, 0.0, 0.0))
    assert solution.position_error == pytest.approx(2.5, abs=0.05)


def test_posture_is_approached_without_giving_up_the_target(model, solver):
    target = tip((0.2, 0.9, 0.4))
    posture = np.array([-0.4, 1.3, 1.0])
    free = solver.solve(start(model), target, iterations=300)
    drawn = solver.solve(start(model), target, posture=posture, iterations=300)
    assert drawn.position_error < 1e-2
    assert np.linalg.norm(drawn.joints - posture) < np.linalg.norm(
        free.joints - posture
    )


def test_find_posture_avoids_the_wall(model, solver):
    qpos = start(model)
    rng = np.random.default_rng(0)
    joints = solver.find_posture(qpos, (0.5, 2.2, 0.0), near=qpos[:3], rng=rng)
    np.testing.assert_allclose(tip(joints), (0.5, 2.2, 0.0), atol=6e-3)
    qpos[:3] = joints
    assert not solver.in_collision(qpos)
    with pytest.raises(RuntimeError, match="no collision-free posture"):
        solver.find_posture(qpos, (0.0, 3.0, 0.0), near=qpos[:3], rng=rng, restarts=4)


def test_in_collision_sees_the_wall(model, solver):
    assert solver.in_collision(start(model, (np.pi / 2, 0.0, 0.0))) is False
    wall = mujoco.MjModel.from_xml_string(ARM.replace('pos="0 2.6 0"', 'pos="0 2.5 0"'))
    closer = InverseKinematics(wall, "tip", ["a", "b", "c"])
    assert closer.in_collision(start(wall, (np.pi / 2, 0.0, 0.0))) is True
    assert closer.in_collision(start(wall, (0.0, 0.0, 0.0))) is False


def test_bad_input(model, solver):
    with pytest.raises(ValueError, match="no site named 'nose'"):
        InverseKinematics(model, "nose", ["a"])
    with pytest.raises(ValueError, match="no joint named 'z'"):
        InverseKinematics(model, "tip", ["a", "z"])
    with pytest.raises(ValueError, match="several degrees of freedom"):
        InverseKinematics(model, "tip", ["loose"])
    with pytest.raises(ValueError, match=r"shape \(1, 2\), expected \(2, 2\)"):
        InverseKinematics(model, "tip", ["a", "b"], limits=[(0, 1)])
    with pytest.raises(ValueError, match="finite"):
        solver.solve(start(model), (np.nan, 0, 0))


def test_clearance_counts_what_is_near(model):
    solver = InverseKinematics(model, "tip", ["a", "b", "c"])
    # Straight up the plane: the last link's capsule ends at 2.45, the wall begins at
    # 2.5.
    qpos = start(model, (np.pi / 2, 0.0, 0.0))
    assert not solver.in_collision(qpos)
    assert not solver.in_collision(qpos, clearance=0.04)
    assert solver.in_collision(qpos, clearance=0.06)
    # Neighbouring links are near one another and do not count.
    assert not solver.in_collision(start(model, (0.0, 0.0, 0.0)), clearance=0.06)
    assert (model.geom_margin == 0).all()


def test_routes_go_round_what_is_in_the_way(model):
    solver = InverseKinematics(model, "tip", ["a", "b", "c"])
    # A straight arm comes within 5 cm of the wall.
    clearance = 0.08
    right, left = np.array([1.2, 0.0, 0.0]), np.array([1.9, 0.0, 0.0])
    low, folded = np.array([0.5, 0.0, 0.0]), np.array([1.5, 2.4, 0.0])

    def close(route, begin=right):
        count = 0
        for first, last in zip([begin, *route], route, strict=False):
            samples = round(np.abs(last - first).max() / 0.02)
            for share in np.linspace(0, 1, samples)[1:]:
                joints = first + share * (last - first)
                count += solver.in_collision(start(model, joints), clearance)
        return count

    free = solver.find_route(start(model, right), low, [folded], clearance=clearance)
    assert len(free) == 1
    np.testing.assert_array_equal(free[0], low)
    assert close([left]) > 0
    round_ = solver.find_route(
        start(model, right), left, [low, folded], clearance=clearance
    )
    np.testing.assert_array_equal(round_, [folded, left])
    assert close(round_) == 0
    # No way is free: the one least in the way.
    near, beyond = np.array([1.65, 0.0, 0.0]), np.array([2.6, 0.0, 0.0])
    least = solver.find_route(start(model, right), near, [beyond], clearance=clearance)
    np.testing.assert_array_equal(least, [near])
    assert close([beyond, near]) > close([near]) > 0
