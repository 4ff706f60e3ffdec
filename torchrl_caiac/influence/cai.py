"""Causal action influence (CAI), section 3.2 and eq. 3 of the paper."""

from __future__ import annotations

import math
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import Bounded

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules.entity_dynamics_model import evaluating
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel

__all__ = ["CAI", "causal_action_influence", "draw_actions"]

Approximation = Literal["bounds", "product"]

_PAIR_TENSORS = 6  # tensors of [rows, K, K] alive at once, and some slack
_CPU_PAIR_BYTES = 2**20  # one such tensor on a CPU: larger ones leave its cache
_CPU_NETWORK_ROWS = 2**14  # rows through the network at once on a CPU, likewise


@torch.no_grad()
def causal_action_influence(
    loc: torch.Tensor,
    var: torch.Tensor,
    *,
    approximation: Approximation = "bounds",
    max_memory: int = 256 * 2**20,
) -> torch.Tensor:
    r"""The influence of the action on one entity, eq. 3 of the paper.

    .. math:: C^j(s) = \frac{1}{K} \sum_{i=1}^{K} D_{KL}\Big(p_i \,\Big\|\,
        \frac{1}{K} \sum_{k=1}^{K} p_k\Big)

    where :math:`p_i` is the diagonal Gaussian of the entity's next state under action
    ``i``. The divergence from a mixture has no closed form; following Durrieu, Thiran
    and Kelly (2012) it is the mean of two approximations,

    .. math:: D_{var} = -\log \frac{1}{K} \sum_k e^{-D_{KL}(p_i \| p_k)}, \qquad
        D_{prod} = -\log \frac{1}{K} \sum_k \frac{\int p_i p_k}{z_i},

    each clipped below at 0. With ``"bounds"`` :math:`\log z_i` is the negative entropy
    of :math:`p_i`: :math:`D_{prod}` is then a lower bound of the divergence, as
    :math:`D_{var}` is always an upper one. This is what Seitzer et al. (2021) and hence
    the paper's thresholds use, and near the truth where the dependence is smooth.
    With ``"product"`` :math:`z_i = \int p_i^2`, Durrieu's form for two mixtures, larger
    by :math:`d (1 - \log 2) / 2` before the clipping: exact where the actions fall
    into well separated groups, about 1.5 times too high where the dependence is
    smooth. Both give 0 where the action changes nothing, and at most :math:`\log K`.

    Scores do not change under an affine map of the columns. No gradients.

    Args:
        loc (torch.Tensor): means under ``K`` actions, ``[*B, K, d]``.
        var (torch.Tensor): variances, ``[*B, K, d]``.

    Keyword Args:
        approximation (str): ``"bounds"`` or ``"product"``. Defaults to ``"bounds"``.
        max_memory (int): bytes of working memory, about. Defaults to 256 MiB.

    Returns:
        torch.Tensor: nats, ``[*B]`` of the dtype of ``loc``, within [0, log K].

    Raises:
        ValueError: shapes differ or are empty, a value is not finite, or a variance is
            not positive.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence.cai import causal_action_influence
        >>> loc = torch.tensor([[[0.0], [0.0]], [[0.0], [100.0]]])
        >>> causal_action_influence(loc, torch.ones(2, 2, 1))
        tensor([0.0000, 0.6164])
    """
    if loc.shape != var.shape or loc.ndim < 2 or not loc.shape[-1] or not loc.shape[-2]:
        raise ValueError(
            "loc and var are both [*B, K, d] with K and d at least 1, got "
            f"{list(loc.shape)} and {list(var.shape)}"
        )
    if approximation not in ("product", "bounds"):
        raise ValueError(
            f"approximation is 'bounds' or 'product', got {approximation!r}"
        )
    if not loc.is_floating_point() or loc.dtype != var.dtype:
        raise ValueError(
            f"loc and var are of one floating dtype, got {loc.dtype} and {var.dtype}"
        )
    if max_memory < 1:
        raise ValueError(f"max_memory is a number of bytes, got {max_memory!r}")
    if not bool(torch.isfinite(loc).all()):
        raise ValueError("loc has NaN or infinite values: the model has diverged")
    if not bool(((var > 0) & torch.isfinite(var)).all()):
        raise ValueError(
            "var has values that are not positive and finite: pass variances, with a "
            "floor above 0"
        )
    k, d = loc.shape[-2:]
    batch = loc.shape[:-2]
    loc, var = loc.reshape(-1, k, d), var.reshape(-1, k, d)
    pair_bytes = max_memory // _PAIR_TENSORS
    if loc.device.type == "cpu":
        pair_bytes = min(pair_bytes, _CPU_PAIR_BYTES)
    pairs = max(1, pair_bytes // loc.element_size())
    rows = max(1, pairs // (k * k))
    own = min(k, max(1, pairs // k))  # below K only where one row is already too much
    out = loc.new_empty(len(loc))
    for start in range(0, len(loc), rows):
        part = slice(start, start + rows)
        out[part] = _influence(loc[part], var[part], own, approximation)
    return out.reshape(batch)


def _influence(
    loc: torch.Tensor, var: torch.Tensor, own: int, approximation: Approximation
) -> torch.Tensor:
    """Eq. 3 for some rows ``[b, K, d]``, ``own`` of the K actions ``i`` at a time."""
    k, d = loc.shape[-2:]
    # Centred and in units of the mean variance, each column's numbers are near 1: the
    # result stays the same and float32 is enough, whatever the units are.
    unit = var.mean(-2, keepdim=True)
    loc = (loc - loc.mean(-2, keepdim=True)) * unit.rsqrt()
    var = (var / unit).clamp_min_(1e8 * torch.finfo(var.dtype).tiny)
    inverse = var.reciprocal()
    log_det = var.log().sum(-1)
    # Columns first, so that every step below runs over contiguous memory.
    loc_t, var_t, inverse_t = (x.movedim(-1, 0) for x in (loc, var, inverse))
    log_k = math.log(k)
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
        variational = log_k - torch.logsumexp(kl.mul_(-0.5), -1)
        product_kl = log_k - torch.logsumexp(log_ratio.mul_(-0.5), -1)
        if approximation == "bounds":
            product_kl -= 0.5 * d * (1 - math.log(2))
        total += (variational.clamp_min_(0) + product_kl.clamp_min_(0)).sum(-1)
    return (total / (2 * k)).clamp_max_(log_k)


def draw_actions(
    num_actions: int,
    low: torch.Tensor,
    high: torch.Tensor,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Uniform actions between bounds.

    Args:
        num_actions (int): how many, ``K``.
        low (torch.Tensor): lower bounds ``[A]``.
        high (torch.Tensor): upper bounds ``[A]``.
        generator (torch.Generator, optional): where the numbers come from.

    Returns:
        torch.Tensor: float32 ``[K, A]``, on the CPU.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.influence.cai import draw_actions
        >>> draw_actions(3, torch.zeros(2), torch.ones(2)).shape
        torch.Size([3, 2])
    """
    low, high = low.cpu().float(), high.cpu().float()
    unit = torch.rand(num_actions, low.shape[-1], generator=generator)
    return low + (high - low) * unit


class CAI(nn.Module):
    """Scores how much the action influences every entity, by a learned model.

    ``K`` actions are drawn once, uniformly over the action space (paper, A.7), and kept
    as a buffer: the same ones serve the expectation and the mixture of eq. 3, and
    every state.

    Args:
        model (GaussianWorldModel): a fitted world model that predicts every entity.
        num_actions (int): the number of actions, ``K``. Defaults to 64.

    Keyword Args:
        action_spec (Bounded, optional): the action space, ``[A]``. Defaults to [-1, 1]
            in every dimension.
        seed (int): of the draw of the actions. Defaults to 0.
        generator (torch.Generator, optional): draw with this instead of ``seed``.
        approximation (str): as in :func:`causal_action_influence`. Defaults to
            ``"bounds"``.
        max_memory (int): bytes of working memory above model, data and scores, about;
            the rows are scored in chunks that fit. Defaults to 256 MiB.

    Attributes:
        actions (torch.Tensor): the actions, ``[K, A]``.

    Raises:
        ValueError: the model does not predict an entity; the action spec has another
            size or no finite bounds; ``num_actions`` is below 2.
        TypeError: the model is not Gaussian, or the action spec is not bounded.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence.cai import CAI
        >>> from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
        >>> layout = EntityLayout({"arm": [0, 1], "cup": [2]})
        >>> estimator = CAI(GaussianWorldModel(layout, 2, (16, 16)), num_actions=8)
        >>> estimator(TensorDict({"observation": torch.randn(5, 3)}, [5])).shape
        torch.Size([5, 2])
    """

    actions: torch.Tensor

    def __init__(
        self,
        model: GaussianWorldModel,
        num_actions: int = 64,
        *,
        action_spec: Bounded | None = None,
        seed: int = 0,
        generator: torch.Generator | None = None,
        approximation: Approximation = "bounds",
        max_memory: int = 256 * 2**20,
    ) -> None:
        super().__init__()
        if not isinstance(num_actions, int) or num_actions < 2:
            raise ValueError(
                "num_actions must be an int of at least 2 (one action has no "
                f"influence over another), got {num_actions!r}"
            )
        if approximation not in ("product", "bounds"):
            raise ValueError(
                f"approximation is 'bounds' or 'product', got {approximation!r}"
            )
        if max_memory < 1:
            raise ValueError(f"max_memory is a number of bytes, got {max_memory!r}")
        if not isinstance(model, GaussianWorldModel):
            raise TypeError(
                f"a {type(model).__name__} has no distribution to compare: give a "
                "GaussianWorldModel"
            )
        missing = [n for n in model.layout.names if n not in model.predicted]
        if missing:
            raise ValueError(
                f"the model predicts no column of {missing}: every entity needs a "
                "score, predict at least one column of each"
            )
        low, high = _bounds(action_spec, model.action_dim)
        if generator is None:
            generator = torch.Generator().manual_seed(seed)
        self.model = model
        self.num_actions = num_actions
        self.approximation: Approximation = approximation
        self.max_memory = int(max_memory)
        self.register_buffer("actions", draw_actions(num_actions, low, high, generator))
        self.actions = self.actions.to(model.loc_head.weight.device)

    @property
    def layout(self) -> EntityLayout:
        """The entities that are scored: the model's."""
        return self.model.layout

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> torch.Tensor:
        """The influence on every entity; without gradients, in evaluation mode.

        Args:
            tensordict (TensorDictBase): states ``[*B]``, with the keys of the layout;
                nothing is written.

        Returns:
            torch.Tensor: float32 ``[*B, N]``, nats, entities in layout order.

        Raises:
            ValueError: an observation is not finite, or the model's output is not.
        """
        state = self.layout.read(tensordict)
        batch = state.shape[:-1]
        state = state.reshape(-1, state.shape[-1])
        scores = torch.empty(
            len(state), self.model.layout.num_entities, device=state.device
        )
        rows, actions = self._chunk()
        with evaluating(self.model):
            for start in range(0, len(state), rows):
                part = state[start : start + rows]
                self.model.check_finite(part, first_row=start)
                scores[start : start + rows] = self._score(part, actions)
        return scores.reshape(*batch, scores.shape[-1])

    def _score(self, state: torch.Tensor, actions: int) -> torch.Tensor:
        state = state.to(self.actions.device)[:, None, :]
        parts = [
            self.model.forward_tensors(state, some[None])
            for some in self.actions.split(actions)
        ]
        loc = torch.cat([p[0] for p in parts], 1) if len(parts) > 1 else parts[0][0]
        var = torch.cat([p[1] for p in parts], 1) if len(parts) > 1 else parts[0][1]
        return torch.stack(
            [
                causal_action_influence(
                    loc[..., where],
                    var[..., where],
                    approximation=self.approximation,
                    max_memory=max(1, self.max_memory // 2),
                )
                for where in self.model.predicted.values()
            ],
            -1,
        ).float()

    def _chunk(self) -> tuple[int, int]:
        """How many states, and how many of the actions, pass the network at once."""
        model, k = self.model, self.num_actions
        size = model.loc_head.weight.element_size()
        # Half of the memory is for the pairs. Two layers' activations and both heads
        # with their temporaries are alive at once.
        per_pass = size * (3 * max(model.hidden_sizes) + 8 * model.predict_dim)
        passes = max(1, self.max_memory // 2 // per_pass)
        if self.actions.device.type == "cpu":
            passes = min(passes, _CPU_NETWORK_ROWS)
        return max(1, passes // k), min(k, passes)

    def extra_repr(self) -> str:
        """The settings, for ``repr``."""
        return f"num_actions={self.num_actions}, approximation={self.approximation!r}"


def _bounds(spec: Bounded | None, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    if spec is None:
        return -torch.ones(size), torch.ones(size)
    if not isinstance(spec, Bounded):
        raise TypeError(
            f"action_spec is a torchrl Bounded spec, got {type(spec).__name__}: only a "
            "bounded action space has a uniform distribution"
        )
    if tuple(spec.shape) != (size,):
        raise ValueError(
            f"action_spec has the shape {list(spec.shape)}, but the model's actions "
            f"are [{size}]: pass the spec of one environment "
            "(env.full_action_spec_unbatched)"
        )
    low = spec.space.low.expand(size)
    high = spec.space.high.expand(size)
    if not bool(torch.isfinite(low).all() and torch.isfinite(high).all()):
        raise ValueError(
            f"action_spec has infinite bounds, low {low.tolist()} and high "
            f"{high.tolist()}: give finite ones"
        )
    return low, high
