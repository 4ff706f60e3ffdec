"""Functions of goals, with tensors or in Gymnasium's form."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import nn

from torchrl_caiac._keys import floating

__all__ = ["GoalFunction"]

_INFO_NAMES = ("info", "infos", "")  # also with underscores around them
_ACCEPTED = (
    "expected function(next_achieved, desired) with tensors, or Gymnasium's "
    "compute_reward(achieved_goal, desired_goal, info) with NumPy arrays, both also "
    "with a parameter named action"
)


class GoalFunction:
    """Calls a function of goals with the arguments that its signature has.

    The signature decides, when the object is created:

    - ``function(next_achieved, desired)`` is called with tensors ``[C, G]``;
    - ``function(achieved_goal, desired_goal, info)``, the form of Gymnasium's goal
      environments, is called with NumPy arrays ``[C, G]`` and an empty ``info``. It may
      be a bound method, such as ``env.unwrapped.compute_reward``. Goals on an
      accelerator are copied to the host, which waits for them;
    - a further parameter named ``action`` gets the actions ``[C, K]``, in the same
      form as the goals.

    Other parameters keep their defaults. Goals that are stored as integers or booleans
    are passed in floating point, so that differences do not wrap around.

    Args:
        function (callable): the function. Its first two parameters are the achieved
            goals of the next states and the desired goals.
        name (str): the argument's name in errors. Defaults to ``"reward_fn"``.

    Attributes:
        function (callable): the function.
        name (str): the argument's name.
        needs_action (bool): whether it has a parameter ``action``.
        uses_numpy (bool): whether it has Gymnasium's form.

    Raises:
        TypeError: it cannot be called.
        ValueError: its signature cannot be read, or has other parameters.

    Examples:
        >>> import numpy as np
        >>> import torch
        >>> from torchrl_caiac.transforms.goal_function import GoalFunction
        >>> def compute_reward(achieved_goal, desired_goal, info):
        ...     return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        >>> GoalFunction(compute_reward)(torch.zeros(1, 2), torch.tensor([[3.0, 4.0]]))
        tensor([-5.])
        >>> GoalFunction(lambda achieved, desired, radius: achieved)
        Traceback (most recent call last):
        ...
        ValueError: reward_fn needs the parameters ['radius'], which are not known...
    """

    def __init__(self, function: Callable[..., Any], name: str = "reward_fn") -> None:
        if not callable(function):
            raise TypeError(
                f"{name} must be a function of the next achieved and desired goals, "
                f"got {type(function).__name__}"
            )
        self.function = function
        self.name = name
        self._extra = _extra_arguments(function, name)
        self.needs_action = "action" in self._extra.values()
        self.uses_numpy = "info" in self._extra.values()

    def __call__(
        self,
        achieved: torch.Tensor,
        desired: torch.Tensor,
        action: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Calls the function.

        Args:
            achieved (torch.Tensor): ``[C, G]``, the achieved goals of the next states.
            desired (torch.Tensor): ``[C, G]``.
            action (torch.Tensor, optional): ``[C, K]``, needed if :attr:`needs_action`.

        Returns:
            torch.Tensor: the ``[C]`` values, in the dtype that the function returned,
            on the device of the goals.

        Raises:
            ValueError: the function returned something else than one number or flag
                for each row.
        """
        known: dict[str, Any] = {"info": {}, "action": action}
        goals: list[Any] = [floating(achieved), floating(desired)]
        if self.uses_numpy:
            goals = [_array(goal) for goal in goals]
            known["action"] = None if action is None else _array(action)
        extra = {name: known[what] for name, what in self._extra.items()}
        found = self.function(*goals, **extra)
        if isinstance(found, (np.ndarray, np.generic)) and found.dtype.kind in "biuf":
            found = torch.tensor(found)
        rows = achieved.shape[0]
        shape = tuple(found.shape) if isinstance(found, torch.Tensor) else None
        if shape not in ((rows,), (rows, 1)):
            text = type(found).__name__ if shape is None else list(shape)
            raise ValueError(
                f"{self.name} returned {text} for goals {list(achieved.shape)}, "
                f"expected [{rows}] or [{rows}, 1]"
            )
        if found.is_complex():
            raise ValueError(
                f"{self.name} returned {found.dtype}, expected real numbers"
            )
        found = found if found.ndim == 1 else found.reshape(rows)
        return found if found.device == achieved.device else found.to(achieved.device)


def _extra_arguments(function: Any, name: str) -> dict[str, str]:
    """Returns the parameters after the goals that get something, and what they get."""
    # Calling a module leads through a function that takes anything.
    called = function.forward if isinstance(function, nn.Module) else function
    try:
        parameters = list(inspect.signature(called).parameters.values())
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"the parameters of {name}, {function!r}, cannot be read: wrap it in a "
            f"function with named parameters, {_ACCEPTED}"
        ) from error
    positional = [p for p in parameters if p.kind <= p.POSITIONAL_OR_KEYWORD]
    if len(positional) < 2:
        raise ValueError(
            f"{name} has the parameters {[str(p) for p in parameters]}, without two "
            f"positional ones for the goals: {_ACCEPTED}"
        )
    first, second = (p.name for p in positional[:2])
    if "desired" in first or "achieved" in second:
        raise ValueError(
            f"the first parameters of {name} are {first!r} and {second!r}, but the "
            f"achieved goals come first: {_ACCEPTED}"
        )
    found: dict[str, str] = {}
    unknown: list[str] = []
    for parameter in parameters[2:]:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        by_name = parameter.kind != parameter.POSITIONAL_ONLY
        if by_name and parameter.name == "action":
            found[parameter.name] = "action"
        elif by_name and parameter.name.strip("_") in _INFO_NAMES:
            found[parameter.name] = "info"
        elif parameter.default is parameter.empty:
            unknown.append(parameter.name)
    if unknown:
        raise ValueError(
            f"{name} needs the parameters {unknown}, which are not known: {_ACCEPTED}. "
            "Give others a value, with functools.partial or a lambda"
        )
    return found


def _array(value: torch.Tensor) -> np.ndarray[Any, Any]:
    """Copies a tensor to an array, so that the function may write to it."""
    value = value.detach().cpu()
    if value.dtype == torch.bfloat16:  # NumPy has none
        value = value.float()
    return np.array(value.numpy())
