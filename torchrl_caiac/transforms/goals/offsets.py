"""Random numbers of rows between a window and its goal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch

from torchrl_caiac._random import draw_numbers
from torchrl_caiac.transforms.checks import check_number

__all__ = [
    "STRATEGIES",
    "GoalNumbers",
    "check_probability",
    "draw_goal_numbers",
    "draw_goal_offset",
    "draw_steps",
    "goal_offset",
    "strategy_bounds",
]

STRATEGIES = ("last", "uniform", "geometric")
"""How goals are drawn, see :func:`draw_goal_offset`; numbered as in ``sampling.c``."""


class GoalNumbers(NamedTuple):
    """The random numbers that goals of windows are drawn with.

    Attributes:
        bounds (list of tuple): the strategies, with the least ``chance`` for which each
            is taken, ascending from 0.
        chance (torch.Tensor, optional): float32 ``[*]``, below 1, which strategy each
            window has; ``None`` if there is one.
        share (torch.Tensor, optional): float64 ``[*]``, below 1, of ``uniform``.
        steps (torch.Tensor, optional): int64 ``[*]``, of ``geometric``.
    """

    bounds: list[tuple[str, float]]
    chance: torch.Tensor | None
    share: torch.Tensor | None
    steps: torch.Tensor | None


def check_probability(p: Any) -> float:
    """Returns the parameter of geometric offsets, or raises.

    Args:
        p (Any): the parameter.

    Returns:
        float: the number, in (0, 1].

    Raises:
        TypeError: it is not a number.
        ValueError: it is out of range.

    Examples:
        >>> from torchrl_caiac.transforms.goals.offsets import check_probability
        >>> check_probability(0.5)
        0.5
    """
    number = check_number("p", p, math.inf)
    if not 0 < number <= 1:
        raise ValueError(f"p, of the geometric strategy, must be in (0, 1], got {p!r}")
    return number


def draw_goal_offset(
    remaining: torch.Tensor,
    mixture: Mapping[str, float],
    *,
    p: float = 0.3,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draws the number of rows from each window to its goal.

    Offset 0 is the window's last row, whose next state is the first one after the
    window. Three strategies are mixed, window by window: ``last`` takes the
    trajectory's last row, ``uniform`` any row from the window's last one on, and
    ``geometric`` the state ``k >= 1`` steps after the window's last one with
    probability ``p * (1 - p) ** (k - 1)``, or the last one if the trajectory ends
    before it.

    Args:
        remaining (torch.Tensor): int64 ``[*]``, rows of the trajectory after the
            window.
        mixture (mapping of str to float): the weight of each strategy.

    Keyword Args:
        p (float): the parameter of ``geometric``, in (0, 1]. Defaults to 0.3.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        torch.Tensor: int64 ``[*]``, between 0 and ``remaining``.

    Raises:
        TypeError: a weight or ``p`` is not a number.
        ValueError: the mixture has an unknown strategy or a wrong weight, or ``p`` is
            out of range.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.goals.offsets import draw_goal_offset
        >>> draw_goal_offset(torch.tensor([4, 0]), {"last": 1.0})
        tensor([4, 0])
    """
    p = check_probability(p)
    numbers = draw_goal_numbers(
        remaining.shape, mixture, p=p, device=remaining.device, generator=generator
    )
    return goal_offset(remaining, numbers)


def draw_goal_numbers(
    shape: torch.Size,
    mixture: Mapping[str, float],
    *,
    p: float,
    device: torch.device,
    generator: torch.Generator | None = None,
) -> GoalNumbers:
    """Draws the random numbers of :func:`draw_goal_offset`.

    Args:
        shape (torch.Size): the shape of the windows.
        mixture (mapping of str to float): the weight of each strategy.

    Keyword Args:
        p (float): the parameter of ``geometric``, in (0, 1].
        device (torch.device): the device of the numbers.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        GoalNumbers: the numbers that the strategies need.

    Raises:
        TypeError: a weight is not a number.
        ValueError: the mixture has an unknown strategy or a wrong weight.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.goals.offsets import draw_goal_numbers
        >>> shape, device = torch.Size([2]), torch.device("cpu")
        >>> draw_goal_numbers(shape, {"last": 1.0}, p=0.3, device=device)
        GoalNumbers(bounds=[('last', 0.0)], chance=None, share=None, steps=None)
    """
    bounds = strategy_bounds(mixture)
    chance = share = steps = None
    own: dict[str, Any] = {"device": device, "generator": generator}
    if len(bounds) > 1:
        chance = draw_numbers(torch.rand, shape, dtype=torch.float32, **own)
    for name, _ in bounds:
        if name == "uniform":
            share = draw_numbers(torch.rand, shape, dtype=torch.float64, **own)
        elif name == "geometric":
            steps = draw_steps(shape, p, **own)
    return GoalNumbers(bounds, chance, share, steps)


