"""The kernels of ``sampling.cu``: compiled once in a process, by NVRTC, and started.

PyTorch comes with that compiler. Where it does not work, what calls :func:`is_there`
uses operations of torch.
"""

from __future__ import annotations

import ctypes
import logging
import os
import struct
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import torch

from torchrl_caiac._torchrl import compile_cuda, cuda_stream

__all__ = [
    "LEAVES",
    "address",
    "blocks",
    "groups",
    "is_there",
    "padded",
    "run",
    "start",
]

_T = TypeVar("_T")
_Pointer = ctypes.c_void_p * 1

_logger = logging.getLogger("torchrl_caiac")

_SOURCE = Path(__file__).with_name("sampling.cu")
LEAVES = 16  # tensors that one start reads, as in the source
THREADS = {"batch_donors": 512, "hindsight_sources": 512}  # of a block, by kernel
_THREADS = 128
_MOST_BLOCKS = 1024
# The fields of each kernel's struct: q an integer or address, d a float64.
_FIELDS = {
    "state_matches": f"7q{3 * LEAVES}q",
    "rows_fit": f"8q{5 * LEAVES}q",
    "uninfluenced": "7q",
    "chosen_windows": "4q",
    "batch_donors": "7qd6q",
    "buffer_donors": "5qd9q",
    "hindsight_sources": "4q3d2q",
    "read_columns": "9q",
    "relabel_rows": "12q",
    "swap_rows": f"6q{8 * LEAVES}q",
    "look": f"q{5 * LEAVES}q",
}
_STRUCTS = {name: struct.Struct("=" + fields) for name, fields in _FIELDS.items()}
_BYTES = {name: ctypes.c_char * kind.size for name, kind in _STRUCTS.items()}


def is_there(device: torch.device) -> bool:
    """Returns whether the kernels can be used on a CUDA device.

    Args:
        device (torch.device): the device.

    Returns:
        bool: false for devices of other kinds, without the compiler, or with the
        environment variable ``TORCHRL_CAIAC_NATIVE=0``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac._sampling.on_cuda import is_there
        >>> is_there(torch.device("cpu"))
        False
    """
    return device.type == "cuda" and _kernels(device.index) is not None


def address(tensor: torch.Tensor | None) -> int:
    """Returns where the numbers of a tensor are; 0 for ``None``."""
    return 0 if tensor is None else tensor.data_ptr()


def blocks(items: int) -> int:
    """Returns a number of blocks for a number of items."""
    return max(1, min(_MOST_BLOCKS, -(-items // _THREADS)))


def groups(items: Sequence[_T]) -> Iterator[Sequence[_T]]:
    """Yields as many items as one start of a kernel reads."""
    return (items[i : i + LEAVES] for i in range(0, len(items), LEAVES))


def padded(numbers: Sequence[int]) -> list[int]:
    """Returns numbers of leaves, and zeros for those that are not there."""
    return [*numbers, *[0] * (LEAVES - len(numbers))]


def start(
    name: str,
    device: torch.device,
    grid: tuple[int, int],
    fields: Sequence[int | float],
) -> None:
    """Starts a kernel on the current stream of a device.

    Args:
        name (str): the kernel.
        device (torch.device): the device of all tensors.
        grid (tuple of int): the numbers of blocks.
        fields (sequence of int or float): the fields of its struct.

    Raises:
        RuntimeError: the driver refuses.
    """
    packed = _STRUCTS[name].pack(*fields)
    run(name, device, grid, _BYTES[name].from_buffer_copy(packed))


def run(name: str, device: torch.device, grid: tuple[int, int], argument: Any) -> None:
    """Starts a kernel with its struct."""
    kernels, index = _kernels(device.index), device.index
    assert kernels is not None and index is not None  # is_there() is true
    if index != torch.cuda.current_device():
        with torch.cuda.device(index):
            return run(name, device, grid, argument)
    error = _driver().cuLaunchKernel(
        kernels[name],
        *(*grid, 1),
        *(THREADS.get(name, _THREADS), 1, 1),
        0,
        cuda_stream(index),
        _Pointer(ctypes.addressof(argument)),
        None,
    )
    if error:
        raise RuntimeError(f"the CUDA driver refuses to start {name}: error {error}")


@cache
def _driver() -> ctypes.CDLL:
    library = ctypes.CDLL("libcuda.so.1")
    numbers = [ctypes.c_uint] * 7
    pointers = [ctypes.c_void_p] * 3
    library.cuLaunchKernel.argtypes = [ctypes.c_void_p, *numbers, *pointers]
    return library


@cache
def _kernels(index: int | None) -> dict[str, Any] | None:
    """Returns the compiled kernels, ``None`` if they cannot be compiled."""
    if os.environ.get("TORCHRL_CAIAC_NATIVE") == "0":
        return None
    try:
        _driver()
        with torch.cuda.device(index):
            return compile_cuda(_SOURCE.read_text(), list(_FIELDS))
    except (AttributeError, ImportError, OSError, RuntimeError, TypeError) as error:
        _logger.warning(
            "sampling from a CUDA device is slower, as its kernels are not compiled: "
            "%s",
            error,
        )
        return None
