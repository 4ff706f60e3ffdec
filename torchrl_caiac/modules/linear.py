"""Linear layers, computed by the faster of two libraries on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchrl_caiac._kernels import (
    choose,
    kernel_mode,
    known_kernel,
    onednn_has_float32,
    through_onednn,
)
from torchrl_caiac._torchrl import packed_linear, transforms_are_active

__all__ = ["faster_dtype", "inference_linear", "linear"]

# Multiply-adds below which the overhead of a call outweighs the faster kernel.
_SMALL = 2**21
# Rows from which on the fastest kernel stays the same.
_ALIKE = 1024


def linear(value: Tensor, weight: Tensor, bias: Tensor, relu: bool = False) -> Tensor:
    """Returns ``value @ weight.T + bias``, or its positive part.

    Large float32 products on a CPU, and those of their gradients, are computed by MKL
    or oneDNN, whichever is faster on this processor for their shape; see
    :func:`~torchrl_caiac.modules.linear_kernel`.

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
    # The first condition is cheap, since it delays every small product.
    if value.numel() * weight.shape[0] < _SMALL or not _has_choice(value):
        out = F.linear(value, weight, bias)
        return out.relu_() if relu else out
    rows = value if value.ndim == 2 else value.reshape(-1, value.shape[-1])
    has_grad = torch.is_grad_enabled()
    product = _Product.of(
        len(rows),
        weight,
        _layout(rows),
        relu,
        has_grad and rows.requires_grad,
        has_grad and (weight.requires_grad or bias.requires_grad),
    )
    if known_kernel(product, product.name, product.others) == "plain":
        return _plain(value, weight, bias, relu)
    out = _onednn(rows, weight, bias, relu)
    return out if value.ndim == 2 else out.reshape(*value.shape[:-1], len(weight))


def inference_linear(
    weight: Tensor, bias: Tensor, relu: bool, rows: int
) -> Callable[[Tensor], Tensor]:
    """Returns a function that applies a linear layer to inputs, without gradients.

    Args:
        weight (torch.Tensor): the weight, ``[O, I]``.
        bias (torch.Tensor): the bias, ``[O]``.
        relu (bool): whether to take the positive part.
        rows (int): the usual number of rows of an input. What is fastest for it is used
            for all inputs.

    Returns:
        callable: maps ``[*B, I]`` to ``[*B, O]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.linear import inference_linear
        >>> inference_linear(torch.ones(1, 2), torch.ones(1), False, 8)(torch.ones(2))
        tensor([3.])
    """
    is_onednn = False
    if rows * weight.numel() >= _SMALL and _has_choice(weight):
        product = _Product.of(rows, weight, "packed", relu)
        is_onednn = known_kernel(product, product.name, product.others) == "onednn"
    if is_onednn:
        return packed_linear(weight, bias, relu)
    return partial(_plain, weight=weight, bias=bias, relu=relu)


