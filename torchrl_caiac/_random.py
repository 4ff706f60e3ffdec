"""Random numbers on one device from generators of another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

__all__ = ["draw_integers", "draw_numbers"]

_RANDOM_BITS = 1 << 62


def draw_numbers(
    kind: Callable[..., torch.Tensor],
    *args: Any,
    device: torch.device,
    generator: torch.Generator | None = None,
    **kwargs: Any,
) -> torch.Tensor:
    """Random numbers where they are needed, whatever the generator's device.

    A generator draws on its own device only, so that one of the CPU gives the same
    numbers on all devices. They are copied without waiting for an accelerator.

    Args:
        kind (callable): what makes them, such as :func:`torch.rand`.
        *args: of ``kind``, such as a shape.

    Keyword Args:
        device (torch.device): where they are needed.
        generator (torch.Generator, optional): where they come from; the global one of
            the device by default.
        **kwargs: more of ``kind``, such as ``dtype``.

    Returns:
        torch.Tensor: on ``device``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac._random import draw_numbers
        >>> generator = torch.Generator().manual_seed(0)
        >>> cpu = torch.device("cpu")
        >>> draw_numbers(torch.randint, 9, (3,), device=cpu, generator=generator)
        tensor([8, 0, 2])
    """
    source = device if generator is None else generator.device
    pinned = source.type == "cpu" and device.type == "cuda"
    drawn = kind(*args, generator=generator, device=source, pin_memory=pinned, **kwargs)
    return drawn.to(device, non_blocking=pinned)


def draw_integers(
    shape: Sequence[int],
    *,
    device: torch.device,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Random integers so large that their remainders are uniform for all purposes.

    Args:
        shape (sequence of int): the shape.

    Keyword Args:
        device (torch.device): where they are needed.
        generator (torch.Generator, optional): where they come from.

    Returns:
        torch.Tensor: int64, from 0 to 2**62.

    Examples:
        >>> import torch
        >>> from torchrl_caiac._random import draw_integers
        >>> draw = draw_integers((4,), device=torch.device("cpu"))
        >>> bool((draw % 3 < 3).all())
        True
    """
    return draw_numbers(
        torch.randint, _RANDOM_BITS, shape, device=device, generator=generator
    )
