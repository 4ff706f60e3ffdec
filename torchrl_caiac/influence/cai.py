"""Causal action influence (CAI), section 3.2 and eq. 3 of the paper."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import Bounded

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.mixture_divergence import (
    Approximation,
    kernel_pays,
    mixture_influence,
)
from torchrl_caiac.modules.entity_dynamics_model import evaluating
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel

__all__ = ["CAI", "causal_action_influence", "draw_actions"]

_CPU_NETWORK_BYTES = 2**20  # of a layer's activations on a CPU: more leave its cache
_CPU_GAUSSIAN_BYTES = 2**20  # of the network's means on a CPU, likewise
_GAUSSIAN_TENSORS = 12  # of the means' size, alive at once

_FEW_ACTIONS = 16  # of the first look in the fast mode
_FACTORS = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 16.0)  # from the threshold to what is near
_SAMPLE = 4096  # states on which the fast mode is checked
# Above the 99.9 % that are wanted on all states: a sample has an error of its own.
_LEAST_AGREEMENT = 0.9995

_logger = logging.getLogger("torchrl_caiac.cai")


@torch.no_grad()
def causal_action_influence(
    loc: torch.Tensor,
    var: torch.Tensor,
    *,
    approximation: Approximation = "bounds",
    max_memory: int = 256 * 2**20,
    compile: bool | None = None,
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
        compile (bool, optional): whether to go over the pairs of actions by a compiled
            kernel, which is about ten times faster, for float32 and ``d`` up to 16; the
            scores agree up to rounding. Compiling takes some seconds, once for each
            ``d``. Defaults to ``None``: from :math:`2^{28}` pairs on, ``K * K`` for
            each mixture.

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
    _check_gaussians(loc, var)
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


def _check_gaussians(loc: torch.Tensor, var: torch.Tensor) -> None:
    if not loc.numel():
        return
    # One pass over each, which NaN gets through.
    if not all(x.isfinite() for x in loc.aminmax()):
        raise ValueError("loc has NaN or infinite values: the model has diverged")
    low, high = var.aminmax()
    if not (low > 0 and high.isfinite()):
        raise ValueError(
            "var has values that are not positive and finite: pass variances, with a "
            "floor above 0"
        )


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
    r"""Scores how much the action influences every entity, by a learned model.

    ``K`` actions are drawn once, uniformly over the action space (paper, A.7), and kept
    as a buffer: the same ones serve the expectation and the mixture of eq. 3, and
    every state.

    The mode ``"fast"`` is for masks at a ``threshold``. Every state gets a first look
    by 16 of the actions, far from each other. Where an entity that is not fixed is then
    near the threshold, the state's scores are made exact; the others stay estimates of
    the same size, at most :math:`\log 16`. Near is from ``threshold / f`` to
    ``threshold * f``, with the smallest f (from 1.5 to 16) by which 99.95 % of all
    entities fall on the same side of the threshold as by exact scores; this is found on
    up to 4,096 states that are spread over the data, before anything is scored. Where
    no f will do, a warning says so and all scores are exact. :func:`score_buffer` has
    the whole buffer looked at (:meth:`prepare`), and scores exact up to ``smoothing``
    times as high, because means are taken; a call of the estimator alone looks at the
    states that it is given first.

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
        mode (str): ``"exact"`` or ``"fast"``. Defaults to ``"exact"``.
        threshold (float, optional): the threshold :math:`\theta` that scores will be
            compared with; needed by the fast mode only.
        compile (bool, optional): as in :func:`causal_action_influence`. Defaults to
            ``None``: where enough states are to be scored, about 20,000 for three
            entities and 64 actions.

    Attributes:
        actions (torch.Tensor): the actions, ``[K, A]``.

    Raises:
        ValueError: the model does not predict an entity; the action spec has another
            size or no finite bounds; ``num_actions`` is below 2; the fast mode has no
            positive threshold, or 16 actions or fewer.
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
        mode: Literal["exact", "fast"] = "exact",
        threshold: float | None = None,
        compile: bool | None = None,
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
        if mode not in ("exact", "fast"):
            raise ValueError(f"mode is 'exact' or 'fast', got {mode!r}")
        if mode == "fast" and (threshold is None or not threshold > 0):
            raise ValueError(
                "the fast mode needs the threshold that the scores will be compared "
                f"with, above 0, got {threshold!r}"
            )
        if mode == "fast" and num_actions <= _FEW_ACTIONS:
            raise ValueError(
                f"the fast mode first looks at {_FEW_ACTIONS} of more actions, got "
                f"num_actions={num_actions}: use mode='exact'"
            )
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
        self.mode: Literal["exact", "fast"] = mode
        self.threshold = threshold
        self.compile_kernel = compile
        self.register_buffer("actions", draw_actions(num_actions, low, high, generator))
        self.actions = self.actions.to(model.loc_head.weight.device)
        self._many = False  # states to score: worth a compiled kernel
        # In the fast mode, the scores that are made exact; None: all.
        self._near: tuple[float, float] | None = None
        self._is_ready = mode == "exact"

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
        states = self._flat(tensordict)
        if not self._is_ready and len(states):
            self._look_around(states, smoothing=1)
        scores = self._score(states, self._near)
        return scores.reshape(*tensordict.batch_size, scores.shape[-1])

    @torch.no_grad()
    def prepare(
        self, tensordict: TensorDictBase, num_states: int, *, smoothing: int = 1
    ) -> None:
        """Gets ready to score many states, of which some are given.

        It decides whether compiling pays and, in the fast mode, which scores have to be
        exact. :func:`score_buffer` calls it before it scores. Call it again when the
        model has changed.

        Args:
            tensordict (TensorDictBase): states ``[*B]``, spread over all; those that
                are not finite are passed over.
            num_states (int): how many will be scored.

        Keyword Args:
            smoothing (int): the states that a mean is taken over before scores are
                compared with the threshold. Defaults to 1.
        """
        self._many = self._kernel_pays(num_states)
        if self.mode == "fast":
            states = self._flat(tensordict)
            finite = self.layout.read(states).isfinite().all(-1)
            if bool(finite.any()):
                self._look_around(states[finite], smoothing)

    def _flat(self, tensordict: TensorDictBase) -> TensorDictBase:
        states = tensordict.select(*self.layout.in_keys, strict=False)
        return states.reshape(tensordict.batch_size.numel())

    def _kernel_pays(self, num_states: int) -> bool:
        return kernel_pays(num_states * self.layout.num_entities * self.num_actions**2)

    def _score(
        self, states: TensorDictBase, near: tuple[float, float] | None
    ) -> torch.Tensor:
        """Scores ``[n, N]`` of states ``[n]``, exact in some range or (None) all."""
        device = self.layout.read(states[:1]).device
        scores = torch.empty(len(states), self.layout.num_entities, device=device)
        fused = self.compile_kernel
        if fused is None:
            fused = self._many or self._kernel_pays(len(states))
        every = list(range(self.num_actions))
        few = every if near is None else _spread(self.actions, _FEW_ACTIONS)
        others = [i for i in every if i not in few]
        at_once = self._states_at_once(len(few))
        again_at_once = self._states_at_once(self.num_actions)
        with evaluating(self.model):
            first = self._network(few)
            more = self._network(others) if others else None
            for start in range(0, len(states), at_once):
                part = slice(start, start + at_once)
                state = self.layout.read(states[part])
                self.model.check_finite(state, first_row=start)
                state = state.to(self.actions.device)
                loc, var = first(state)
                found = self._influence(loc, var, fused)
                if near is not None and more is not None:
                    unsure = self._any_within(found, near).nonzero().squeeze(-1)
                    for rows in unsure.split(again_at_once):
                        more_loc, more_var = more(state[rows])
                        found[rows] = self._influence(
                            torch.cat([loc[rows], more_loc], 1),
                            torch.cat([var[rows], more_var], 1),
                            fused,
                        )
                scores[part] = found
        return scores

    def _network(
        self, actions: list[int]
    ) -> Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
        """The model's predictions under some of the actions."""
        model = self.model
        # A quarter of the memory: two layers' activations and both heads' outputs.
        most = self.max_memory // 4 // 3
        if self.actions.device.type == "cpu":
            most = min(most, _CPU_NETWORK_BYTES)
        width = max(*model.hidden_sizes, 2 * model.predict_dim)
        rows = max(1, most // (model.loc_head.weight.element_size() * width))
        return model.for_actions(self.actions[actions], rows=rows)

    def _states_at_once(self, num_actions: int) -> int:
        """How many states' Gaussians are worked on at once."""
        most = self.max_memory // 4 // _GAUSSIAN_TENSORS
        if self.actions.device.type == "cpu":
            most = min(most, _CPU_GAUSSIAN_BYTES)
        size = self.model.loc_head.weight.element_size()
        return max(1, most // (size * num_actions * self.model.predict_dim))

    def _influence(
        self, loc: torch.Tensor, var: torch.Tensor, fused: bool
    ) -> torch.Tensor:
        """Scores ``[b, N]`` from Gaussians ``[b, K, P]``."""
        _check_gaussians(loc, var)
        scores = mixture_influence(
            loc,
            var,
            tuple(self.model.predicted.values()),
            approximation=self.approximation,
            max_memory=max(1, self.max_memory // 2),
            fused=fused,
        )
        return scores.float()

    def _any_within(
        self, scores: torch.Tensor, near: tuple[float, float]
    ) -> torch.Tensor:
        """Whether an entity that may be swapped has a score in a range, ``[n]``."""
        names, fixed = self.layout.names, self.layout.fixed
        free = [i for i, name in enumerate(names) if name not in fixed]
        return ((scores > near[0]) & (scores < near[1]))[:, free].any(-1)

    def _look_around(self, states: TensorDictBase, smoothing: int) -> None:
        """Sets the range of scores that the fast mode makes exact, or that all are."""
        threshold = self.threshold or math.nan
        if len(states) > _SAMPLE:
            rows = torch.linspace(0, len(states) - 1, _SAMPLE, dtype=torch.float64)
            states = states[rows.long()]
        nowhere = (threshold, threshold)
        first, exact = (self._score(states, near) for near in (nowhere, None))
        same = (first <= threshold) == (exact <= threshold)
        for factor in _FACTORS:
            near = (threshold / factor, threshold * factor * smoothing)
            unsure = self._any_within(first, near)
            agreement = (same | unsure[:, None]).double().mean().item()
            if agreement >= _LEAST_AGREEMENT:
                break
        self._is_ready = True
        if agreement >= _LEAST_AGREEMENT:
            self._near = near
            _logger.info(
                "fast mode: states with scores from %.3g to %.3g, %.0f %% of a sample, "
                "get exact ones; masks agree on %.3f %%",
                *(*near, 100 * unsure.double().mean().item(), 100 * agreement),
            )
            return
        self._near = None
        warnings.warn(
            f"the fast mode cannot be used: masks at the threshold {threshold:g} agree "
            f"with the exact ones on {agreement:.2%} of a sample, wanted "
            f"{_LEAST_AGREEMENT:.2%}. All scores are made exact, which is slower",
            RuntimeWarning,
            stacklevel=3,
        )

    def extra_repr(self) -> str:
        """The settings, for ``repr``."""
        text = f"num_actions={self.num_actions}, approximation={self.approximation!r}"
        if self.mode == "fast":
            text += f", mode='fast', threshold={self.threshold:g}"
        return text


def _spread(actions: torch.Tensor, count: int) -> list[int]:
    """Some of the actions ``[K, A]``, each as far from those before it as can be."""
    unit = actions / actions.std(0).clamp_min(1e-9)
    distance = (unit - unit.mean(0)).norm(dim=-1)
    chosen = [int(distance.argmax())]
    distance.fill_(math.inf)
    while len(chosen) < count:
        distance = torch.minimum(distance, (unit - unit[chosen[-1]]).norm(dim=-1))
        chosen.append(int(distance.argmax()))
    return chosen


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
