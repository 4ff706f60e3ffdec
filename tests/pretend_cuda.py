"""A stand-in for a CUDA device, for tests marked ``gpu`` where there is none.

Its tensors say that they lie on ``cuda:0`` and keep their values on the CPU. An
operation raises where its operands lie on two devices, and within
:func:`nothing_waits` where the host would wait for the device, as a CUDA device does.
The package's own kernels run on the CPU, by one thread.
What it cannot do: gradients, other compiled kernels, and to be as fast.
"""

from __future__ import annotations

import ctypes
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import torch
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

from torchrl_caiac._sampling import native, on_cuda

# Operations whose result, or its size, the host has to see.
LOOKS = {
    *("_local_scalar_dense", "equal", "nonzero", "masked_select", "bincount"),
    *("_unique", "_unique2", "unique_dim", "unique_consecutive", "repeat_interleave"),
}
INDEXES = {"index", "index_put", "index_put_"}

_must_not_wait = False


@contextmanager
def nothing_waits() -> Iterator[None]:
    """Raises where the host would wait for the device, be it there or not."""
    global _must_not_wait
    if torch.cuda.is_available():
        torch.cuda.set_sync_debug_mode("error")
    _must_not_wait = True
    try:
        yield
    finally:
        _must_not_wait = False
        if torch.cuda.is_available():
            torch.cuda.set_sync_debug_mode("default")


@contextmanager
def pretend_cuda() -> Iterator[None]:
    """Lets ``"cuda"`` be used as if there were a device."""
    lifts = torch._C._only_lift_cpu_tensors()
    overwrites = torch.__future__.get_overwrite_module_params_on_conversion()
    # Have torch.tensor(..., device="cuda") copy to the device where that can be seen,
    torch._C._set_only_lift_cpu_tensors(True)
    # modules get new parameters, of another class, when they are moved,
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    # and no operation make a device that is not there the current one.
    torch._C._ensureCUDADeviceGuardSet()
    try:
        with (
            mock.patch("torch.cuda._lazy_init"),
            mock.patch("torch.cuda.current_device", return_value=0),
            mock.patch("torch.cuda.synchronize"),
            mock.patch.object(native, "PLAIN", {torch.Tensor, OnCuda}),
            mock.patch.object(on_cuda, "is_there", _is_there),
            mock.patch.object(on_cuda, "run", _run),
            torch.backends.cudnn.flags(enabled=False),
            _MadeOnCuda(),
        ):
            yield
    finally:
        torch._C._set_only_lift_cpu_tensors(lifts)
        torch.__future__.set_overwrite_module_params_on_conversion(overwrites)


def _is_there(device: torch.device) -> bool:
    return device.type == "cuda"


def _run(name: str, device: torch.device, grid: tuple[int, int], argument: Any) -> None:
    _kernels()[f"run_{name}"](argument, *grid)


@cache
def _kernels() -> Any:
    """Compiles the kernels for the CPU: a block has one thread, which does all."""
    source = Path(on_cuda.__file__).with_name("sampling.cu")
    names = re.findall(r"__global__ void (\w+)\(const (\w+) a\)", source.read_text())
    text = f"""
        struct Index {{ unsigned x, y, z; }};
        static Index threadIdx, blockIdx, blockDim = {{1, 1, 1}}, gridDim;
        #define __device__
        #define __global__
        #define __shared__ static
        #define __syncthreads()
        #define __trap() __builtin_trap()
        template <class T> static void atomicAdd(T *sum, T value) {{ *sum += value; }}
        #include "{source}"
    """
    for name, argument in names:
        text += f"""
            extern "C" void run_{name}(const {argument} *a, unsigned x, unsigned y)
            {{
                gridDim = {{x, y, 1}};
                for (blockIdx.y = 0; blockIdx.y < y; blockIdx.y++)
                    for (blockIdx.x = 0; blockIdx.x < x; blockIdx.x++)
                        {name}(*a);
            }}
        """
    with TemporaryDirectory() as folder:
        file, made = Path(folder, "kernels.cpp"), Path(folder, "kernels.so")
        file.write_text(text)
        command = ["g++", "-O1", "-ffp-contract=off", "-shared", "-fPIC", str(file)]
        subprocess.run([*command, "-o", str(made)], check=True)
        return ctypes.CDLL(str(made))


