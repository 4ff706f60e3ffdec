"""Fetch-Push with several cubes (sections 4.3 and A.6.2 of the paper)."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

# First: where mujoco cannot be imported, it says why.
from torchrl_caiac.envs.rendering import OffscreenRenderer

# isort: split
import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import torch
from gymnasium_robotics.utils.rotations import mat2euler

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.envs.goal_env import make_goal_env

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from torchrl.envs import EnvBase

__all__ = [
    "FETCH_PUSH_ENV_ID",
    "FetchPushCubes",
    "FetchPushState",
    "FetchPushTruth",
    "fetch_push_distances",
    "fetch_push_layout",
    "fetch_push_reward",
    "make_fetch_push_env",
    "register_fetch_push",
]

FETCH_PUSH_ENV_ID = "torchrl_caiac/FetchPushCubes-v0"

_THRESHOLD = 0.05
_EPISODE_STEPS = 100
# As in gymnasium-robotics' FetchPush: substeps of 2 ms a step, and what an action of 1
# moves the gripper's target by, metres.
_SUBSTEPS = 20
_ACTION_SCALE = 0.05
# The gripper points down: its target's orientation, added to the present one.
_DOWN = np.array([1.0, 0.0, 1.0, 0.0])
# Above the table's centre and, with all noise, above the cubes (their top is at 0.45,
# the fingers end 1.9 cm below this point).
_START = np.array([1.342, 0.749, 0.505])
_NOISE_SCALE = np.array([1.0, 1.0, 0.3])
_MAX_NOISE = 0.1
_SETTLE_STEPS = 40
_RESET_STEPS = 10
# Half a cube's side; the table's surface. The packaged table ends 6 cm beyond where
# cubes are drawn, and a cube that is pushed off is lost. Nearer to the robot than this
# the table would overlap its base, which costs half the speed.
_CUBE_HALF = 0.025
_TABLE_LOW, _TABLE_HIGH = np.array([1.0, 0.3]), np.array([1.7, 1.2])
_TABLE_TOP = 0.4
# The gripper reaches these distances from the shoulder's axis tilted by less than 15
# degrees.
_SHOULDER = np.array([0.7245, 0.7441])
_REACH = (0.40, 0.87)
# Between the centres of cubes, of goals, and of a cube and the gripper (horizontally),
# when they are drawn; between the centres of cubes that touch at their corners.
_SEPARATION = 0.1
_DIAGONAL = 2 * np.sqrt(2) * _CUBE_HALF
_MAX_DRAWS = 200
# Links that touch the table or a cube; the others never come near.
_COLLIDING = tuple(
    f"robot0:{link}_link"
    for link in (
        "wrist_flex",
        "wrist_roll",
        "gripper",
        "r_gripper_finger",
        "l_gripper_finger",
    )
)
_COLOURS = (
    (0.85, 0.25, 0.2),
    (0.2, 0.4, 0.85),
    (0.25, 0.65, 0.3),
    (0.9, 0.65, 0.15),
    (0.55, 0.35, 0.7),
)
_CAMERA = {
    "lookat": np.array([1.3, 0.75, 0.47]),
    "distance": 1.25,
    "azimuth": 145.0,
    "elevation": -32.0,
}
_GRIPPER_WIDTH, _CUBE_WIDTH = 10, 12


def fetch_push_layout(num_cubes: int = 2) -> EntityLayout:
    """Return the entities of the observation: the gripper (fixed) and the cubes.

    Args:
        num_cubes: ``n``.

    Returns:
        a flat layout over ``10 + 12 n`` columns; the goal has three columns a cube,
        which mirror its position.

    Example:
        >>> fetch_push_layout(2)
        EntityLayout(
            gripper: observation[0:10], fixed
            cube0: observation[10:22], goal[0:3] mirrors observation[10:13]
            cube1: observation[22:34], goal[3:6] mirrors observation[22:25]
        )
    """
    cubes = _cube_columns(num_cubes)
    return EntityLayout(
        {"gripper": range(_GRIPPER_WIDTH), **cubes},
        goal={name: range(3 * i, 3 * i + 3) for i, name in enumerate(cubes)},
        achieved={name: columns[:3] for name, columns in cubes.items()},
        fixed=("gripper",),
    )


def _cube_columns(num_cubes: int) -> dict[str, range]:
    if num_cubes < 1:
        raise ValueError(f"num_cubes is {num_cubes}, wanted at least 1")
    first = [_GRIPPER_WIDTH + _CUBE_WIDTH * i for i in range(num_cubes)]
    return {f"cube{i}": range(c, c + _CUBE_WIDTH) for i, c in enumerate(first)}


def fetch_push_distances(achieved: Any, desired: Any) -> Any:
    """Return each cube's distance to its goal, in metres.

    Args:
        achieved: positions of the cubes ``[*B, 3 n]`` (numpy or torch).
        desired: their goals ``[*B, 3 n]`` (numpy or torch, as ``achieved``).

    Returns:
        ``[*B, n]``.

    Example:
        >>> import numpy as np
        >>> fetch_push_distances(np.zeros(6), np.array([0.0, 3, 4, 0, 0, 1]))
        array([5., 1.])
    """
    shapes = {"achieved": np.shape(achieved), "desired": np.shape(desired)}
    for name, shape in shapes.items():
        if not shape or shape[-1] == 0 or shape[-1] % 3:
            raise ValueError(
                f"{name} goal has shape {tuple(shape)}, wanted [*B, 3 n]: the "
                "positions of n cubes"
            )
    if shapes["achieved"][-1] != shapes["desired"][-1]:
        raise ValueError(
            f"achieved and desired goals have shapes {tuple(shapes['achieved'])} and "
            f"{tuple(shapes['desired'])}, wanted the same last dimension: are they of "
            "environments with different numbers of cubes?"
        )
    if isinstance(achieved, torch.Tensor) or isinstance(desired, torch.Tensor):
        achieved = torch.as_tensor(achieved)
        difference = achieved - torch.as_tensor(desired, device=achieved.device)
        return (
            difference.unflatten(-1, (difference.shape[-1] // 3, 3))
            .square()
            .sum(-1)
            .sqrt()
        )
    difference = np.asarray(achieved) - np.asarray(desired)
    shape = (*difference.shape[:-1], difference.shape[-1] // 3, 3)
    return np.sqrt(np.square(difference.reshape(shape)).sum(-1))


def fetch_push_reward(
    achieved: Any, desired: Any, info: Any = None, *, threshold: float = _THRESHOLD
) -> Any:
    """Return the sparse reward: 0 where every cube is at its goal, else -1 (A.6.2).

    Args:
        achieved: positions of the cubes ``[*B, 3 n]`` (numpy or torch).
        desired: their goals ``[*B, 3 n]``.
        info: ignored; there because goal environments pass it.

    Keyword Args:
        threshold: distance below which a cube is at its goal, in metres.

    Returns:
        ``[*B]`` float32, numpy or torch as the input.

    Example:
        >>> import torch
        >>> achieved = torch.zeros(2, 6)
        >>> fetch_push_reward(achieved, torch.tensor([0, 0, 0, 0, 0, 0.04]))
        tensor([0., 0.])
        >>> fetch_push_reward(achieved, torch.tensor([0, 0, 0, 0, 0, 0.06]))
        tensor([-1., -1.])
    """
    reached = (fetch_push_distances(achieved, desired) < threshold).all(-1)
    if isinstance(reached, torch.Tensor):
        return reached.to(torch.float32) - 1
    return np.asarray(reached).astype(np.float32) - np.float32(1)


class _Compiled(NamedTuple):
    """A model, which environments share, and the places of what they read in it."""

    model: Any
    state_size: int
    gripper_body: int
    gripper_site: int
    finger_positions: NDArray[np.intp]
    finger_velocities: NDArray[np.intp]
    cube_bodies: NDArray[np.intp]
    cube_position: int
    cube_velocity: int


# What the next step depends on; the gripper's target is set anew in every step.
_STATE = (
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_WARMSTART
)


@functools.cache
def _compiled(num_cubes: int) -> _Compiled:
    """Build the model once a process, from gymnasium-robotics' packaged one."""
    packaged = Path(gymnasium_robotics.__file__).parent / "envs/assets/fetch/push.xml"
    spec = mujoco.MjSpec.from_file(str(packaged))
    for body in spec.bodies:
        if body.name.startswith("robot0:") and body.name not in _COLLIDING:
            for geom in body.geoms:
                geom.contype = geom.conaffinity = 0
    for geom in spec.body("robot0:mocap").geoms:
        geom.rgba = [0, 0, 0, 0]
    table = spec.body("table0")
    table.pos = [*(_TABLE_LOW + _TABLE_HIGH) / 2, _TABLE_TOP / 2]
    table.geoms[0].size = [*(_TABLE_HIGH - _TABLE_LOW) / 2, _TABLE_TOP / 2]
    spec.delete(spec.site("target0"))

    first = spec.body("object0")
    for i in range(num_cubes):
        body = first
        if i:
            joint, geom = first.joints[0], first.geoms[0]
            body = spec.worldbody.add_body(name=f"object{i}")
            body.add_joint(
                name=f"object{i}:joint", type=joint.type, damping=joint.damping
            )
            body.add_geom(
                name=f"object{i}",
                type=geom.type,
                size=geom.size,
                condim=geom.condim,
                material=geom.material,
                mass=geom.mass,
            )
        for site in list(body.sites):
            spec.delete(site)
        colour = _COLOURS[i % len(_COLOURS)]
        body.geoms[0].rgba = [*colour, 1.0]
        # Goals are bodies without mass or collisions, moved through MjData: the model
        # stays the same for all environments.
        goal = spec.worldbody.add_body(name=f"goal{i}", mocap=True)
        goal.add_site(
            name=f"goal{i}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.02] * 3,
            rgba=[*colour, 0.5],
        )
    model = spec.compile()
    # Upstream resets the weld in this way: the gripper sits in the mocap body's frame.
    model.eq_data[0, :7] = [0, 0, 0, 0, 0, 0, 1]
    fingers = [model.joint(f"robot0:{s}_gripper_finger_joint") for s in "rl"]
    cubes = [model.joint(f"object{i}:joint") for i in range(num_cubes)]
    compiled = _Compiled(
        model=model,
        state_size=mujoco.mj_stateSize(model, _STATE),
        gripper_body=model.body("robot0:gripper_link").id,
        gripper_site=model.site("robot0:grip").id,
        finger_positions=np.array([joint.qposadr[0] for joint in fingers]),
        finger_velocities=np.array([joint.dofadr[0] for joint in fingers]),
        cube_bodies=np.array([model.body(f"object{i}").id for i in range(num_cubes)]),
        cube_position=int(cubes[0].qposadr[0]),
        cube_velocity=int(cubes[0].dofadr[0]),
    )
    # The cubes' coordinates are the last ones, one cube after the other.
    assert compiled.cube_position + 7 * num_cubes == model.nq
    assert compiled.cube_velocity + 6 * num_cubes == model.nv
    return compiled


