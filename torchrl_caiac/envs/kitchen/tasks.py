"""Entities, tasks and goals of the Franka-Kitchen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import (
    OBS_ELEMENT_GOALS,
    OBS_ELEMENT_INDICES,
)

from torchrl_caiac.layouts import ready_layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "BURNER_RATIO",
    "KITCHEN_LAYOUT",
    "KITCHEN_TASKS",
    "LIGHT_RATIO",
    "OBJECTS",
    "STATE_COLUMNS",
    "SUCCESS_DISTANCE",
    "TASK_COLUMNS",
    "TASK_GOALS",
    "check_task",
    "done_tasks",
    "kitchen_distances",
    "kitchen_reward",
    "solved",
    "task_number",
]

#: The tasks, in the order of ``info["task"]`` and ``info["wrong_tasks"]``.
KITCHEN_TASKS: tuple[str, ...] = (
    "microwave",
    "kettle",
    "slide_cabinet",
    "hinge_cabinet",
    "light_switch",
    "bottom_burner",
    "top_burner",
)

#: Distance of an object to its goal below which its task is done (A.6.1).
SUCCESS_DISTANCE = 0.3
#: Columns of the 30-column state that belong to objects: the goal.
OBJECTS = slice(9, 30)
#: Columns of ``FrankaKitchen-v1``'s 59 (positions and velocities of the robot, then of
#: the objects) that form the 30-column state: positions of the robot and the objects.
STATE_COLUMNS: tuple[int, ...] = (*range(0, 9), *range(18, 39))

# The model couples pairs of joints by equality constraints: a burner to its knob, the
# light to its switch. A state that violates a coupling jumps in the first step.
#: Angle of a burner's knob per unit of its burner joint.
BURNER_RATIO = 174.0
#: Angle of the light switch per unit of its light joint.
LIGHT_RATIO = 14.0

#: The entities of the 30-column state and the goal's columns of each object.
KITCHEN_LAYOUT = ready_layout("kitchen/positions")
#: State columns of each task's object.
TASK_COLUMNS: dict[str, NDArray[np.int64]] = {
    task: np.asarray(OBS_ELEMENT_INDICES[task.replace("_", " ")])
    for task in KITCHEN_TASKS
}
#: Goal values of each task, as gymnasium-robotics defines them.
TASK_GOALS: dict[str, NDArray[np.float64]] = {
    task: np.asarray(OBS_ELEMENT_GOALS[task.replace("_", " ")], dtype=np.float64)
    for task in KITCHEN_TASKS
}
# [21, 9]: 1 where a goal column belongs to an object.
_MEMBERSHIP = np.zeros((21, len(KITCHEN_LAYOUT.goal)), dtype=np.float64)
for _index, _columns in enumerate(KITCHEN_LAYOUT.goal.values()):
    _MEMBERSHIP[list(_columns), _index] = 1.0
# Upstream's goals are rounded: coupled joints agree with each other here. The right
# burners have no task of their own and turn like the left ones.
_SOLVED: dict[str, NDArray[np.float64]] = {
    **TASK_GOALS,
    "bottom_burner": np.array([-0.88, -0.88 / BURNER_RATIO]),
    "top_burner": np.array([-0.92, -0.92 / BURNER_RATIO]),
    "bottom_right_burner": np.array([-0.88, -0.88 / BURNER_RATIO]),
    "top_right_burner": np.array([-0.92, -0.92 / BURNER_RATIO]),
    "light_switch": np.array([-0.69, -0.69 / LIGHT_RATIO]),
}


def check_task(task: str) -> str:
    """Returns a task's name, or raises an error.

    Args:
        task (str): the name.

    Returns:
        str: the name.

    Raises:
        ValueError: there is no such task.

    Examples:
        >>> check_task("kettle")
        'kettle'
    """
    if task not in KITCHEN_TASKS:
        raise ValueError(f"task is {task!r}, expected one of {KITCHEN_TASKS}")
    return task


def task_number(name: str | None) -> int:
    """Returns the index of a task in :data:`KITCHEN_TASKS`.

    Args:
        name (str, optional): the task as this package or as gymnasium-robotics spells
            it.

    Returns:
        int: the index; -1 for a name that is not a task.

    Examples:
        >>> task_number("slide_cabinet"), task_number("slide cabinet")
        (2, 2)
        >>> task_number("toaster")
        -1
    """
    task = str(name).replace(" ", "_")
    return KITCHEN_TASKS.index(task) if task in KITCHEN_TASKS else -1


def solved(entity: str) -> NDArray[np.float64]:
    """Returns the configuration of an entity whose task is done.

    Args:
        entity (str): an entity other than the robot.

    Returns:
        numpy.ndarray: a copy of the values of the entity's state columns. Coupled
        joints agree with each other.

    Raises:
        ValueError: the entity has no solved configuration.

    Examples:
        >>> solved("slide_cabinet")
        array([0.37])
    """
    if entity not in _SOLVED:
        raise ValueError(
            f"entity {entity!r} has no solved configuration, expected one of "
            f"{sorted(_SOLVED)}"
        )
    return _SOLVED[entity].copy()


def done_tasks(
    state: NDArray[np.floating[Any]], *, threshold: float = SUCCESS_DISTANCE
) -> NDArray[np.bool_]:
    """Returns which tasks are done in a state.

    Args:
        state (numpy.ndarray): ``[30]``.

    Keyword Args:
        threshold (float): distance of an object to its goal below which its task is
            done. Defaults to 0.3.

    Returns:
        numpy.ndarray: bool ``[7]``, in the order of :data:`KITCHEN_TASKS`.

    Examples:
        >>> import numpy as np
        >>> state = np.zeros(30)
        >>> state[22] = -0.75
        >>> done_tasks(state).tolist()
        [True, False, False, False, False, False, False]
    """
    return np.array(
        [
            np.linalg.norm(state[TASK_COLUMNS[task]] - TASK_GOALS[task]) < threshold
            for task in KITCHEN_TASKS
        ]
    )


def kitchen_distances(achieved: Any, desired: Any) -> Any:
    """Returns the distance of each object to its goal configuration.

    Args:
        achieved (torch.Tensor or numpy.ndarray): object configurations ``[*B, 21]``.
        desired (torch.Tensor or numpy.ndarray): goal configurations ``[*B, 21]``.

    Returns:
        torch.Tensor or numpy.ndarray: ``[*B, 9]``, in the order of
        :data:`KITCHEN_LAYOUT` without the robot: the Euclidean norm over an object's
        columns (metres, radians and quaternion entries alike, as in the original
        tasks).

    Raises:
        ValueError: a goal does not have 21 columns.

    Examples:
        >>> import numpy as np
        >>> achieved, desired = np.zeros((2, 21)), np.zeros(21)
        >>> desired[13] = -0.75  # the microwave
        >>> kitchen_distances(achieved, desired).max(-1)
        array([0.75, 0.75])
    """
    for name, value in (("achieved", achieved), ("desired", desired)):
        shape = tuple(np.shape(value))
        if not shape or shape[-1] != 21:
            raise ValueError(
                f"{name} goal has shape {shape}, expected [*B, 21]: columns 9 to 29 of "
                "the state"
            )
    if isinstance(achieved, torch.Tensor) or isinstance(desired, torch.Tensor):
        achieved = torch.as_tensor(achieved)
        difference = achieved - torch.as_tensor(desired, device=achieved.device)
        member = torch.as_tensor(
            _MEMBERSHIP, dtype=difference.dtype, device=difference.device
        )
        return (difference.square() @ member).sqrt()
    difference = np.asarray(achieved) - np.asarray(desired)
    return np.sqrt(np.square(difference) @ _MEMBERSHIP.astype(difference.dtype))


def kitchen_reward(
    achieved: Any,
    desired: Any,
    info: Any = None,
    *,
    threshold: float = SUCCESS_DISTANCE,
) -> Any:
    """Returns the sparse reward: 1 where every object is at its goal, else 0.

    Args:
        achieved (torch.Tensor or numpy.ndarray): object configurations ``[*B, 21]``.
        desired (torch.Tensor or numpy.ndarray): goal configurations ``[*B, 21]``.
        info (Any, optional): ignored; goal environments pass it.

    Keyword Args:
        threshold (float): distance below which an object is at its goal (A.6.1).
            Defaults to 0.3.

    Returns:
        torch.Tensor or numpy.ndarray: ``[*B]`` float32, of the type of the input.

    Examples:
        >>> import torch
        >>> achieved = torch.zeros(2, 5, 21)
        >>> kitchen_reward(achieved, achieved).shape
        torch.Size([2, 5])
    """
    reached = (kitchen_distances(achieved, desired) < threshold).all(-1)
    if isinstance(reached, torch.Tensor):
        return reached.to(torch.float32)
    return np.asarray(reached).astype(np.float32)
