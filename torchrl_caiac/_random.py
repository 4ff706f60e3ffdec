"""Random numbers on one device from a generator of another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

__all__ = ["draw_below", "draw_integers", "draw_numbers"]

_RANDOM_BITS = 1 << 62


def draw_numbers(
    kind: Callable[..., torch.Tensor],
    *args: Any,
    device: torch.device,
    generator: torch.Generator | None = None,
    **kwargs: Any,
) -> torch.Tensor:
    """Draws random numbers for one device with a generator of any device.

    A generator draws on its own device, so a CPU generator returns the same numbers for
    all devices. They are copied without synchronising an accelerator.

    Args:
        kind (callable): the random function, such as :func:`torch.rand`.
        *args (Any): its arguments, such as a shape.

    Keyword Args:
        device (torch.device): the device of the result.
        generator (torch.Generator, optional): the generator. Defaults to ``None``: the
            global one of ``device``.
        **kwargs (Any): further arguments of ``kind``, such as ``dtype``.

    Returns:
        torch.Tensor: the numbers.

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
    return drawn if source == device else drawn.to(device, non_blocking=pinned)


def draw_integers(
    shape: Sequence[int],
    *,
    device: torch.device,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draws random integers so large that their remainders are practically uniform.

    Args:
        shape (sequence of int): the shape.

    Keyword Args:
        device (torch.device): the device of the result.
        generator (torch.Generator, optional): the generator. Defaults to ``None``: the
            global one of ``device``.

    Returns:
        torch.Tensor: the integers, int64, at least 0 and below ``2**62``.

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


def draw_below(
    limit: torch.Tensor, *, generator: torch.Generator | None = None
) -> torch.Tensor:
    """Draws random integers below limits, each with practically the same probability.

    Args:
        limit (torch.Tensor): int64 ``[*]``, from -1 to ``2**48``.

    Keyword Args:
        generator (torch.Generator, optional): the generator. Defaults to ``None``: the
            global one of the limits' device.

    Returns:
        torch.Tensor: int64 ``[*]``, from 0 to ``limit - 1``; 0 where the limit is 0 or
        -1.

    Examples:
        >>> import torch
        >>> from torchrl_caiac._random import draw_below
        >>> draw_below(torch.tensor([1, 0]))
        tensor([0, 0])
    """
    share = draw_numbers(
        torch.rand,
        limit.shape,
        device=limit.device,
        generator=generator,
        dtype=torch.float64,
    )
    return (share * limit).long()