class OnCuda(torch.Tensor):
    """A tensor that says that it lies on ``cuda:0``."""

    values: torch.Tensor  # on the CPU

    @staticmethod
    def __new__(cls, values: torch.Tensor) -> OnCuda:
        made: OnCuda = torch.Tensor._make_wrapper_subclass(
            cls,
            values.shape,
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device=torch.device("cuda", 0),
        )
        made.values = values
        return made

    def __repr__(self, **kwargs: Any) -> str:
        return f"OnCuda({self.values!r})"

    def data_ptr(self) -> int:
        return self.values.data_ptr()

    def tolist(self) -> Any:
        if _must_not_wait:
            raise RuntimeError("tolist waits for the device")
        return self.values.tolist()

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _computed(func, args, kwargs or {})


class _MadeOnCuda(TorchDispatchMode):
    """Has tensors that are made on, or moved to, the device lie there."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _computed(func, args, kwargs or {})


def _computed(func: Any, args: Any, kwargs: Any) -> Any:
    name = func.overloadpacket.__name__
    operands = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    on_cuda = any(isinstance(x, OnCuda) for x in operands)
    wanted = kwargs.get("device")
    if wanted is None:
        to_cuda = isinstance(args[0], OnCuda) if name == "copy_" else on_cuda
    else:
        to_cuda = torch.device(wanted).type == "cuda"
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if name == "_foreach_copy_":
        for own, other in zip(args[0], args[1], strict=True):
            own.copy_(other, *args[2:], **kwargs)
        return None
    if name in ("copy_", "_to_copy"):
        crosses = isinstance(args[1 if name == "copy_" else 0], OnCuda) != to_cuda
        asynchronous = args[2] if len(args) > 2 else kwargs.get("non_blocking", False)
        waits = crosses and not asynchronous
    else:
        if on_cuda:
            _check_devices(name, operands)
        masks = name in INDEXES and any(
            x is not None and (not isinstance(x, OnCuda) or x.dtype == torch.bool)
            for x in args[1]
        )
        waits = on_cuda and (masks or name in LOOKS)
    if waits and _must_not_wait:
        raise RuntimeError(f"{name} waits for the device")
    if to_cuda and isinstance(kwargs.get("generator"), torch.Generator):
        raise RuntimeError(f"{name} expected a generator of a CUDA device")
    if kwargs.get("pin_memory"):
        kwargs = {**kwargs, "pin_memory": False}
    if name == "_thnn_fused_lstm_cell":
        func = _lstm_cell
    plain_args, plain_kwargs = tree_map_only(OnCuda, lambda x: x.values, (args, kwargs))
    out = func(*plain_args, **plain_kwargs)
    if to_cuda:
        out = tree_map_only(torch.Tensor, OnCuda, out)
    if func is _lstm_cell or not on_cuda:
        return out
    return return_and_correct_aliasing(func, args, kwargs, out)


def _lstm_cell(
    of_input: torch.Tensor,
    of_hidden: torch.Tensor,
    cell: torch.Tensor,
    *biases: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    # What CUDA devices have a kernel for, and CPUs have not.
    gates = of_input + of_hidden + sum(biases)
    enter, forget, new, leave = gates.chunk(4, -1)
    cell = forget.sigmoid() * cell + enter.sigmoid() * new.tanh()
    return leave.sigmoid() * cell.tanh(), cell, gates


def _check_devices(name: str, operands: list[torch.Tensor]) -> None:
    # A number may lie on the CPU, and so may places to index with.
    astray = [x for x in operands if not isinstance(x, OnCuda) and x.ndim]
    if astray and name not in INDEXES:
        raise RuntimeError(
            f"{name} expected all tensors to be on the same device, found shapes "
            f"{[list(x.shape) for x in astray]} on the CPU among "
            f"{[list(x.shape) for x in operands]}"
        )
