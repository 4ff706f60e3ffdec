"""Checks of values on an accelerator that do not wait for it."""

from __future__ import annotations

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
        self._sums: torch.Tensor | None = None
        self._arrived: torch.Tensor | None = None

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
        sums = self._sums
        if sums is None or sums.device != values.device or len(sums) != len(values):
            sums = torch.zeros_like(values, dtype=torch.float64)
            self._arrived = torch.zeros(
                len(values), dtype=torch.float64, pin_memory=values.is_cuda
            )
            self._sums = sums
        sums += values
        self._arrived.copy_(sums, non_blocking=True)  # type: ignore[union-attr]

    def found(self) -> list[int]:
        """What was not finite in any batch that has arrived; starts over if there was.

        Returns:
            list of int: places in ``values``.
        """
        if self._arrived is None:
            return []
        sums = self._arrived.tolist()
        bad = [place for place, value in enumerate(sums) if value - value != 0]
        if bad:
            self._sums = self._arrived = None
        return bad

    def __reduce__(self) -> tuple[type[LateCheck], tuple[()]]:
        return LateCheck, ()  # a copy has seen nothing yet
