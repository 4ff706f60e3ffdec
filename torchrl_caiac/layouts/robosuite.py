"""Layouts of robosuite's tasks, in the entries of robomimic datasets.

robomimic stores all columns of the objects as one entry, ``object``: what robosuite's
observables give, in their order. robosuite 1.5 changed the order of the tasks
``PickPlaceCan`` and ``NutAssemblySquare``.
"""

from __future__ import annotations

from torchrl_caiac.layouts.description import (
    MILLIRADIAN,
    TURN,
    Columns,
    LayoutDescription,
)

__all__ = ["ROBOSUITE"]

_ROBOT = (
    Columns("effector position, m", 3, "robot", is_position=True, bounds=(-2, 2)),
    Columns(
        "effector orientation, quaternion xyzw",
        4,
        "robot",
        MILLIRADIAN / 2,
        is_unit=True,
    ),
    Columns("finger positions, m", 2, "robot"),
)


def _pose(name: str) -> tuple[Columns, ...]:
    return (
        Columns("position, m: x and y", 2, name, is_position=True, bounds=(-1, 1)),
        # Tables and bins are 0.8 m high. Relative positions are far smaller.
        Columns("position, m: z", 1, name, is_position=True, bounds=(0.6, 2)),
        Columns("orientation, quaternion xyzw", 4, name, TURN / 2, is_unit=True),
    )


_RELATIVE = (
    Columns("position relative to the effector, m", 3),
    Columns("orientation relative to the effector", 4),
)
_LIFT = (*_pose("cube"), Columns("effector and cube, difference, m", 3))
_STACK = (
    *_pose("cubeA"),
    *_pose("cubeB"),
    Columns("differences between cubes and effector, m", 9),
)
_OBJECTS: dict[str, tuple[Columns, ...]] = {
    "lift": _LIFT,
    "stack": _STACK,
    "can": (*_RELATIVE, *_pose("can")),
    "can-1.4": (*_pose("can"), *_RELATIVE),
    "square": (*_RELATIVE, *_pose("nut")),
    "square-1.4": (*_pose("nut"), *_RELATIVE),
}


def _notes(task: str, objects: tuple[Columns, ...], is_flat: bool) -> str:
    first = sum(part.width for part in objects if part.entity is None)
    version = "" if task in ("lift", "stack") else " 1.5"
    if task.endswith("-1.4"):
        version = " 1.4 and older"
    notes = f"Data of robosuite{version}. {first} of the columns are relative to "
    notes += "the effector or another object: they belong to no entity and are wrong "
    notes += "after a swap, so take them out of what a policy reads. "
    if is_flat:
        return notes + (
            "The observation is 'object', 'robot0_eef_pos', 'robot0_eef_quat' and "
            "'robot0_gripper_qpos', one after the other."
        )
    return notes + (
        "The layout reads the entry ('observation', 'object') alone: entries of the "
        "robot are not swapped. A world model needs the robot: for one, load the data "
        f"as one observation and take 'robosuite/{task}-flat'."
    )


def _descriptions(task: str, objects: tuple[Columns, ...]) -> list[LayoutDescription]:
    return [
        LayoutDescription(
            f"robosuite/{task}",
            objects,
            (),
            _notes(task, objects, is_flat=False),
            observation_key=("observation", "object"),
        ),
        LayoutDescription(
            f"robosuite/{task}-flat",
            (*objects, *_ROBOT),
            ("robot",),
            _notes(task, objects, is_flat=True),
        ),
    ]


#: The layouts of robosuite.
ROBOSUITE = tuple(
    description
    for task, objects in _OBJECTS.items()
    for description in _descriptions(task, objects)
)
