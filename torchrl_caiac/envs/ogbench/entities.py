"""The entities of OGBench's manipulation environments in its simulator."""

from __future__ import annotations

import re

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.envs.ogbench.registration import check_name
from torchrl_caiac.layouts import ready_layout

__all__ = ["entity_joints", "ogbench_layout"]

_JOINTS = {
    "cube": "object_joint_{}",
    "button": "buttonbox_joint_{}",
    "drawer": "drawer_slide",
    "window": "window_slide",
}


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
    check_name(name)
    return ready_layout(f"ogbench/{name}")


def entity_joints(name: str) -> dict[str, str]:
    """Returns the entities that can be moved, and their joints in OGBench's model.

    Args:
        name (str): one of :data:`OGBENCH_ENVS`.

    Returns:
        dict of str to str: the joint of each entity, in the order of the layout.

    Raises:
        ValueError: ``name`` is not such an environment.

    Examples:
        >>> from torchrl_caiac.envs.ogbench.entities import entity_joints
        >>> entity_joints("cube-double")
        {'cube0': 'object_joint_0', 'cube1': 'object_joint_1'}
    """
    layout = ogbench_layout(name)
    joints = {}
    for entity in layout.names:
        if entity in layout.fixed:
            continue
        kind, number = re.fullmatch(r"([a-z]+)(\d*)", entity).groups()  # type: ignore[union-attr]
        joints[entity] = _JOINTS[kind].format(number)
    return joints
