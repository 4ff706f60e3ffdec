"""The MuJoCo simulation of the Franka-Kitchen and exact snapshots of it."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
from gymnasium_robotics.envs.franka_kitchen.franka_env import FrankaRobot
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import (
    KitchenEnv as UpstreamKitchen,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = [
    "HANDLES",
    "KitchenRobot",
    "KitchenState",
    "as_states",
    "default_state",
    "handle_positions",
]

#: Sites of the model where the robot touches and where each object is touched, in the
#: order of the layout.
HANDLES: dict[str, str] = {
    "robot": "end_effector",
    "bottom_right_burner": "knob1_site",
    "bottom_burner": "knob2_site",
    "top_right_burner": "knob3_site",
    "top_burner": "knob4_site",
    "light_switch": "light_site",
    "slide_cabinet": "slide_site",
    "hinge_cabinet": "hinge_site2",
    "microwave": "microhandle_site",
    "kettle": "kettle_site",
}

_MODEL = "../assets/kitchen_franka/kitchen_assets/kitchen_env_model.xml"
_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


@functools.cache
def _upstream() -> tuple[Any, NDArray[np.float64]]:
    """Compiles the model once per process (0.3 s) and returns it with its start."""
    gymnasium.register_envs(gymnasium_robotics)
    kitchen = UpstreamKitchen()
    return kitchen.model, kitchen.robot_env.init_qpos.copy()


def default_state() -> NDArray[np.float64]:
    """Returns the default start ``[30]``: all closed, kettle on the bottom left burner.

    Returns:
        numpy.ndarray: positions of the robot and the objects, float64.

    Examples:
        >>> default_state().shape
        (30,)
    """
    return _upstream()[1].copy()


def as_states(states: ArrayLike) -> NDArray[np.float64]:
    """Returns one state or several as a matrix.

    Args:
        states (ArrayLike): ``[30]`` or ``[S, 30]``.

    Returns:
        numpy.ndarray: ``[S, 30]``, float64.

    Raises:
        ValueError: the states have another shape.

    Examples:
        >>> as_states(default_state()).shape
        (1, 30)
    """
    states = np.atleast_2d(np.asarray(states, dtype=np.float64))
    if states.ndim != 2 or states.shape[1] != 30:
        raise ValueError(f"states have shape {states.shape}, expected [S, 30]")
    return states


def handle_positions(model: Any, states: ArrayLike) -> NDArray[np.float64]:
    """Returns where :data:`HANDLES` are.

    Args:
        model (mujoco.MjModel): the kitchen's model.
        states (ArrayLike): ``[S, 30]``.

    Returns:
        numpy.ndarray: positions ``[S, N, 3]`` in metres, entities in the order of the
        layout.

    Examples:
        >>> handle_positions(KitchenRobot().model, default_state()).shape
        (1, 10, 3)
    """
    states = as_states(states)
    sites = [model.site(name).id for name in HANDLES.values()]
    data = mujoco.MjData(model)
    positions = np.empty((len(states), len(sites), 3))
    for position, state in zip(positions, states, strict=True):
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        position[:] = data.site_xpos[sites]
    return positions


class KitchenRobot(FrankaRobot):
    """The kitchen of gymnasium-robotics with the same dynamics and noise, but faster.

    Each instance has its own copy of the MuJoCo model.

    Args:
        robot_noise_ratio (float): scale of the noise on the robot's joints.
            Defaults to 0.01.

    Examples:
        >>> robot = KitchenRobot()
        >>> robot.model.nq, robot.model.nv
        (30, 29)
    """

    def __init__(self, robot_noise_ratio: float = 0.01) -> None:
        super().__init__(model_path=_MODEL, robot_noise_ratio=robot_noise_ratio)
        self.init_qpos = default_state()
        self.init_qvel = np.zeros(self.model.nv)

    def _initialize_simulation(self) -> tuple[Any, Any]:
        # A copy: changes of one environment to its model do not reach others.
        model = mujoco.MjModel.__copy__(_upstream()[0])
        return model, mujoco.MjData(model)

    def _step_mujoco_simulation(self, ctrl: NDArray[np.float64], n_frames: int) -> None:
        # Upstream adds mj_rnePostConstraint, whose forces are not used here.
        self.data.ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, nstep=n_frames)

    def _get_obs(self) -> NDArray[np.float64]:
        # Upstream looks up 18 joints by name; they are the first nine of each array.
        low_high = {"low": -1.0, "high": 1.0, "size": 9}
        positions = self.data.qpos[:9] + (
            self.robot_noise_ratio
            * self.robot_pos_noise_amp[:9]
            * self.np_random.uniform(**low_high)
        )
        velocities = self.data.qvel[:9] + (
            self.robot_noise_ratio
            * self.robot_vel_noise_amp[:9]
            * self.np_random.uniform(**low_high)
        )
        self._last_robot_qpos = positions
        return np.concatenate((positions, velocities))

    def restart(
        self, start: NDArray[np.float64], *, seed: int | None = None
    ) -> NDArray[np.float64]:
        """Starts an episode at rest.

        Args:
            start (numpy.ndarray): positions ``[30]``.

        Keyword Args:
            seed (int, optional): seed of the noise. Defaults to ``None``: the generator
                continues.

        Returns:
            numpy.ndarray: noisy positions and velocities ``[18]`` of the robot.
        """
        self.init_qpos = start.copy()
        # Upstream's may be a view of the velocities that it is meant to reset.
        self.init_qvel = np.zeros(self.model.nv)
        observation: NDArray[np.float64] = self.reset(seed=seed)[0]
        return observation

    def place(
        self, qpos: NDArray[np.float64], qvel: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Puts the simulation into a state of the given positions and velocities.

        Args:
            qpos (numpy.ndarray): positions ``[30]``.
            qvel (numpy.ndarray): velocities ``[29]``.

        Returns:
            numpy.ndarray: noisy positions and velocities ``[18]`` of the robot.
        """
        mujoco.mj_resetData(self.model, self.data)
        self.set_state(qpos, qvel)
        # Also updates the joint positions that the next action starts from.
        return self._get_obs()

    def full_observation(
        self, robot_observation: NDArray[np.float64], object_noise_ratio: float
    ) -> NDArray[np.float64]:
        """Returns the noisy observation in the 59 columns of ``FrankaKitchen-v1``.

        Args:
            robot_observation (numpy.ndarray): noisy positions and velocities ``[18]``
                of the robot.
            object_noise_ratio (float): scale of the noise on the objects.

        Returns:
            numpy.ndarray: ``[59]``.
        """
        positions = self.data.qpos[9:] + (
            object_noise_ratio
            * self.robot_pos_noise_amp[8:]
            * self.np_random.uniform(low=-1.0, high=1.0, size=21)
        )
        velocities = self.data.qvel[9:] + (
            object_noise_ratio
            * self.robot_vel_noise_amp[9:]
            * self.np_random.uniform(low=-1.0, high=1.0, size=20)
        )
        return np.concatenate((robot_observation, positions, velocities))

    @property
    def diverged(self) -> bool:
        """Whether MuJoCo has reset a diverged simulation since the last reset."""
        # MuJoCo only warns: the transition would be recorded as if the state jumped.
        return any(self.data.warning[kind].number for kind in _DIVERGED)

    def read_physics(self) -> NDArray[np.float64]:
        """Returns MuJoCo's integration state (positions, velocities, warm start, ...).

        Returns:
            numpy.ndarray: a vector for :meth:`write_physics`.
        """
        physics = np.empty(mujoco.mj_stateSize(self.model, _INTEGRATION))
        mujoco.mj_getState(self.model, self.data, physics, _INTEGRATION)
        return physics

    def write_physics(self, physics: NDArray[np.float64]) -> None:
        """Restores an integration state exactly.

        Args:
            physics (numpy.ndarray): the vector from :meth:`read_physics`.

        Raises:
            ValueError: the vector has another length.
        """
        size = mujoco.mj_stateSize(self.model, _INTEGRATION)
        if np.shape(physics) != (size,):
            raise ValueError(
                f"the snapshot's physics have shape {np.shape(physics)}, expected "
                f"({size},): use a snapshot of this environment"
            )
        mujoco.mj_setState(self.model, self.data, physics, _INTEGRATION)
        # mj_forward computes what follows from the state (sites, contacts). It also
        # overwrites the warm start, which the second call restores.
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, physics, _INTEGRATION)


@dataclass(frozen=True)
class KitchenState:
    """Everything an episode depends on: an exact, picklable snapshot.

    Attributes:
        physics (numpy.ndarray): MuJoCo's integration state (positions, velocities,
            controls, warm start).
        last_robot_qpos (numpy.ndarray): the noisy joint positions ``[9]`` that the next
            action starts from.
        full_observation (numpy.ndarray): the last noisy observation ``[59]``.
        goal (numpy.ndarray): the desired goal ``[21]``.
        start (numpy.ndarray): the positions ``[30]`` in which the episode started.
        task (str): the task.
        steps (int): number of environment steps since the start.
        wrong_tasks (numpy.ndarray): bool ``[7]``, other tasks done so far.
        generators (tuple of dict): states of the random generators, of the noise and
            of starts and tasks.
    """

    physics: NDArray[np.float64]
    last_robot_qpos: NDArray[np.float64]
    full_observation: NDArray[np.float64]
    goal: NDArray[np.float64]
    start: NDArray[np.float64]
    task: str
    steps: int
    wrong_tasks: NDArray[np.bool_]
    generators: tuple[dict[str, Any], dict[str, Any]] = field(repr=False)
