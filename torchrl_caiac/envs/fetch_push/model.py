"""The MuJoCo model of Fetch-Push, built from the one in gymnasium-robotics."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium_robotics
import mujoco
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "COLLIDING_BODIES",
    "CUBE_HALF",
    "STATE",
    "TABLE_HIGH",
    "TABLE_LOW",
    "TABLE_TOP",
    "CompiledModel",
    "compile_model",
]

#: Half the side of a cube, in metres.
CUBE_HALF = 0.025
# The table of gymnasium-robotics ends 6 cm beyond the region in which cubes are drawn,
# and a cube that is pushed off it is lost. This one is larger. It must not come closer
# to the robot: it would overlap the robot's base, which halves the speed.
#: Corners of the table's surface (x, y) and its height, in metres.
TABLE_LOW, TABLE_HIGH = np.array([1.0, 0.3]), np.array([1.7, 1.2])
TABLE_TOP = 0.4
#: The links of the robot that can touch the table or a cube. The others do not collide.
COLLIDING_BODIES = tuple(
    f"robot0:{link}_link"
    for link in (
        "wrist_flex",
        "wrist_roll",
        "gripper",
        "r_gripper_finger",
        "l_gripper_finger",
    )
)
#: The parts of MuJoCo's state that the next step depends on. The target of the gripper
#: is not among them: every step sets it.
STATE = (
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_WARMSTART
)
_COLOURS = (
    (0.85, 0.25, 0.2),
    (0.2, 0.4, 0.85),
    (0.25, 0.65, 0.3),
    (0.9, 0.65, 0.15),
    (0.55, 0.35, 0.7),
)


class CompiledModel(NamedTuple):
    """A MuJoCo model and the indices of what the simulator reads.

    Attributes:
        model (mujoco.MjModel): the model. It is shared and must not be changed.
        state_size (int): the length of a state vector.
        gripper_body (int): id of the body that the actions move.
        gripper_site (int): id of the site whose position is observed.
        finger_positions (NDArray): indices ``[2]`` of the fingers in ``qpos``.
        finger_velocities (NDArray): indices ``[2]`` of the fingers in ``qvel``.
        cube_bodies (NDArray): ids ``[n]`` of the cubes' bodies.
        cube_position (int): where the cubes start in ``qpos``; they are the last
            entries, seven per cube.
        cube_velocity (int): where the cubes start in ``qvel``, six per cube.
    """

    model: Any
    state_size: int
    gripper_body: int
    gripper_site: int
    finger_positions: NDArray[np.intp]
    finger_velocities: NDArray[np.intp]
    cube_bodies: NDArray[np.intp]
    cube_position: int
    cube_velocity: int


@functools.cache
def compile_model(num_cubes: int, cube_friction: float | None = None) -> CompiledModel:
    """Builds the model with a number of cubes, once per process.

    Args:
        num_cubes (int): the number of cubes.
        cube_friction (float, optional): the coefficient of sliding friction of the
            cubes on everything. Defaults to ``None``: that of gymnasium-robotics.

    Returns:
        CompiledModel: the model, shared by all simulators of the process.

    Examples:
        >>> from torchrl_caiac.envs.fetch_push.model import compile_model
        >>> compile_model(2).cube_bodies.shape
        (2,)
    """
    model = _specification(num_cubes, cube_friction).compile()
    # gymnasium-robotics resets the weld in the same way: the gripper has the pose of
    # the mocap body.
    model.eq_data[0, :7] = [0, 0, 0, 0, 0, 0, 1]
    fingers = [model.joint(f"robot0:{s}_gripper_finger_joint") for s in "rl"]
    cubes = [model.joint(f"object{i}:joint") for i in range(num_cubes)]
    compiled = CompiledModel(
        model=model,
        state_size=mujoco.mj_stateSize(model, STATE),
        gripper_body=model.body("robot0:gripper_link").id,
        gripper_site=model.site("robot0:grip").id,
        finger_positions=np.array([joint.qposadr[0] for joint in fingers]),
        finger_velocities=np.array([joint.dofadr[0] for joint in fingers]),
        cube_bodies=np.array([model.body(f"object{i}").id for i in range(num_cubes)]),
        cube_position=int(cubes[0].qposadr[0]),
        cube_velocity=int(cubes[0].dofadr[0]),
    )
    assert compiled.cube_position + 7 * num_cubes == model.nq
    assert compiled.cube_velocity + 6 * num_cubes == model.nv
    return compiled


def _specification(num_cubes: int, cube_friction: float | None) -> Any:
    packaged = Path(gymnasium_robotics.__file__).parent / "envs/assets/fetch/push.xml"
    spec = mujoco.MjSpec.from_file(str(packaged))
    for body in spec.bodies:
        if body.name.startswith("robot0:") and body.name not in COLLIDING_BODIES:
            for geom in body.geoms:
                geom.contype = geom.conaffinity = 0
    for geom in spec.body("robot0:mocap").geoms:
        geom.rgba = [0, 0, 0, 0]
    table = spec.body("table0")
    table.pos = [*(TABLE_LOW + TABLE_HIGH) / 2, TABLE_TOP / 2]
    table.geoms[0].size = [*(TABLE_HIGH - TABLE_LOW) / 2, TABLE_TOP / 2]
    spec.delete(spec.site("target0"))

    first = spec.body("object0")
    for i in range(num_cubes):
        body = first if i == 0 else _copy_cube(spec, first, i)
        for site in list(body.sites):
            spec.delete(site)
        colour = _COLOURS[i % len(_COLOURS)]
        body.geoms[0].rgba = [*colour, 1.0]
        if cube_friction is not None:
            body.geoms[0].friction[0] = cube_friction
            body.geoms[0].priority = 1  # else the larger friction of the two counts
        # A goal is a body without mass and collisions, and MjData has its position.
        # So all environments can share the model.
        goal = spec.worldbody.add_body(name=f"goal{i}", mocap=True)
        goal.add_site(
            name=f"goal{i}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.02] * 3,
            rgba=[*colour, 0.5],
        )
    return spec


def _copy_cube(spec: Any, cube: Any, number: int) -> Any:
    body = spec.worldbody.add_body(name=f"object{number}")
    joint, geom = cube.joints[0], cube.geoms[0]
    body.add_joint(name=f"object{number}:joint", type=joint.type, damping=joint.damping)
    body.add_geom(
        name=f"object{number}",
        type=geom.type,
        size=geom.size,
        condim=geom.condim,
        material=geom.material,
        mass=geom.mass,
    )
    return body
