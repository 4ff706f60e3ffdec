"""The scripted expert of the Franka-Kitchen: it plays a task's table of waypoints.

The expert reads the simulator (``mujoco.MjModel``, ``mujoco.MjData``) and acts through
the environment's own nine-dimensional action, with noise on the waypoints, the speed
and the actions. A task is a table: another task is another table of waypoints.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.envs.kitchen.inverse_kinematics import InverseKinematics
from torchrl_caiac.envs.kitchen.rotations import rotation_matrix, rotation_vector
from torchrl_caiac.envs.kitchen.tasks import SUCCESS_DISTANCE
from torchrl_caiac.envs.kitchen.waypoints import (
    TASKS,
    ExpertTask,
    Waypoint,
    get_task,
    tool_rotation,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["KitchenExpert", "task_distance"]

_ARM_JOINTS = tuple(f"robot:panda0_joint{i}" for i in range(1, 8))
_TOOL_SITE = "end_effector"
_TOOL_OFFSET = (0.0, 0.0, 0.035)
# Joint ranges that the environment enforces on its position targets; some are narrower
# than the model's.
_ARM_TARGET_LIMITS = np.array(
    [
        [-2.9, 2.9],
        [-1.8, 1.8],
        [-2.9, 2.9],
        [-3.1, 0.0],
        [-2.9, 2.9],
        [0.0, 3.8],
        [-2.9, 2.9],
    ]
)
# One environment step in seconds, and what an action of 1 adds to a joint's target.
_STEP_SECONDS = 0.08
_ACTION_SCALE = 0.16
# On the way from one task to the next: postures without collisions.
_POSTURES = tuple(task.posture for task in TASKS.values() if task.posture is not None)


def _simulator(env: Any) -> tuple[Any, Any]:
    """Returns ``(model, data)`` of an environment, a robot environment or a pair."""
    if isinstance(env, tuple):
        model, data = env
        return model, data
    for holder in (env, getattr(env, "unwrapped", None)):
        robot: Any = getattr(holder, "robot_env", holder)
        if hasattr(robot, "model") and hasattr(robot, "data"):
            return robot.model, robot.data
    raise TypeError(
        f"{type(env).__name__} has no simulator: give a FrankaKitchen environment, its "
        "robot_env, or a (model, data) pair"
    )


def task_distance(data: Any, task: ExpertTask) -> float:
    """Returns the distance of a task's object to its goal.

    Args:
        data (mujoco.MjData): the simulator.
        task (ExpertTask): the task.

    Returns:
        float: the Euclidean norm over the object's columns.

    Examples:
        >>> from torchrl_caiac.envs.kitchen import KitchenEnv
        >>> env = KitchenEnv(open="microwave")
        >>> _ = env.reset(seed=0)
        >>> task_distance(env.data, get_task("microwave"))
        0.0
    """
    return float(np.linalg.norm(data.qpos[list(task.columns)] - np.array(task.goal)))


class KitchenExpert:
    """Plays a task's table of waypoints in the Franka-Kitchen.

    Every step solves the arm's inverse kinematics for a point a little further along
    the current stage and turns the change ``dq`` of the joints into an action,
    ``(dq g + qfrc_bias / kp) / 0.16`` with ``g = 1 / (1 - exp(-0.08 kp / damping))``:
    what a position servo with these gains does in one step of 0.08 s, gravity included.

    The expert reads the simulator and never changes it.

    Args:
        env (gymnasium.Env or tuple): a FrankaKitchen environment (wrapped or not), its
            ``robot_env``, or a ``(model, data)`` pair.
        task (str or ExpertTask): a name in
            :data:`~torchrl_caiac.envs.kitchen.waypoints.TASKS`, or a table.

    Keyword Args:
        speed (float): factor on all speeds. Defaults to 1.
        speed_range (float): the factor is drawn in each episode from
            ``speed * (1 ± speed_range)``. Defaults to 0.05.
        waypoint_noise (float): standard deviation of a waypoint's position, metres per
            axis, drawn once in each episode. Defaults to 0.005.
        action_noise (float): standard deviation of the noise on every action.
            Defaults to 0.03.
        clearance (float, optional): a ``"reach"`` that would move the arm closer than
            this to something, metres, takes a detour through the posture of another
            task if that keeps more distance. Defaults to ``None``: the arm always goes
            straight, which suits a start from the default posture.
        rng (numpy.random.Generator or int, optional): generator of all draws, or its
            seed.

    Raises:
        KeyError: unknown task.
        TypeError: ``env`` has no simulator.
        ValueError: speed, noise or clearance out of range.

    Examples:
        >>> from torchrl_caiac.envs.kitchen import KitchenEnv
        >>> env = KitchenEnv("kettle")
        >>> observation, _ = env.reset(seed=0)
        >>> expert = KitchenExpert(env, "kettle", rng=0)
        >>> expert.reset()
        >>> expert(observation).shape
        (9,)
    """

    def __init__(
        self,
        env: Any,
        task: str | ExpertTask,
        *,
        speed: float = 1.0,
        speed_range: float = 0.05,
        waypoint_noise: float = 0.005,
        action_noise: float = 0.03,
        clearance: float | None = None,
        rng: np.random.Generator | int | None = None,
    ) -> None:
        task = get_task(task)
        if not speed > 0:
            raise ValueError(f"speed is {speed}, expected a positive factor")
        if not 0 <= speed_range < 1:
            raise ValueError(f"speed_range is {speed_range}, expected 0 <= range < 1")
        if waypoint_noise < 0 or action_noise < 0:
            raise ValueError(
                f"waypoint_noise is {waypoint_noise} and action_noise {action_noise}, "
                "expected standard deviations of at least 0"
            )
        if clearance is not None and clearance < 0:
            raise ValueError(f"clearance is {clearance}, expected at least 0 metres")
        self.model, self.data = _simulator(env)
        self.speed = speed
        self.speed_range = speed_range
        self.waypoint_noise = waypoint_noise
        self.action_noise = action_noise
        self.clearance = clearance
        self.rng = np.random.default_rng(rng)
        own = np.array([self.model.joint(name).range for name in _ARM_JOINTS])
        self.ik = InverseKinematics(
            self.model,
            _TOOL_SITE,
            _ARM_JOINTS,
            offset=_TOOL_OFFSET,
            limits=np.stack(
                [
                    np.maximum(own[:, 0], _ARM_TARGET_LIMITS[:, 0]),
                    np.minimum(own[:, 1], _ARM_TARGET_LIMITS[:, 1]),
                ],
                axis=1,
            ),
        )
        gain = self.model.actuator_gainprm[:9, 0]
        damping = self.model.dof_damping[:9]
        self._stiffness = gain.copy()
        self._gain = 1 / (1 - np.exp(-_STEP_SECONDS * gain / damping))
        self.set_task(task)

    def set_task(self, task: str | ExpertTask) -> None:
        """Changes the task; :meth:`reset` starts it.

        Args:
            task (str or ExpertTask): a name in
                :data:`~torchrl_caiac.envs.kitchen.waypoints.TASKS`, or a table.
        """
        self.task = get_task(task)
        self._posture = self._find_posture()
        self._stage = len(self.task.waypoints)
        self._targets: list[NDArray[np.float64]] = []

    def _find_posture(self) -> NDArray[np.float64]:
        if self.task.posture is not None:
            return np.array(self.task.posture)
        first = self.task.waypoints[0]
        return self.ik.find_posture(
            self.data.qpos,
            self._anchor(first) + first.offset,
            tool_rotation(first.yaw, first.pitch, first.roll),
            near=self.data.qpos[:7],
            rng=np.random.default_rng(0),
        )

    def _anchor(self, waypoint: Waypoint) -> NDArray[np.float64]:
        if waypoint.anchor is None:
            return np.zeros(3)
        return self.data.site(waypoint.anchor).xpos.copy()

    def _rotation(self, waypoint: Waypoint) -> NDArray[np.float64]:
        rotation = tool_rotation(waypoint.yaw, waypoint.pitch, waypoint.roll)
        if not waypoint.turn:
            return rotation
        joint = self.data.joint(waypoint.joint)
        angle = float(joint.qpos[0]) + waypoint.lead
        return rotation_matrix(angle * joint.xaxis) @ rotation

    def reset(self) -> None:
        """Starts an episode from the current state of the simulator.

        Draws the episode's speed and waypoints.
        """
        self._factor = self.speed * (1 + self.speed_range * self.rng.uniform(-1.0, 1.0))
        self._targets = []
        for waypoint in self.task.waypoints:
            noise = self.rng.normal(size=3) * self.waypoint_noise * waypoint.noisy
            moving = waypoint.move in ("follow", "back")
            origin = 0.0 if moving else self._anchor(waypoint)
            self._targets.append(origin + np.array(waypoint.offset) + noise)
        self._enter(0)

    def skip_to(self, stage: int) -> None:
        """Skips to a later stage; does nothing if that stage has begun already.

        Args:
            stage (int): index of the stage.
        """
        if self._stage < stage:
            self._enter(stage)

    def _enter(self, stage: int) -> None:
        self._stage = stage
        self._steps_in_stage = 0
        self._begin, self._begin_rotation = self.ik.pose(self.data.qpos)
        if stage >= len(self.task.waypoints):
            return
        waypoint = self.task.waypoints[stage]
        if waypoint.move == "reach":
            configuration = self.data.qpos.copy()
            configuration[:7] = self._posture
            joints = self.ik.solve(
                configuration,
                self._targets[stage],
                self._rotation(waypoint),
                iterations=30,
            ).joints
            self._route = [joints]
            if self.clearance is not None:
                self._route = self.ik.find_route(
                    self.data.qpos, joints, _POSTURES, clearance=self.clearance
                )
        elif waypoint.move == "back":
            self._targets[stage] = self._begin + waypoint.offset

    @property
    def stage(self) -> int:
        """Index of the current stage; the length of the table when finished."""
        return self._stage

    @property
    def finished(self) -> bool:
        """Whether the last stage is over."""
        return self._stage >= len(self.task.waypoints)

    @property
    def goal_distance(self) -> float:
        """Distance of the task's object to its goal, as FrankaKitchen measures it."""
        return task_distance(self.data, self.task)

    @property
    def success(self) -> bool:
        """Whether the object is within FrankaKitchen's 0.3 of its goal."""
        return self.goal_distance < SUCCESS_DISTANCE

    def __call__(self, observation: Any = None) -> NDArray[np.float64]:
        """Returns the next action.

        Args:
            observation (Any, optional): ignored; makes the expert a policy like others.

        Returns:
            numpy.ndarray: action ``[9]`` in [-1, 1], float64.

        Raises:
            RuntimeError: :meth:`reset` has not been called.
        """
        if not self._targets:
            raise RuntimeError("call reset() before the first action of an episode")
        self.update()
        waypoint = self.task.waypoints[min(self._stage, len(self.task.waypoints) - 1)]
        joints = self.data.qpos[:7].copy()
        change = np.zeros(9)
        if self.finished:
            change[:7] = self._towards(self._begin, self._begin_rotation) - joints
        elif waypoint.move == "reach":
            if len(self._route) > 1 and np.abs(self._route[0] - joints).max() < 0.2:
                self._route.pop(0)
            change[:7] = self._route[0] - joints
            limit = waypoint.speed * self._factor * _STEP_SECONDS
            change[:7] *= min(1.0, limit / max(np.abs(change[:7]).max(), 1e-9))
        else:
            change[:7] = self._towards(*self._tool_target(waypoint)) - joints
        change[7:] = waypoint.gripper - self.data.qpos[7:9]
        self._steps_in_stage += 1
        action = (
            change * self._gain + self.data.qfrc_bias[:9] / self._stiffness
        ) / _ACTION_SCALE
        largest = np.abs(action[:7]).max()
        if largest > 0.95:
            action[:7] *= 0.95 / largest
        action += self.action_noise * self.rng.normal(size=9)
        return np.clip(action, -1.0, 1.0)

    def update(self) -> bool:
        """Enters the next stage if the current one is over; so does an action.

        Returns:
            bool: whether the last stage is over.
        """
        while not self.finished and self._stage_over():
            self._enter(self._stage + 1)
        return self.finished

    def _towards(
        self, position: NDArray[np.float64], rotation: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return self.ik.solve(
            self.data.qpos, position, rotation, posture=self._posture
        ).joints

    def _stage_over(self) -> bool:
        waypoint = self.task.waypoints[self._stage]
        if waypoint.move == "hold":
            return self._steps_in_stage >= waypoint.steps
        if self._steps_in_stage * min(self._factor, 1.0) >= waypoint.steps:
            return True
        if waypoint.move == "follow":
            assert waypoint.joint is not None and waypoint.until is not None
            position = float(self.data.joint(waypoint.joint).qpos[0])
            return (position - waypoint.until) * np.sign(waypoint.lead) >= 0
        if waypoint.move == "reach":
            error = np.abs(self._route[-1] - self.data.qpos[:7]).max()
        else:
            point, _ = self.ik.pose(self.data.qpos)
            error = np.linalg.norm(self._targets[self._stage] - point)
        return bool(error < waypoint.tolerance)

    def _tool_target(
        self, waypoint: Waypoint
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the tool's target pose in this step."""
        rotation = self._rotation(waypoint)
        if waypoint.move == "back":
            rotation = self._begin_rotation
        target = self._targets[self._stage]
        point, _ = self.ik.pose(self.data.qpos)
        reach = waypoint.speed * self._factor * _STEP_SECONDS
        if waypoint.move == "follow":
            aim = self._ahead(waypoint) + target
            way = aim - point
            distance = float(np.linalg.norm(way))
            return point + way * min(1.0, reach / max(distance, 1e-9)), rotation
        if waypoint.move == "hold":
            return target, rotation
        # A point on the line, one step past the tool's projection: errors across the
        # line are corrected, and the target never moves far ahead of a slow arm.
        line = target - self._begin
        length = max(float(np.linalg.norm(line)), 1e-9)
        progress = float((point - self._begin) @ line) / length + reach
        share = min(max(progress / length, 0.0), 1.0)
        turn = rotation_vector(rotation @ self._begin_rotation.T)
        return (
            self._begin + share * line,
            rotation_matrix(min(1.0, 2 * share) * turn) @ self._begin_rotation,
        )

    def _ahead(self, waypoint: Waypoint) -> NDArray[np.float64]:
        """Returns where the anchor would be with its joint ``lead`` further."""
        joint = self.data.joint(waypoint.joint)
        anchor = self._anchor(waypoint)
        if int(self.model.joint(waypoint.joint).type[0]) == 2:
            return anchor + waypoint.lead * joint.xaxis
        turn = rotation_matrix(waypoint.lead * joint.xaxis)
        return joint.xanchor + turn @ (anchor - joint.xanchor)
