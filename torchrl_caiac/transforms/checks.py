"""Checks of arguments, and of the values of each batch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms.keys import TransformKeys

__all__ = [
    "BatchCheck",
    "LateCheck",
    "check_generator",
    "check_layout",
    "check_number",
    "check_window",
]


# --- arguments -----------------------------------------------------------------------


def check_number(name: str, value: Any, high: float) -> float:
    """Returns a number between 0 and ``high``, or raises.

    Args:
        name (str): the argument.
        value (Any): its value.
        high (float): the upper limit, which may be infinite.

    Returns:
        float: the number.

    Raises:
        TypeError: it is not a number.
        ValueError: it is out of range or not finite.

    Examples:
        >>> from torchrl_caiac.transforms.checks import check_number
        >>> check_number("swap_prob", 2, 1.0)
        Traceback (most recent call last):
        ...
        ValueError: swap_prob must be in [0, 1], got 2
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name} must be a number, got {value!r}")
    if not 0 <= value <= high or not math.isfinite(value):
        limits = f"in [0, {high:g}]" if math.isfinite(high) else "finite, at least 0"
        raise ValueError(f"{name} must be {limits}, got {value!r}")
    return float(value)


def check_layout(layout: Any) -> EntityLayout:
    """Returns the layout, or raises a ``TypeError`` if it is none."""
    if not isinstance(layout, EntityLayout):
        raise TypeError(f"layout must be an EntityLayout, got {type(layout).__name__}")
    return layout


def check_window(window: Any) -> int:
    """Returns a number of rows, or raises a ``TypeError`` or ``ValueError``."""
    if isinstance(window, bool) or not isinstance(window, int):
        raise TypeError(f"window must be a number of rows, an int; got {window!r}")
    if window < 1:
        raise ValueError(f"window must be at least 1 row, got {window}")
    return window


def check_generator(generator: Any) -> torch.Generator | None:
    """Returns a generator or ``None``, or raises a ``TypeError``."""
    if generator is not None and not isinstance(generator, torch.Generator):
        raise TypeError(
            f"generator must be a torch.Generator, got {type(generator).__name__}"
        )
    return generator


# --- values --------------------------------------------------------------------------


class LateCheck:
    """Finds values that are not finite on an accelerator, without waiting for it.

    Reading a value from an accelerator waits until all work before it is done. Here
    values are added up on the device, batch after batch, so that NaN or an infinity
    stays in the sum, and the sums are copied to the host asynchronously. The host reads
    the sums that have arrived, usually those of all batches but the newest.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.checks import LateCheck
        >>> late = LateCheck()
        >>> late.add(torch.tensor([0.0, float("nan")]))
        >>> late.add(torch.zeros(2))
        >>> late.found(), late.found()
        ([1], [])
    """

    def __init__(self) -> None:
        # The sums on the device, and their copies on the host.
        self._sums: tuple[torch.Tensor, torch.Tensor] | None = None

    @staticmethod
    def needed(device: torch.device) -> bool:
        """Returns whether reading a value on this device would wait for it.

        Args:
            device (torch.device): where the values are.

        Returns:
            bool: true for CUDA devices.
        """
        return device.type == "cuda"

    def add(self, values: torch.Tensor) -> None:
        """Adds the values of one batch.

        Args:
            values (torch.Tensor): ``[V]``, of the same meaning in every batch.
        """
        known = self._sums
        if known is None or (known[0].shape, known[0].device) != (
            values.shape,
            values.device,
        ):
            sums = torch.zeros_like(values, dtype=torch.float64)
            arrived = torch.zeros(
                values.shape, dtype=torch.float64, pin_memory=values.is_cuda
            )
            known = self._sums = sums, arrived
        sums, arrived = known
        sums += values
        arrived.copy_(sums, non_blocking=True)

    def found(self) -> list[int]:
        """Returns and clears the places that were not finite in arrived batches.

        Returns:
            list of int: places in ``values``.
        """
        if self._sums is None:
            return []
        arrived = self._sums[1].tolist()
        bad = [place for place, value in enumerate(arrived) if not math.isfinite(value)]
        if bad:
            self._sums = None
        return bad

    def __reduce__(self) -> tuple[type[LateCheck], tuple[()]]:
        return LateCheck, ()  # a copy starts empty


