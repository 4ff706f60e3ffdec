"""Linear layers on contiguous and strided input, beside torch's own."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from torchrl_caiac.modules.linear import linear

INPUTS = {
    "contiguous": lambda: torch.randn(256, 256),
    "every_fourth_row": lambda: torch.randn(1024, 256)[::4],
    "every_other_column": lambda: torch.randn(256, 512)[:, ::2],
    "some_columns": lambda: torch.randn(256, 512)[:, :256],
}


@pytest.mark.parametrize("product", [linear, F.linear], ids=["ours", "torch"])
@pytest.mark.parametrize("kind", INPUTS)
def bench_linear(benchmark, device, kind, product):
    value = INPUTS[kind]().to(device)
    weight = torch.randn(256, 256, device=device, requires_grad=True)
    bias = torch.randn(256, device=device, requires_grad=True)

    def step():
        product(value, weight, bias).sum().backward()

    benchmark(step)