@functools.cache
def _settled() -> tuple[NDArray[np.float64], float]:
    """Return the robot's joints with the gripper at the start, and a cube's height."""
    compiled = _compiled(1)
    data = mujoco.MjData(compiled.model)
    for name, value in (("slide0", 0.405), ("slide1", 0.48), ("slide2", 0.0)):
        data.joint(f"robot0:{name}").qpos[0] = value
    corner = _TABLE_HIGH - 0.1
    data.qpos[-7:] = [*corner, _TABLE_TOP + _CUBE_HALF, 1, 0, 0, 0]
    mujoco.mj_forward(compiled.model, data)
    _move_gripper(compiled, data, _START, _SETTLE_STEPS)
    return data.qpos[:-7].copy(), float(data.qpos[-5])


def _move_gripper(
    compiled: _Compiled, data: Any, position: NDArray[np.float64], steps: int
) -> None:
    """Draw the gripper to a position, without the speed limit of actions."""
    data.mocap_quat[0] = _DOWN
    for _ in range(steps):
        offset = (
            data.xpos[compiled.gripper_body] - data.site_xpos[compiled.gripper_site]
        )
        data.mocap_pos[0] = position + offset
        _advance(compiled, data)


def _advance(compiled: _Compiled, data: Any) -> None:
    """Simulate one step; bring up to date what observations and targets read."""
    model = compiled.model
    mujoco.mj_step(model, data, nstep=_SUBSTEPS)
    data.qpos[compiled.finger_positions] = 0.0
    _refresh(model, data)


