"""Ground truth of influence in the Franka-Kitchen, from the simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import gymnasium
import mujoco
import numpy as np

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.envs.kitchen.simulator import KitchenRobot, KitchenState
from torchrl_caiac.envs.kitchen.tasks import KITCHEN_LAYOUT

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["KitchenTruth"]


class KitchenTruth:
    """The simulator that :func:`~torchrl_caiac.influence.true_influence` queries.

    It has no noise and no episode, and it never changes the simulation of ``robot``.

    Args:
        robot (KitchenRobot, optional): the simulation whose model and action limits
            are used. Defaults to a new one.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs.kitchen import KitchenEnv
        >>> truth = KitchenTruth()
        >>> truth.outcomes(KitchenEnv.default_state(), np.zeros((2, 9))).shape
        (2, 30)
    """

    #: The entities of the states.
    layout: ClassVar[EntityLayout] = KITCHEN_LAYOUT

    def __init__(self, robot: KitchenRobot | None = None) -> None:
        self._robot = KitchenRobot() if robot is None else robot
        self._data = mujoco.MjData(self._robot.model)
        #: The box of the actions.
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (9,), np.float32)

    def outcomes(
        self, state: ArrayLike | KitchenState, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Returns the next state after each of several actions from one state.

        Args:
            state (ArrayLike or KitchenState): positions ``[30]``, positions and
                velocities ``[59]``, or a snapshot of
                :meth:`~torchrl_caiac.envs.KitchenEnv.get_state`.
            actions (ArrayLike): ``[K, 9]`` in [-1, 1].

        Keyword Args:
            horizon (int): number of steps for which each action is held. Defaults to 1.

        Returns:
            numpy.ndarray: states ``[K, 30]``, float64.

        Raises:
            ValueError: a shape is wrong, a value is not finite, or ``horizon`` is less
                than 1.
        """
        robot, data = self._robot, self._data
        model = robot.model
        width = model.nq + model.nv
        if isinstance(state, KitchenState):
            vector, physics = np.zeros(width), state.physics
        else:
            vector, physics = np.asarray(state, dtype=np.float64), None
            if vector.shape == (model.nq,):
                vector = np.concatenate((vector, np.zeros(model.nv)))
            if vector.shape != (width,):
                raise ValueError(
                    f"state has shape {vector.shape}, expected ({model.nq},) positions "
                    f"or ({width},) positions and velocities"
                )
        actions = np.asarray(actions, dtype=np.float64)
        if actions.ndim != 2 or actions.shape[1] != 9:
            raise ValueError(f"actions have shape {actions.shape}, expected [K, 9]")
        if not (np.isfinite(vector).all() and np.isfinite(actions).all()):
            raise ValueError("state and actions must be finite")
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}, expected at least 1")
        last_robot_qpos = robot.__dict__.get("_last_robot_qpos")
        states = np.empty((len(actions), model.nq))
        try:
            for next_state, action in zip(states, actions, strict=True):
                mujoco.mj_resetData(model, data)
                if physics is None:
                    data.qpos[:] = vector[: model.nq]
                    data.qvel[:] = vector[model.nq :]
                else:
                    mujoco.mj_setState(
                        model, data, physics, mujoco.mjtState.mjSTATE_INTEGRATION
                    )
                velocity = robot.act_mid + np.clip(action, -1, 1) * robot.act_rng
                for _ in range(horizon):
                    robot._last_robot_qpos = data.qpos[:9].copy()
                    data.ctrl[:] = robot._ctrl_position_limits(
                        robot._ctrl_velocity_limits(velocity)
                    )
                    mujoco.mj_step(model, data, nstep=robot.frame_skip)
                next_state[:] = data.qpos
        finally:
            robot._last_robot_qpos = last_robot_qpos
        return states
