"""A scripted expert for the Franka kitchen: tables of waypoints and their player.

The expert sees the simulator (`mujoco.MjModel`, `mujoco.MjData`) and acts through the
environment's own nine-dimensional action, with noise on the waypoints, the speed and
the actions. A task is a table: another task is another entry of `TASKS`.

`python -m torchrl_caiac.envs.kitchen_expert --task microwave --episodes 50` measures
it.
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from torchrl_caiac.envs.inverse_kinematics import InverseKinematics, rotation_vector

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = [
    "TASKS",
    "ExpertTask",
    "KitchenExpert",
    "Waypoint",
    "set_kitchen_start",
    "tool_rotation",
]

logger = logging.getLogger("torchrl_caiac.envs.kitchen_expert")

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
            "hold" stays for `steps`.
        offset: tool point relative to `anchor`, `[3]`, metres, world axes. For
            "follow": relative to the moving anchor.
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
        steps: number of steps of a "hold"; for other moves the most steps it may take.
        joint: the object's joint, for "follow".
        lead: how far ahead of the joint's position the tool is led, radians or metres,
            with its sign.
        until: joint position at which a "follow" ends.
        noisy: whether waypoint noise applies.
    """

    move: Literal["reach", "line", "follow", "hold"]
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
    """

    name: str
    columns: tuple[int, ...]
    goal: tuple[float, ...]
    waypoints: tuple[Waypoint, ...]
    posture: tuple[float, ...] | None = None


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
TASKS: dict[str, ExpertTask] = {task.name: task for task in (_microwave(), _kettle())}


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
        rng: source of all draws; a `numpy.random.Generator` or a seed.

    Raises:
        KeyError: unknown task.
        ValueError: speeds or noise out of range.
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
        rng: np.random.Generator | int | None = None,
    ) -> None:
        if isinstance(task, str):
            if task not in TASKS:
                raise KeyError(
                    f"no expert for task {task!r}; known tasks: {sorted(TASKS)}"
                )
            task = TASKS[task]
        if not speed > 0:
            raise ValueError(f"speed is {speed}, wanted a positive factor")
        if not 0 <= speed_range < 1:
            raise ValueError(f"speed_range is {speed_range}, wanted 0 <= range < 1")
        if waypoint_noise < 0 or action_noise < 0:
            raise ValueError(
                f"waypoint_noise is {waypoint_noise} and action_noise {action_noise}, "
                "wanted standard deviations of at least 0"
            )
        self.task = task
        self.model, self.data = _simulator(env)
        self.speed = speed
        self.speed_range = speed_range
        self.waypoint_noise = waypoint_noise
        self.action_noise = action_noise
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
        self._posture = self._find_posture()
        self._stage = len(task.waypoints)

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

    def reset(self) -> None:
        """Begin an episode from the state that the simulator is in.

        Draws the episode's speed and waypoints.
        """
        self._factor = self.speed * (1 + self.speed_range * self.rng.uniform(-1.0, 1.0))
        self._targets = []
        for waypoint in self.task.waypoints:
            noise = self.rng.normal(size=3) * self.waypoint_noise * waypoint.noisy
            origin = 0.0 if waypoint.move == "follow" else self._anchor(waypoint)
            self._targets.append(origin + np.array(waypoint.offset) + noise)
        self._enter(0)

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
            self._joints = self.ik.solve(
                configuration,
                self._targets[stage],
                tool_rotation(waypoint.yaw, waypoint.pitch, waypoint.roll),
                iterations=30,
            ).joints

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
        position = self.data.qpos[list(self.task.columns)]
        return float(np.linalg.norm(position - np.array(self.task.goal)))

    @property
    def success(self) -> bool:
        """Whether the object is within FrankaKitchen's 0.3 of its goal."""
        return self.goal_distance < 0.3

    def __call__(self, observation: Any = None) -> NDArray[np.float64]:
        """Return the next action.

        Args:
            observation: not read; here so that the expert is a policy like others.

        Returns:
            action `[9]` in [-1, 1], float64.
        """
        if not hasattr(self, "_targets"):
            raise RuntimeError("call reset() before the first action of an episode")
        while not self.finished and self._stage_over():
            self._enter(self._stage + 1)
        waypoint = self.task.waypoints[min(self._stage, len(self.task.waypoints) - 1)]
        joints = self.data.qpos[:7].copy()
        change = np.zeros(9)
        if self.finished:
            change[:7] = self._towards(self._begin, self._begin_rotation) - joints
        elif waypoint.move == "reach":
            change[:7] = self._joints - joints
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

    def _towards(
        self, position: NDArray[np.float64], rotation: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return self.ik.solve(
            self.data.qpos, position, rotation, posture=self._posture
        ).joints

    def _stage_over(self) -> bool:
        waypoint = self.task.waypoints[self._stage]
        if self._steps_in_stage >= waypoint.steps:
            return True
        if waypoint.move == "hold":
            return False
        if waypoint.move == "follow":
            assert waypoint.joint is not None and waypoint.until is not None
            position = float(self.data.joint(waypoint.joint).qpos[0])
            return (position - waypoint.until) * np.sign(waypoint.lead) >= 0
        if waypoint.move == "reach":
            error = np.abs(self._joints - self.data.qpos[:7]).max()
        else:
            point, _ = self.ik.pose(self.data.qpos)
            error = np.linalg.norm(self._targets[self._stage] - point)
        return bool(error < waypoint.tolerance)

    def _tool_target(
        self, waypoint: Waypoint
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the tool's pose to aim at in this step."""
        rotation = tool_rotation(waypoint.yaw, waypoint.pitch, waypoint.roll)
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the expert's success and say it on standard output."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--task", choices=sorted(TASKS), required=True)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--cabinet", type=float, default=0.0, help="slide, metres")
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--waypoint-noise", type=float, default=0.005)
    parser.add_argument("--action-noise", type=float, default=0.03)
    parser.add_argument("--keep", type=int, default=5, help="steps after success")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args(arguments)

    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(
        "FrankaKitchen-v1",
        tasks_to_complete=[options.task],
        terminate_on_tasks_completed=False,
        disable_env_checker=True,
    )
    expert = None
    lengths, moved, ends, seconds = [], [], [], time.perf_counter()
    for episode in range(options.episodes):
        env.reset(seed=options.seed + episode)
        set_kitchen_start(env, {"slide_cabinet": options.cabinet})
        if expert is None:
            expert = KitchenExpert(
                env,
                options.task,
                speed=options.speed,
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
    logger.info(
        "%s: %d of %d episodes, steps %s to %s (median %s), %.2f s an episode",
        options.task,
        len(done),
        len(lengths),
        min(done, default=0),
        max(done, default=0),
        np.median(done) if done else 0,
        (time.perf_counter() - seconds) / max(len(lengths), 1),
    )
    logger.info("object at the end: median %s", np.median(ends, axis=0).round(3))
    largest = np.max(moved, axis=0)
    logger.info(
        "other objects moved by at most %.4f (position %d)",
        largest.max(),
        largest.argmax(),
    )
    env.close()
    return 0 if done else 1


if __name__ == "__main__":
    import sys

    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    sys.exit(main())
