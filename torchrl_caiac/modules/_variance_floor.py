"""The variance floor of world models, given or taken from the noise in data."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import nn

from torchrl_caiac._layout_units import position_places
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.noise import resting_noise

__all__ = [
    "FloorFromData",
    "FoundFloor",
    "VarianceFloor",
    "checked_floor",
    "layout_floor",
]

VarianceFloor: TypeAlias = (
    float | Mapping[str, float | Sequence[float]] | Literal["auto"] | None
)

_LOGGER = logging.getLogger("torchrl_caiac.fit")
_DEFAULT_FLOOR = 1e-3  # 1 mm, 1 mrad
_ROWS = 100_000  # from which the floor is taken


class FoundFloor(NamedTuple):
    """A variance floor that was taken from data.

    Attributes:
        values (torch.Tensor): float64 ``[P]``, the floor of the predicted columns.
        reasons (dict of str to str): how the floor of each entity was found.
    """

    values: torch.Tensor
    reasons: dict[str, str]


class FloorFromData(nn.Module):
    """A world model that can take its variance floor from data.

    Attributes:
        auto_floor (bool): whether the floor comes from data.
        floor (torch.Tensor): float64 ``[P]``, the floor; NaN until it is known.
        floor_reasons (dict of str to str): how the floor of each entity was found.
    """

    layout: EntityLayout
    predict: dict[str, tuple[int, ...]]
    predicted: dict[str, slice]
    auto_floor: bool
    floor: torch.Tensor
    floor_reasons: dict[str, str]

    @property
    def has_floor(self) -> bool:
        """Whether the variance floor is known; false before it is taken from data."""
        return not self.auto_floor or bool(self.floor_reasons)

    def entity_floors(self, found: FoundFloor | None = None) -> dict[str, list[float]]:
        """Returns the variance floor of the predicted columns of each entity.

        Args:
            found (FoundFloor, optional): the floor. Defaults to that of the model.

        Returns:
            dict of str to list of float: the floor, by entity.
        """
        floor = (self.floor if found is None else found.values).tolist()
        return {name: floor[where] for name, where in self.predicted.items()}

    def fit_variance_floor(
        self, data: TensorDictBase | Sequence[TensorDictBase]
    ) -> None:
        """Sets the variance floor from the noise of the entities while they rest.

        See :func:`~torchrl_caiac.noise.resting_noise`. The columns of
        ``layout.positions`` of an entity share one floor, the largest of theirs. With
        ``variance_floor="auto"``, :meth:`fit_statistics` and
        :func:`~torchrl_caiac.fit.fit_world_model` call it. The reasons are logged and
        kept in :attr:`floor_reasons`.

        Args:
            data (TensorDictBase or sequence of them): transitions ``[T]``, of which up
                to 100,000 are read.

        Raises:
            ValueError: the floor of the model is not ``"auto"``; the data are empty, or
                a value is not finite.

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from torchrl_caiac import EntityLayout
            >>> from torchrl_caiac.modules import GaussianWorldModel
            >>> model = GaussianWorldModel(
            ...     EntityLayout({"cup": [0]}), 2, (8,), variance_floor="auto"
            ... )
            >>> change = (torch.arange(100) % 2).view(100, 1) * 0.5
            >>> model.fit_variance_floor(
            ...     TensorDict(
            ...         {
            ...             "observation": torch.zeros(100, 1),
            ...             "next": {"observation": change},
            ...         },
            ...         [100],
            ...     )
            ... )
            >>> model.floor
            tensor([0.0500], dtype=torch.float64)
        """
        self.set_floor(self.floor_from(data))

    def floor_from(self, data: TensorDictBase | Sequence[TensorDictBase]) -> FoundFloor:
        """Returns what :meth:`fit_variance_floor` sets, without setting it."""
        if not self.auto_floor:
            raise ValueError(
                "the model has a variance floor of its own: create it with "
                "variance_floor='auto' to take the floor from data"
            )
        noise = resting_noise(_state_sample(self.layout, data), self.layout)
        floor: list[float] = []
        for name, own in self.predict.items():
            each = list(noise[name].floor)
            places = position_places(self.layout, name)
            # An object that is pushed hardly moves in height, but not more exactly.
            for place in places:
                each[place] = max(noise[name].floor[p] for p in places)
            floor += [each[p] for p in own]
        values = torch.tensor(floor, dtype=torch.float64)
        return FoundFloor(values, {name: noise[name].reason for name in self.predicted})

    def set_floor(self, found: FoundFloor) -> None:
        """Sets the variance floor, and logs it with its reasons."""
        self.floor.copy_(found.values)
        self.floor_reasons = dict(found.reasons)
        for name, where in self.predicted.items():
            own_floor = ", ".join(f"{value:.3g}" for value in self.floor[where])
            _LOGGER.info(
                "variance floor of %r: %s (%s)",
                name,
                own_floor,
                self.floor_reasons[name],
            )


def layout_floor(
    layout: EntityLayout, predict: Mapping[str, tuple[int, ...]]
) -> float | dict[str, float | Sequence[float]]:
    """Returns the variance floor that a layout has for the predicted columns.

    Args:
        layout (EntityLayout): the entities.
        predict (Mapping of str to tuple of int): the output of
            :func:`~torchrl_caiac.modules._predicted_columns.checked_predict`.

    Returns:
        float or dict of str to float or sequence of float: the floors, 1e-3 if the
        layout has none.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules._variance_floor import layout_floor
        >>> layout = EntityLayout({"cup": [2, 3]}, variance_floor={"cup": [0.1, 0.2]})
        >>> layout_floor(layout, {"cup": (1,)})
        {'cup': [0.2]}
    """
    if not layout.variance_floor:
        return _DEFAULT_FLOOR
    result: dict[str, float | Sequence[float]] = {}
    for name, positions in predict.items():
        floor = layout.variance_floor[name]
        if isinstance(floor, tuple):
            result[name] = [floor[position] for position in positions]
        else:
            result[name] = floor
    return result


def checked_floor(
    floor: VarianceFloor,
    predict: Mapping[str, tuple[int, ...]],
) -> list[float]:
    """Returns the variance floor of every predicted column.

    Args:
        floor (float, Mapping or "auto"): the argument of the model, or the output of
            :func:`layout_floor`.
        predict (Mapping of str to tuple of int): the output of
            :func:`~torchrl_caiac.modules._predicted_columns.checked_predict`.

    Returns:
        list of float: one standard deviation for each predicted column, NaN for
        ``"auto"``.

    Raises:
        ValueError: a floor is missing, negative or not finite.

    Examples:
        >>> from torchrl_caiac.modules._variance_floor import checked_floor
        >>> checked_floor({"arm": 0.1, "cup": [0.2, 0.3]}, {"arm": (0,), "cup": (0, 1)})
        [0.1, 0.2, 0.3]
    """
    if isinstance(floor, str) and floor == "auto":
        return [math.nan for positions in predict.values() for _ in positions]
    per_entity: dict[str, Any]
    if isinstance(floor, Mapping):
        wanted = [name for name, positions in predict.items() if positions]
        if set(floor) - set(predict) or set(wanted) - set(floor):
            raise ValueError(
                f"variance_floor names {sorted(floor)}, expected the predicted "
                f"entities {wanted}: give each its own floor, or one float for all"
            )
        per_entity = {name: floor[name] for name in wanted}
    else:
        per_entity = {name: floor for name, positions in predict.items() if positions}
    floors: list[float] = []
    for name, value in per_entity.items():
        count = len(predict[name])
        # NumPy's numbers and arrays, and tensors, become Python's.
        value = value.tolist() if hasattr(value, "tolist") else value
        values = list(value) if isinstance(value, Sequence) else [value] * count
        if len(values) != count or not all(map(_is_deviation, values)):
            raise ValueError(
                f"variance_floor of entity {name!r} is {value!r}, expected a standard "
                "deviation in physical units, at least 0, or one for each of its "
                f"{count} predicted columns, or 'auto' for all entities"
            )
        floors += [float(v) for v in values]
    return floors


def _is_deviation(value: Any) -> bool:
    # Written so that NaN fails too.
    return not isinstance(value, str) and bool(0 <= value < math.inf)


def _state_sample(
    layout: EntityLayout, data: TensorDictBase | Sequence[TensorDictBase]
) -> TensorDictBase:
    """Returns evenly spaced states and next states of one or several datasets."""
    parts = [data] if isinstance(data, TensorDictBase) else list(data)
    parts = [td.reshape(-1) for td in parts if td.batch_size.numel()]
    if not parts:
        raise ValueError("the data are empty: give some transitions")
    keys = [*layout.in_keys, *(layout.next(key) for key in layout.in_keys)]
    stride = -(-sum(len(td) for td in parts) // _ROWS)
    return torch.cat([td.select(*keys, strict=False)[::stride] for td in parts])
