"""Checks of values on an accelerator that do not wait for it."""

from __future__ import annotations

import math

import torch

__all__ = ["LateCheck"]


class LateCheck:
    """Tells the host, some batches later, what was not finite on an accelerator.

    To look at a value on an accelerator is to wait until all work before it is done.
    Here values are added up on the device, batch after batch, so that NaN or an
    infinity stays in the sum, and the sums are copied to the host while the device
    goes on. Whoever asks sees what has arrived by then: as a rule all batches but the
    newest ones.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.late_check import LateCheck
        >>> late = LateCheck()
        >>> late.add(torch.tensor([0.0, float("nan")]))
        >>> late.add(torch.zeros(2))
        >>> late.found(), late.found()
        ([1], [])
    """

    def __init__(self) -> None:
        # The sums on the device, and what of them has arrived on the host.
        self._sums: tuple[torch.Tensor, torch.Tensor] | None = None

    @staticmethod
    def needed(device: torch.device) -> bool:
        """Whether looking at a value on this device means to wait for it.

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
        """What was not finite in any batch that has arrived; starts over if there was.

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
        return LateCheck, ()  # a copy has seen nothing yet
