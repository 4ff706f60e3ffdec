"""Causal action influence of Gaussians (eq. 3 of the paper)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Literal

import torch

__all__ = [
    "Approximation",
    "causal_action_influence",
    "check_gaussians",
    "kernel_pays",
    "mixture_influence",
]

Approximation = Literal["bounds", "product"]

_PAIR_TENSORS = 6  # tensors of [rows, K, K] at the same time, with a margin
_CPU_PAIR_BYTES = 2**20  # one such tensor that fits into a CPU's cache
_GAUSSIAN_TENSORS = 12  # tensors of [rows, K, P] at the same time with the kernel
_CPU_GAUSSIAN_BYTES = 2**20  # one such tensor that fits into a CPU's cache
_MOST_COLUMNS = 16  # the kernel is unrolled over the columns of an entity
_LEAST_PAIRS = 2**28  # about 5 s without the kernel, as long as compiling it takes

_without_compiler: set[str] = set()  # device types on which compiling failed


@torch.no_grad()
def causal_action_influence(
    loc: torch.Tensor,
    var: torch.Tensor,
    *,
    approximation: Approximation = "bounds",
    max_memory: int = 256 * 2**20,
    compile: bool | None = None,
) -> torch.Tensor:
    r"""Returns the influence of the action on one entity, equation 3 of the paper.

    .. math:: C^j(s) = \frac{1}{K} \sum_{i=1}^{K} D_{KL}\Big(p_i \,\Big\|\,
        \frac{1}{K} \sum_{k=1}^{K} p_k\Big)

    where :math:`p_i` is the diagonal Gaussian of the entity's next state under action
    ``i``. The divergence from a mixture has no closed form. Following Durrieu, Thiran
    and Kelly (2012), it is the mean of two approximations,

    .. math:: D_{var} = -\log \frac{1}{K} \sum_k e^{-D_{KL}(p_i \| p_k)}, \qquad
        D_{prod} = -\log \frac{1}{K} \sum_k \frac{\int p_i p_k}{z_i},

    each clipped below at 0. With ``"bounds"``, :math:`\log z_i` is the negative entropy
    of :math:`p_i`. :math:`D_{prod}` is then a lower bound of the divergence;
    :math:`D_{var}` is always an upper bound. Seitzer et al. (2021), and hence the
    paper's thresholds, use this form. It is accurate where the next state depends
    smoothly on the action. With ``"product"``, :math:`z_i = \int p_i^2`, Durrieu's form
    for two mixtures, which is larger by :math:`d (1 - \log 2) / 2` before the clipping.
    It is exact where the actions form well separated groups, and about 1.5 times too
    high where the dependence is smooth. Both give 0 where the action changes nothing,
    and at most :math:`\log K`.

    Scores do not change under an affine map of the columns. There are no gradients.

    Args:
        loc (torch.Tensor): means under ``K`` actions, ``[*B, K, d]``.
        var (torch.Tensor): variances, ``[*B, K, d]``.

    Keyword Args:
        approximation (str): ``"bounds"`` or ``"product"``. Defaults to ``"bounds"``.
        max_memory (int): approximate bytes of working memory. Defaults to 256 MiB.
        compile (bool, optional): whether to use a compiled kernel for the pairs of
            actions. It is about ten times faster, for float32 and ``d`` up to 16, and
            agrees up to rounding. Compiling takes some seconds, once for each ``d``.
            Defaults to ``None``: compile from :math:`2^{28}` pairs on, ``K * K`` for
            each mixture.

    Returns:
        torch.Tensor: in nats, ``[*B]`` of the dtype of ``loc``, within [0, log K].

    Raises:
        ValueError: shapes differ or are empty, a value is not finite, or a variance is
            not positive.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence import causal_action_influence
        >>> loc = torch.tensor([[[0.0], [0.0]], [[0.0], [100.0]]])
        >>> causal_action_influence(loc, torch.ones(2, 2, 1))
        tensor([0.0000, 0.6164])
    """
    if loc.shape != var.shape or loc.ndim < 2 or not loc.shape[-1] or not loc.shape[-2]:
        raise ValueError(
            "expected loc and var of shape [*B, K, d], K and d at least 1, got "
            f"{list(loc.shape)} and {list(var.shape)}"
        )
    if approximation not in ("product", "bounds"):
        raise ValueError(
            f"approximation must be 'bounds' or 'product', got {approximation!r}"
        )
    if not loc.is_floating_point() or loc.dtype != var.dtype:
        raise ValueError(
            f"expected one floating dtype for both, got {loc.dtype} and {var.dtype}"
        )
    if max_memory < 1:
        raise ValueError(f"max_memory must be a number of bytes, got {max_memory!r}")
    check_gaussians(loc, var)
    k, d = loc.shape[-2:]
    scores = mixture_influence(
        loc.reshape(-1, k, d),
        var.reshape(-1, k, d),
        [slice(0, d)],
        approximation=approximation,
        max_memory=max_memory,
        fused=kernel_pays(loc[..., 0].numel() * k) if compile is None else compile,
    )
    return scores.reshape(loc.shape[:-2])


def check_gaussians(loc: torch.Tensor, var: torch.Tensor) -> None:
    """Raises if means or variances cannot be those of Gaussians.

    Args:
        loc (torch.Tensor): means, any shape.
        var (torch.Tensor): variances, any shape.

    Raises:
        ValueError: a value is not finite, or a variance is not positive.
    """
    if not loc.numel():
        return
    # aminmax is one pass, and NaN if a value is.
    if not all(x.isfinite() for x in loc.aminmax()):
        raise ValueError("loc has NaN or infinite values: the model has diverged")
    low, high = var.aminmax()
    if not (low > 0 and high.isfinite()):
        raise ValueError(
            "var has values that are not positive and finite: pass variances, with a "
            "floor above 0"
        )


def kernel_pays(num_pairs: int) -> bool:
    """Returns whether compiling the kernel is faster than working without it.

    Args:
        num_pairs (int): the pairs of actions, ``K * K`` for each state and entity.

    Returns:
        bool: ``True`` from :math:`2^{28}` on.
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
    """Returns the influence on several entities, see :func:`causal_action_influence`.

    The compiled kernel visits all pairs of actions without writing them to memory. It
    is for float32 and entities of up to 16 columns. Everything else, and everything
    where no compiler works, is computed step by step.

    Args:
        loc (torch.Tensor): means under ``K`` actions, ``[B, K, P]``, finite.
        var (torch.Tensor): variances, ``[B, K, P]``, positive and finite.
        slices (sequence of slice): the columns of each entity.

    Keyword Args:
        approximation (str): ``"bounds"`` or ``"product"``.
        max_memory (int): approximate bytes of working memory.
        fused (bool): use the kernel where possible.

    Returns:
        torch.Tensor: in nats, ``[B, N]`` of the dtype of ``loc``.
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
        # Parts of about equal size: a single row would need another kernel.
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
    """Returns the columns of some entities of one width, ``[width, n]``."""
    own = [list(range(slices[i].start, slices[i].stop)) for i in entities]
    return torch.tensor(own, device=device).T


# --- with the compiled kernel ---------------------------------------------------------


def _columns_first(loc: torch.Tensor, var: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Returns the input of the kernel, each ``[P, b, K]`` and contiguous."""
    loc, var = (x.permute(2, 0, 1).contiguous() for x in _standardized(loc, var))
    return loc, var, var.reciprocal(), var.log().mul_(0.5)


