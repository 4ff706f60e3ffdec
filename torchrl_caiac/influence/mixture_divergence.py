"""Works eq. 3 out of Gaussians: by one compiled kernel, or step by step."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Literal

import torch

__all__ = ["Approximation", "kernel_pays", "mixture_influence"]

Approximation = Literal["bounds", "product"]

_PAIR_TENSORS = 6  # tensors of [rows, K, K] alive at once, and some slack
_CPU_PAIR_BYTES = 2**20  # one such tensor on a CPU: larger ones leave its cache
_GAUSSIAN_TENSORS = 12  # tensors of [rows, K, P] alive at once around the kernel
_CPU_GAUSSIAN_BYTES = 2**20  # one such tensor on a CPU, likewise
_MOST_COLUMNS = 16  # the kernel is unrolled over an entity's columns
_LEAST_PAIRS = 2**28  # about 5 s without the kernel, as long as it takes to compile

_without_compiler: set[str] = set()  # device types on which compiling failed


def kernel_pays(num_pairs: int) -> bool:
    """Whether so many pairs of actions take longer than compiling the kernel.

    Args:
        num_pairs (int): the pairs of all states and entities, ``K * K`` each.

    Returns:
        bool: true from :math:`2^{28}` on.
    """
    return num_pairs >= _LEAST_PAIRS


@torch.no_grad()
def mixture_influence(
    loc: torch.Tensor,
    var: torch.Tensor,
    slices: Sequence[slice],
    *,
    approximation: Approximation,
    max_memory: int,
    fused: bool,
) -> torch.Tensor:
    """The influence on several entities, eq. 3 as in :func:`causal_action_influence`.

    The compiled kernel goes over all pairs of actions without writing one of them to
    memory. It is for float32 and entities of up to 16 columns; all else, and everything
    where no compiler works, is worked out step by step.

    Args:
        loc (torch.Tensor): means under ``K`` actions, ``[B, K, P]``, finite.
        var (torch.Tensor): variances, ``[B, K, P]``, positive and finite.
        slices (sequence of slice): the columns of each entity.

    Keyword Args:
        approximation (str): ``"bounds"`` or ``"product"``.
        max_memory (int): bytes of working memory, about.
        fused (bool): use the kernel where it can be had.

    Returns:
        torch.Tensor: nats, ``[B, N]`` of the dtype of ``loc``.
    """
    scores = loc.new_empty(len(loc), len(slices))
    by_width: dict[int, list[int]] = {}
    for entity, where in enumerate(slices):
        by_width.setdefault(where.stop - where.start, []).append(entity)
    fused = fused and loc.dtype == torch.float32 and len(loc) > 1
    kernels = {
        width: _kernel(width, loc.device.type)
        for width in by_width
        if fused and width <= _MOST_COLUMNS
    }
    for width, entities in by_width.items():
        if kernels.get(width) is None:
            for entity in entities:
                where = slices[entity]
                scores[:, entity] = _stepwise(
                    loc[..., where], var[..., where], approximation, max_memory
                )
    compiled = [
        (by_width[width], _columns(slices, by_width[width], loc.device), kernel)
        for width, kernel in kernels.items()
        if kernel is not None
    ]
    if compiled:
        most = max(1, max_memory // _GAUSSIAN_TENSORS)
        if loc.device.type == "cpu":
            most = min(most, _CPU_GAUSSIAN_BYTES)
        # Parts of about one size: a kernel for one row would be compiled anew.
        parts = math.ceil(loc.numel() * loc.element_size() / most)
        parts = min(parts, len(loc) // 2)
        split = (x.tensor_split(parts) for x in (loc, var, scores))
        for own_loc, own_var, own_scores in zip(*split, strict=True):
            gaussians = _columns_first(own_loc, own_var)
            for entities, columns, kernel in compiled:
                own_scores[:, entities] = _by_kernel(
                    gaussians, columns, kernel, approximation
                )
    return scores


def _columns(
    slices: Sequence[slice], entities: Sequence[int], device: torch.device
) -> torch.Tensor:
    """The columns of some entities of one width, ``[width, n]``."""
    own = [list(range(slices[i].start, slices[i].stop)) for i in entities]
    return torch.tensor(own, device=device).T


# --- by the compiled kernel ----------------------------------------------------------


def _columns_first(loc: torch.Tensor, var: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """What the kernel reads, each ``[P, b, K]``: it runs over contiguous memory."""
    loc, var = (x.permute(2, 0, 1).contiguous() for x in _standardised(loc, var))
    return loc, var, var.reciprocal(), var.log().mul_(0.5)


def _by_kernel(
    gaussians: tuple[torch.Tensor, ...],
    columns: torch.Tensor,
    kernel: Callable[..., tuple[torch.Tensor, torch.Tensor]],
    approximation: Approximation,
) -> torch.Tensor:
    """Scores ``[b, n]`` of n entities of one width, columns ``[width, n]``."""
    width, n = columns.shape
    loc, var, inverse, half_log = (
        x[columns.flatten()].view(width, -1, x.shape[-1]) for x in gaussians
    )
    upper, lower = kernel(loc, var, inverse, half_log.sum(0))
    k = loc.shape[-1]
    divergence = _average(upper.log_(), lower.log_(), k, width, approximation)
    score = divergence.mean(-1).clamp_max_(math.log(k))
    return score.view(n, -1).transpose(0, 1)


def _pair_sums(
    loc: torch.Tensor,
    var: torch.Tensor,
    inverse: torch.Tensor,
    half_log_det: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    r"""Sums of both approximations over the actions k, ``[b, K]`` for the actions i.

    One is of :math:`e^{-D_{KL}(p_i \| p_k)}`, the other of
    :math:`\int p_i p_k / \int p_i^2`. Both terms are 1 for k = i, the first at most 1
    and the second at most :math:`2^{d / 2}`: no maximum has to be taken out.
    """
    exponent = half_log_det[:, :, None] - half_log_det[:, None, :]
    product = torch.ones_like(exponent)
    quadratic = torch.zeros_like(exponent)
    for m, v, w in zip(loc, var, inverse, strict=True):
        v_i, v_k = v[:, :, None], v[:, None, :]
        square = (m[:, :, None] - m[:, None, :]).square()
        exponent = exponent - 0.5 * ((v_i + square) * w[:, None, :] - 1)
        shared = 1 / (v_i + v_k)
        product = product * (2 * v_i * shared)
        quadratic = quadratic + square * shared
    return (
        exponent.exp().sum(-1),
        (product.sqrt() * (-0.5 * quadratic).exp()).sum(-1),
    )


@cache
def _kernel(
    width: int, device: str
) -> Callable[..., tuple[torch.Tensor, torch.Tensor]] | None:
    """The kernel for entities of some width, for any rows and K; None without one."""
    if device in _without_compiler:
        return None
    # torch's annotations do not know isolate_recompiles yet.
    kernel = torch.compile(  # type: ignore[call-overload]
        _pair_sums, fullgraph=True, dynamic=True, isolate_recompiles=True
    )
    # Sizes of which no two are equal, so that none is taken for another.
    sizes = [(width, 19, 23)] * 3 + [(19, 23)]
    try:
        kernel(*(torch.ones(size, device=device) for size in sizes))
    except Exception as error:
        _without_compiler.add(device)
        warnings.warn(
            "influence is scored without its compiled kernel, eq. 3 about ten times "
            f"slower: torch.compile failed ({str(error).strip().splitlines()[0]}). "
            "Install what it needs (a C++ compiler and Python's headers, on CUDA also "
            "Triton), or pass compile=False",
            RuntimeWarning,
            stacklevel=2,
        )
        return None
    return kernel


# --- step by step --------------------------------------------------------------------


def _stepwise(
    loc: torch.Tensor, var: torch.Tensor, approximation: Approximation, max_memory: int
) -> torch.Tensor:
    """The influence ``[B]`` on one entity ``[B, K, d]``, with pairs in memory."""
    k = loc.shape[1]
    pair_bytes = max_memory // _PAIR_TENSORS
    if loc.device.type == "cpu":
        pair_bytes = min(pair_bytes, _CPU_PAIR_BYTES)
    pairs = max(1, pair_bytes // loc.element_size())
    rows = max(1, pairs // (k * k))
    own = min(k, max(1, pairs // k))  # below K only where one row is already too much
    out = loc.new_empty(len(loc))
    for start in range(0, len(loc), rows):
        part = slice(start, start + rows)
        out[part] = _stepwise_rows(loc[part], var[part], own, approximation)
    return out


def _stepwise_rows(
    loc: torch.Tensor, var: torch.Tensor, own: int, approximation: Approximation
) -> torch.Tensor:
    """Eq. 3 for some rows ``[b, K, d]``, ``own`` of the K actions ``i`` at a time."""
    k, d = loc.shape[-2:]
    loc, var = _standardised(loc, var)
    inverse = var.reciprocal()
    log_det = var.log().sum(-1)
    # Columns first, so that every step below runs over contiguous memory.
    loc_t, var_t, inverse_t = (x.movedim(-1, 0) for x in (loc, var, inverse))
    total = loc.new_zeros(len(loc))
    for start in range(0, k, own):
        i = slice(start, min(start + own, k))
        kl = torch.matmul(var[:, i], inverse.transpose(-1, -2))
        kl += log_det[:, None, :] - log_det[:, i, None] - d
        product: torch.Tensor | None = None  # of (v_i + v_k) / 2 v_i over columns
        log_ratio = torch.zeros_like(kl)
        quadratic = torch.zeros_like(kl)
        for column in range(d):
            m, v = loc_t[column], var_t[column]
            m_i, v_i = m[:, i, None], v[:, i, None]
            square = (m_i - m[:, None, :]).square_()
            kl.addcmul_(square, inverse_t[column][:, None, :])
            both = v_i + v[:, None, :]
            quadratic.addcdiv_(square, both)
            both *= 0.5 * inverse_t[column][:, i, None]
            product = both if product is None else product.mul_(both)
            # One logarithm for several columns, before the product can overflow.
            if column % 2 or column == d - 1:
                log_ratio += product.log_()
                product = None
        log_ratio += quadratic
        total += _average(
            torch.logsumexp(kl.mul_(-0.5), -1),
            torch.logsumexp(log_ratio.mul_(-0.5), -1),
            k,
            d,
            approximation,
        ).sum(-1)
    return (total / k).clamp_max_(math.log(k))


# --- common to both ------------------------------------------------------------------


def _standardised(
    loc: torch.Tensor, var: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Centres, in units of the mean variance: each column's numbers are near 1.

    The result stays the same and float32 is enough, whatever the units are.
    """
    unit = var.mean(-2, keepdim=True)
    loc = (loc - loc.mean(-2, keepdim=True)) * unit.rsqrt()
    return loc, (var / unit).clamp_min_(1e8 * torch.finfo(var.dtype).tiny)


def _average(
    log_upper: torch.Tensor,
    log_lower: torch.Tensor,
    k: int,
    d: int,
    approximation: Approximation,
) -> torch.Tensor:
    """The mean of both approximations, from the logarithms of their sums over k."""
    log_k = math.log(k)
    gap = 0.5 * d * (1 - math.log(2)) if approximation == "bounds" else 0.0
    upper = (log_k - log_upper).clamp_min_(0)
    lower = (log_k - gap - log_lower).clamp_min_(0)
    return upper.add_(lower).mul_(0.5)