class BatchCheck:
    """Raises if the values of a batch are invalid.

    Scores and observations must be finite, and windows must stay within trajectories.
    On a CUDA device nothing waits for the result: an error is raised at a later batch.

    Args:
        layout (EntityLayout): the entities.

    Keyword Args:
        score_key (NestedKey): the scores.
        window (int): rows in a window.
        keys (TransformKeys): trajectory ids and end flags.
        scores_name (str): the name of the scores in error messages.
    """

    def __init__(
        self,
        layout: EntityLayout,
        *,
        score_key: NestedKey,
        window: int,
        keys: TransformKeys,
        scores_name: str,
    ) -> None:
        self.layout = layout
        self.score_key = score_key
        self.window = window
        self.keys = keys
        self.scores_name = scores_name
        self._late = LateCheck()

    def __call__(
        self,
        before: TensorDictBase,
        after: TensorDictBase,
        scores: torch.Tensor,
        states: Sequence[NestedKey],
    ) -> None:
        """Checks a batch.

        Args:
            before (TensorDictBase): the batch as it was sampled, ``[B * window]``.
            after (TensorDictBase): the batch after swapping.
            scores (torch.Tensor): its scores, ``[B * window, ...]``.
            states (sequence of NestedKey): the floating-point leaves of its states.

        Raises:
            ValueError: a value is not finite, or a window crosses a trajectory's end.
        """
        observed = [after.get(key) for key in states]
        crossings = self._crossings(before)
        leaves = [scores, *observed]
        # A sum is finite if all its terms are (unless it overflows: see _explain).
        if not LateCheck.needed(scores.device):
            finite = math.isfinite(sum(leaf.sum().item() for leaf in leaves))
            if not finite or (crossings is not None and bool(crossings.any())):
                self._explain(after, scores, states, crossings)
            return
        found = self._late.found()
        if found:
            # The newest batch is likely to have the same fault.
            self._explain(after, scores, states, crossings)
            names = [self.score_key, *states, "the windows"]
            raise ValueError(
                f"{[names[place] for place in found]} were invalid in an earlier "
                f"batch: {self.scores_name} or observations are NaN or infinite, or "
                "windows cross a trajectory's end. On a CUDA device errors are late; "
                "sample the same data on the CPU to find the rows"
            )
        sums = [leaf.sum(dtype=torch.float64) for leaf in leaves]
        if crossings is not None:
            sums.append(torch.where(crossings.any(), math.nan, 0.0).double())
        self._late.add(torch.stack(sums))

    def _crossings(self, td: TensorDictBase) -> torch.Tensor | None:
        """Returns where a window leaves its trajectory, bool ``[B, window - 1]``."""
        if self.window == 1:
            return None
        found = None
        if self.keys.trajectory is not None:
            ids = td.get(self.keys.trajectory, None)
            if ids is not None:
                ids = ids.reshape(-1, self.window)
                found = ids[:, 1:] != ids[:, :-1]
        if self.keys.done is not None:
            done = td.get(self.keys.done, None)
            if done is not None:
                ended = done.reshape(-1, self.window)[:, :-1].bool()
                found = ended if found is None else found | ended
        return found

    def _explain(
        self,
        after: TensorDictBase,
        scores: torch.Tensor,
        states: Sequence[NestedKey],
        crossings: torch.Tensor | None,
    ) -> None:
        nan, infinite = scores.isnan(), scores.isinf()
        if nan.any():
            rows = int(nan.flatten(1).any(1).sum())
            raise ValueError(
                f"{self.score_key!r} is NaN, that is not scored, in {rows} of "
                f"{scores.shape[0]} rows for {self._entities(nan)}: call score_buffer "
                "on the replay buffer after extending it"
            )
        if infinite.any():
            raise ValueError(
                f"{self.score_key!r} is infinite for {self._entities(infinite)}: check "
                "the influence measure, then call score_buffer(..., overwrite=True)"
            )
        if crossings is not None and crossings.any():
            window = int(crossings.any(1).nonzero()[0, 0])
            raise ValueError(
                f"window {window} of {self.window} rows crosses a trajectory's end "
                f"according to {self.keys.trajectory!r} or {self.keys.done!r}: use "
                f"SliceSampler with slice_len={self.window}, strict_length=True and "
                "trajectories of at least this length. If end flags do not end a "
                "trajectory in these data, pass keys=TransformKeys(done=None)"
            )
        for key in states:
            bad = ~after.get(key).isfinite()
            if bad.any():
                row = int(bad.flatten(1).any(1).nonzero()[0, 0])
                raise ValueError(
                    f"{key!r} is not finite (NaN or infinite) in {int(bad.sum())} "
                    f"values, first in row {row} of the batch: clean the data, or "
                    "the donors' data"
                )

    def _entities(self, bad: torch.Tensor) -> list[str]:
        """Returns the entities that have a bad score, ``[*, N]``."""
        columns = bad.reshape(-1, bad.shape[-1]).any(0).nonzero()[:, 0]
        return [self.layout.names[column] for column in columns.tolist()]
