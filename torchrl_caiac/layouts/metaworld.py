"""Layouts of Meta-World: two frames of 18 columns, and the goal."""

from __future__ import annotations

from torchrl_caiac.layouts.description import (
    MILLIMETRE,
    TURN,
    Columns,
    LayoutDescription,
)

__all__ = ["METAWORLD"]

_ROOM = (-2.0, 2.0)  # m


def _frame(objects: tuple[str, ...], *, is_now: bool) -> tuple[Columns, ...]:
    when = "" if is_now else "previous "
    parts = [
        Columns(f"{when}hand position, m", 3, "hand", is_position=is_now, bounds=_ROOM),
        # A share of 0.1 m.
        Columns(
            f"{when}gripper opening, share", 1, "hand", 10 * MILLIMETRE, bounds=(0, 1)
        ),
    ]
    for name in objects:
        parts += [
            Columns(
                f"{when}position, m",
                3,
                name,
                is_position=is_now,
                is_not_zero=True,
                bounds=_ROOM,
            ),
            # Some tasks have zeros here.
            Columns(
                f"{when}orientation, quaternion", 4, name, TURN / 2, bounds=(-1, 1)
            ),
        ]
    padding = 7 * (2 - len(objects))
    if padding:
        parts.append(Columns("zeros", padding, bounds=(0, 0)))
    return tuple(parts)


def _description(name: str, objects: tuple[str, ...], notes: str) -> LayoutDescription:
    return LayoutDescription(
        f"metaworld/{name}",
        (
            *_frame(objects, is_now=True),
            *_frame(objects, is_now=False),
            Columns("goal position, m; zeros where it is hidden", 3, "goal"),
        ),
        ("hand", "goal"),
        notes + " A swap takes both frames of an object. The goal stays.",
    )


#: The layouts of Meta-World.
METAWORLD = (
    _description("one-object", ("object",), "All tasks but those with two objects."),
    _description(
        "two-objects",
        ("object0", "object1"),
        "The tasks hammer, stick-push and stick-pull.",
    ),
)
