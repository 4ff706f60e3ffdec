"""Layouts of the Fetch environments, of gymnasium-robotics and of this package."""

from __future__ import annotations

from torchrl_caiac.layouts.description import (
    MILLIMETRE,
    MILLIRADIAN,
    TURN,
    Columns,
    LayoutDescription,
)

__all__ = ["FETCH", "fetch_push_cubes"]

# Velocities are displacements in a step of 0.04 s, in metres or radians.
# In metres. Objects may fall to the floor.
_REACH_OF_ROBOT = (0.1, 2.5)
_ROOM = (0.0, 2.5)
_TASKS = ("push", "slide", "pick-and-place")
_COUNTS = (1, 2, 3, 4)

_REACH = LayoutDescription(
    "fetch/reach",
    (
        Columns(
            "gripper position, m",
            3,
            "gripper",
            is_position=True,
            is_goal=True,
            bounds=_REACH_OF_ROBOT,
        ),
        Columns("finger positions, m", 2, "gripper"),
        Columns("gripper velocity, m per step", 3, "gripper"),
        Columns("finger velocities, m per step", 2, "gripper"),
    ),
    ("gripper",),
    "The gripper is the only entity: nothing can be swapped.",
)


def _with_object(task: str) -> LayoutDescription:
    return LayoutDescription(
        f"fetch/{task}",
        (
            Columns(
                "gripper position, m",
                3,
                "gripper",
                is_position=True,
                bounds=_REACH_OF_ROBOT,
            ),
            Columns(
                "position, m", 3, "object", is_position=True, is_goal=True, bounds=_ROOM
            ),
            Columns("object minus gripper, m", 3, difference=(3, 0)),
            Columns("finger positions, m", 2, "gripper"),
            Columns("Euler angles, rad", 3, "object", TURN),
            Columns("object velocity minus gripper's, m per step", 3),
            Columns("angular velocity, rad per step", 3, "object", TURN),
            Columns("gripper velocity, m per step", 3, "gripper"),
            Columns("finger velocities, m per step", 2, "gripper"),
        ),
        ("gripper",),
        "Columns 6 to 8 and 14 to 16 (position and velocity of the object relative to "
        "the gripper) depend on both, so they belong to no entity and are wrong after "
        "a swap: take them out of what a policy reads, or compute the positions again "
        "(columns 3 to 5 minus columns 0 to 2).",
    )


def fetch_push_cubes(num_cubes: int) -> LayoutDescription:
    """Describes the observation of ``FetchPushCubes``.

    Args:
        num_cubes (int): the number of cubes ``n``.

    Returns:
        LayoutDescription: ``10 + 12 n`` columns.

    Examples:
        >>> from torchrl_caiac.layouts.fetch import fetch_push_cubes
        >>> fetch_push_cubes(2).layout().names
        ('gripper', 'cube0', 'cube1')
    """
    cubes = [
        part
        for i in range(num_cubes)
        for part in (
            Columns(
                "position, m",
                3,
                f"cube{i}",
                is_position=True,
                is_goal=True,
                bounds=_ROOM,
            ),
            # The floor that the published results were obtained with.
            Columns("Euler angles, rad", 3, f"cube{i}", MILLIRADIAN),
            Columns("velocity, m per step", 3, f"cube{i}", MILLIMETRE),
            Columns("angular velocity, rad per step", 3, f"cube{i}", MILLIRADIAN),
        )
    ]
    return LayoutDescription(
        f"fetch_push_cubes/{num_cubes}",
        (
            Columns(
                "gripper position, m",
                3,
                "gripper",
                is_position=True,
                bounds=_REACH_OF_ROBOT,
            ),
            Columns("finger positions, m", 2, "gripper"),
            Columns("gripper velocity, m per step", 3, "gripper"),
            Columns("finger velocities, m per step", 2, "gripper"),
            *cubes,
        ),
        ("gripper",),
        "The environment FetchPushCubes of this package. All columns are in the world "
        "frame.",
    )


#: The layouts of the Fetch environments.
FETCH = (
    _REACH,
    *(_with_object(task) for task in _TASKS),
    *(fetch_push_cubes(count) for count in _COUNTS),
)
