"""Checks of arguments, and values that are checked without waiting for them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDictBase

from torchrl_caiac._sampling import is_native, look
from torchrl_caiac.entities import EntityLayout

__all__ = [
    "LateCheck",
    "LateValue",
    "check_batch_shape",
    "check_choice",
    "check_generator",
    "check_layout",
    "check_number",
    "check_relabeled_rows",
    "check_window",
    "check_windows",
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
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not 0 <= number <= high or not math.isfinite(number):
        limits = f"in [0, {high:g}]" if math.isfinite(high) else "finite, at least 0"
        raise ValueError(f"{name} must be {limits}, got {value!r}")
    return number


def check_choice(name: str, value: Any, choices: Sequence[str]) -> Any:
    """Returns one of several strings, or raises.

    Args:
        name (str): the argument.
        value (Any): its value.
        choices (sequence of str): what it may be.

    Returns:
        str: the value.

    Raises:
        ValueError: it is something else.

    Examples:
        >>> from torchrl_caiac.transforms.checks import check_choice
        >>> check_choice("rows", "first", ("random", "last"))
        Traceback (most recent call last):
        ...
        ValueError: rows must be 'random' or 'last', got 'first'
    """
    if value not in choices:
        names = " or ".join(map(repr, choices))
        raise ValueError(f"{name} must be {names}, got {value!r}")
    return value


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


def check_windows(count: int, windows: int) -> int:
    """Returns how many windows become counterfactual, or raises a ``ValueError``.

    Args:
        count (int): how many.
        windows (int): the windows of a batch.

    Returns:
        int: how many, from 0 to ``windows``.
    """
    if not 0 <= count <= windows:
        raise ValueError(
            f"{count} of {windows} windows are to become counterfactual: set "
            "counterfactual_ratio to a share from 0 to 1"
        )
    return count


def check_generator(generator: Any) -> torch.Generator | None:
    """Returns a generator or ``None``, or raises a ``TypeError``."""
    if generator is not None and not isinstance(generator, torch.Generator):
        raise TypeError(
            f"generator must be a torch.Generator, got {type(generator).__name__}"
        )
    return generator


def check_batch_shape(td: TensorDictBase, window: int) -> None:
    """Raises if a batch does not consist of windows along its last dimension.

    Args:
        td (TensorDictBase): the batch. A last dimension of size 1, as in slices of an
            ensemble, does not count.
        window (int): rows in a window.

    Raises:
        ValueError: it is a single transition, has no rows, or is no multiple of the
            window.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.transforms.checks import check_batch_shape
        >>> check_batch_shape(TensorDict({"a": torch.zeros(2, 10)}, [2, 10]), 5)
    """
    sizes = list(td.batch_size)
    if not sizes:
        raise ValueError(
            "the batch has shape [], a single transition: give a batch [B], such as "
            "the one that a buffer samples, or td.unsqueeze(0)"
        )
    while len(sizes) > 1 and sizes[-1] == 1:
        sizes.pop()
    if not td.numel():
        raise ValueError(
            f"the batch has shape {list(td.shape)}, which has no rows: sample from a "
            "buffer that is not empty"
        )
    if sizes[-1] % window:
        raise ValueError(
            f"the batch has shape {list(td.shape)}, whose last dimension is not a "
            f"multiple of the window {window}: sample whole windows from each buffer"
        )


def check_relabeled_rows(
    relabeled: int, kept: int, rows: int, name: str, ratio: float
) -> None:
    """Raises if a :class:`~torchrl.data.HERReplayBuffer` relabels counterfactual rows.

    Args:
        relabeled (int): the first rows of a batch, which the buffer relabels.
        kept (int): the first rows, which are not counterfactual.
        rows (int): the rows of the batch.
        name (str): the transform.
        ratio (float): its share of counterfactual rows.

    Raises:
        RuntimeError: it does.

    Examples:
        >>> from torchrl_caiac.transforms.checks import check_relabeled_rows
        >>> check_relabeled_rows(4, 5, 10, "CAIACTransform", 0.5)
    """
    if relabeled > kept:
        raise RuntimeError(
            f"HERReplayBuffer relabels the first {relabeled} of {rows} rows of each "
            "batch after all transforms, and some of them may be counterfactual: pass "
            f"rows='last' to {name}, and a her_ratio of at most 1 - "
            f"counterfactual_ratio = {1 - ratio:g}"
        )


# --- values --------------------------------------------------------------------------


class LateValue(NamedTuple):
    """A tensor that :class:`LateCheck` looks at.

    Attributes:
        tensor (torch.Tensor): the values, contiguous.
        bad (str): which values are bad: ``"not finite"``, ``"infinite"``, ``"false"``
            or ``"true"``.
        where (torch.Tensor, optional): bool, of the same size, the values that count;
            all of them by default.
    """

    tensor: torch.Tensor
    bad: Literal["not finite", "infinite", "false", "true"] = "not finite"
    where: torch.Tensor | None = None

    def summed(self) -> torch.Tensor:
        """Returns a float64 that is not finite if a value is bad."""
        values = self.tensor
        if self.bad in ("false", "true"):
            is_bad = values if self.bad == "true" else ~values
            values = torch.where(is_bad, math.nan, 0.0)
        if self.where is not None:
            values = values.where(self.where, torch.zeros_like(values))
        if self.bad == "infinite":
            values = values.nan_to_num(nan=0.0, posinf=math.inf, neginf=-math.inf)
        return values.sum(dtype=torch.float64)


# Kinds of bad values, as in _sampling/sampling.cu.
_KINDS = {
    ("not finite", torch.float32): 0,
    ("not finite", torch.float64): 1,
    ("infinite", torch.float32): 3,
    ("infinite", torch.float64): 4,
    ("true", torch.bool): 5,
    ("false", torch.bool): 6,
}


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

    def look(self, values: Sequence[LateValue | None]) -> None:
        """Looks for bad values in the tensors of one batch, which stay on the device.

        Args:
            values (sequence of LateValue, optional): the tensors, of the same meaning
                in every batch; ``None`` has no bad values.
        """
        there = [(place, value) for place, value in enumerate(values) if value]
        if not there:
            return
        device = there[0][1].tensor.device
        looked = [
            (place, value.tensor, kind, value.where)
            for place, value in there
            if (kind := _KINDS.get((value.bad, value.tensor.dtype))) is not None
        ]
        tensors = [x for _, tensor, _, where in looked for x in (tensor, where)]
        if (
            device.type == "cuda"
            and len(looked) == len(there)
            and is_native(*(x for x in tensors if x is not None))
        ):
            sums, arrived = self._numbers(torch.Size([len(values)]), device)
            look(sums, looked)
            arrived.copy_(sums, non_blocking=True)
            return
        sums = torch.zeros(len(values), dtype=torch.float64, device=device)
        for place, value in there:
            sums[place] = value.summed()
        self.add(sums)

    def add(self, values: torch.Tensor) -> None:
        """Adds the values of one batch.

        Args:
            values (torch.Tensor): ``[V]``, of the same meaning in every batch.
        """
        sums, arrived = self._numbers(values.shape, values.device)
        sums += values
        arrived.copy_(sums, non_blocking=True)

    def _numbers(
        self, shape: torch.Size, device: torch.device
    ) -> tuple[torch.Tensor, torch.Tensor]:
        known = self._sums
        if known is None or (known[0].shape, known[0].device) != (shape, device):
            sums = torch.zeros(shape, dtype=torch.float64, device=device)
            arrived = torch.zeros(
                shape, dtype=torch.float64, pin_memory=device.type == "cuda"
            )
            known = self._sums = sums, arrived
        return known

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
