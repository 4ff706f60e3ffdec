"""Influence from the recorded motion: an entity that moves is influenced."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import nn
from torchrl.data import ReplayBuffer
from typing_extensions import Self

from torchrl_caiac._layout_units import entity_floors, position_features
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.noise import resting_noise

__all__ = ["MotionInfluence"]

_logger = logging.getLogger("torchrl_caiac.influence.motion")

Tolerance = float | Mapping[str, float | Sequence[float]]


class MotionInfluence(nn.Module):
    r"""Counts an entity as influenced if it moves in the recorded transition.

    It needs no model, no simulator and no data of random actions. It suits entities
    that move only if the robot moves them. Entities that move by themselves (rolling,
    falling, conveyors, other agents) count as influenced while they move: use
    :class:`~torchrl_caiac.influence.ResidualInfluence` for these. Entities that the
    robot *could* have moved, but did not, count as uninfluenced.

    An entity has the score

    .. math:: d = \max_c |s'_c - s_c| / \tau_c

    over its position columns :math:`c` with tolerances :math:`\tau_c` if :math:`d > 1`,
    and 0 if not. Every threshold in [0, 1) gives the same mask, the default of
    :class:`~torchrl_caiac.CAIACTransform` included. Choose the ``lookahead`` of
    :func:`~torchrl_caiac.influence.score_buffer` as long as an action takes to have its
    effect.

    The columns are ``layout.positions`` of the entity, or all of its columns if the
    layout does not name positions.

    Args:
        layout (EntityLayout): the entities.
        tolerance (float, mapping or str): the largest change of a column that does not
            count as motion, in the units of the data. One number, or for each entity
            one number or one for each of its columns. ``"auto"``:
            ``layout.variance_floor`` if the layout has it, else the tolerance of
            :func:`~torchrl_caiac.noise.resting_noise`, which :meth:`fit` reads from
            data. Defaults to ``"auto"``.

    Attributes:
        tolerance (dict of str to float or tuple of float, optional): the tolerance of
            each entity; ``None`` until it is known.

    Raises:
        TypeError: a tolerance is not a number.
        ValueError: an entity has no tolerance, or one that is not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence import MotionInfluence
        >>> layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])
        >>> td = TensorDict(
        ...     {
        ...         "observation": torch.tensor([[0.0, 5.0], [1.0, 5.0]]),
        ...         ("next", "observation"): torch.tensor([[1.0, 5.0], [2.0, 5.25]]),
        ...     },
        ...     [2],
        ... )
        >>> MotionInfluence(layout, tolerance=0.125)(td)
        tensor([[8., 0.],
                [8., 2.]])
    """

    def __init__(
        self, layout: EntityLayout, tolerance: Tolerance | Literal["auto"] = "auto"
    ) -> None:
        super().__init__()
        if not isinstance(layout, EntityLayout):
            raise TypeError(
                f"layout must be an EntityLayout, got {type(layout).__name__}"
            )
        self.layout = layout
        self.tolerance: dict[str, float | tuple[float, ...]] | None = None
        if isinstance(tolerance, str):
            if tolerance != "auto":
                raise ValueError(
                    f"tolerance must be 'auto', a number or a mapping, got "
                    f"{tolerance!r}"
                )
            if layout.variance_floor:
                self.tolerance = dict(layout.variance_floor)
        else:
            self.tolerance = entity_floors(
                tolerance, layout.names, layout.columns, "tolerance"
            )
        # For each device and width of the state: the output of `columns`.
        self._limits: dict[tuple[torch.device, int], list[torch.Tensor]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Returns the settings without the cache, which the digest must not have."""
        return {**self.__dict__, "_limits": {}}

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys of the state and of the next state."""
        keys = self.layout.in_keys
        return [*keys, *(self.layout.next(key) for key in keys)]

    @property
    def fitted(self) -> bool:
        """Whether the tolerances are known."""
        return self.tolerance is not None

    def fit(self, data: TensorDictBase | ReplayBuffer) -> Self:
        """Measures the tolerances from data, unless they are known.

        How each was found is logged.

        Args:
            data (TensorDictBase or ReplayBuffer): transitions, ``[*B]``.

        Returns:
            MotionInfluence: this estimator.

        Raises:
            KeyError: the state or the next state is missing.
            ValueError: there are no rows, or the states have NaN or infinite values.
        """
        if self.tolerance is None:
            noise = resting_noise(data, self.layout)
            for name, found in noise.items():
                _logger.info("%r %s", name, found.reason)
            self.tolerance = {name: found.tolerance for name, found in noise.items()}
            self._limits.clear()
        return self

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Returns the scores of transitions.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]``; it is not changed.

        Returns:
            torch.Tensor: float32 ``[*B, N]``, 0 for an entity that does not move, else
            its largest change in tolerances.

        Raises:
            KeyError: the state or the next state is missing.
            RuntimeError: the tolerances are unknown.
            ValueError: a state or a next state is not finite.
        """
        now = self.layout.read(tensordict)
        after = self.layout.read(tensordict, next=True)
        index, limit, owner = self.columns(now, tensordict)
        change = (after - now)[..., index] - self.expected_change(now)
        ratio = (change.abs() / limit).float()
        score = ratio.new_zeros((*ratio.shape[:-1], len(self.layout)))
        score = score.scatter_reduce(-1, owner.expand(ratio.shape), ratio, "amax")
        if not bool(score.isfinite().all()):
            bad = (~score.isfinite()).reshape(-1, len(self.layout)).any(0).tolist()
            names = [n for n, b in zip(self.layout.names, bad, strict=True) if b]
            raise ValueError(
                f"the states or next states of {names} have NaN or infinite values: "
                "remove or repair these rows"
            )
        return torch.where(score > 1, score, 0)

    def expected_change(self, state: torch.Tensor) -> torch.Tensor | float:
        """Returns how the positions change if nothing influences the entities.

        Args:
            state (torch.Tensor): the features of all entities, ``[*B, W]``.

        Returns:
            torch.Tensor or float: ``[*B, P]``, the position columns of all entities in
            layout order; here 0.
        """
        return 0.0

    def columns(
        self, state: torch.Tensor, td: TensorDictBase
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Returns the position columns of all entities, ``[P]``.

        Args:
            state (torch.Tensor): the features of all entities, ``[*B, W]``.
            td (TensorDictBase): the transitions that they were read from.

        Returns:
            tuple of torch.Tensor: their places in the features, their tolerances, and
            the numbers of their entities, in layout order.

        Raises:
            RuntimeError: the tolerances are unknown.
            ValueError: the number of tolerances of an entity is not that of its
                features.
        """
        if self.tolerance is None:
            raise RuntimeError(
                "the tolerances of MotionInfluence are unknown: call fit(data) first, "
                "or pass tolerance="
            )
        key = (state.device, state.shape[-1])
        if key not in self._limits:
            index: list[int] = []
            limit: list[float] = []
            owner: list[int] = []
            for number, (name, where) in enumerate(self.layout.slices(td).items()):
                width = where.stop - where.start
                value = self.tolerance[name]
                values = value if isinstance(value, tuple) else (value,) * width
                own = position_features(self.layout, name, width)
                if len(values) != width:
                    raise ValueError(
                        f"tolerance of entity {name!r} has {len(values)} numbers, "
                        f"expected one for each of its {width} features"
                    )
                index += [where.start + feature for feature in own]
                limit += [values[feature] for feature in own]
                owner += [number] * len(own)
            self._limits[key] = [
                torch.tensor(index, device=state.device),
                torch.tensor(limit, dtype=state.dtype, device=state.device),
                torch.tensor(owner, device=state.device),
            ]
        index_, limit_, owner_ = self._limits[key]
        return index_, limit_, owner_

    def extra_repr(self) -> str:
        """Returns the settings, for ``repr``."""
        return f"tolerance={'auto' if self.tolerance is None else self.tolerance}"
