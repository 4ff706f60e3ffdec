"""The bounds of actions: of a spec, and in comparison with the data."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Bounded

from torchrl_caiac.data.action_bounds import action_bounds

__all__ = [
    "bounds_text",
    "check_actions",
    "differing_bounds",
    "filled_bounds",
    "is_one_hot",
    "known_bounds",
    "spec_bounds",
]

_OUTSIDE = 1e-3  # of the range: what rounding and normalisation may add
_NARROW = 0.05  # of the range: actions in less have not shown what the others do
_WIDER = 1.5  # factor between widths that are taken for the same


def spec_bounds(spec: Any, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the bounds of an action space.

    Args:
        spec (Bounded): the action space, ``[A]``.
        size (int): the size ``A`` of the actions.

    Returns:
        tuple of torch.Tensor: the lowest and the highest action, ``[A]`` each.

    Raises:
        TypeError: it is not bounded.
        ValueError: it has another size, or infinite bounds.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_caiac.modules._action_bounds import spec_bounds
        >>> spec_bounds(Bounded(-1, 2, (2,)), 2)
        (tensor([-1., -1.]), tensor([2., 2.]))
    """
    if not isinstance(spec, Bounded):
        raise TypeError(
            f"action_spec must be a torchrl Bounded spec, got {type(spec).__name__}. "
            f"Continuous actions from low to high have Bounded(low, high, ({size},)); "
            "for discrete ones use MotionInfluence or ResidualInfluence"
        )
    if tuple(spec.shape) != (size,):
        raise ValueError(
            f"action_spec has the shape {list(spec.shape)}, but the model's actions "
            f"are [{size}]: pass the spec of one environment "
            "(env.full_action_spec_unbatched)"
        )
    low = spec.space.low.expand(size)
    high = spec.space.high.expand(size)
    if not bool(torch.isfinite(low).all() and torch.isfinite(high).all()):
        raise ValueError(
            f"action_spec has infinite bounds, low {low.tolist()} and high "
            f"{high.tolist()}: give finite ones"
        )
    return low.float(), high.float()


def check_actions(
    action: torch.Tensor,
    low: torch.Tensor,
    high: torch.Tensor,
    key: NestedKey,
    *,
    tolerance: float = _OUTSIDE,
    first_row: int = 0,
    remedy: str = "rescale the actions, or correct action_spec",
) -> None:
    """Raises an error that names row and column if an action is outside of its bounds.

    Args:
        action (torch.Tensor): ``[*B, A]``.
        low (torch.Tensor): the lowest action, ``[A]`` or ``[]``.
        high (torch.Tensor): the highest action, ``[A]`` or ``[]``.
        key (NestedKey): the name of the actions in the error.

    Keyword Args:
        tolerance (float): the tolerated excess, as a share of the width.
            Defaults to ``1e-3``.
        first_row (int): the number of the first row. Defaults to ``0``.
        remedy (str): the end of the message, which says what to do.

    Raises:
        ValueError: an action is outside, or NaN.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules._action_bounds import check_actions
        >>> low, high = -torch.ones(2), torch.ones(2)
        >>> check_actions(torch.tensor([[0.5, 90.0]]), low, high, "action")
        Traceback (most recent call last):
        ...
        ValueError: 'action' is 90 in column 1 of row 0, expected [-1, 1] (1 such row...
    """
    rows = action.reshape(-1, action.shape[-1])
    low, high = (x.to(rows.device).expand(rows.shape[-1]) for x in (low, high))
    # The bounds themselves are rounded to float32.
    margin = tolerance * (high - low) + 1e-6 * torch.maximum(low.abs(), high.abs())
    inside = (rows >= low - margin) & (rows <= high + margin)  # false for NaN
    if bool(inside.all()):
        return
    row, column = (~inside).nonzero()[0].tolist()
    count = int((~inside).any(-1).sum())
    raise ValueError(
        f"{key!r} is {rows[row, column].item():g} in column {column} of row "
        f"{first_row + row}, expected [{low[column].item():g}, "
        f"{high[column].item():g}] ({count} such row{'s' if count > 1 else ''} of "
        f"{len(rows)}): {remedy}"
    )


def is_one_hot(action: torch.Tensor) -> bool:
    """Returns whether actions are discrete ones, of which each row has one.

    Args:
        action (torch.Tensor): ``[T, A]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules._action_bounds import is_one_hot
        >>> is_one_hot(torch.tensor([[0.0, 1.0], [1.0, 0.0]]))
        True
        >>> is_one_hot(torch.tensor([[0.0, 1.0], [0.5, 0.5]]))
        False
    """
    is_binary = ((action == 0) | (action == 1)).all()
    return action.shape[-1] > 1 and bool(is_binary and (action.sum(-1) == 1).all())


