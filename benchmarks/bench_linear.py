"""Linear layers, to ``F.linear``: what computes them, by shape, strides and gradients.

Run with ``pytest benchmarks/bench_linear.py`` (``make bench``). ``linear`` of
:mod:`torchrl_caiac.modules.linear` and, for scoring, ``inference_linear`` must not be
slower than ``F.linear`` anywhere. Their candidates are listed, with times as ratios to
``F.linear``:

- ``onednn``: ``F.linear`` with ``torch.backends.mkldnn.matmul.fp32_precision="bf16"``,
  on processors where that still computes in float32;
- ``private``: the operator to which ``torch.compile`` lowers a float32 layer, also of
  oneDNN, and ``packed`` the same with the weight in its own layout (no gradients);
- ``bfloat16``: factors are cast, as hidden layers with ``hidden_dtype=torch.bfloat16``
  do.

Times are the least of 25 rounds, of the processor for the only thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F

from benchmarks.ratios import seconds
from torchrl_caiac._kernels import onednn_has_float32
from torchrl_caiac._torchrl import packed_linear
from torchrl_caiac.modules import linear_kernel
from torchrl_caiac.modules.linear import inference_linear, linear

CASES = {  # rows, inputs and outputs; how the input is cut from a larger matrix
    "4 x 256 x 256": (4, 256, 256, "all"),
    "16 x 256 x 256": (16, 256, 256, "all"),
    "64 x 256 x 256": (64, 256, 256, "all"),
    "256 x 256 x 256": (256, 256, 256, "all"),
    "512 x 256 x 256": (512, 256, 256, "all"),
    "1,024 x 256 x 256": (1024, 256, 256, "all"),
    "4,096 x 256 x 256": (4096, 256, 256, "all"),
    "512 x 52 x 256": (512, 52, 256, "all"),
    "512 x 256 x 11": (512, 256, 11, "all"),
    "512 x 256 x 1": (512, 256, 1, "all"),
    "512 x 512 x 512": (512, 512, 512, "all"),
    "every fourth row, 256 x 256 x 256": (256, 256, 256, "every fourth row"),
    "every other column, 256 x 256 x 256": (256, 256, 256, "every other column"),
    "half of the columns, 256 x 256 x 256": (256, 256, 256, "half of the columns"),
    "transposed, 256 x 256 x 256": (256, 256, 256, "transposed"),
    "one row for all, 256 x 256 x 256": (256, 256, 256, "one row for all"),
}
CUTS = {
    "all": lambda rows, width: torch.randn(rows, width),
    "every fourth row": lambda rows, width: torch.randn(4 * rows, width)[::4],
    "every other column": lambda rows, width: torch.randn(rows, 2 * width)[:, ::2],
    "half of the columns": lambda rows, width: torch.randn(rows, 2 * width)[:, :width],
    "transposed": lambda rows, width: torch.randn(width, rows).t(),
    "one row for all": lambda rows, width: torch.randn(1, width).expand(rows, width),
}
Product = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]
_PER_CALL = 2e7  # multiply-adds, for the clock to have no part in the time


def torchs(
    value: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor
) -> torch.Tensor:
    return F.linear(value, weight, bias).relu_()


def in_bfloat16(*factors: torch.Tensor) -> torch.Tensor:
    return torchs(*(x.bfloat16() for x in factors)).float()


def fixed(kernel: Any) -> Product:
    def product(*factors: torch.Tensor) -> torch.Tensor:
        with linear_kernel(kernel):
            return linear(*factors, relu=True)

    return product


def candidates(
    value: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, *, training: bool
) -> dict[str, Product]:
    found: dict[str, Product] = {
        "F.linear": torchs,
        "linear": lambda *x: linear(*x, relu=True),
        "bfloat16": in_bfloat16,
    }
    if onednn_has_float32():
        found["onednn"] = fixed("onednn")
    if not training:
        apply = inference_linear(weight, bias, True, len(value))
        found["inference_linear"] = lambda value, *_: apply(value)
    if not training and torch.backends.mkldnn.is_available():
        packed = packed_linear(weight, bias, True)
        found["packed"] = lambda value, *_: packed(value)
    return found


@pytest.mark.parametrize("training", [False, True], ids=["scoring", "training"])
@pytest.mark.parametrize("case", CASES)
def bench_linear(benchmark, judge, note, case, training):
    """All candidates in turns."""
    rows, inputs, outputs, cut = CASES[case]
    value = CUTS[cut](rows, inputs).requires_grad_(training)
    weight = torch.randn(outputs, inputs).requires_grad_(training)
    bias = torch.randn(outputs).requires_grad_(training)
    slope = torch.randn(rows, outputs)
    factors = (value, weight, bias)
    repeats = max(1, int(_PER_CALL / (rows * inputs * outputs * (1 + 2 * training))))

    def repeated(product: Product) -> Callable[[], None]:
        def call() -> None:
            for _ in range(repeats):
                out = product(*factors)
                if training:
                    torch.autograd.grad(out, factors, slope)

        return call

    calls = {
        name: repeated(product)
        for name, product in candidates(*factors, training=training).items()
    }
    times = seconds(calls, rounds=25, warmup=3, clock=time.thread_time, statistic=min)
    ratios = {name: value / times["F.linear"] for name, value in times.items()}
    what = f"{'training' if training else 'scoring'}, {case}"
    for name in ("linear", "inference_linear"):
        if name in ratios:
            judge(f"{name}, {what} / F.linear", ratios.pop(name), at_most=1.1)
    del ratios["F.linear"]
    note("  " + ", ".join(f"{name} {value:.2f}" for name, value in ratios.items()))
    benchmark.extra_info["us"] = {
        name: round(1e6 * value / repeats, 1) for name, value in times.items()
    }
    benchmark.pedantic(calls["linear"], rounds=5)