def goal_offset(remaining: torch.Tensor, numbers: GoalNumbers) -> torch.Tensor:
    """Returns the number of rows from each window to its goal.

    Args:
        remaining (torch.Tensor): int64 ``[*]``, rows of the trajectory after the
            window.
        numbers (GoalNumbers): of :func:`draw_goal_numbers`.

    Returns:
        torch.Tensor: int64 ``[*]``, between 0 and ``remaining``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.goals.offsets import GoalNumbers, goal_offset
        >>> bounds, steps = [("geometric", 0.0)], torch.tensor([1, 1])
        >>> numbers = GoalNumbers(bounds, None, None, steps)
        >>> goal_offset(torch.tensor([4, 0]), numbers)
        tensor([1, 0])
    """
    offset = remaining
    for name, least in numbers.bounds:
        drawn = remaining
        if name == "uniform":
            assert numbers.share is not None
            drawn = (numbers.share * (remaining + 1)).long()
        elif name == "geometric":
            assert numbers.steps is not None
            drawn = torch.minimum(numbers.steps, remaining)
        if numbers.chance is None or least == 0.0:
            offset = drawn
        else:
            offset = torch.where(numbers.chance >= least, drawn, offset)
    return offset


def strategy_bounds(mixture: Mapping[str, float]) -> list[tuple[str, float]]:
    """Returns each strategy with the least ``chance`` for which it is taken.

    Args:
        mixture (mapping of str to float): the weight of each strategy.

    Returns:
        list of tuple: strategies and bounds, ascending from 0.

    Raises:
        TypeError: the mixture is not a mapping, or a weight is not a number.
        ValueError: the mixture has an unknown strategy or a wrong weight.

    Examples:
        >>> from torchrl_caiac.transforms.goals.offsets import strategy_bounds
        >>> strategy_bounds({"last": 1.0, "uniform": 0.0, "geometric": 3.0})
        [('last', 0.0), ('geometric', 0.25)]
    """
    if not isinstance(mixture, Mapping):
        raise TypeError(
            f"mixture must map strategies among {list(STRATEGIES)} to weights, got "
            f"{mixture!r}"
        )
    mixture = dict(mixture)  # which another thread may change
    if not mixture or not set(mixture) <= set(STRATEGIES):
        raise ValueError(
            f"mixture maps strategies among {list(STRATEGIES)} to weights, got "
            f"{mixture}"
        )
    weights = {
        name: check_number(f"the weight of {name!r} in mixture", weight, math.inf)
        for name, weight in mixture.items()
    }
    total, below, found = sum(weights.values()), 0.0, []
    if not 0 < total < math.inf:
        raise ValueError(
            f"the weights of mixture must have a positive, finite sum, got {mixture}"
        )
    for name, weight in weights.items():
        if weight > 0:
            found.append((name, below / total))
            below += weight
    return found


def draw_steps(
    shape: torch.Size,
    p: float,
    device: torch.device,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draws the number of failed trials before the first success.

    Args:
        shape (torch.Size): the shape of the result.
        p (float): the probability of success, above 0.
        device (torch.device): the device of the result.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        torch.Tensor: int64, of this shape.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.goals.offsets import draw_steps
        >>> draw_steps((2,), 1.0, torch.device("cpu"))
        tensor([0, 0])
    """

    def draw(*, generator: Any, **kwargs: Any) -> torch.Tensor:
        trials = torch.empty(shape, dtype=torch.int64, **kwargs)
        return trials.geometric_(p, generator=generator).sub_(1)

    if p >= 1.0:
        return torch.zeros(shape, dtype=torch.int64, device=device)
    return draw_numbers(draw, device=device, generator=generator)