def _refresh(model: Any, data: Any) -> None:
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)


def _act(compiled: _Compiled, data: Any, action: NDArray[np.float64]) -> None:
    body = compiled.gripper_body
    data.mocap_pos[0] = data.xpos[body] + _ACTION_SCALE * action[:3]
    data.mocap_quat[0] = data.xquat[body] + _DOWN
    _advance(compiled, data)


def _observation(
    compiled: _Compiled, data: Any, out: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Write the observation ``[10 + 12 n]``, in double precision."""
    dt = _SUBSTEPS * compiled.model.opt.timestep
    velocity = np.empty(6)
    mujoco.mj_objectVelocity(
        compiled.model,
        data,
        mujoco.mjtObj.mjOBJ_SITE.value,
        compiled.gripper_site,
        velocity,
        0,
    )
    out[0:3] = data.site_xpos[compiled.gripper_site]
    out[3:5] = data.qpos[compiled.finger_positions]
    out[5:8] = velocity[3:] * dt
    out[8:10] = data.qvel[compiled.finger_velocities] * dt
    cubes = out[_GRIPPER_WIDTH:].reshape(-1, _CUBE_WIDTH)
    rotation = data.xmat[compiled.cube_bodies].reshape(-1, 3, 3)
    velocities = data.qvel[compiled.cube_velocity :].reshape(-1, 6)
    cubes[:, 0:3] = data.qpos[compiled.cube_position :].reshape(-1, 7)[:, :3]
    cubes[:, 3:6] = mat2euler(rotation)
    cubes[:, 6:9] = velocities[:, :3] * dt
    # A free joint's angular velocity is in the body's own axes.
    cubes[:, 9:12] = (rotation @ velocities[:, 3:, None])[..., 0] * dt
    return out


@dataclass(frozen=True)
class FetchPushState:
    """Everything an episode depends on: an exact, picklable snapshot.

    Attributes:
        simulator: the simulator's state ``[S]``, see
            :meth:`FetchPushCubes.simulator_state`.
        goal: the desired goal ``[3 n]``.
        steps: environment steps taken.
        generator: state of the random generator of starts and goals.
    """

    simulator: NDArray[np.float64]
    goal: NDArray[np.float64]
    steps: int
    generator: dict[str, Any] = field(repr=False)


class FetchPushCubes(gymnasium.Env[dict[str, Any], Any]):
    """Push each of several cubes to its own goal on the table (A.6.2).

    Robot, cubes and action are those of gymnasium-robotics' ``FetchPush``: an action
    moves the gripper's target by up to 5 cm, of which the arm makes 3.3 cm in a step of
    0.04 s; the fingers stay closed, so the fourth number does nothing. The table is
    larger, so that cubes stay on it, and links that never touch anything do not
    collide.

    The observation has ``10 + 12 n`` columns, which :attr:`layout` names: gripper
    position (3), finger positions (2), gripper velocity (3), finger velocities (2);
    then for each cube position (3), Euler angles (3; about x, then the new y, then the
    new z), linear velocity (3), angular velocity (3). All are in the world's frame,
    unlike in ``FetchPush``: coordinates relative to the gripper would entangle the
    entities. Positions are in metres, angles in radians, velocities, as there, per step
    (0.04 s). The goal holds the positions of all cubes.

    Args:
        num_cubes: ``n``.

    Keyword Args:
        max_episode_steps: steps after which an episode is truncated.
        distance_threshold: distance below which a cube is at its goal, in metres.
        terminate_on_success: end the episode when all cubes are at their goals.
        cube_range: cubes are drawn from a square around the table's centre; half its
            side, in metres.
        goal_range: the same of goals.
        gripper_noise: the gripper starts up to this far from the table's centre, along
            x and y, in metres (a third of it in height).
        render_mode: ``None`` or ``"rgb_array"``.
        render_size: width and height of rendered frames, in pixels.

    ``reset`` takes ``options`` with the keys ``"cubes"`` and ``"goals"``, positions
    ``[n, 2]`` or ``[n, 3]``. What is drawn keeps 10 cm between the cubes, between the
    goals, and between cubes and gripper, and no cube starts at its goal. ``reset`` and
    ``step`` return in ``info``:

    - ``"success"``: all cubes at their goals;
    - ``"cube_success"``: bool ``[n]``, which are;
    - ``"is_success"``: ``"success"`` as float32, as in gymnasium-robotics.

    Raises:
        ValueError: an argument is out of range, or the cubes or goals do not fit into
            their regions.

    Example:
        >>> env = FetchPushCubes(2)
        >>> observation, info = env.reset(
        ...     seed=0, options={"cubes": [[1.3, 0.7], [1.4, 0.8]]}
        ... )
        >>> observation["observation"].shape, observation["desired_goal"].shape
        ((34,), (6,))
        >>> observation["achieved_goal"].round(2)
        array([1.3 , 0.7 , 0.42, 1.4 , 0.8 , 0.42], dtype=float32)
        >>> observation, reward, terminated, truncated, info = env.step(np.zeros(4))
        >>> reward, bool(info["success"])
        (-1.0, False)
        >>> env.layout.names
        ('gripper', 'cube0', 'cube1')
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": 25,
    }

    def __init__(
        self,
        num_cubes: int = 2,
        *,
        max_episode_steps: int = _EPISODE_STEPS,
        distance_threshold: float = _THRESHOLD,
        terminate_on_success: bool = False,
        cube_range: float = 0.15,
        goal_range: float = 0.15,
        gripper_noise: float = 0.05,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (320, 240),
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode is {render_mode!r}, wanted None or 'rgb_array'"
            )
        if max_episode_steps < 1:
            raise ValueError(
                f"max_episode_steps is {max_episode_steps}, wanted at least 1"
            )
        if not (np.isfinite(distance_threshold) and distance_threshold > 0):
            raise ValueError(
                f"distance_threshold is {distance_threshold}, wanted a positive "
                "distance"
            )
        if not 0 <= gripper_noise <= _MAX_NOISE:
            raise ValueError(
                f"gripper_noise is {gripper_noise}, wanted between 0 and {_MAX_NOISE}"
            )
        #: The entities of the observation and their goal columns.
        self.layout = fetch_push_layout(num_cubes)
        self.num_cubes = num_cubes
        self.max_episode_steps = max_episode_steps
        self.distance_threshold = distance_threshold
        self.terminate_on_success = terminate_on_success
        self.cube_range = cube_range
        self.goal_range = goal_range
        self.gripper_noise = gripper_noise
        self.render_mode = render_mode
        self.render_size = render_size
        self._renderer: OffscreenRenderer | None = None
        self._compiled = _compiled(num_cubes)
        self.data = mujoco.MjData(self.model)
        self._scratch: Any = None
        self._goal = np.zeros((num_cubes, 3))
        self._steps = 0
        self._ready = False
        self._check_regions()

        def box(width: int) -> gymnasium.spaces.Box:
            return gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float32)

        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "observation": box(self._width),
                "achieved_goal": box(3 * num_cubes),
                "desired_goal": box(3 * num_cubes),
            }
        )

    @property
    def _width(self) -> int:
        return _GRIPPER_WIDTH + _CUBE_WIDTH * self.num_cubes

    @property
    def model(self) -> Any:
        """The MuJoCo model, shared by the process's environments: do not change it."""
        return self._compiled.model

    @property
    def dt(self) -> float:
        """Seconds of an environment step."""
        return float(_SUBSTEPS * self.model.opt.timestep)

    @property
    def goal(self) -> NDArray[np.float64]:
        """The desired goal ``[3 n]`` of this episode, a copy."""
        return self._goal.flatten()

    # Gymnasium.

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        """Start an episode.

        Keyword Args:
            seed: seeds starts and goals; equal seeds give equal episodes.
            options: ``"cubes"`` and ``"goals"``, positions ``[n, 2]`` or ``[n, 3]``;
                what is left out is drawn.

        Returns:
            observation dictionary and info.

        Raises:
            ValueError: a position is off the table, out of reach or overlaps another.
        """
        options = dict(options or {})
        unknown = sorted(set(options) - {"cubes", "goals"})
        if unknown:
            raise ValueError(
                f"reset options hold {unknown}, wanted among 'cubes', 'goals'"
            )
        cubes = self._positions("cubes", options.get("cubes"))
        goals = self._positions("goals", options.get("goals"))
        super().reset(seed=seed)
        gripper = _START + self.gripper_noise * _NOISE_SCALE * self.np_random.uniform(
            -1, 1, 3
        )
        if cubes is None:
            cubes = self._draw("cubes", self.np_random, gripper[:2], goals)
        if goals is None:
            goals = self._draw("goals", self.np_random, None, cubes)
        robot, _ = _settled()
        data = self.data
        mujoco.mj_resetData(self.model, data)
        data.qpos[: len(robot)] = robot
        poses = data.qpos[len(robot) :].reshape(-1, 7)
        poses[:] = np.concatenate((cubes, np.tile([1.0, 0, 0, 0], (len(cubes), 1))), 1)
        start = poses.copy()
        _refresh(self.model, data)
        _move_gripper(self._compiled, data, gripper, _RESET_STEPS)
        poses[:] = start
        data.qvel[:] = 0.0
        data.qacc_warmstart[:] = 0.0
        _refresh(self.model, data)
        self._set_goal(goals)
        self._steps = 0
        self._ready = True
        observation = self._observe()
        return observation, self._info(observation)

    def step(
        self, action: ArrayLike
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        """Move the gripper for 0.04 s.

        Args:
            action: ``[4]`` in [-1, 1], clipped: the gripper's displacement (times 5
                cm) and its opening, which does nothing.

        Returns:
            observation, reward (0 on success, else -1), terminated, truncated, info.
        """
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (4,):
            raise ValueError(f"action has shape {values.shape}, wanted (4,)")
        if not np.isfinite(values).all():
            raise ValueError(
                f"action holds non-finite values: {values.tolist()}; look at what the "
                "policy was given"
            )
        self._check_ready()
        _act(self._compiled, self.data, np.clip(values, -1.0, 1.0))
        self._check_stable()
        self._steps += 1
        observation = self._observe()
        info = self._info(observation)
        success = bool(info["success"])
        return (
            observation,
            0.0 if success else -1.0,
            success and self.terminate_on_success,
            self._steps >= self.max_episode_steps,
            info,
        )

    def compute_reward(self, achieved: Any, desired: Any, info: Any = None) -> Any:
        """Return the reward of goals in a batch; see :func:`fetch_push_reward`.

        Args:
            achieved: achieved goals ``[*B, 3 n]``, numpy or torch.
            desired: desired goals ``[*B, 3 n]``.
            info: ignored.

        Returns:
            ``[*B]`` float32: 0 where all cubes are at their goals, else -1.
        """
        for name, value in (("achieved", achieved), ("desired", desired)):
            shape = tuple(np.shape(value))
            if not shape or shape[-1] != 3 * self.num_cubes:
                raise ValueError(
                    f"{name} goal has shape {shape}, wanted "
                    f"[*B, {3 * self.num_cubes}]: the positions of "
                    f"{self.num_cubes} cubes"
                )
        return fetch_push_reward(
            achieved, desired, info, threshold=self.distance_threshold
        )

    def render(self) -> NDArray[np.uint8] | None:
        """Render the present state; goals are translucent balls of their cube's colour.

        Returns:
            RGB frame ``[height, width, 3]``; ``None`` without a render mode.

        Raises:
            RenderingUnavailable: no OpenGL context could be made.
        """
        if self.render_mode is None:
            return None
        self._check_ready()
        return self._frame(self.data)

    def render_states(
        self, states: ArrayLike, goals: ArrayLike | None = None
    ) -> NDArray[np.uint8]:
        """Render recorded states without touching the running episode.

        Args:
            states: ``[R, S]``, of :meth:`simulator_state`.
            goals: ``[3 n]`` or ``[R, 3 n]``; the present episode's by default.

        Returns:
            RGB frames ``[R, height, width, 3]``.

        Raises:
            RenderingUnavailable: no OpenGL context could be made.
        """
        vectors = np.atleast_2d(np.asarray(states, dtype=np.float64))
        shown = np.broadcast_to(
            self.goal if goals is None else np.asarray(goals, dtype=np.float64),
            (len(vectors), 3 * self.num_cubes),
        )
        data = self._get_scratch()
        frames = np.empty(
            (len(vectors), self.render_size[1], self.render_size[0], 3), dtype=np.uint8
        )
        for frame, vector, goal in zip(frames, vectors, shown, strict=True):
            self._restore(data, vector)
            data.mocap_pos[1:] = goal.reshape(-1, 3)
            frame[:] = self._frame(data)
        return frames

    def close(self) -> None:
        """Free the OpenGL context, if one was made."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    # Snapshots.

    def simulator_state(self) -> NDArray[np.float64]:
        """Return all that the simulator's next steps depend on, as one vector.

        Positions, velocities and the solver's warm start: the same actions after
        :meth:`set_simulator_state` give the same states, to the last bit.

        Returns:
            ``[S]``, float64; ``S`` is 83 for two cubes.
        """
        self._check_ready()
        state = np.empty(self._compiled.state_size)
        mujoco.mj_getState(self.model, self.data, state, int(_STATE))
        return state

    def set_simulator_state(
        self, state: ArrayLike, *, goal: ArrayLike | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Put the simulator into a recorded state, within the present episode.

        Args:
            state: ``[S]``, of :meth:`simulator_state`, of this or of another
                environment with as many cubes.

        Keyword Args:
            goal: the desired goal ``[3 n]``; as it is where ``None``.

        Returns:
            the observation there.
        """
        if goal is not None:
            wanted = np.asarray(goal, dtype=np.float64)
            if wanted.shape != (3 * self.num_cubes,) or not np.isfinite(wanted).all():
                raise ValueError(
                    f"goal has shape {wanted.shape}, wanted ({3 * self.num_cubes},), "
                    "finite"
                )
        self._restore(self.data, state)
        self._set_goal(self._goal if goal is None else wanted.reshape(-1, 3))
        self._ready = True
        return self._observe()

    def get_state(self) -> FetchPushState:
        """Return a snapshot; the same actions after :meth:`set_state` give the same."""
        return FetchPushState(
            simulator=self.simulator_state(),
            goal=self.goal,
            steps=self._steps,
            generator=dict(self.np_random.bit_generator.state),
        )

    def set_state(self, state: FetchPushState) -> None:
        """Restore a snapshot of :meth:`get_state`, exactly.

        Args:
            state: the snapshot, of this or of another environment with as many cubes.
        """
        self.set_simulator_state(state.simulator, goal=state.goal)
        self._steps = state.steps
        self.np_random.bit_generator.state = state.generator

    def outcomes(
        self, state: ArrayLike, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Return the next observation after each of several actions from one state.

        Without touching the running episode. To ask what an action influences, use
        :class:`FetchPushTruth`, which compares positions.

        Args:
            state: ``[S]``, of :meth:`simulator_state`.
            actions: ``[K, 4]`` in [-1, 1].

        Keyword Args:
            horizon: steps for which each action is held.

        Returns:
            observations ``[K, 10 + 12 n]``, in double precision.

        Example:
            >>> env = FetchPushCubes(2)
            >>> _ = env.reset(seed=0)
            >>> env.outcomes(env.simulator_state(), np.zeros((3, 4))).shape
            (3, 34)
        """
        values = np.asarray(actions, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != 4:
            raise ValueError(f"actions have shape {values.shape}, wanted [K, 4]")
        if not np.isfinite(values).all():
            raise ValueError("actions hold non-finite values")
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}, wanted at least 1")
        data = self._get_scratch()
        observations = np.empty((len(values), self._width))
        for observation, action in zip(
            observations, np.clip(values, -1.0, 1.0), strict=True
        ):
            self._restore(data, state)
            for _ in range(horizon):
                _act(self._compiled, data, action)
            _observation(self._compiled, data, observation)
        return observations

    # Internals.

    def _restore(self, data: Any, state: ArrayLike) -> None:
        vector = np.asarray(state, dtype=np.float64)
        size = self._compiled.state_size
        if vector.shape != (size,):
            raise ValueError(
                f"the simulator's state has shape {vector.shape}, wanted ({size},): is "
                "it of an environment with another number of cubes?"
            )
        if not np.isfinite(vector).all():
            raise ValueError("the simulator's state holds non-finite values")
        mujoco.mj_resetData(self.model, data)
        mujoco.mj_setState(self.model, data, vector, int(_STATE))
        _refresh(self.model, data)

    def _get_scratch(self) -> Any:
        if self._scratch is None:
            self._scratch = mujoco.MjData(self.model)
        return self._scratch

    def _frame(self, data: Any) -> NDArray[np.uint8]:
        if self._renderer is None:
            self._renderer = OffscreenRenderer(
                self.model, *self.render_size, camera=_CAMERA
            )
        mujoco.mj_kinematics(self.model, data)  # the goals may have been moved
        mujoco.mj_camlight(self.model, data)
        return self._renderer.frame(data)

    def _set_goal(self, goals: NDArray[np.float64]) -> None:
        self._goal = np.array(goals, dtype=np.float64)
        self.data.mocap_pos[1:] = self._goal

    def _check_ready(self) -> None:
        if not self._ready:
            raise RuntimeError("the environment has no episode: call reset() first")

    def _check_stable(self) -> None:
        # MuJoCo resets a diverged simulation with a warning only: the transition would
        # be recorded as if everything had jumped.
        warning = self.data.warning
        for kind in _DIVERGED:
            if warning[kind].number:
                self._ready = False
                raise RuntimeError(
                    "the simulation diverged; call reset() and leave this episode out"
                )

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        exact = _observation(self._compiled, self.data, np.empty(self._width))
        observation = exact.astype(np.float32)
        cubes = observation[_GRIPPER_WIDTH:].reshape(-1, _CUBE_WIDTH)
        return {
            "observation": observation,
            "achieved_goal": cubes[:, :3].flatten(),
            "desired_goal": self._goal.flatten().astype(np.float32),
        }

    def _info(self, observation: dict[str, NDArray[np.float32]]) -> dict[str, Any]:
        distances = fetch_push_distances(
            observation["achieved_goal"], observation["desired_goal"]
        )
        reached = distances < self.distance_threshold
        success = reached.all()
        return {
            "success": success,
            "cube_success": reached,
            "is_success": np.float32(success),
        }

    # Starts and goals.

    def _positions(
        self, name: str, option: ArrayLike | None
    ) -> NDArray[np.float64] | None:
        """Check positions given to ``reset``; return them as ``[n, 3]``."""
        if option is None:
            return None
        given = np.asarray(option, dtype=np.float64)
        n = self.num_cubes
        if given.shape not in ((n, 2), (n, 3)) or not np.isfinite(given).all():
            raise ValueError(
                f"{name} have shape {given.shape}, wanted ({n}, 2) or ({n}, 3), finite"
            )
        height = _settled()[1]
        positions = np.full((n, 3), height)
        positions[:, : given.shape[1]] = given
        slack = self.distance_threshold if name == "goals" else 1e-3
        for i, position in enumerate(positions):
            what = f"{name}[{i}] = {position.tolist()}"
            place = position[:2]
            if (place < _TABLE_LOW + 0.05).any() or (place > _TABLE_HIGH - 0.05).any():
                raise ValueError(
                    f"{what} is off the table, wanted x and y between "
                    f"{(_TABLE_LOW + 0.05).tolist()} and "
                    f"{(_TABLE_HIGH - 0.05).tolist()}"
                )
            if not _in_reach(place):
                raise ValueError(
                    f"{what} is out of reach, wanted {_REACH[0]} to {_REACH[1]} m from "
                    f"the shoulder at {_SHOULDER.tolist()}"
                )
            if abs(position[2] - height) >= slack:
                raise ValueError(
                    f"{what} is not on the table, wanted a height of {height:.4f}: "
                    "leave it out"
                )
        gaps = _gaps(positions[:, :2])
        if gaps.min(initial=np.inf) < _DIAGONAL:
            raise ValueError(
                f"{name} overlap: two are {gaps.min():.3f} m apart, wanted at least "
                f"{_DIAGONAL:.3f}"
            )
        return positions

    def _check_regions(self) -> None:
        for name in ("cube_range", "goal_range"):
            half = getattr(self, name)
            corners = _START[:2] + half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
            nearest = _START[:2] - [half, 0.0]
            if not half >= 0 or not all(map(_in_reach, (*corners, nearest))):
                raise ValueError(
                    f"{name} is {half}, wanted at least 0 and small enough for the arm "
                    "to reach the whole square (up to about 0.2)"
                )
        # Asked for now, so that a region too small for its cubes is reported here.
        rng = np.random.default_rng(0)
        cubes = self._draw("cubes", rng, _START[:2], None)
        self._draw("goals", rng, None, cubes)

    def _draw(
        self,
        name: str,
        rng: np.random.Generator,
        gripper: NDArray[np.float64] | None,
        own: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        """Draw positions ``[n, 3]``, apart from each other, the gripper, their own."""
        half = self.cube_range if name == "cubes" else self.goal_range
        for _ in range(_MAX_DRAWS):
            chosen: list[NDArray[np.float64]] = []
            for i in range(self.num_cubes):
                candidates = _START[:2] + rng.uniform(-half, half, (_MAX_DRAWS, 2))
                free = np.ones(_MAX_DRAWS, dtype=np.bool_)
                others = [*chosen, *([] if gripper is None else [gripper])]
                for other in others:
                    gap = np.linalg.norm(candidates - other, axis=-1)
                    free &= gap >= _SEPARATION
                if own is not None:
                    gap = np.linalg.norm(candidates - own[i, :2], axis=-1)
                    free &= gap > self.distance_threshold
                if not free.any():
                    break
                chosen.append(candidates[free.argmax()])
            else:
                height = np.full((self.num_cubes, 1), _settled()[1])
                return np.concatenate((np.array(chosen), height), 1)
        raise ValueError(
            f"{self.num_cubes} {name} do not fit into the square of +-{half} m with "
            f"{_SEPARATION} m between them and more than {self.distance_threshold} m "
            "between a cube and its goal: give fewer cubes, a larger "
            f"{'cube_range' if name == 'cubes' else 'goal_range'} or a smaller "
            "distance_threshold"
        )


_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


def _in_reach(place: NDArray[np.float64]) -> bool:
    return bool(_REACH[0] <= np.linalg.norm(place - _SHOULDER) <= _REACH[1])


def _gaps(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances of all pairs ``[n (n - 1) / 2]``."""
    first, second = np.triu_indices(len(places), 1)
    return np.linalg.norm(places[first] - places[second], axis=-1)


class FetchPushTruth:
    """The simulator that :func:`torchrl_caiac.influence.truth.true_influence` asks.

    Its layout has the entities of :func:`fetch_push_layout`, in the same order, with
    their *positions* alone: the distance between two outcomes is then in metres. (Over
    all columns it would mix metres with radians, and Euler angles jump.)

    Args:
        num_cubes: ``n``.

    Example:
        >>> import torch
        >>> from torchrl_caiac.influence.truth import true_influence
        >>> env = FetchPushCubes(2)
        >>> _ = env.reset(seed=0)  # the gripper above the table, no cube near
        >>> states = env.simulator_state()[None]
        >>> truth = true_influence(
        ...     FetchPushTruth, states, num_actions=4, threshold=1e-3, progress=False
        ... )
        >>> truth.influenced
        tensor([[ True, False, False]])
    """

    def __init__(self, num_cubes: int = 2) -> None:
        self._env = FetchPushCubes(num_cubes)
        self.layout = EntityLayout(
            {name: columns[:3] for name, columns in self._env.layout.columns.items()},
            fixed=("gripper",),
        )
        self.action_space = self._env.action_space
        model = self._env.model
        self._cubes = [model.geom(f"object{i}").id for i in range(num_cubes)]
        self._robot = [
            geom
            for geom in range(model.ngeom)
            if model.body(model.geom_bodyid[geom]).name in _COLLIDING
            and model.geom_contype[geom]
        ]

    def in_reach(self, state: ArrayLike, *, horizon: int = 1) -> NDArray[np.bool_]:
        """Return which entities an action might move: a safe bound, and a quick one.

        A cube is in reach where the gap between it and a link that collides, or a cube
        in reach, is smaller than the way that both can go: an action sets the gripper's
        target at most 5 cm off along each axis, which it does not overshoot, and cubes
        that move go on. So 8.7 cm where cubes rest; in 7,500 states, played ones and
        ones with a fast gripper beside moving cubes, no gap that an action bridged was
        wider than 4.9 cm. Holding an action for several steps was not checked so.

        Args:
            state: ``[S]``, of :meth:`FetchPushCubes.simulator_state`.

        Keyword Args:
            horizon: steps for which each action is held.

        Returns:
            bool ``[1 + n]``, in the order of the layout; true for the gripper.

        Example:
            >>> env = FetchPushCubes(2)
            >>> _ = env.reset(seed=0, options={"cubes": [[1.3, 0.7], [1.3, 1.0]]})
            >>> FetchPushTruth(2).in_reach(env.simulator_state())
            array([ True,  True, False])
        """
        env = self._env
        data = env._get_scratch()
        env._restore(data, state)
        observation = _observation(env._compiled, data, np.empty(env._width))
        cubes = observation[_GRIPPER_WIDTH:].reshape(-1, _CUBE_WIDTH)
        speed = np.linalg.norm(cubes[:, 6:9], axis=1).max()
        way = horizon * (np.sqrt(3) * _ACTION_SCALE + speed)

        def near(first: int, second: int) -> bool:
            gap = mujoco.mj_geomDistance(env.model, data, first, second, way, None)
            return bool(gap < way)

        reached = {c for c in self._cubes if any(near(g, c) for g in self._robot)}
        new = reached
        while new:
            rest = [c for c in self._cubes if c not in reached]
            new = {c for c in rest if any(near(c, other) for other in reached)}
            reached = reached | new
        return np.array([True, *(cube in reached for cube in self._cubes)])

    def outcomes(
        self, state: ArrayLike, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Return observations ``[K, 10 + 12 n]``; see :meth:`FetchPushCubes.outcomes`.

        Args:
            state: ``[S]``, of :meth:`FetchPushCubes.simulator_state`.
            actions: ``[K, 4]`` in [-1, 1].

        Keyword Args:
            horizon: steps for which each action is held.
        """
        return self._env.outcomes(state, actions, horizon=horizon)


def register_fetch_push() -> None:
    """Register :class:`FetchPushCubes` with gymnasium as :data:`FETCH_PUSH_ENV_ID`.

    Importing ``torchrl_caiac.envs`` does this; calling it again changes nothing. A
    worker process started by ``spawn`` registers through the import too, or through
    ``gymnasium.make("torchrl_caiac.envs:torchrl_caiac/FetchPushCubes-v0")``.
    """
    if FETCH_PUSH_ENV_ID not in gymnasium.registry:
        gymnasium.register(
            id=FETCH_PUSH_ENV_ID,
            entry_point="torchrl_caiac.envs.fetch_push:FetchPushCubes",
        )


def make_fetch_push_env(
    num_cubes: int = 2, *, device: Any = "cpu", **kwargs: Any
) -> EnvBase:
    """Make Fetch-Push as a TorchRL environment.

    Args:
        num_cubes: ``n``.

    Keyword Args:
        device: where tensors go.
        **kwargs: of :class:`FetchPushCubes`.

    Returns:
        a ``TransformedEnv`` whose tensordicts hold ``"observation"``,
        ``"achieved_goal"``, ``"desired_goal"``, ``"is_init"`` and, from ``info``,
        ``"success"`` (bool ``[1]``) and ``"cube_success"`` (bool ``[n]``).
        ``env.reset(options={...})`` takes the options of :meth:`FetchPushCubes.reset`.

    Example:
        >>> env = make_fetch_push_env(2)
        >>> rollout = env.rollout(3)
        >>> rollout["next", "success"].shape, rollout["observation"].shape
        (torch.Size([3, 1]), torch.Size([3, 34]))
    """
    from torchrl.data import Binary

    register_fetch_push()
    flag = functools.partial(Binary, dtype=torch.bool, device=device)
    info = {"success": flag(1), "cube_success": flag(num_cubes)}
    return make_goal_env(
        FETCH_PUSH_ENV_ID, info, num_cubes=num_cubes, device=device, **kwargs
    )


register_fetch_push()
