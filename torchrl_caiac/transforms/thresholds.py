"""The threshold of scores: one number, one for each entity, or chosen from the data."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, Literal

import torch
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac._columns import check_names
from torchrl_caiac._processes import ThreadLock
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.thresholds import suggest_thresholds
from torchrl_caiac.transforms.checks import check_number

__all__ = ["EntityThresholds", "ThresholdArgument"]

_logger = logging.getLogger("torchrl_caiac.transforms.thresholds")
_CHOOSING = ThreadLock()

ThresholdArgument = float | Mapping[str, float] | Literal["auto"]


class EntityThresholds:
    """The largest score of an uninfluenced entity, for each entity.

    Args:
        layout (EntityLayout): the entities.
        given (float, mapping of str to float or str): one number for all entities; a
            number for each entity that is not fixed, where one below 0 means that the
            entity is never swapped; or ``"auto"``, for numbers that :meth:`choose` sets
            later.

    Raises:
        TypeError: a threshold is not a number.
        ValueError: a number is out of range; a name is unknown or missing.

    Examples:
        >>> import torch
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms.thresholds import EntityThresholds
        >>> layout = EntityLayout({"arm": [0], "cup": [1], "lid": [2]}, fixed=["arm"])
        >>> EntityThresholds(layout, 0.05).limit(torch.zeros(4, 3))
        0.05
        >>> thresholds = EntityThresholds(layout, {"lid": 0.25, "cup": 0.5})
        >>> thresholds.limit(torch.zeros(4, 3))
        tensor([  -inf, 0.5000, 0.2500])
    """

    def __init__(self, layout: EntityLayout, given: ThresholdArgument) -> None:
        self.layout = layout
        self.given: float | dict[str, float] | Literal["auto"]
        # What scores are compared with; ``None`` until it is known.
        self._limit: float | torch.Tensor | None = None
        self._numbers: dict[str, float] = {}
        #: Entities that are known to be swapped always or never.
        self.expected: frozenset[str] = frozenset()
        if isinstance(given, str):
            if given != "auto":
                raise TypeError(
                    f"threshold must be a number, a mapping with one for each entity, "
                    f"or 'auto'; got {given!r}"
                )
            self.given = "auto"
        elif isinstance(given, Mapping):
            self.given = _checked(layout, given)
            self._set(self.given)
        else:
            self.given = self._limit = check_number("threshold", given, math.inf)
            self._numbers = dict.fromkeys(_free_names(layout), self._limit)

    @property
    def is_known(self) -> bool:
        """Whether there are numbers: always, but with ``"auto"`` before a choice."""
        return self._limit is not None

    @property
    def numbers(self) -> dict[str, float]:
        """The threshold of each entity that is not fixed, empty until it is known."""
        return dict(self._numbers)

    @property
    def number(self) -> float:
        """The number for all entities; an ``AttributeError`` if there are several."""
        if not isinstance(self.given, float):
            raise AttributeError(f"there is no single threshold, but {self}")
        return self.given

    def choose(self, numbers: Mapping[str, float]) -> None:
        """Sets the numbers of ``"auto"``.

        Args:
            numbers (mapping of str to float): one for each entity that is not fixed.

        Raises:
            TypeError: a threshold is not a number.
            ValueError: a number is not finite; a name is unknown or missing.
        """
        self._set(_checked(self.layout, numbers))

    def restore(self, numbers: torch.Tensor, names: Sequence[str] | None) -> None:
        """Sets the numbers of ``"auto"`` to those of another transform.

        Args:
            numbers (torch.Tensor): float64, one for each name.
            names (sequence of str, optional): the entities, in any order. ``None`` if
                the state is of a version that did not record them.

        Raises:
            ValueError: the names are unknown, or not those of the entities that are not
                fixed; numbers were given to this transform, and they differ.
        """
        own = _free_names(self.layout)
        if names is None or len(names) != numbers.numel():
            raise ValueError(
                "the state has thresholds that threshold='auto' chose, but not the "
                "names of their entities: it is of an earlier version. Let 'auto' "
                "choose again, or pass the numbers as threshold={...}"
            )
        if set(names) != set(own):
            raise ValueError(
                f"the state has thresholds of {list(names)}, but the entities of the "
                f"layout that are not fixed are {own}: it is of another layout"
            )
        found = dict(zip(names, numbers.tolist(), strict=True))
        if self.given == "auto":
            self.choose(found)
        elif found != self._numbers:
            raise ValueError(
                f"the state has the thresholds {found} that threshold='auto' chose, "
                f"but this transform has threshold={self.given}: create it with "
                "threshold='auto', or with the numbers of the state"
            )

    def choose_from(self, buffer: ReplayBuffer | None, score_key: NestedKey) -> None:
        """Chooses the numbers of ``"auto"`` from the scores of a buffer.

        Args:
            buffer (ReplayBuffer, optional): the buffer; ``None`` if there is none.
            score_key (NestedKey): its scores.

        Raises:
            RuntimeError: there is no buffer, or none with a storage of its own.
        """
        if buffer is None or not isinstance(buffer.storage, TensorStorage):
            what = "no replay buffer samples here"
            if buffer is not None:
                what = f"the buffer has a {type(buffer.storage).__name__}"
            raise RuntimeError(
                "threshold='auto' reads the scores of the replay buffer that samples, "
                f"but {what}: pass numbers, such as "
                "threshold=suggest_thresholds(rb, layout).thresholds"
            )
        with _CHOOSING:  # batches may be prefetched by several threads
            if self.is_known:
                return
            found = suggest_thresholds(buffer, self.layout, score_key=score_key)
            confidence = found.confidence
            self.expected = frozenset(
                name for name, word in confidence.items() if word != "two clear modes"
            )
            self.choose(found.thresholds)
        _logger.info("threshold='auto':\n%s", found)
        unclear = [name for name, word in confidence.items() if word == "unclear"]
        if unclear:
            reasons = "; ".join(f"{name}: {found.reasons[name]}" for name in unclear)
            numbers = dict.fromkeys(unclear, "...")
            warnings.warn(
                f"threshold='auto' found no clear threshold for {unclear}, which are "
                f"never swapped ({reasons}). Look at suggest_thresholds(rb, layout)"
                ".plot(path), and pass threshold={"
                f"**suggest_thresholds(rb, layout).thresholds, **{numbers}}}",
                stacklevel=2,
            )

    def limit(self, scores: torch.Tensor) -> float | torch.Tensor:
        """Returns what scores are compared with.

        Args:
            scores (torch.Tensor): ``[*, N]``.

        Returns:
            float or torch.Tensor: the number for all entities, or ``[N]``, with the
            dtype and on the device of the scores; minus infinity for fixed entities.

        Raises:
            RuntimeError: ``"auto"`` has no numbers yet.
        """
        limit = self._limit
        if isinstance(limit, float):
            return limit
        if limit is None:
            raise RuntimeError(
                "threshold='auto' chooses the numbers when a replay buffer samples for "
                "the first time: pass numbers, such as "
                "suggest_thresholds(rb, layout).thresholds"
            )
        # With the dtype of the scores, so that a number means the same for one entity
        # as for all of them: a float32 score is compared with the float32 number.
        # Flags and integers cannot hold the numbers.
        dtype = scores.dtype if scores.is_floating_point() else torch.float32
        if (limit.device, limit.dtype) != (scores.device, dtype):
            self._limit = limit = self._tensor().to(scores.device, dtype)
        return limit

    def _set(self, numbers: dict[str, float]) -> None:
        self._numbers = numbers
        never = {name for name, number in numbers.items() if number < 0}
        self.expected = self.expected | never
        self._limit = self._tensor()

    def _tensor(self) -> torch.Tensor:
        values = [self._numbers.get(name, -math.inf) for name in self.layout.names]
        return torch.tensor(values, dtype=torch.float64)

    def __str__(self) -> str:
        if self.given != "auto":
            return str(self.given)
        return f"'auto': {self._numbers}" if self.is_known else "'auto'"


def _free_names(layout: EntityLayout) -> list[str]:
    return [name for name in layout.names if name not in layout.fixed]


def _checked(layout: EntityLayout, numbers: Mapping[str, Any]) -> dict[str, float]:
    """Returns the numbers in layout order."""
    check_names(numbers, layout.names, "threshold")
    fixed = [name for name in numbers if name in layout.fixed]
    if fixed:
        raise ValueError(
            f"threshold names {fixed}, which are fixed and never swapped: leave them "
            "out"
        )
    names = _free_names(layout)
    missing = [name for name in names if name not in numbers]
    if missing:
        raise ValueError(
            f"threshold lacks {missing}: give one number for each entity that is not "
            f"fixed, {names}, or one number for all; below 0, an entity is never "
            "swapped"
        )
    result = {}
    for name in names:
        value = numbers[name]
        if isinstance(value, bool) or not isinstance(value, Real):
            raise TypeError(f"threshold of {name!r} must be a number, got {value!r}")
        if not math.isfinite(value):
            raise ValueError(f"threshold of {name!r} must be finite, got {value!r}")
        result[name] = float(value)
    return result
