"""Which tensors are computed in C or CUDA."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import torch

from torchrl_caiac._sampling import on_cuda
from torchrl_caiac._sampling.on_cpu import library

__all__ = ["PLAIN", "is_native", "only_torch", "plain"]

#: Kinds of tensors whose numbers are at their addresses.
PLAIN = {torch.Tensor}
# Numbers of a batch from which torch, with several threads, may be faster.
_MOST = 1 << 22
_off: ContextVar[bool] = ContextVar("only_torch", default=False)


@contextmanager
def only_torch() -> Iterator[None]:
    """Uses the reference inside of the block.

    Examples:
        >>> from torchrl_caiac._sampling import is_native, only_torch
        >>> with only_torch():
        ...     is_native()
        False
    """
    token = _off.set(True)
    try:
        yield
    finally:
        _off.reset(token)


def is_native(*tensors: torch.Tensor, sources: Sequence[torch.Tensor] = ()) -> bool:
    """Returns whether tensors are computed in C or CUDA: plain ones on one device.

    Args:
        *tensors (torch.Tensor): the tensors of a batch.

    Keyword Args:
        sources (sequence of torch.Tensor): tensors that rows are read from, which may
            be large.

    Returns:
        bool: whether they are, and the functions can be used here.
    """
    if _off.get() or torch.compiler.is_compiling():
        return False
    device = tensors[0].device if tensors else torch.device("cpu")
    for tensor in (*tensors, *sources):
        if (
            type(tensor) not in PLAIN
            or tensor.device != device
            or not tensor.is_contiguous()
            or tensor.requires_grad
            or tensor.is_neg()
            or tensor.is_conj()
            or (tensor.data_ptr() == 0 and tensor.numel() > 0)
        ):
            return False
    if device.type != "cpu":
        return on_cuda.is_there(device)
    if torch.get_num_threads() > 1 and any(x.numel() > _MOST for x in tensors):
        return False
    return library() is not None


def plain(tensor: torch.Tensor) -> torch.Tensor:
    """Returns a view of a tensor, such as a memory-mapped one, without its class."""
    return tensor if type(tensor) in PLAIN else tensor.as_subclass(torch.Tensor)
