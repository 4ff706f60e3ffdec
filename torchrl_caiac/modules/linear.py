"""Linear layers with the faster of two libraries on a CPU."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrl_caiac._torchrl import linear_pointwise

__all__ = ["linear"]

# Multiply-adds below which the overhead of a call outweighs the faster kernel.
_SMALL = 2**20


def linear(value: Tensor, weight: Tensor, bias: Tensor, relu: bool = False) -> Tensor:
    """Returns ``value @ weight.T + bias``, or its positive part.

    On CPUs torch computes float32 products with MKL, which uses half the width of an
    AMD processor's AVX-512 units. oneDNN, torch's library for bfloat16, uses the full
    width in the same precision, so it computes large float32 products here.

    Args:
        value (torch.Tensor): the input, ``[*B, I]``.
        weight (torch.Tensor): the weight, ``[O, I]``.
        bias (torch.Tensor): the bias, ``[O]``.
        relu (bool): whether to take the positive part. Defaults to ``False``.

    Returns:
        torch.Tensor: ``[*B, O]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.linear import linear
        >>> linear(torch.ones(2, 2), -torch.ones(1, 2), torch.ones(1), relu=True)
        tensor([[0.],
                [0.]])
    """
    if value.numel() * len(weight) < _SMALL or not _onednn(value, weight, bias):
        out = F.linear(value, weight, bias)
        return out.relu_() if relu else out
    rows = value.reshape(-1, value.shape[-1])
    out = _Linear.apply(rows, weight, bias, relu)
    return out.reshape(*value.shape[:-1], len(weight))


def _onednn(*operands: Tensor) -> bool:
    """Returns whether oneDNN is available and may be faster than MKL."""
    return (
        # First: the compiler chooses its own kernels, and cannot trace the others.
        not torch.compiler.is_compiling()
        and all(x.device.type == "cpu" and x.dtype == torch.float32 for x in operands)
        and torch.backends.mkldnn.is_available()
        and torch.backends.cpu.get_cpu_capability() == "AVX512"
        and not torch.is_autocast_enabled("cpu")
    )


def _dense(matrix: Tensor) -> Tensor:
    """Returns a matrix, or a copy where its elements are not next to each other.

    On other strides oneDNN is hundreds of times slower.
    """
    is_dense = matrix.is_contiguous() or matrix.t().is_contiguous()
    return matrix if is_dense else matrix.contiguous()


class _Linear(torch.autograd.Function):
    """The product of oneDNN for ``[B, I]``, with gradients and :func:`torch.vmap`."""

    @staticmethod
    def forward(
        value: Tensor, weight: Tensor, bias: Tensor | None, relu: bool
    ) -> Tensor:
        return linear_pointwise(_dense(value), _dense(weight), bias, relu)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        value, weight, _, relu = inputs
        ctx.save_for_backward(value, weight, output if relu else None)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        value, weight, positive = ctx.saved_tensors
        if positive is not None:
            grad = torch.ops.aten.threshold_backward(grad, positive, 0)
        needed = ctx.needs_input_grad
        return (
            _Linear.apply(grad, weight.t(), None, False) if needed[0] else None,
            _Linear.apply(grad.t(), value.t(), None, False) if needed[1] else None,
            grad.sum(0) if needed[2] else None,
            None,
        )

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], *operands: Any
    ) -> tuple[Tensor, int]:
        parts = [
            [x] * info.batch_size if dim is None else x.unbind(dim)
            for x, dim in zip(operands, in_dims, strict=True)
        ]
        layers = zip(*parts, strict=True)
        return torch.stack([_Linear.apply(*layer) for layer in layers]), 0
