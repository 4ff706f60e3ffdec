"""The simulation of Fetch-Push: starts, actions, observations and states."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from gymnasium_robotics.utils.rotations import mat2euler

from torchrl_caiac.envs.fetch_push.model import (
    CUBE_HALF,
    STATE,
    TABLE_HIGH,
    TABLE_TOP,
    compile_model,
)
from torchrl_caiac.envs.fetch_push.task import CUBE_WIDTH, GRIPPER_WIDTH

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["ACTION_SCALE", "START", "FetchPushSimulator", "cube_height"]

#: An action of 1 moves the target of the gripper by this distance, in metres, as in
#: gymnasium-robotics' ``FetchPush``.
ACTION_SCALE = 0.05
#: Where the gripper starts, in metres: above the centre of the table and, with all
#: noise, above the cubes. (Their top is at 0.45, the fingers end 1.9 cm below this
#: point.)
START = np.array([1.342, 0.749, 0.505])
# Simulator steps of 2 ms per environment step, as in gymnasium-robotics.
_SUBSTEPS = 20
# The gripper points down. This is added to its present orientation.
_DOWN = np.array([1.0, 0.0, 1.0, 0.0])
_SETTLE_STEPS = 40
_RESET_STEPS = 10
_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


class FetchPushSimulator:
    """Simulates the robot and the cubes, without goals, rewards or episodes.

    The simulators of a process that have the same cubes share one model.

    Args:
        num_cubes (int): the number of cubes ``n``.
        cube_friction (float, optional): as in
            :func:`~torchrl_caiac.envs.fetch_push.model.compile_model`.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs.fetch_push.simulator import FetchPushSimulator
        >>> simulator = FetchPushSimulator(1)
        >>> simulator.start(np.array([[1.3, 0.7, 0.425]]))
        >>> simulator.act(np.zeros(4))
        >>> simulator.observation().shape
        (22,)
    """

    def __init__(self, num_cubes: int, cube_friction: float | None = None) -> None:
        self.num_cubes = num_cubes
        self._compiled = compile_model(num_cubes, cube_friction)
        #: The MuJoCo model: shared, do not change it.
        self.model = self._compiled.model
        #: The MuJoCo data.
        self.data = mujoco.MjData(self.model)
        #: The duration of an environment step, in seconds.
        self.dt = float(_SUBSTEPS * self.model.opt.timestep)
        #: The number of columns of an observation, ``10 + 12 n``.
        self.width = GRIPPER_WIDTH + CUBE_WIDTH * num_cubes

    @property
    def diverged(self) -> bool:
        """Whether the simulation diverged.

        MuJoCo resets a diverged simulation and only counts a warning: without this
        check the transition would be recorded as if everything had jumped.
        """
        return any(self.data.warning[kind].number for kind in _DIVERGED)

    def start(
        self, cubes: NDArray[np.float64], gripper: NDArray[np.float64] = START
    ) -> None:
        """Resets the simulation, with everything at rest.

        Args:
            cubes (NDArray): positions of the cubes ``[n, 3]``.
            gripper (NDArray, optional): position of the gripper ``[3]``.
        """
        robot, _ = _settled()
        data = self.data
        mujoco.mj_resetData(self.model, data)
        data.qpos[: len(robot)] = robot
        poses = data.qpos[len(robot) :].reshape(-1, 7)
        poses[:] = np.concatenate((cubes, np.tile([1.0, 0, 0, 0], (len(cubes), 1))), 1)
        start = poses.copy()
        self._refresh()
        self.move_gripper(gripper, _RESET_STEPS)
        poses[:] = start
        data.qvel[:] = 0.0
        data.qacc_warmstart[:] = 0.0
        self._refresh()

    def push_cubes(self, velocities: NDArray[np.float64]) -> None:
        """Sets the velocities of the cubes.

        Args:
            velocities (NDArray): along x and y ``[n, 2]``, in metres per second.
        """
        moving = self.data.qvel[self._compiled.cube_velocity :].reshape(-1, 6)
        moving[:, :2] = velocities
        self._refresh()

    def act(self, action: NDArray[np.float64]) -> None:
        """Simulates one environment step.

        Args:
            action (NDArray): ``[4]``, in [-1, 1].
        """
        data, body = self.data, self._compiled.gripper_body
        data.mocap_pos[0] = data.xpos[body] + ACTION_SCALE * action[:3]
        data.mocap_quat[0] = data.xquat[body] + _DOWN
        self._advance()

    def move_gripper(self, position: NDArray[np.float64], steps: int) -> None:
        """Moves the gripper to a position, without the speed limit of actions.

        Args:
            position (NDArray): ``[3]``, in metres.
            steps (int): the number of environment steps.
        """
        data, compiled = self.data, self._compiled
        data.mocap_quat[0] = _DOWN
        for _ in range(steps):
            offset = (
                data.xpos[compiled.gripper_body] - data.site_xpos[compiled.gripper_site]
            )
            data.mocap_pos[0] = position + offset
            self._advance()

    def show_goals(self, goals: NDArray[np.float64]) -> None:
        """Moves the balls that mark the goals, which nothing collides with.

        Args:
            goals (NDArray): positions ``[n, 3]``.
        """
        self.data.mocap_pos[1:] = goals

    def observation(
        self, out: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Returns the observation, in double precision.

        Args:
            out (NDArray, optional): ``[10 + 12 n]``, written and returned.

        Returns:
            NDArray: ``[10 + 12 n]``; see
            :class:`~torchrl_caiac.envs.FetchPushCubes` for the columns.
        """
        out = np.empty(self.width) if out is None else out
        data, compiled = self.data, self._compiled
        dt = self.dt
        velocity = np.empty(6)
        mujoco.mj_objectVelocity(
            self.model,
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
        cubes = out[GRIPPER_WIDTH:].reshape(-1, CUBE_WIDTH)
        rotation = data.xmat[compiled.cube_bodies].reshape(-1, 3, 3)
        velocities = data.qvel[compiled.cube_velocity :].reshape(-1, 6)
        cubes[:, 0:3] = data.qpos[compiled.cube_position :].reshape(-1, 7)[:, :3]
        cubes[:, 3:6] = mat2euler(rotation)
        cubes[:, 6:9] = velocities[:, :3] * dt
        # The angular velocity of a free joint is in the axes of the body.
        cubes[:, 9:12] = (rotation @ velocities[:, 3:, None])[..., 0] * dt
        return out

    def state(self) -> NDArray[np.float64]:
        """Returns everything that the next steps depend on, as one vector.

        Returns:
            NDArray: ``[S]``: positions, velocities and the warm start of the solver.
        """
        state = np.empty(self._compiled.state_size)
        mujoco.mj_getState(self.model, self.data, state, int(STATE))
        return state

    def restore(self, state: ArrayLike) -> None:
        """Restores a state exactly.

        Args:
            state (array): ``[S]``, from :meth:`state`.

        Raises:
            ValueError: the state has another shape, or values that are not finite.
        """
        vector = np.asarray(state, dtype=np.float64)
        size = self._compiled.state_size
        if vector.shape != (size,):
            raise ValueError(
                f"the simulator state has shape {vector.shape}, expected ({size},): "
                "use states of an environment with the same number of cubes"
            )
        if not np.isfinite(vector).all():
            raise ValueError(
                "the simulator state has non-finite values, expected finite ones"
            )
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, vector, int(STATE))
        self._refresh()

    def outcomes(
        self, state: ArrayLike, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Returns the next observation after each of several actions from one state.

        The simulation ends in the state after the last action.

        Args:
            state (array): ``[S]``, from :meth:`state`.
            actions (array): ``[K, 4]``, clipped to [-1, 1].

        Keyword Args:
            horizon (int): the number of steps for which each action is repeated.
                Defaults to 1.

        Returns:
            NDArray: observations ``[K, 10 + 12 n]``, in double precision.

        Raises:
            ValueError: the state or the actions have a wrong shape or non-finite
                values, or ``horizon`` is less than 1.
        """
        values = np.asarray(actions, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != 4:
            raise ValueError(f"actions have shape {values.shape}, expected [K, 4]")
        if not np.isfinite(values).all():
            raise ValueError("actions have non-finite values, expected finite ones")
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}, expected at least 1")
        observations = np.empty((len(values), self.width))
        for out, action in zip(observations, np.clip(values, -1.0, 1.0), strict=True):
            self.restore(state)
            for _ in range(horizon):
                self.act(action)
            self.observation(out)
        return observations

    def _advance(self) -> None:
        mujoco.mj_step(self.model, self.data, nstep=_SUBSTEPS)
        self.data.qpos[self._compiled.finger_positions] = 0.0
        self._refresh()

    def _refresh(self) -> None:
        """Updates what observations and targets read."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)


def cube_height() -> float:
    """Returns the height of the centre of a cube that rests on the table, in metres.

    Examples:
        >>> from torchrl_caiac.envs.fetch_push.simulator import cube_height
        >>> round(cube_height(), 3)
        0.425
    """
    return _settled()[1]


@functools.cache
def _settled() -> tuple[NDArray[np.float64], float]:
    """Returns the robot's joints with the gripper at START, and the cube height."""
    simulator = FetchPushSimulator(1)
    data = simulator.data
    for name, value in (("slide0", 0.405), ("slide1", 0.48), ("slide2", 0.0)):
        data.joint(f"robot0:{name}").qpos[0] = value
    corner = TABLE_HIGH - 0.1
    data.qpos[-7:] = [*corner, TABLE_TOP + CUBE_HALF, 1, 0, 0, 0]
    mujoco.mj_forward(simulator.model, data)
    simulator.move_gripper(START, _SETTLE_STEPS)
    return data.qpos[:-7].copy(), float(data.qpos[-5])
