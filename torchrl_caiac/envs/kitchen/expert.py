"""A scripted expert for the Franka kitchen: tables of waypoints and their player.

The expert sees the simulator (`mujoco.MjModel`, `mujoco.MjData`) and acts through the
environment's own nine-dimensional action, with noise on the waypoints, the speed and
the actions. A task is a table: another task is another entry of `TASKS`.

`KitchenChain` plays several of them in a row.

`python -m torchrl_caiac.envs.kitchen.expert --task all --episodes 50` measures the
tasks, `--chain 4 --episodes 30 [--random-start]` chains of four in random order.
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from torchrl_caiac.envs.kitchen.inverse_kinematics import (
    InverseKinematics,
    rotation_vector,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from torchrl_caiac.envs.kitchen.env import KitchenEnv

__all__ = [
    "TASKS",
    "ExpertTask",
    "KitchenChain",
    "KitchenExpert",
    "Waypoint",
    "random_chain_start",
    "set_kitchen_start",
    "tool_rotation",
]

logger = logging.getLogger("torchrl_caiac.envs.kitchen.expert")

ARM_JOINTS = tuple(f"robot:panda0_joint{i}" for i in range(1, 8))
TOOL_SITE = "end_effector"
TOOL_OFFSET = (0.0, 0.0, 0.035)
#: Joint ranges that the environment enforces on its position targets, narrower than
#: the model's in places.
ARM_TARGET_LIMITS = np.array(
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
#: One environment step, seconds, and what an action of 1 adds to a joint's target.
STEP_SECONDS = 0.08
ACTION_SCALE = 0.16
OPEN, CLOSED = 0.04, 0.0
# More than a chain of all tasks takes, retries included.
_CHAIN_STEPS = 1500
# How coupled joints of the kitchen move together.
_KNOB_PER_BURNER = 174.0
_LIGHT_PER_SWITCH = 0.05 / 0.69

# Site axes in the world when the hand points straight ahead (+y): x up, y to the
# right, z (the approach direction) forward.
_STRAIGHT = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


@dataclasses.dataclass(frozen=True)
class Waypoint:
    """One stage of a motion.

    Args:
        move: "reach" goes there in joint space; "line" moves the tool along a straight
            line; "follow" leads the tool along the way that the object's joint takes;
            "hold" stays for `steps`; "back" is a line from where the hand is,
            without turning it.
        offset: tool point relative to `anchor`, `[3]`, metres, world axes. For
            "follow": relative to the moving anchor; for "back": to where it begins.
        anchor: the site that the offset is relative to, as it stands when the episode
            starts ("follow": as it stands now); None for world coordinates.
        yaw: turn of the hand about the vertical, radians: 0 points straight ahead
            (+y), positive to the robot's right (+x).
        pitch: turn about the hand's horizontal axis, radians, negative points down.
        roll: turn about the approach direction, radians.
        gripper: opening of each finger, metres, 0 (closed) to 0.04.
        speed: "reach": radians per second of the fastest joint; else metres per second
            of the tool.
        tolerance: distance at which the stage counts as reached, metres (radians for
            "reach").
        steps: number of steps of a "hold"; for other moves the most steps it may take
            (more in proportion where the speed's factor is below 1).
        joint: the object's joint, for "follow".
        lead: how far ahead of the joint's position the tool is led, radians or metres,
            with its sign.
        until: joint position at which a "follow" ends.
        turn: whether the hand turns with `joint` (it is grasped): the angles of the
            hand hold for the joint at 0.
        noisy: whether waypoint noise applies.
    """

    move: Literal["reach", "line", "follow", "hold", "back"]
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    anchor: str | None = None
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    gripper: float = CLOSED
    speed: float = 0.6
    tolerance: float = 0.015
    steps: int = 60
    joint: str | None = None
    lead: float = 0.0
    until: float | None = None
    turn: bool = False
    noisy: bool = True

    def __post_init__(self) -> None:
        if self.move == "follow" and (
            self.joint is None or self.anchor is None or self.until is None
        ):
            raise ValueError('a "follow" waypoint needs joint, anchor and until')


@dataclasses.dataclass(frozen=True)
class ExpertTask:
    """A task of the kitchen as a table of waypoints.

    Args:
        name: the task's name in FrankaKitchen.
        columns: positions of the object in `qpos` that its goal is about.
        goal: their goal values.
        waypoints: the motion.
        posture: joint positions `[7]` of the arm, free of collisions, before contact:
            the first stage goes to the solution near it, later ones are pulled to it.
        retreat: where the hand goes, from where the motion ended, before another task,
            metres, world axes, each relative to the one before. Empty: 12 cm back the
            way it pointed.
        alternative: another table of the same task, which a chain plays where
            `obstacle` is in the way, and in every second attempt.
        obstacle: joint of another object, and the position from which on it is in the
            way.
    """

    name: str
    columns: tuple[int, ...]
    goal: tuple[float, ...]
    waypoints: tuple[Waypoint, ...]
    posture: tuple[float, ...] | None = None
    retreat: tuple[tuple[float, float, float], ...] = ()
    alternative: ExpertTask | None = None
    obstacle: tuple[str, float] | None = None

    def with_retreat(self) -> ExpertTask:
        """Return the table with the retreat at its end."""
        first, last = self.waypoints[0], self.waypoints[-1]
        back = -0.12 * tool_rotation(last.yaw, last.pitch)[:, 2]
        stages = tuple(
            # With fingers as they came: open where something was held.
            Waypoint("back", offset, gripper=first.gripper, speed=0.4, steps=10)
            for offset in self.retreat or (tuple(back.tolist()),)
        )
        return dataclasses.replace(self, waypoints=(*self.waypoints, *stages))


def _microwave() -> ExpertTask:
    site, yaw, pitch = "microhandle_site", -0.35, -0.4
    hand: dict[str, Any] = {"anchor": site, "yaw": yaw, "pitch": pitch}
    direction = tool_rotation(yaw, pitch)[:, 2]
    before = tuple((-0.11 * direction).tolist())
    past = tuple((0.035 * direction).tolist())
    return ExpertTask(
        name="microwave",
        columns=(22,),
        goal=(-0.75,),
        # Of the postures that reach the handle, the one whose forearm stays farthest
        # (3.6 cm) from the kettle.
        posture=(-0.98, -1.59, 2.01, -1.93, 0.13, 1.73, 1.56),
        waypoints=(
            Waypoint("reach", before, gripper=OPEN, speed=1.5, tolerance=0.06, **hand),
            Waypoint("line", past, gripper=OPEN, speed=0.5, steps=20, **hand),
            Waypoint("hold", past, gripper=CLOSED, steps=4, **hand),
            Waypoint(
                "follow",
                past,
                gripper=CLOSED,
                speed=0.6,
                joint="microwave",
                lead=-0.3,
                until=-0.75,
                noisy=False,
                **hand,
            ),
        ),
    )


def _kettle() -> ExpertTask:
    hand: dict[str, Any] = {"yaw": 0.3, "pitch": -0.4, "gripper": CLOSED}
    return ExpertTask(
        name="kettle",
        columns=(23, 24, 25, 26, 27, 28, 29),
        goal=(-0.23, 0.75, 1.62, 0.99, 0.0, 0.0, -0.06),
        posture=(0.01, -1.654, 2.456, -2.41, 0.87, 0.843, 1.841),
        waypoints=(
            Waypoint("reach", (-0.27, 0.17, 1.70), speed=1.5, tolerance=0.06, **hand),
            Waypoint("line", (-0.25, 0.62, 1.70), speed=0.4, **hand),
        ),
    )


def _slide_cabinet() -> ExpertTask:
    hand: dict[str, Any] = {"anchor": "slide_site", "yaw": 0.3}
    return ExpertTask(
        name="slide cabinet",
        columns=(19,),
        goal=(0.37,),
        posture=(-1.039, -0.75, 1.012, -1.946, -0.578, 1.386, 1.19),
        waypoints=(
            Waypoint("reach", (-0.09, 0.0, -0.08), speed=1.5, tolerance=0.06, **hand),
            Waypoint("line", (0.33, 0.0, -0.08), speed=0.5, steps=40, **hand),
        ),
        alternative=_slide_cabinet_from_the_right(),
        obstacle=("right_hinge_cabinet", 0.2),
    )


def _slide_cabinet_from_the_right() -> ExpertTask:
    # The open hinge cabinet's door stands left of the handle, where the hand would be
    # to push: pull instead.
    yaw = -0.8
    hand: dict[str, Any] = {"anchor": "slide_site", "yaw": yaw}
    direction = tool_rotation(yaw)[:, 2]
    lower = np.array([0.0, 0.0, -0.08])
    before = tuple((lower - 0.12 * direction).tolist())
    around = tuple((lower + 0.01 * direction).tolist())
    return ExpertTask(
        name="slide cabinet",
        columns=(19,),
        goal=(0.37,),
        posture=(1.236, -1.109, -0.843, -2.227, 0.073, 1.28, -0.802),
        waypoints=(
            Waypoint("reach", before, gripper=OPEN, speed=1.5, tolerance=0.06, **hand),
            Waypoint("line", around, gripper=OPEN, speed=0.5, steps=20, **hand),
            Waypoint("hold", around, gripper=CLOSED, steps=3, **hand),
            Waypoint("line", (0.36, 0.0, -0.08), gripper=CLOSED, speed=0.5, **hand),
        ),
    )


def _hinge_cabinet() -> ExpertTask:
    yaw, pitch = 0.35, 0.3
    hand: dict[str, Any] = {"anchor": "hinge_site2", "yaw": yaw, "pitch": pitch}
    direction = tool_rotation(yaw, pitch)[:, 2]
    lower = np.array([0.0, 0.0, -0.06])
    before = tuple((lower - 0.11 * direction).tolist())
    past = tuple((lower + 0.035 * direction).tolist())
    return ExpertTask(
        name="hinge cabinet",
        columns=(20, 21),
        goal=(0.0, 1.45),
        posture=(-1.256, -1.174, 1.356, -1.196, -0.434, 0.677, 1.383),
        # Along the open door, then below it.
        retreat=((0.03, -0.14, 0.0), (0.0, -0.03, -0.25)),
        waypoints=(
            Waypoint("reach", before, gripper=OPEN, speed=1.5, tolerance=0.06, **hand),
            Waypoint("line", past, gripper=OPEN, speed=0.5, steps=20, **hand),
            Waypoint("hold", past, gripper=CLOSED, steps=4, **hand),
            Waypoint(
                "follow",
                past,
                gripper=CLOSED,
                joint="right_hinge_cabinet",
                lead=0.3,
                until=1.4,
                noisy=False,
                **hand,
            ),
        ),
    )


def _light_switch() -> ExpertTask:
    # One finger above the other: the switch is as high as one of them.
    hand: dict[str, Any] = {
        "anchor": "light_site",
        "pitch": -0.3,
        "roll": np.pi / 2,
        "speed": 0.5,
    }
    return ExpertTask(
        name="light switch",
        columns=(17, 18),
        goal=(-0.69, -0.05),
        posture=(-0.864, -0.758, 1.268, -2.387, 0.154, 1.694, 2.25),
        waypoints=(
            Waypoint(
                "reach", (0.075, -0.05, 0.0), tolerance=0.06, **{**hand, "speed": 1.5}
            ),
            Waypoint("line", (0.065, 0.02, 0.0), steps=8, **hand),
            Waypoint("line", (-0.13, 0.05, 0.0), steps=20, **hand),
        ),
    )


def _burner(
    name: str, knob: int, goal: float, pitch: float, posture: tuple[float, ...]
) -> ExpertTask:
    column = 7 + 2 * knob
    hand: dict[str, Any] = {
        "anchor": f"knob{knob}_site",
        "joint": f"knob_Joint_{knob}",
        "pitch": pitch,
        "turn": True,
    }
    before, around = (0.0, -0.11, 0.0), (0.0, -0.01, 0.0)
    return ExpertTask(
        name=name,
        columns=(column, column + 1),
        goal=(goal, -0.01),
        posture=posture,
        waypoints=(
            Waypoint("reach", before, gripper=OPEN, speed=1.5, tolerance=0.06, **hand),
            Waypoint("line", around, gripper=OPEN, speed=0.5, steps=15, **hand),
            Waypoint("hold", around, gripper=CLOSED, steps=4, **hand),
            Waypoint(
                "follow",
                around,
                gripper=CLOSED,
                lead=-0.8,
                until=goal,
                noisy=False,
                **hand,
            ),
        ),
    )


def tool_rotation(
    yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> NDArray[np.float64]:
    """Return the orientation of the tool site for angles of the hand.

    Args:
        yaw: turn about the vertical, radians; 0 points straight ahead (+y), positive
            to the right (+x).
        pitch: turn about the hand's horizontal axis, radians; negative points down.
        roll: turn about the approach direction, radians.

    Returns:
        rotation matrix `[3, 3]`; its last column is the approach direction.

    Example:
        >>> tool_rotation()[:, 2].tolist()
        [0.0, 1.0, 0.0]
    """
    cos_yaw, sin_yaw = np.cos(yaw), np.sin(yaw)
    cos_pitch, sin_pitch = np.cos(pitch), np.sin(pitch)
    cos_roll, sin_roll = np.cos(roll), np.sin(roll)
    about_z = np.array([[cos_yaw, sin_yaw, 0], [-sin_yaw, cos_yaw, 0], [0, 0, 1]])
    about_x = np.array(
        [[1, 0, 0], [0, cos_pitch, -sin_pitch], [0, sin_pitch, cos_pitch]]
    )
    about_approach = np.array(
        [[cos_roll, -sin_roll, 0], [sin_roll, cos_roll, 0], [0, 0, 1]]
    )
    return about_z @ about_x @ _STRAIGHT @ about_approach


#: The expert's tasks by FrankaKitchen's names.
TASKS: dict[str, ExpertTask] = {
    task.name: task
    for task in (
        _microwave(),
        _kettle(),
        _slide_cabinet(),
        _hinge_cabinet(),
        _light_switch(),
        _burner(
            "bottom burner",
            knob=2,
            goal=-0.88,
            pitch=-0.2,
            posture=(-0.881, -0.944, 1.295, -2.616, -0.026, 1.947, 0.94),
        ),
        _burner(
            "top burner",
            knob=4,
            goal=-0.92,
            pitch=0.0,
            posture=(-0.849, -0.948, 1.21, -2.523, 0.25, 1.965, 0.636),
        ),
    )
}

# On the way from one task to the next: postures that are free of the furniture.
_POSTURES = tuple(task.posture for task in TASKS.values() if task.posture is not None)
_SUCCESS_DISTANCE = 0.3


def _rotation_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix `[3, 3]` of a rotation vector `[3]`."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _simulator(env: Any) -> tuple[Any, Any]:
    """Return `(model, data)` of an environment, a robot environment or a pair."""
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


def _task(task: str | ExpertTask) -> ExpertTask:
    """Return the table of a task."""
    if isinstance(task, ExpertTask):
        return task
    if task not in TASKS:
        raise KeyError(f"no expert for task {task!r}; known tasks: {sorted(TASKS)}")
    return TASKS[task]


def _distance(data: Any, task: ExpertTask) -> float:
    """Return the distance of a task's object to its goal."""
    return float(np.linalg.norm(data.qpos[list(task.columns)] - np.array(task.goal)))


class KitchenExpert:
    """Plays a task's waypoint table in a Franka kitchen.

    Every step solves the arm's inverse kinematics for a point a little further along
    the current stage and turns the joints' change `dq` into an action,
    `(dq g + qfrc_bias / kp) / 0.16` with `g = 1 / (1 - exp(-0.08 kp / damping))`: what
    a position servo with these gains does in one step of 0.08 s, gravity included.

    Args:
        env: FrankaKitchen environment (wrapped or not), its `robot_env`, or a
            `(model, data)` pair. The simulator is read, never changed.
        task: name in `TASKS`, or an `ExpertTask`.

    Keyword Args:
        speed: factor on all speeds.
        speed_range: the factor is drawn per episode from `speed * (1 ± speed_range)`.
        waypoint_noise: standard deviation of a waypoint's position, metres per axis,
            drawn once an episode.
        action_noise: standard deviation of the noise on every action.
        clearance: a "reach" that would bring the arm nearer than this to something,
            metres, goes by the posture of another task where that is freer. None: it
            always goes straight, which suits a start from the default posture.
        rng: source of all draws; a `numpy.random.Generator` or a seed.

    Raises:
        KeyError: unknown task.
        ValueError: speeds, noise or clearance out of range.
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
        task = _task(task)
        if not speed > 0:
            raise ValueError(f"speed is {speed}, wanted a positive factor")
        if not 0 <= speed_range < 1:
            raise ValueError(f"speed_range is {speed_range}, wanted 0 <= range < 1")
        if waypoint_noise < 0 or action_noise < 0:
            raise ValueError(
                f"waypoint_noise is {waypoint_noise} and action_noise {action_noise}, "
                "wanted standard deviations of at least 0"
            )
        self.model, self.data = _simulator(env)
        self.speed = speed
        self.speed_range = speed_range
        self.waypoint_noise = waypoint_noise
        if clearance is not None and clearance < 0:
            raise ValueError(f"clearance is {clearance}, wanted at least 0 metres")
        self.action_noise = action_noise
        self.clearance = clearance
        self.rng = np.random.default_rng(rng)
        own = np.array([self.model.joint(name).range for name in ARM_JOINTS])
        self.ik = InverseKinematics(
            self.model,
            TOOL_SITE,
            ARM_JOINTS,
            offset=TOOL_OFFSET,
            limits=np.stack(
                [
                    np.maximum(own[:, 0], ARM_TARGET_LIMITS[:, 0]),
                    np.minimum(own[:, 1], ARM_TARGET_LIMITS[:, 1]),
                ],
                axis=1,
            ),
        )
        gain = self.model.actuator_gainprm[:9, 0]
        damping = self.model.dof_damping[:9]
        self._stiffness = gain.copy()
        self._gain = 1 / (1 - np.exp(-STEP_SECONDS * gain / damping))
        self.set_task(task)

    def set_task(self, task: str | ExpertTask) -> None:
        """Take on another task; `reset` begins it.

        Args:
            task: name in `TASKS`, or an `ExpertTask`.
        """
        self.task = _task(task)
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
        return _rotation_matrix(angle * joint.xaxis) @ rotation

    def reset(self) -> None:
        """Begin an episode from the state that the simulator is in.

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
        """Go on with a later stage; nothing happens where it is played already.

        Args:
            stage: number of the stage.
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
        """Number of the stage being played; the table's length when finished."""
        return self._stage

    @property
    def finished(self) -> bool:
        """Whether the last stage is over."""
        return self._stage >= len(self.task.waypoints)

    @property
    def goal_distance(self) -> float:
        """Distance of the task's object to its goal, as FrankaKitchen measures it."""
        return _distance(self.data, self.task)

    @property
    def success(self) -> bool:
        """Whether the object is within FrankaKitchen's 0.3 of its goal."""
        return self.goal_distance < _SUCCESS_DISTANCE

    def __call__(self, observation: Any = None) -> NDArray[np.float64]:
        """Return the next action.

        Args:
            observation: not read; here so that the expert is a policy like others.

        Returns:
            action `[9]` in [-1, 1], float64.
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
            limit = waypoint.speed * self._factor * STEP_SECONDS
            change[:7] *= min(1.0, limit / max(np.abs(change[:7]).max(), 1e-9))
        else:
            change[:7] = self._towards(*self._tool_target(waypoint)) - joints
        change[7:] = waypoint.gripper - self.data.qpos[7:9]
        self._steps_in_stage += 1
        action = (
            change * self._gain + self.data.qfrc_bias[:9] / self._stiffness
        ) / ACTION_SCALE
        largest = np.abs(action[:7]).max()
        if largest > 0.95:
            action[:7] *= 0.95 / largest
        action += self.action_noise * self.rng.normal(size=9)
        return np.clip(action, -1.0, 1.0)

    def update(self) -> bool:
        """Go on to the next stage where one is over; a call of the expert does.

        Returns:
            whether the last stage is over.
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
        """Return the tool's pose to aim at in this step."""
        rotation = self._rotation(waypoint)
        if waypoint.move == "back":
            rotation = self._begin_rotation
        target = self._targets[self._stage]
        point, _ = self.ik.pose(self.data.qpos)
        reach = waypoint.speed * self._factor * STEP_SECONDS
        if waypoint.move == "follow":
            aim = self._ahead(waypoint) + target
            way = aim - point
            distance = float(np.linalg.norm(way))
            return point + way * min(1.0, reach / max(distance, 1e-9)), rotation
        if waypoint.move == "hold":
            return target, rotation
        # A point on the line, one step's way past the tool's projection: errors across
        # the line are taken back, and the aim never runs away from a slow arm.
        line = target - self._begin
        length = max(float(np.linalg.norm(line)), 1e-9)
        progress = float((point - self._begin) @ line) / length + reach
        share = min(max(progress / length, 0.0), 1.0)
        turn = rotation_vector(rotation @ self._begin_rotation.T)
        return (
            self._begin + share * line,
            _rotation_matrix(min(1.0, 2 * share) * turn) @ self._begin_rotation,
        )

    def _ahead(self, waypoint: Waypoint) -> NDArray[np.float64]:
        """Return where the anchor would be with its joint `lead` further."""
        joint = self.data.joint(waypoint.joint)
        anchor = self._anchor(waypoint)
        if int(self.model.joint(waypoint.joint).type[0]) == 2:
            return anchor + waypoint.lead * joint.xaxis
        turn = _rotation_matrix(waypoint.lead * joint.xaxis)
        return joint.xanchor + turn @ (anchor - joint.xanchor)


class KitchenChain:
    """Plays several tasks, one after the other, from wherever the arm is.

    Each attempt plays the task's table until its object is well past the threshold, or
    past it and leaving its goal again, then backs the hand away. The next task is the
    first in the order that is not solved and has attempts left: a failed one is tried
    again at once, one that was undone later is repaired. Tasks that are solved already
    are not played.

    Args:
        env: as for `KitchenExpert`.
        tasks: names in `TASKS`, in the order in which to play them.

    Keyword Args:
        retries: attempts of a task after its first.
        speed: factor on all speeds.
        speed_range: the factor is drawn per episode from `speed * (1 ± speed_range)`.
        waypoint_noise: as for `KitchenExpert`, drawn anew in every attempt.
        action_noise: as for `KitchenExpert`.
        clearance: as for `KitchenExpert`.
        margin: distance of an object to its goal at which its motion may end early.
        rng: source of all draws; a `numpy.random.Generator` or a seed.

    Raises:
        KeyError: unknown task.
        ValueError: no tasks, a task twice, negative retries, or what `KitchenExpert`
            refuses.

    Example:
        >>> from torchrl_caiac.envs import KitchenEnv
        >>> env = KitchenEnv()
        >>> _ = env.reset(seed=0, options={"open": "hinge_cabinet"})
        >>> chain = KitchenChain(env, ["kettle", "hinge cabinet", "microwave"], rng=0)
        >>> chain.reset()
        >>> chain.task, chain.solved, chain.finished
        ('kettle', ('hinge cabinet',), False)
        >>> action = chain()
    """

    def __init__(
        self,
        env: Any,
        tasks: Sequence[str],
        *,
        retries: int = 1,
        speed: float = 1.0,
        speed_range: float = 0.05,
        waypoint_noise: float = 0.005,
        action_noise: float = 0.03,
        clearance: float = 0.02,
        margin: float = 0.15,
        rng: np.random.Generator | int | None = None,
    ) -> None:
        if retries < 0:
            raise ValueError(f"retries is {retries}, wanted at least 0")
        self.tasks = self._check(tasks)
        self.retries = retries
        self.margin = margin
        self.speed = speed
        self.speed_range = speed_range
        self.rng = np.random.default_rng(rng)
        #: Plays the attempts.
        self.expert = KitchenExpert(
            env,
            self.tasks[0],
            speed=speed,
            speed_range=speed_range,
            waypoint_noise=waypoint_noise,
            action_noise=action_noise,
            clearance=clearance,
        )
        #: Name of the task being played.
        self.task: str | None = None
        #: How often each task was begun.
        self.attempts: dict[str, int] = {}

    @staticmethod
    def _check(tasks: Sequence[str]) -> tuple[str, ...]:
        names = (tasks,) if isinstance(tasks, str) else tuple(tasks)
        if not names:
            raise ValueError(f"no tasks given, wanted some of {sorted(TASKS)}")
        if len(set(names)) < len(names):
            raise ValueError(f"tasks are {names}, wanted each at most once")
        for name in names:
            _task(name)
        return names

    def reset(self, tasks: Sequence[str] | None = None) -> None:
        """Begin an episode from the state that the simulator is in.

        Args:
            tasks: the episode's tasks; those of the last episode where None.
        """
        if tasks is not None:
            self.tasks = self._check(tasks)
        self.attempts = dict.fromkeys(self.tasks, 0)
        self._solved_before = self.solved
        self.expert.rng = self.rng
        # One draw for the whole chain.
        self.expert.speed_range = 0.0
        self.expert.speed = self.speed * (
            1 + self.speed_range * self.rng.uniform(-1.0, 1.0)
        )
        self._advance()
        if self.finished:
            # All are solved: stay here.
            self.expert.reset()
            self.expert.skip_to(len(self.expert.task.waypoints))

    @property
    def finished(self) -> bool:
        """Whether nothing is left to play."""
        return self.task is None

    @property
    def solved(self) -> tuple[str, ...]:
        """All tasks whose objects are within FrankaKitchen's 0.3 of their goals."""
        return tuple(
            name
            for name, task in TASKS.items()
            if _distance(self.expert.data, task) < _SUCCESS_DISTANCE
        )

    @property
    def wrong_tasks(self) -> tuple[str, ...]:
        """Tasks that are solved now, were not at the start and were not asked for."""
        known = {*self.tasks, *self._solved_before}
        return tuple(name for name in self.solved if name not in known)

    @property
    def success(self) -> bool:
        """Whether all the chain's tasks are solved and no wrong one is."""
        return set(self.tasks) <= set(self.solved) and not self.wrong_tasks

    def _advance(self) -> None:
        """Begin the next attempt, or finish."""
        solved = self.solved
        left = (
            name
            for name in self.tasks
            if name not in solved and self.attempts[name] <= self.retries
        )
        self.task = next(left, None)
        if self.task is None:
            return
        self.attempts[self.task] += 1
        table = TASKS[self.task]
        if table.alternative is not None and (
            self.attempts[self.task] % 2 == 0 or self._is_obstructed(table)
        ):
            table = table.alternative
        self._table, self._nearest = table, np.inf
        self.expert.set_task(table.with_retreat())
        self.expert.reset()

    def _is_obstructed(self, table: ExpertTask) -> bool:
        if table.obstacle is None:
            return False
        joint, position = table.obstacle
        return float(self.expert.data.joint(joint).qpos[0]) > position

    def __call__(self, observation: Any = None) -> NDArray[np.float64]:
        """Return the next action.

        Args:
            observation: not read; here so that the chain is a policy like others.

        Returns:
            action `[9]` in [-1, 1], float64; it holds the hand where it is when
            finished.
        """
        if not self.attempts:
            raise RuntimeError("call reset() before the first action of an episode")
        if self.task is not None:
            distance = self.expert.goal_distance
            self._nearest = min(self._nearest, distance)
            worse = self.expert.success and distance > self._nearest + 0.01
            if distance < self.margin or worse:
                self.expert.skip_to(len(self._table.waypoints))
            if self.expert.update():
                self._advance()
        return self.expert()


def set_kitchen_start(
    env: Any,
    positions: Mapping[str, float] | None = None,
    *,
    qpos: ArrayLike | None = None,
    qvel: ArrayLike | None = None,
) -> dict[str, Any]:
    """Put FrankaKitchen into a start state, ready for the next `step`.

    Joints that are coupled to one another are set together: a burner with its knob,
    the light with its switch. (`KitchenEnv` has start states of its own: give them to
    its `reset`.)

    Args:
        env: `FrankaKitchen-v1`, wrapped or not, after a `reset`.
        positions: object joints by name, for example `{"slide_cabinet": 0.37}`.

    Keyword Args:
        qpos: positions of the whole model `[30]` to begin with; as they are where
            None.
        qvel: velocities of the whole model `[29]`; zeros where None.

    Returns:
        the environment's observation of the state.

    Raises:
        TypeError: not a FrankaKitchen environment.
        ValueError: wrong shape, unknown joint, or values that are not finite.
    """
    kitchen = env.unwrapped
    if not hasattr(kitchen, "robot_env") or not hasattr(kitchen, "_get_obs"):
        raise TypeError(
            f"{type(kitchen).__name__} is not gymnasium-robotics' FrankaKitchen; for "
            'a KitchenEnv use reset(options={"start": ...})'
        )
    robot = kitchen.robot_env
    model, data = robot.model, robot.data
    start = np.array(data.qpos if qpos is None else qpos, dtype=np.float64)
    speeds = np.zeros(model.nv) if qvel is None else np.array(qvel, dtype=np.float64)
    for name, value, size in (("qpos", start, model.nq), ("qvel", speeds, model.nv)):
        if value.shape != (size,):
            raise ValueError(f"{name} has shape {value.shape}, wanted ({size},)")
    names = {model.joint(i).name for i in range(model.njnt)}
    for name, position in (positions or {}).items():
        if name not in names:
            raise ValueError(
                f"the kitchen has no joint {name!r}; it has {sorted(names)}"
            )
        start[model.joint(name).qposadr[0]] = position
        if name.startswith("knob_Joint_"):
            start[model.joint(name).qposadr[0] + 1] = position / _KNOB_PER_BURNER
        elif name == "light_switch":
            start[model.joint("light_joint").qposadr[0]] = position * _LIGHT_PER_SWITCH
    for name, value in (("qpos", start), ("qvel", speeds)):
        if not np.isfinite(value).all():
            raise ValueError(
                f"{name} has values that are not finite at positions "
                f"{np.flatnonzero(~np.isfinite(value)).tolist()}"
            )
    robot.set_state(start, speeds)
    # Also keeps the joint positions that the next action will be added to.
    observation: dict[str, Any] = kitchen._get_obs(robot._get_obs())
    return observation


def random_chain_start(
    kitchen: KitchenEnv, tasks: Sequence[str], *, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw a start for a chain: `KitchenEnv.random_start` for several tasks.

    Args:
        kitchen: the environment that draws; it may be another one than the one acted
            in.
        tasks: names in `TASKS`, whose objects keep their default configuration.

    Keyword Args:
        rng: source of the draw.

    Returns:
        state `[30]`, for `set_kitchen_start(env, qpos=...)` or a KitchenEnv's `reset`.

    Raises:
        KeyError: unknown task.
        ValueError: no tasks.

    Example:
        >>> from torchrl_caiac.envs import KitchenEnv
        >>> draw = np.random.default_rng(0)
        >>> start = random_chain_start(KitchenEnv(), ["microwave", "kettle"], rng=draw)
        >>> start.shape, bool(start[22] == KitchenEnv.default_state()[22])
        ((30,), True)
    """
    tables = [_task(name) for name in tasks]
    if not tables:
        raise ValueError(f"no tasks given, wanted some of {sorted(TASKS)}")
    # The kettle's place must be free; doors and knobs close without running into it.
    spared = "kettle" if "kettle" in tasks else tables[0].name
    state = kitchen.random_start(spared.replace(" ", "_"), rng=rng)
    for table in tables:
        columns = list(table.columns)
        state[columns] = kitchen.default_state()[columns]
    return state


def _make_env() -> Any:
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(
        "FrankaKitchen-v1",
        tasks_to_complete=list(TASKS),
        terminate_on_tasks_completed=False,
        max_episode_steps=_CHAIN_STEPS,
        disable_env_checker=True,
    )


def _measure_task(env: Any, name: str, options: argparse.Namespace) -> int:
    """Play episodes of one task, say how they went, return the successful ones."""
    expert = None
    lengths, moved, ends, seconds = [], [], [], time.perf_counter()
    for episode in range(options.episodes):
        env.reset(seed=options.seed + episode)
        set_kitchen_start(env, {"slide_cabinet": options.cabinet})
        if expert is None:
            expert = KitchenExpert(
                env,
                name,
                speed=options.speed,
                speed_range=options.speed_range,
                waypoint_noise=options.waypoint_noise,
                action_noise=options.action_noise,
            )
        expert.rng = np.random.default_rng([options.seed, episode])
        expert.reset()
        start = expert.data.qpos.copy()
        kept = 0
        for step in range(120):
            env.step(expert())
            if options.verbose:
                logger.info(
                    "%d stage %d tool %s object %s distance %.3f",
                    step,
                    expert.stage,
                    expert.ik.pose(expert.data.qpos)[0].round(3),
                    expert.data.qpos[list(expert.task.columns)].round(3),
                    expert.goal_distance,
                )
            kept += expert.success
            if kept > options.keep:
                break
        others = np.ones(30, dtype=bool)
        others[:9] = False
        others[list(expert.task.columns)] = False
        moved.append(np.abs(expert.data.qpos - start) * others)
        lengths.append(step + 1 if kept > options.keep else 0)
        ends.append(expert.data.qpos[list(expert.task.columns)].copy())
    done = [length for length in lengths if length]
    largest = np.max(moved, axis=0)
    logger.info(
        "%s: %d of %d episodes, steps %d to %d (median %d), %.2f s an episode; object "
        "at the end %s (median), others moved by at most %.4f (position %d)",
        name,
        len(done),
        len(lengths),
        min(done, default=0),
        max(done, default=0),
        np.median(done) if done else 0,
        (time.perf_counter() - seconds) / len(lengths),
        np.median(ends, axis=0).round(3),
        largest.max(),
        largest.argmax(),
    )
    return len(done)


def _measure_chains(env: Any, options: argparse.Namespace) -> int:
    """Play chains in random order, say how they went, return the successful ones."""
    from torchrl_caiac.envs.kitchen.env import KitchenEnv

    kitchen = KitchenEnv()
    names = list(TASKS)
    chain = None
    lengths, clean, seconds = [], 0, time.perf_counter()
    # By pairs of a task and the one before it: attempts, and chains that had it.
    pairs: dict[tuple[str, str], list[int]] = {}
    for episode in range(options.episodes):
        rng = np.random.default_rng([options.seed, episode])
        tasks = [str(name) for name in rng.permutation(names)[: options.chain]]
        env.reset(seed=options.seed + episode)
        start = kitchen.default_state()
        if options.random_start:
            start = random_chain_start(kitchen, tasks, rng=rng)
        set_kitchen_start(env, qpos=start)
        if chain is None:
            chain = KitchenChain(
                env,
                tasks,
                retries=options.retries,
                speed=options.speed,
                speed_range=options.speed_range,
                waypoint_noise=options.waypoint_noise,
                action_noise=options.action_noise,
            )
        chain.rng = rng
        chain.reset(tasks)
        own = [column for name in tasks for column in TASKS[name].columns]
        others = np.setdiff1d(np.arange(9, 30), own)
        moved, steps = 0.0, 0
        while steps < _CHAIN_STEPS:
            action = chain()
            if chain.finished:
                break
            env.step(action)
            steps += 1
            change = np.abs(chain.expert.data.qpos - start)[others]
            moved = max(moved, float(change.max(initial=0.0)))
        lengths.append(steps if chain.success else 0)
        clean += chain.success and moved < 0.02
        for before, name in zip(["", *tasks], tasks, strict=False):
            count = pairs.setdefault((before, name), [0, 0])
            count[0] += chain.attempts[name] == 1 and name in chain.solved
            count[1] += 1
        if options.verbose or not chain.success:
            logger.info(
                "chain %d %s: %s after %d steps, attempts %s, undone %s, wrong %s, "
                "speed %.2f",
                episode,
                tasks,
                "success" if chain.success else "failure",
                steps,
                list(chain.attempts.values()),
                [name for name in tasks if name not in chain.solved],
                list(chain.wrong_tasks),
                chain.expert.speed,
            )
    done = [length for length in lengths if length]
    logger.info(
        "chains of %d: %d of %d, in %d no other object moved by 2 cm (or 0.02 rad); "
        "steps %d to %d (median %d), %.2f s a chain",
        options.chain,
        len(done),
        len(lengths),
        clean,
        min(done, default=0),
        max(done, default=0),
        np.median(done) if done else 0,
        (time.perf_counter() - seconds) / len(lengths),
    )
    failing = {pair: count for pair, count in pairs.items() if count[0] < count[1]}
    logger.info(
        "in %d of %d orders of two the second was always done at the first attempt%s",
        len(pairs) - len(failing),
        len(pairs),
        "; not so:" if failing else "",
    )
    for (before, name), (first, total) in sorted(failing.items()):
        logger.info(
            "  %s after %s: %d of %d", name, before or "the start", first, total
        )
    return len(done)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the expert's success and say it on standard output."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--task", choices=[*sorted(TASKS), "all"])
    what.add_argument(
        "--chain",
        type=int,
        choices=range(1, len(TASKS) + 1),
        help="number of tasks, in random order",
    )
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--cabinet", type=float, default=0.0, help="slide, metres")
    parser.add_argument("--random-start", action="store_true", help="of chains")
    parser.add_argument("--retries", type=int, default=1, help="of chains")
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--speed-range", type=float, default=0.05)
    parser.add_argument("--waypoint-noise", type=float, default=0.005)
    parser.add_argument("--action-noise", type=float, default=0.03)
    parser.add_argument("--keep", type=int, default=5, help="steps after success")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args(arguments)
    if options.episodes < 1:
        parser.error(f"--episodes is {options.episodes}, wanted at least 1")

    env = _make_env()
    if options.chain:
        done = [_measure_chains(env, options)]
    else:
        names = list(TASKS) if options.task == "all" else [options.task]
        done = [_measure_task(env, name, options) for name in names]
    env.close()
    return 0 if all(done) else 1


if __name__ == "__main__":
    import sys

    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    sys.exit(main())