def known_bounds(
    sources: Sequence[TensorDictBase], action_spec: Bounded | None, size: int
) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Returns the bounds of the actions of data, of a spec or stored with the data.

    Args:
        sources (sequence of TensorDictBase): the datasets.
        action_spec (Bounded, optional): the action space; it takes precedence over
            stored bounds.
        size (int): the size ``A`` of the actions.

    Returns:
        tuple of torch.Tensor, optional: the lowest and the highest action, ``[A]``
        each, on the CPU; ``None`` if they are not known.

    Raises:
        TypeError: the spec is not bounded.
        ValueError: bounds have another size, or those of datasets differ.
    """
    if action_spec is not None:
        low, high = spec_bounds(action_spec, size)
        return low.cpu(), high.cpu()
    known = None
    for number, source in enumerate(sources):
        found = action_bounds(source)
        if found is None:
            continue
        if tuple(found[0].shape) != (size,):
            raise ValueError(
                f"dataset {number} has bounds of {list(found[0].shape)} actions, "
                f"expected [{size}]: give the data of the model's actions"
            )
        if known is not None and not all(map(torch.equal, known, found)):
            raise ValueError(
                f"dataset {number} has actions in {bounds_text(found)}, but one "
                f"before it in {bounds_text(known)}: rescale one of them, or pass "
                "action_spec if their actions mean the same"
            )
        known = found
    return known


def filled_bounds(
    seen: tuple[torch.Tensor, torch.Tensor],
    known: tuple[torch.Tensor, torch.Tensor] | None,
    key: NestedKey,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the bounds of actions, and warns if the data do not tell or fill them.

    Args:
        seen (tuple of torch.Tensor): the lowest and the highest action in the data,
            ``[A]`` each.
        known (tuple of torch.Tensor, optional): the bounds, if they are known.
        key (NestedKey): the name of the actions in the warning.

    Returns:
        tuple of torch.Tensor: the known bounds, else those of the data.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules._action_bounds import filled_bounds
        >>> one = torch.ones(2)
        >>> filled_bounds((-0.9 * one, 0.9 * one), (-one, one), "action")
        (tensor([-1., -1.]), tensor([1., 1.]))
    """
    if known is None:
        warnings.warn(
            f"the action space is not known: {key!r} is taken to be in the range of "
            f"the data, {bounds_text(seen)}. If other actions are possible, pass "
            "action_spec, or store the bounds with the data (action_bounds=)",
            stacklevel=3,
        )
    low, high = seen if known is None else known
    spread = seen[1] - seen[0]
    narrow = (spread <= 0) | (spread < _NARROW * (high - low))
    columns = narrow.nonzero()[:, 0].tolist()
    if columns:
        warnings.warn(
            f"the columns {columns} of {key!r} hardly vary: the data are in "
            f"{bounds_text(seen)}, of {bounds_text((low, high))}. The model has not "
            "seen what other actions do, so that their influence is extrapolated. Add "
            "transitions with random actions, or correct action_spec",
            stacklevel=3,
        )
    return low, high


def bounds_text(bounds: tuple[torch.Tensor, torch.Tensor]) -> str:
    """Returns bounds as text for messages.

    Args:
        bounds (tuple of torch.Tensor): the lowest and the highest action, ``[A]`` each.

    Returns:
        str: one range for each column.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules._action_bounds import bounds_text
        >>> bounds_text((torch.zeros(2), torch.tensor([0.1, 90.0])))
        '[0, 0.1] x [0, 90]'
    """
    pairs = zip(*(bound.tolist() for bound in bounds), strict=True)
    return " x ".join(f"[{low:g}, {high:g}]" for low, high in pairs)


def differing_bounds(
    given: tuple[torch.Tensor, torch.Tensor],
    known: tuple[torch.Tensor, torch.Tensor],
) -> list[int]:
    """Returns the columns in which bounds are outside of others, or much narrower.

    Args:
        given (tuple of torch.Tensor): the lowest and the highest action, ``[A]`` each.
        known (tuple of torch.Tensor): those to compare with, ``[A]`` each.

    Returns:
        list of int: the columns, those in which the widths differ by more than a factor
        of 1.5, or ``given`` lies outside of ``known``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules._action_bounds import differing_bounds
        >>> one = torch.ones(2)
        >>> differing_bounds((-one, one), (-one, torch.tensor([1.0, 90.0])))
        [1]
    """
    (low, high), (known_low, known_high) = given, known
    width, known_width = high - low, known_high - known_low
    margin = _OUTSIDE * known_width + 1e-6 * torch.maximum(
        known_low.abs(), known_high.abs()
    )
    differ = (low < known_low - margin) | (high > known_high + margin)
    differ |= (width > _WIDER * known_width) | (known_width > _WIDER * width)
    return differ.nonzero()[:, 0].tolist()
