"""Layouts of the Adroit hand, of gymnasium-robotics.

A control step lasts 0.01 s. Floors of velocities are a millimetre in five steps.
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

__all__ = ["ADROIT"]

_STEPS = 0.05  # s
_PALM = Columns("palm position, m", 3, "hand", is_position=True, is_not_zero=True)


def _hand(joints: int) -> Columns:
    return Columns("joint angles, rad and m", joints, "hand", MILLIRADIAN)


_DOOR = LayoutDescription(
    "adroit/door",
    (
        _hand(27),
        Columns("latch, rad", 1, "door", 10 * MILLIRADIAN, is_position=True),
        Columns("hinge, rad", 1, "door", MILLIRADIAN, is_position=True),
        _PALM,
        Columns("handle position, m", 3, "door", is_position=True),
        Columns("palm minus handle, m", 3, difference=(29, 32)),
        Columns("1 if the door is open, else -1", 1, "door", 2 * STATE, bounds=(-1, 1)),
    ),
    ("hand",),
    "Columns 35 to 37 (palm minus handle) depend on the hand and the door, so they "
    "belong to no entity and are wrong after a swap: take them out of what a policy "
    "reads, or compute them again.",
)
_HAMMER = LayoutDescription(
    "adroit/hammer",
    (
        _hand(26),
        Columns("insertion, m", 1, "nail", is_position=True, bounds=(-0.1, 0.2)),
        Columns("velocity, m/s", 3, "hammer", MILLIMETRE / _STEPS, bounds=(-1, 1)),
        Columns("angular velocity, rad/s", 3, "hammer", TURN / _STEPS, bounds=(-1, 1)),
        _PALM,
        Columns("position, m", 3, "hammer", is_position=True),
        Columns("Euler angles, rad", 3, "hammer", TURN),
        Columns("position, m", 3, "nail", is_position=True),
        Columns("force, N", 1, "nail", STATE, bounds=(-1, 1)),
    ),
    ("hand",),
    "The hand's rotation (its first joints) is part of the joint angles.",
)
_PEN = LayoutDescription(
    "adroit/pen",
    (
        _hand(24),
        Columns("position, m", 3, "pen", is_position=True),
        Columns("velocity, m/s", 3, "pen", MILLIMETRE / _STEPS),
        Columns("angular velocity, rad/s", 3, "pen", TURN / _STEPS),
        Columns("direction", 3, "pen", TURN, is_unit=True),
        Columns("direction", 3, "target", TURN, is_unit=True),
        # The target has one position in all episodes.
        Columns("position minus the target's, m", 3, "pen"),
        Columns("direction minus the target's", 3, difference=(33, 36)),
    ),
    ("hand", "target"),
    "The pen lies in the hand, so it is influenced almost always. Columns 42 to 44 "
    "(direction of the pen minus the target's) belong to no entity and are wrong after "
    "a swap: take them out of what a policy reads, or compute them again.",
)
_RELOCATE = LayoutDescription(
    "adroit/relocate",
    (
        _hand(30),
        Columns("palm minus ball, m", 3),
        Columns("palm minus target, m", 3),
        Columns("ball minus target, m", 3, difference=(33, 30)),
    ),
    ("hand",),
    "Nothing can be swapped: the observation says where the ball is only relative to "
    "the palm and the target. Store the positions of palm, ball and target instead "
    "(get_env_state() of the environment has them), and make a layout of your own.",
)

#: The layouts of the Adroit hand.
ADROIT = (_DOOR, _HAMMER, _PEN, _RELOCATE)
