"""Checks that states and actions are finite, with errors that name the rows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import nn

from torchrl_caiac.entities import EntityLayout

__all__ = ["FiniteChecks", "owner"]


class FiniteChecks(nn.Module):
    """A world model that tells where states and actions are not finite.

    Attributes:
        slices (dict of str to slice): the position of each entity in ``W``.
    """

    layout: EntityLayout
    slices: dict[str, slice]
    action_key: NestedKey

    def check_finite(
        self, state: torch.Tensor, *, next: bool = False, first_row: int = 0
    ) -> None:
        """Raises an error that names entity and row if a state is not finite.

        Args:
            state (torch.Tensor): the entities' features ``[*B, W]``.

        Keyword Args:
            next (bool): whether these are next states. Defaults to ``False``.
            first_row (int): the number of the first row. Defaults to ``0``.

        Raises:
            ValueError: a value is not finite.
        """
        found = _first_non_finite(state)
        if found is None:
            return
        row, column, value, count = found
        name = owner(self.slices, column)
        key: Any = self.layout.observation_key or self.layout.keys[name]
        key = self.layout.next(key) if next else key
        raise ValueError(
            f"{key!r} is {value} for entity {name!r} in row {first_row + row} "
            f"({count} such rows), expected finite observations: remove or repair "
            "these rows"
        )

    def check_finite_action(self, action: torch.Tensor, *, first_row: int = 0) -> None:
        """Raises an error that names the row if an action is not finite.

        Args:
            action (torch.Tensor): ``[*B, A]``.

        Keyword Args:
            first_row (int): the number of the first row. Defaults to ``0``.

        Raises:
            ValueError: a value is not finite.
        """
        found = _first_non_finite(action)
        if found is not None:
            row, column, value, count = found
            raise ValueError(
                f"{self.action_key!r} is {value} in column {column} of row "
                f"{first_row + row} ({count} such rows), expected finite actions: "
                "remove or repair these rows"
            )


def owner(slices: Mapping[str, slice], column: int) -> str:
    """Returns the entity whose slice a column is in.

    Args:
        slices (Mapping of str to slice): the slices.
        column (int): the column.

    Returns:
        str: the name of the entity.

    Examples:
        >>> from torchrl_caiac.modules._finite import owner
        >>> owner({"arm": slice(0, 2), "cup": slice(2, 3)}, 2)
        'cup'
    """
    return next(n for n, s in slices.items() if s.start <= column < s.stop)


def _first_non_finite(x: torch.Tensor) -> tuple[int, int, float, int] | None:
    """Returns row, column, value, and the number of such rows; ``None`` if finite."""
    bad = ~torch.isfinite(x).reshape(-1, x.shape[-1])
    if not bool(bad.any()):
        return None
    row, column = bad.nonzero()[0].tolist()
    value = x.reshape(-1, x.shape[-1])[row, column].item()
    return row, column, value, int(bad.any(-1).sum())
