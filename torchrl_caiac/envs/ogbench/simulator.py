"""OGBench's simulation, put into recorded states."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np
import torch
from gymnasium.spaces import Box

from torchrl_caiac._keys import get_leaf
from torchrl_caiac.envs.ogbench.entities import entity_joints, ogbench_layout
from torchrl_caiac.envs.ogbench.registration import make_ogbench_env

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from tensordict import TensorDictBase
    from tensordict.utils import NestedKey

__all__ = ["ROBOT", "OGBenchSimulator", "ogbench_states"]

#: The name of the robot in the layouts.
ROBOT = "robot"
_BUTTONS = "button_states"
# The command that closes the gripper.
_CLOSED = 255.0


class OGBenchSimulator:
    """Simulates OGBench's manipulation environments from recorded states.

    A state is a vector of ``"qpos"``, ``"qvel"`` and, if there are buttons,
    ``"button_states"``, in this order, as OGBench's files have them. From a state in
    float64, an action leads to exactly the recorded next observation. Files have
    float32, and the rounding changes the next observation: by less than 0.2 mm for
    cubes, in the tests. The error can be larger in the first transition of an episode,
    if a cube touches the table or another cube there.

    OGBench's environments depend on more than positions and velocities. Their
    controller starts from the position of the gripper one substep of 2 ms before the
    state. This class computes that position from the velocities. The gripper's command
    is not recorded. Only the observed contact of the gripper, column 18, depends on it:
    in a restored state that column is approximate, until the first step.

    Args:
        name (str): one of :data:`OGBENCH_ENVS`. Defaults to ``"cube-double"``.

    Raises:
        ValueError: ``name`` is not such an environment.
        ImportError: ``ogbench`` is not installed.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs.ogbench import OGBenchSimulator
        >>> simulator = OGBenchSimulator("cube-double")
        >>> state = simulator.reset(seed=0)
        >>> simulator.outcomes(state, np.zeros((3, 5))).shape
        (3, 37)
    """

    #: There is no task.
    has_rewards: ClassVar[bool] = False

    def __init__(self, name: str = "cube-double") -> None:
        self.name = name
        #: The entities of the observations.
        self.layout = ogbench_layout(name)
        self._env = make_ogbench_env(name)
        self._env.reset(seed=0)
        self._task = self._env.unwrapped
        #: The box of the actions, [-1, 1].
        self.action_space = Box(-1.0, 1.0, (5,), np.float32)
        joints = entity_joints(name)
        model = self.model
        #: Where in ``qpos`` each entity is.
        self.places: dict[str, slice] = {}
        #: Where in ``qvel`` each entity is.
        self.speeds: dict[str, slice] = {}
        for entity, joint in joints.items():
            number = model.joint(joint).id
            free = model.jnt_type[number] == mujoco.mjtJoint.mjJNT_FREE
            place, speed = model.jnt_qposadr[number], model.jnt_dofadr[number]
            self.places[entity] = slice(place, place + (7 if free else 1))
            self.speeds[entity] = slice(speed, speed + (6 if free else 1))
        self._geoms = {
            ROBOT: self._colliding(
                i for i in range(model.nbody) if model.body(i).name.startswith("ur5e/")
            ),
            **{
                entity: self._colliding([model.jnt_bodyid[model.joint(joint).id]])
                for entity, joint in joints.items()
            },
        }
        self._buttons = [entity for entity in joints if entity.startswith("button")]
        #: The number of buttons.
        self.buttons: int = len(self._buttons)
        #: The number of columns of a state.
        self.state_width = model.nq + model.nv + self.buttons

    @property
    def model(self) -> Any:
        """The ``mujoco.MjModel``: do not change it."""
        return self._task.model

    @property
    def data(self) -> Any:
        """The ``mujoco.MjData``."""
        return self._task.data

    def reset(self, *, seed: int) -> NDArray[np.float64]:
        """Starts from a random state, as OGBench's datasets do.

        Keyword Args:
            seed (int): equal seeds give equal states.

        Returns:
            numpy.ndarray: the state ``[S]``.
        """
        self._env.reset(seed=seed)
        return self.state()

    def state(self) -> NDArray[np.float64]:
        """Returns the current state.

        Returns:
            numpy.ndarray: ``[S]``, float64, a copy.
        """
        return np.concatenate((self.data.qpos, self.data.qvel, self.button_states()))

    def restore(self, state: ArrayLike) -> NDArray[np.float32]:
        """Puts the simulation into a state.

        Args:
            state (array_like): ``[S]``.

        Returns:
            numpy.ndarray: the observation ``[D]``, float32.

        Raises:
            ValueError: the state has another shape, is not finite, or has a quaternion
                of length 0 or button states other than 0 and 1.
        """
        qpos, qvel, buttons = self._parts(state)
        task, model, data = self._task, self.model, self.data
        mujoco.mj_resetData(model, data)
        # Unknown, and the next step sets it: this one holds the arm.
        data.ctrl[task._arm_actuator_ids] = qpos[task._arm_joint_ids]
        opening = qpos[task._gripper_opening_joint_id] / 0.8
        data.ctrl[task._gripper_actuator_ids] = _CLOSED * np.clip(opening, 0, 1)
        data.qpos[:] = qpos
        data.qvel[:] = qvel
        if self.buttons:
            # This also computes all places: after a step, OGBench does so too.
            task._cur_button_states = buttons.copy()
            task._apply_button_states()
        else:
            mujoco.mj_integratePos(model, data.qpos, -qvel, model.opt.timestep)
            mujoco.mj_forward(model, data)
            data.qpos[:] = qpos
        mujoco.mj_rnePostConstraint(model, data)
        return self.observation()

    def observation(self) -> NDArray[np.float32]:
        """Returns the observation of the current state.

        Returns:
            numpy.ndarray: ``[D]``, float32.
        """
        return self._task.compute_observation().astype(np.float32)

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Simulates one step, as Gymnasium's environments do.

        Args:
            action (array_like): ``[5]``, in [-1, 1].

        Returns:
            tuple: the observation ``[D]``, the reward, which is 0 since there is no
            task, whether the episode has terminated and whether it is truncated, both
            ``False``, and an empty dictionary.
        """
        self._act(np.asarray(action, dtype=np.float64))
        return self.observation(), 0.0, False, False, {}

    def button_states(self) -> NDArray[np.int64]:
        """Returns the state of each button.

        Returns:
            numpy.ndarray: 0 or 1, int64 ``[B]``, empty where there are no buttons.
        """
        states = self._task._cur_button_states if self.buttons else []
        return np.array(states, dtype=np.int64)

    def record(self) -> dict[str, NDArray[Any]]:
        """Returns the state as OGBench's files have it.

        Returns:
            dict: ``"qpos"`` and ``"qvel"``, float32, and ``"button_states"``, int64.
        """
        result: dict[str, NDArray[Any]] = {
            "qpos": self.data.qpos.astype(np.float32),
            "qvel": self.data.qvel.astype(np.float32),
        }
        if self.buttons:
            result[_BUTTONS] = self.button_states()
        return result

    def outcomes(
        self, state: ArrayLike, actions: ArrayLike, *, horizon: int = 1
    ) -> NDArray[np.float64]:
        """Returns the next observation after each of several actions from one state.

        Args:
            state (array_like): ``[S]``.
            actions (array_like): ``[K, 5]``, clipped to [-1, 1].

        Keyword Args:
            horizon (int): the number of steps for which each action is repeated.
                Defaults to 1.

        Returns:
            numpy.ndarray: observations ``[K, D]``, float64.

        Raises:
            ValueError: a shape is wrong, a value is not finite, or ``horizon`` is less
                than 1.
        """
        return np.stack(
            [
                self._task.compute_observation()
                for _ in self.visit(state, actions, horizon=horizon)
            ]
        )

    def visit(
        self, state: ArrayLike, actions: ArrayLike, *, horizon: int = 1
    ) -> Iterator[None]:
        """Puts the simulation into the state after each of several actions in turn.

        Args:
            state (array_like): ``[S]``.
            actions (array_like): ``[K, 5]``, clipped to [-1, 1].

        Keyword Args:
            horizon (int): the number of steps for which each action is repeated.
                Defaults to 1.

        Yields:
            None: after each action.

        Raises:
            ValueError: as :meth:`outcomes`.
        """
        checked = np.asarray(actions, dtype=np.float64)
        if checked.ndim != 2 or checked.shape[1] != 5 or not len(checked):
            raise ValueError(f"actions have shape {checked.shape}, expected [K, 5]")
        if not np.isfinite(checked).all():
            raise ValueError("actions have values that are not finite")
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}, expected at least 1")
        for action in checked:
            self.restore(state)
            for _ in range(horizon):
                self._act(action)
            yield

    def positions(self) -> dict[str, NDArray[np.float64]]:
        """Returns where the hand and the entities are, in metres and not scaled.

        Returns:
            dict of str to numpy.ndarray: ``[3]`` of the robot's hand and each cube,
            ``[1]`` of the drawer and the window, ``[2]`` of each button: its place and
            its state, 0 or 1.
        """
        states = iter(self.button_states())
        result = {ROBOT: np.array(self.data.site_xpos[self._task._pinch_site_id])}
        for entity, place in self.places.items():
            own = np.array(self.data.qpos[place][:3])
            is_button = entity in self._buttons
            result[entity] = np.append(own, next(states)) if is_button else own
        return result

    def state_columns(self, entity: str) -> list[int]:
        """Returns the columns of a state that belong to an entity.

        Args:
            entity (str): an entity other than the robot.

        Returns:
            list of int: those of its place, its velocity and its button state.
        """
        nq, nv = self.model.nq, self.model.nv
        place, speed = self.places.get(entity), self.speeds.get(entity)
        if place is None or speed is None:
            raise ValueError(
                f"{entity!r} is not one of the entities {list(self.places)}"
            )
        columns = [*range(place.start, place.stop)]
        columns += range(nq + speed.start, nq + speed.stop)
        if entity in self._buttons:
            columns.append(nq + nv + self._buttons.index(entity))
        return columns

    def speed(self) -> float:
        """Returns how fast the fastest entity moves.

        Returns:
            float: in metres per second.
        """
        return max(
            float(np.linalg.norm(self.data.qvel[place][:3]))
            for place in self.speeds.values()
        )

    def is_near(self, first: str, second: str, distance: float) -> bool:
        """Returns whether two entities, or one and the robot, are close to each other.

        Args:
            first (str): an entity or ``"robot"``.
            second (str): another one.
            distance (float): the gap between them, in metres.

        Returns:
            bool: whether the gap is smaller.
        """
        data, radius = self.data, self.model.geom_rbound
        one, other = self._geoms[first], self._geoms[second]
        centres = data.geom_xpos[one, None] - data.geom_xpos[None, other]
        reach = radius[one, None] + radius[None, other] + distance
        pairs = np.argwhere(np.linalg.norm(centres, axis=-1) < reach)
        return any(
            mujoco.mj_geomDistance(self.model, data, one[i], other[j], distance, None)
            < distance
            for i, j in pairs
        )

    def close(self) -> None:
        """Closes OGBench's environment."""
        self._env.close()

    def _colliding(self, bodies: Iterable[int]) -> NDArray[np.int64]:
        model = self.model
        own = np.isin(model.geom_bodyid, list(bodies))
        touch = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        return np.flatnonzero(own & touch)

    def _act(self, action: NDArray[np.float64]) -> None:
        task = self._task
        task.set_control(np.clip(action, -1, 1))
        task.pre_step()
        mujoco.mj_step(self.model, self.data, nstep=task._n_steps)
        mujoco.mj_rnePostConstraint(self.model, self.data)
        task.post_step()

    def _parts(
        self, state: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        vector = np.asarray(state, dtype=np.float64)
        nq, nv = self.model.nq, self.model.nv
        if vector.shape != (self.state_width,):
            raise ValueError(
                f"state has shape {vector.shape}, expected ({self.state_width},): "
                f"{nq} positions, {nv} velocities and {self.buttons} button states of "
                f"{self.name}"
            )
        if not np.isfinite(vector).all():
            raise ValueError(
                "state has values that are not finite at "
                f"{np.flatnonzero(~np.isfinite(vector)).tolist()}: leave it out"
            )
        qpos, qvel, buttons = np.split(vector, [nq, nq + nv])
        for entity, place in self.places.items():
            if place.stop - place.start == 7 and not qpos[place][3:].any():
                raise ValueError(
                    f"the orientation of {entity!r} in state is all zeros, expected a "
                    "quaternion: give states that the simulator recorded"
                )
        if not np.isin(buttons, (0.0, 1.0)).all():
            raise ValueError(
                f"the button states in state are {buttons.tolist()}, expected 0 and 1: "
                "they come after the positions and velocities"
            )
        return qpos, qvel, buttons.astype(np.int64)


def ogbench_states(
    data: TensorDictBase,
    *,
    keys: Sequence[NestedKey] | None = None,
) -> torch.Tensor:
    """Returns the simulator's states of transitions that OGBench's files hold.

    Args:
        data (TensorDictBase): the transitions ``[*B]``.

    Keyword Args:
        keys (sequence of NestedKey, optional): the keys of positions, velocities and,
            where there are buttons, button states. Defaults to ``("info", "qpos")``,
            ``("info", "qvel")`` and ``("info", "button_states")``, where the data have
            it.

    Returns:
        torch.Tensor: float64 ``[*B, S]``, what :class:`OGBenchSimulator` takes.

    Raises:
        KeyError: the data lack an entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.envs.ogbench import ogbench_states
        >>> rows = TensorDict(
        ...     {"info": {"qpos": torch.zeros(4, 28), "qvel": torch.zeros(4, 26)}}, [4]
        ... )
        >>> ogbench_states(rows).shape
        torch.Size([4, 54])
    """
    if keys is None:
        keys = [("info", "qpos"), ("info", "qvel")]
        if data.get(("info", _BUTTONS), None) is not None:
            keys.append(("info", _BUTTONS))
    leaves = [
        get_leaf(
            data,
            key,
            "the data lack the simulator's state",
            "load them with it, or name the entries with keys=",
        )
        for key in keys
    ]
    return torch.cat([leaf.to(torch.float64) for leaf in leaves], -1)