def faster_dtype(rows: int, width: int) -> torch.dtype:
    """Returns the dtype in which a hidden layer is trained faster on this CPU.

    Args:
        rows (int): the size of a batch.
        width (int): the number of units, of the layer and of the one before.

    Returns:
        torch.dtype: ``torch.bfloat16`` if float32 takes at least 1.11 times as long,
        casts included, else ``torch.float32``. It is measured once for each processor,
        see :func:`~torchrl_caiac.modules.linear_kernel`.

    Examples:
        >>> from torchrl_caiac.modules import faster_dtype
        >>> faster_dtype(1, 2) in (torch.float32, torch.bfloat16)
        True
    """

    def candidates() -> dict[str, Callable[[], Any]]:
        operands = _operands(rows, width, width, "dense")

        def in_bfloat16(value: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
            value, weight, bias = (x.bfloat16() for x in (value, weight, bias))
            return _plain(value, weight, bias, True).float()

        return {
            "float32": _step(partial(linear, relu=True), operands, (True, True)),
            "bfloat16": _step(in_bfloat16, operands, (True, True)),
        }

    # Another linear_kernel is another candidate.
    kind = f"{rows}x{width}x{width} hidden layer {kernel_mode()}"
    dtype: torch.dtype = getattr(torch, choose(kind, "float32", candidates))
    return dtype


class _Product(NamedTuple):
    """A kind of product, for which one kernel is the fastest.

    Args:
        rows (int): the number of rows, rounded down to a power of two.
        outputs (int): the number of outputs.
        inputs (int): the number of inputs.
        layout (str): how the rows lie in memory, see :func:`_layout`; or ``"packed"``
            for dense rows and a weight in oneDNN's layout.
        relu (bool): whether the positive part is taken.
        of_value (bool): whether there is a gradient of the input.
        of_weight (bool): whether there is one of weight and bias.
        threads (int): the number of threads, which a file of choices is for.
    """

    rows: int
    outputs: int
    inputs: int
    layout: str
    relu: bool
    of_value: bool
    of_weight: bool
    threads: int

    @classmethod
    def of(
        cls,
        rows: int,
        weight: Tensor,
        layout: str,
        relu: bool,
        of_value: bool = False,
        of_weight: bool = False,
    ) -> _Product:
        """Returns the kind of a product."""
        rows = 1 << (min(rows, _ALIKE).bit_length() - 1)
        outputs, inputs = weight.shape
        threads = torch.get_num_threads()
        return cls(rows, outputs, inputs, layout, relu, of_value, of_weight, threads)

    def name(self) -> str:
        """Returns the name in files."""
        grads = ["input"] * self.of_value + ["weight"] * self.of_weight
        words = [
            f"{self.rows}x{self.inputs}x{self.outputs}",
            self.layout,
            *["relu"] * self.relu,
            *(f"{name}-gradient" for name in grads),
        ]
        return " ".join(words)

    def others(self) -> dict[str, Callable[[], Any]]:
        """Returns calls that compute such a product, and its gradients."""
        operands = _operands(self.rows, self.inputs, self.outputs, self.layout)
        value, weight, bias = operands
        if self.layout == "packed":
            return {
                "plain": partial(_plain, *operands, self.relu),
                "onednn": partial(packed_linear(weight, bias, self.relu), value),
            }
        needed = (self.of_value, self.of_weight)
        return {
            "plain": _step(partial(_plain, relu=self.relu), operands, needed),
            "onednn": _step(partial(_onednn, relu=self.relu), operands, needed),
        }


def _layout(rows: Tensor) -> str:
    """Returns how a matrix lies in memory; libraries copy some."""
    if rows.is_contiguous():
        return "dense"
    if rows.t().is_contiguous():
        return "transposed"
    return "spaced-rows" if rows.stride(1) == 1 else "spaced-columns"


def _operands(
    rows: int, inputs: int, outputs: int, layout: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns a random input of a layout, a weight and a bias."""
    generator = np.random.default_rng(0)

    def draw(*shape: int) -> Tensor:
        return torch.from_numpy(generator.standard_normal(shape, dtype=np.float32))

    if layout == "transposed":
        value = draw(inputs, rows).t()
    elif layout in ("dense", "packed"):
        value = draw(rows, inputs)
    else:
        value = draw(rows, 2 * inputs)
        value = value[:, ::2] if layout == "spaced-columns" else value[:, :inputs]
    return value, draw(outputs, inputs), draw(outputs)


def _step(
    product: Callable[..., Tensor],
    operands: tuple[Tensor, ...],
    needed: tuple[bool, bool],
) -> Callable[[], Any]:
    """Returns a call that computes a product and the gradients that are needed."""
    factors = [
        x.requires_grad_(is_needed)
        for x, is_needed in zip(
            (x.detach() for x in operands), (*needed, needed[1]), strict=True
        )
    ]
    wanted = [x for x in factors if x.requires_grad]
    slope = operands[0].new_ones(len(operands[0]), len(operands[1]))

    def call() -> None:
        with torch.enable_grad():
            out = product(*factors)
        if wanted:
            torch.autograd.grad(out, wanted, slope)

    return call


def _has_choice(value: Tensor) -> bool:
    """Returns whether another kernel than torch's may be faster for an input."""
    return (
        # First: the compiler chooses its own kernels, and cannot trace the others.
        not torch.compiler.is_compiling()
        and value.dtype is torch.float32
        and value.device.type == "cpu"
        and not torch.is_autocast_enabled("cpu")
        and not transforms_are_active()
        and onednn_has_float32()
    )


def _plain(value: Tensor, weight: Tensor, bias: Tensor, relu: bool) -> Tensor:
    out = F.linear(value, weight, bias)
    return out.relu_() if relu else out


def _onednn(value: Tensor, weight: Tensor, bias: Tensor, relu: bool) -> Tensor:
    operands = (value, weight, bias)
    if torch.is_grad_enabled() and any(x.requires_grad for x in operands):
        out: Tensor = _Linear.apply(value, weight, bias, relu)
        return out
    with through_onednn():
        return _plain(value, weight, bias, relu)


class _Linear(torch.autograd.Function):
    """The product of oneDNN for ``[R, I]``, with those of its gradients."""

    @staticmethod
    def forward(
        ctx: Any, value: Tensor, weight: Tensor, bias: Tensor, relu: bool
    ) -> Tensor:
        with through_onednn():
            out = _plain(value, weight, bias, relu)
        ctx.save_for_backward(value, weight, out if relu else None)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        value, weight, positive = ctx.saved_tensors
        if positive is not None:
            grad = torch.ops.aten.threshold_backward(grad, positive, 0)
        needed = ctx.needs_input_grad
        with through_onednn():
            return (
                grad @ weight if needed[0] else None,
                grad.t() @ value if needed[1] else None,
                grad.sum(0) if needed[2] else None,
                None,
            )
