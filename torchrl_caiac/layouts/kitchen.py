"""Layouts of the Franka-Kitchen, of gymnasium-robotics and of this package.

A control step lasts 0.08 s. The simulated noise of observations is below the floors.
"""

from __future__ import annotations

from torchrl_caiac.layouts.description import Columns, LayoutDescription

__all__ = ["KITCHEN"]

# Twice the usual millimetre and milliradian: the published results have this floor, and
# it is above the noise of the robot's joints.
_FLOOR = 2e-3
_SPEED = _FLOOR / 0.08  # in a control step

# The objects in the order of the simulator's joints: joints, all of them with one
# column, but for the kettle.
_JOINTS = {
    "bottom_right_burner": ("knob and burner, rad", 2),
    "bottom_burner": ("knob and burner, rad", 2),
    "top_right_burner": ("knob and burner, rad", 2),
    "top_burner": ("knob and burner, rad", 2),
    "light_switch": ("switch and light, rad", 2),
    "slide_cabinet": ("position, m", 1),
    "hinge_cabinet": ("left and right door, rad", 2),
    "microwave": ("door, rad", 1),
}
_OBJECTS = (
    *(
        Columns(what, width, name, _FLOOR, is_position=True, is_goal=True)
        for name, (what, width) in _JOINTS.items()
    ),
    Columns("position, m", 3, "kettle", _FLOOR, is_position=True, is_goal=True),
    Columns(
        "orientation, quaternion wxyz", 4, "kettle", _FLOOR, is_goal=True, is_unit=True
    ),
)
_GOALS = "The goal contains the configurations of all objects, 21 columns."

_POSITIONS = LayoutDescription(
    "kitchen/positions",
    (
        Columns("joint positions, rad and m", 9, "robot", _FLOOR, is_position=True),
        *_OBJECTS,
    ),
    ("robot",),
    "The environment KitchenEnv of this package: positions without velocities. "
    + _GOALS,
)
_FRANKA = LayoutDescription(
    "kitchen/franka",
    (
        Columns("joint positions, rad and m", 9, "robot", _FLOOR, is_position=True),
        Columns("joint velocities, rad/s and m/s", 9, "robot", _SPEED),
        *_OBJECTS,
        *(
            Columns("velocities, rad/s or m/s", width, name, _SPEED)
            for name, (_, width) in _JOINTS.items()
        ),
        Columns("velocity, m/s, and angular velocity, rad/s", 6, "kettle", _SPEED),
    ),
    ("robot",),
    "The observation of FrankaKitchen-v1. "
    + _GOALS
    + " Goals of FrankaKitchen-v1 are one entry for each task: leave 'achieved_goal' "
    "and 'desired_goal' out of the data, goals are then read from later states.",
)

#: The layouts of the kitchen.
KITCHEN = (_FRANKA, _POSITIONS)
