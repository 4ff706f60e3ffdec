"""Tables of waypoints for the scripted expert, one for each task of the kitchen."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["TASKS", "ExpertTask", "Waypoint", "get_task", "tool_rotation"]

OPEN, CLOSED = 0.04, 0.0
# Site axes in the world when the hand points straight ahead (+y): x up, y to the
# right, z (the approach direction) forward.
_STRAIGHT = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


@dataclasses.dataclass(frozen=True)
class Waypoint:
    """One stage of a motion.

    Args:
        move (str): ``"reach"`` goes to the waypoint in joint space. ``"line"`` moves
            the tool along a straight line. ``"follow"`` leads the tool along the path
            of the object's joint. ``"hold"`` stays for ``steps``. ``"back"`` is a line
            that starts where the hand is, without turning it.
        offset (tuple of float): tool point relative to ``anchor``, ``[3]``, metres,
            world axes. For ``"follow"``: relative to the moving anchor. For ``"back"``:
            relative to where the stage begins. Defaults to zeros.
        anchor (str, optional): the site that the offset is relative to, at its position
            when the episode starts (``"follow"``: at its current position); ``None``
            for world coordinates. Defaults to ``None``.
        yaw (float): turn of the hand about the vertical, radians: 0 points straight
            ahead (+y), positive to the robot's right (+x). Defaults to 0.
        pitch (float): turn about the hand's horizontal axis, radians; negative points
            down. Defaults to 0.
        roll (float): turn about the approach direction, radians. Defaults to 0.
        gripper (float): opening of each finger, metres, 0 (closed) to 0.04.
            Defaults to 0.
        speed (float): ``"reach"``: radians per second of the fastest joint; otherwise
            metres per second of the tool. Defaults to 0.6.
        tolerance (float): distance at which the stage counts as reached, metres
            (radians for ``"reach"``). Defaults to 0.015.
        steps (int): number of steps of a ``"hold"``; for other moves the maximum number
            of steps (proportionally more where the speed factor is below 1).
            Defaults to 60.
        joint (str, optional): the object's joint, for ``"follow"``.
        lead (float): how far ahead of the joint's position the tool is led, radians or
            metres, signed. Defaults to 0.
        until (float, optional): joint position at which a ``"follow"`` ends.
        turn (bool): whether the hand turns with ``joint``, which it grasps: the angles
            of the hand are those for the joint at 0. Defaults to ``False``.
        noisy (bool): whether waypoint noise applies. Defaults to ``True``.

    Raises:
        ValueError: a ``"follow"`` without joint, anchor or end.

    Examples:
        >>> Waypoint("line", (-0.25, 0.62, 1.70), speed=0.4).gripper
        0.0
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
        name (str): the task's name in ``FrankaKitchen-v1``.
        columns (tuple of int): indices in ``qpos`` of the object's joints that the goal
            describes.
        goal (tuple of float): their goal values.
        waypoints (tuple of Waypoint): the motion.
        posture (tuple of float, optional): joint positions ``[7]`` of the arm, free of
            collisions, before contact: the first stage goes to the solution near it,
            later ones are pulled towards it. Defaults to ``None``: searched for.
        retreat (tuple of tuple of float): where the hand goes from the end of the
            motion before another task begins, metres, world axes, each relative to the
            one before. Defaults to 12 cm back against the approach direction.
        alternative (ExpertTask, optional): another table of the same task, which a
            chain plays if ``obstacle`` is in the way, and in every second attempt.
        obstacle (tuple of str and float, optional): joint of another object, and the
            position above which it is in the way.

    Examples:
        >>> len(TASKS["kettle"].with_retreat().waypoints)
        3
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
        """Returns the table with the retreat at its end.

        Returns:
            ExpertTask: a copy with more waypoints.
        """
        first, last = self.waypoints[0], self.waypoints[-1]
        back = -0.12 * tool_rotation(last.yaw, last.pitch)[:, 2]
        stages = tuple(
            # Fingers as at the start: open where something was held.
            Waypoint("back", offset, gripper=first.gripper, speed=0.4, steps=10)
            for offset in self.retreat or (tuple(back.tolist()),)
        )
        return dataclasses.replace(self, waypoints=(*self.waypoints, *stages))


def tool_rotation(
    yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> NDArray[np.float64]:
    """Returns the orientation of the tool site for angles of the hand.

    Args:
        yaw (float): turn about the vertical, radians; 0 points straight ahead (+y),
            positive to the right (+x). Defaults to 0.
        pitch (float): turn about the hand's horizontal axis, radians; negative points
            down. Defaults to 0.
        roll (float): turn about the approach direction, radians. Defaults to 0.

    Returns:
        numpy.ndarray: rotation matrix ``[3, 3]``; its last column is the approach
        direction.

    Examples:
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
    # The open door of the hinge cabinet is left of the handle, where the hand would
    # push from: pull instead.
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


#: The tables of waypoints, by the names of the tasks in ``FrankaKitchen-v1``.
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


def get_task(task: str | ExpertTask) -> ExpertTask:
    """Returns the table of a task.

    Args:
        task (str or ExpertTask): a name in :data:`TASKS`, or a table.

    Returns:
        ExpertTask: the table.

    Raises:
        KeyError: there is no table of that name.

    Examples:
        >>> get_task("kettle").columns
        (23, 24, 25, 26, 27, 28, 29)
    """
    if isinstance(task, ExpertTask):
        return task
    if task not in TASKS:
        raise KeyError(f"no expert for task {task!r}; known tasks: {sorted(TASKS)}")
    return TASKS[task]
