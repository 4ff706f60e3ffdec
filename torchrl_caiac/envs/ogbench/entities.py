"""The entities of OGBench's manipulation environments, by name."""

from __future__ import annotations

import re

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.envs.ogbench.registration import check_name

__all__ = ["ROBOT", "entity_joints", "ogbench_layout"]

#: The name of the robot.
ROBOT = "robot"
_ROBOT_WIDTH = 19
_CUBE_WIDTH = 9
_BUTTON_WIDTH = 4
_CUBES = {"single": 1, "double": 2, "triple": 3, "quadruple": 4}


def entity_joints(name: str) -> dict[str, str]:
    """Returns the entities that can be moved, and their joints in OGBench's model.

    Args:
        name (str): one of :data:`OGBENCH_ENVS`.

    Returns:
        dict of str to str: the joint of each entity, in the order of the observation.

    Raises:
        ValueError: ``name`` is not such an environment.

    Examples:
        >>> from torchrl_caiac.envs.ogbench.entities import entity_joints
        >>> entity_joints("cube-double")
        {'cube0': 'object_joint_0', 'cube1': 'object_joint_1'}
    """
    check_name(name)
    if name == "scene":
        cubes, buttons = 1, 2
    elif name.startswith("cube"):
        cubes, buttons = _CUBES[name.removeprefix("cube-")], 0
    else:
        rows, columns = re.findall(r"\d", name)
        cubes, buttons = 0, int(rows) * int(columns)
    joints = {f"cube{i}": f"object_joint_{i}" for i in range(cubes)}
    joints |= {f"button{i}": f"buttonbox_joint_{i}" for i in range(buttons)}
    if name == "scene":
        joints |= {"drawer": "drawer_slide", "window": "window_slide"}
    return joints


def ogbench_layout(name: str) -> EntityLayout:
    """Returns the layout of the observations of an OGBench environment.

    Args:
        name (str): one of :data:`OGBENCH_ENVS`.

    Returns:
        EntityLayout: the robot, which is fixed, and the entities.

    Raises:
        ValueError: ``name`` is not such an environment.

    Examples:
        >>> from torchrl_caiac.envs.ogbench.entities import ogbench_layout
        >>> ogbench_layout("cube-double").names
        ('robot', 'cube0', 'cube1')
    """
    widths = {"cube": _CUBE_WIDTH, "button": _BUTTON_WIDTH}
    columns, first = {ROBOT: range(_ROBOT_WIDTH)}, _ROBOT_WIDTH
    for entity in entity_joints(name):
        width = widths.get(entity.rstrip("0123456789"), 2)
        columns[entity] = range(first, first + width)
        first += width
    return EntityLayout(columns, fixed=(ROBOT,))