def _by_kernel(
    gaussians: tuple[torch.Tensor, ...],
    columns: torch.Tensor,
    kernel: Callable[..., tuple[torch.Tensor, torch.Tensor]],
    approximation: Approximation,
) -> torch.Tensor:
    """Scores ``[b, n]`` of n entities of equal width, columns ``[width, n]``."""
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
    r"""Sums both approximations over actions k, ``[b, K]`` for actions i.

    The first is over :math:`e^{-D_{KL}(p_i \| p_k)}`, the second over
    :math:`\int p_i p_k / \int p_i^2`. Both terms are 1 for k = i; the first is at most
    1, the second at most :math:`2^{d / 2}`. So the sums cannot overflow.
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
    """Returns the kernel for entities of this width, ``None`` if compiling fails."""
    if device in _without_compiler:
        return None
    # torch's annotations do not include isolate_recompiles yet.
    kernel = torch.compile(  # type: ignore[call-overload]
        _pair_sums, fullgraph=True, dynamic=True, isolate_recompiles=True
    )
    # All sizes differ, so that the compiler does not assume that two are equal.
    sizes = [(width, 19, 23)] * 3 + [(19, 23)]
    try:
        kernel(*(torch.ones(size, device=device) for size in sizes))
    except Exception as error:
        _without_compiler.add(device)
        warnings.warn(
            "influence is computed without the compiled kernel, about ten times "
            f"slower: torch.compile failed ({str(error).strip().splitlines()[0]}). "
            "Install its requirements (a C++ compiler and Python's headers, and Triton "
            "for CUDA), or pass compile=False",
            RuntimeWarning,
            stacklevel=2,
        )
        return None
    return kernel


# --- step by step --------------------------------------------------------------------


def _stepwise(
    loc: torch.Tensor, var: torch.Tensor, approximation: Approximation, max_memory: int
) -> torch.Tensor:
    """Returns the influence ``[B]`` on one entity ``[B, K, d]``, from all pairs."""
    k = loc.shape[1]
    pair_bytes = max_memory // _PAIR_TENSORS
    if loc.device.type == "cpu":
        pair_bytes = min(pair_bytes, _CPU_PAIR_BYTES)
    pairs = max(1, pair_bytes // loc.element_size())
    rows = max(1, pairs // (k * k))
    own = min(k, max(1, pairs // k))  # below K only if one row exceeds the memory
    out = loc.new_empty(len(loc))
    for start in range(0, len(loc), rows):
        part = slice(start, start + rows)
        out[part] = _stepwise_rows(loc[part], var[part], own, approximation)
    return out


def _stepwise_rows(
    loc: torch.Tensor, var: torch.Tensor, own: int, approximation: Approximation
) -> torch.Tensor:
    """Computes eq. 3 for rows ``[b, K, d]``, ``own`` of the actions ``i`` at a time."""
    k, d = loc.shape[-2:]
    loc, var = _standardized(loc, var)
    inverse = var.reciprocal()
    log_det = var.log().sum(-1)
    # Columns first, so that each step below reads contiguous memory.
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


# --- shared by both ------------------------------------------------------------------


def _standardized(
    loc: torch.Tensor, var: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Centers the means and divides by the mean variance, column by column.

    The influence does not change, and float32 suffices for any unit.
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
    """Returns the mean of both approximations, from the log sums over k."""
    log_k = math.log(k)
    gap = 0.5 * d * (1 - math.log(2)) if approximation == "bounds" else 0.0
    upper = (log_k - log_upper).clamp_min_(0)
    lower = (log_k - gap - log_lower).clamp_min_(0)
    return upper.add_(lower).mul_(0.5)
