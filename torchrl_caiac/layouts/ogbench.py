"""Layouts of OGBench's manipulation environments.

From ``ogbench.manipspace.envs``: positions are shifted and scaled, so that a millimetre
is 0.01 for cubes, 0.12 for buttons, 0.018 for the drawer and 0.015 for the window.
Velocities are neither. A control step lasts 0.05 s.
"""

from __future__ import annotations

from torchrl_caiac.layouts.description import (
    MILLIMETRE,
    MILLIRADIAN,
    STATE,
    TURN,
    Columns,
    LayoutDescription,
)

__all__ = ["OGBENCH"]

_STEP = 0.05  # s
_CUBES = {"single": 1, "double": 2, "triple": 3, "quadruple": 4}
_PUZZLES = ((3, 3), (4, 4), (4, 5), (4, 6))

_ROBOT = (
    Columns("joint angles, rad", 6, "robot", MILLIRADIAN),
    Columns("joint velocities, rad/s", 6, "robot", MILLIRADIAN / _STEP),
    Columns("effector position, 10 x m", 3, "robot", 10 * MILLIMETRE, is_position=True),
    Columns("effector yaw, cosine and sine", 2, "robot", MILLIRADIAN, is_unit=True),
    # A share of 0.8 rad of the driver joint.
    Columns(
        "gripper opening, 3 x share", 1, "robot", 3 / 0.8 * MILLIRADIAN, bounds=(0, 3)
    ),
    # The floor is one newton.
    Columns("gripper contact, force / 50 N", 1, "robot", 1 / 50, bounds=(0, 1)),
)
_GOALS = (
    "Goals are those of the 'oraclerep' environments: {}. For goals that are whole "
    "observations, make a layout of your own."
)


def _cube(name: str) -> tuple[Columns, ...]:
    position = Columns(
        "position, 10 x m", 3, name, 10 * MILLIMETRE, is_position=True, is_goal=True
    )
    return (
        position,
        # A turn by an angle changes a quaternion by half of it.
        Columns("orientation, quaternion wxyz", 4, name, TURN / 2, is_unit=True),
        Columns("yaw, cosine and sine", 2, name, TURN, is_unit=True),
    )


def _button(name: str) -> tuple[Columns, ...]:
    # The state is a position: a neighbour that is pressed changes it.
    return (
        Columns("whether the state is 0", 1, name, STATE, bounds=(0, 1)),
        Columns(
            "whether the state is 1",
            1,
            name,
            STATE,
            is_position=True,
            is_goal=True,
            bounds=(0, 1),
        ),
        Columns("position, 120 x m", 1, name, 120 * MILLIMETRE, is_position=True),
        Columns("velocity, m/s", 1, name, MILLIMETRE / _STEP),
    )


def _slide(name: str, scale: float) -> tuple[Columns, ...]:
    return (
        Columns(
            f"position, {scale:g} x m",
            1,
            name,
            scale * MILLIMETRE,
            is_position=True,
            is_goal=True,
        ),
        Columns("velocity, m/s", 1, name, MILLIMETRE / _STEP),
    )


def _cubes(kind: str, count: int) -> LayoutDescription:
    parts = [part for i in range(count) for part in _cube(f"cube{i}")]
    return LayoutDescription(
        f"ogbench/cube-{kind}",
        (*_ROBOT, *parts),
        ("robot",),
        _GOALS.format("the positions of the cubes"),
    )


def _puzzle(rows: int, columns: int) -> LayoutDescription:
    parts = [part for i in range(rows * columns) for part in _button(f"button{i}")]
    return LayoutDescription(
        f"ogbench/puzzle-{rows}x{columns}",
        (*_ROBOT, *parts),
        ("robot",),
        "A button that is pressed changes its neighbours' states, too: they count as "
        "moved. " + _GOALS.format("the states of the buttons"),
    )


_SCENE = LayoutDescription(
    "ogbench/scene",
    (
        *_ROBOT,
        *_cube("cube0"),
        *_button("button0"),
        *_button("button1"),
        *_slide("drawer", 18),
        *_slide("window", 15),
    ),
    ("robot",),
    "button0 locks the drawer and button1 the window, and the drawer carries the cube: "
    "entities of different samples may not fit together while the drawer or the window "
    "moves. " + _GOALS.format("cube position, button states, drawer, window"),
)

#: The layouts of OGBench.
OGBENCH = (
    *(_cubes(kind, count) for kind, count in _CUBES.items()),
    _SCENE,
    *(_puzzle(rows, columns) for rows, columns in _PUZZLES),
)
