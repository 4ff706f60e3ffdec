"""The estimator of causal action influence (CAI), section 3.2 of the paper."""

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

from torchrl_caiac._spread import spread_rows
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.mixture_divergence import (
    Approximation,
    check_gaussians,
    kernel_pays,
    mixture_influence,
)
from torchrl_caiac.modules._action_bounds import (
    bounds_text,
    differing_bounds,
    spec_bounds,
)
from torchrl_caiac.modules.entity_dynamics_model import evaluating
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel

__all__ = ["CAI", "draw_actions"]

_CPU_NETWORK_BYTES = 2**20  # activations of a layer that fit into a CPU's cache
_CPU_GAUSSIAN_BYTES = 2**20  # means of the network that fit into a CPU's cache
_GAUSSIAN_TENSORS = 12  # tensors of the size of the means at the same time

_FEW_ACTIONS = 16  # for the estimates of the fast mode
_FACTORS = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 16.0)  # widths of the range around θ
_SAMPLE = 4096  # states on which the fast mode is checked
# The target on all states is 99.9 %; the margin is for the error of the sample.
_LEAST_AGREEMENT = 0.9995

_logger = logging.getLogger("torchrl_caiac.cai")


def draw_actions(
    num_actions: int,
    low: torch.Tensor,
    high: torch.Tensor,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draws uniform actions between bounds.

    Args:
        num_actions (int): the number of actions, ``K``.
        low (torch.Tensor): lower bounds ``[A]``.
        high (torch.Tensor): upper bounds ``[A]``.
        generator (torch.Generator, optional): the random number generator. Defaults to
            that of torch.

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
    r"""Scores how much the action influences each entity, by a learned model.

    ``K`` actions are drawn once, uniformly from the action space (paper, A.7), and kept
    as a buffer. The same actions are used for the expectation and the mixture of eq. 3,
    and for all states.

    The mode ``"fast"`` is for masks at a ``threshold``. It first estimates the scores
    of each state from 16 of the actions, which are far from each other. If an estimate
    is near the threshold for an entity that is not fixed, the scores of the state are
    computed exactly. The other scores remain estimates of at most :math:`\log 16`.
    "Near" is the range from ``threshold / f`` to ``threshold * f``. The factor ``f``,
    from 1.5 to 16, is the smallest one with which 99.95 % of all entities are on the
    same side of the threshold as with exact scores, on up to 4,096 states spread over
    the data. If no factor suffices, a warning says so and all scores are exact.
    :func:`~torchrl_caiac.influence.score_buffer` takes these states from the whole
    buffer (:meth:`prepare`) and multiplies the upper end of the range by ``smoothing``,
    since it averages scores. If the estimator is called directly, they are taken from
    its input.

    Args:
        model (GaussianWorldModel): a fitted world model that predicts every entity.
        num_actions (int): the number of actions, ``K``. Defaults to 64.

    Keyword Args:
        action_spec (Bounded, optional): the action space, ``[A]``. Defaults to the
            bounds that :func:`~torchrl_caiac.fit.fit_world_model` recorded in the
            model or, with a warning, to [-1, 1] if there are none. If it
            differs from the recorded bounds, there is a warning.
        seed (int): the seed of the actions. Defaults to 0.
        generator (torch.Generator, optional): draws the actions instead of ``seed``.
        approximation (str): as in
            :func:`~torchrl_caiac.influence.causal_action_influence`. Defaults to
            ``"bounds"``.
        max_memory (int): approximate bytes of working memory, without model, data and
            scores; rows are scored in chunks that fit. Defaults to 256 MiB.
        mode (str): ``"exact"`` or ``"fast"``. Defaults to ``"exact"``.
        threshold (float, optional): the threshold :math:`\theta` that scores will be
            compared with; the fast mode needs it.
        compile (bool, optional): as in
            :func:`~torchrl_caiac.influence.causal_action_influence`. Defaults to
            ``None``: compile if there are enough states, about 20,000 for three
            entities and 64 actions.

    Attributes:
        actions (torch.Tensor): the actions, ``[K, A]``.

    Raises:
        ValueError: the model was never fitted or does not predict an entity; the action
            spec has another size or infinite bounds; ``num_actions`` is below 2; the
            fast mode has no positive threshold, or at most 16 actions.
        TypeError: the model is not Gaussian, or the action spec is not bounded.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.fit import fit_world_model
        >>> from torchrl_caiac.influence.cai import CAI
        >>> from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
        >>> layout = EntityLayout({"arm": [0, 1], "cup": [2]})
        >>> model = GaussianWorldModel(layout, 2, (16, 16))
        >>> data = TensorDict({
        ...     "observation": torch.randn(50, 3), "action": torch.rand(50, 2),
        ...     "episode": torch.arange(50) // 10,
        ...     "next": {"observation": torch.randn(50, 3)}}, [50])
        >>> _ = fit_world_model(
        ...     model, data, steps=10, action_spec=Bounded(-1, 1, (2,)), progress=False
        ... )
        >>> CAI(model, num_actions=8)(data).shape
        torch.Size([50, 2])
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
                f"approximation must be 'bounds' or 'product', got {approximation!r}"
            )
        if max_memory < 1:
            raise ValueError(
                f"max_memory must be a number of bytes, got {max_memory!r}"
            )
        if mode not in ("exact", "fast"):
            raise ValueError(f"mode must be 'exact' or 'fast', got {mode!r}")
        if mode == "fast" and (threshold is None or not threshold > 0):
            raise ValueError(
                "the fast mode needs the threshold that the scores will be compared "
                f"with, above 0, got {threshold!r}"
            )
        if mode == "fast" and num_actions <= _FEW_ACTIONS:
            raise ValueError(
                f"the fast mode needs more than {_FEW_ACTIONS} actions, got "
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
        if not model.fitted:
            raise ValueError(
                "the model was never fitted, so that its scores would mean nothing: "
                "call fit_world_model(model, data), or load a fitted one, first"
            )
        low, high = _bounds(model, action_spec)
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
        self._many = False  # whether there are enough states to compile the kernel
        # The range of estimates that the fast mode replaces by exact scores; None: all.
        self._near: tuple[float, float] | None = None
        self._is_ready = mode == "exact"

    @property
    def layout(self) -> EntityLayout:
        """The entities that are scored, those of the model."""
        return self.model.layout

    @property
    def is_ready(self) -> bool:
        """Whether the fast mode knows which scores must be exact; else always true."""
        return self._is_ready

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Returns the influence on each entity, without gradients.

        The model is in evaluation mode.

        Args:
            tensordict (TensorDictBase): states ``[*B]``, with the keys of the layout;
                it is not changed.

        Returns:
            torch.Tensor: float32 ``[*B, N]``, in nats, entities in layout order.

        Raises:
            ValueError: an observation or an output of the model is not finite.
        """
        states = self._flat(tensordict)
        if not self._is_ready and len(states):
            self._find_range(states, smoothing=1)
        scores = self._score(states, self._near)
        return scores.reshape(*tensordict.batch_size, scores.shape[-1])

    @torch.no_grad()
    def prepare(
        self, tensordict: TensorDictBase, num_states: int, *, smoothing: int = 1
    ) -> None:
        """Prepares to score many states.

        It decides whether to compile the kernel and, in the fast mode, which scores
        have to be exact. :func:`~torchrl_caiac.influence.score_buffer` calls it before
        it scores. Call it again if the model has changed.

        Args:
            tensordict (TensorDictBase): a sample of the states, ``[*B]``; states that
                are not finite are ignored.
            num_states (int): the number of states to score.

        Keyword Args:
            smoothing (int): the number of states whose scores will be averaged before
                they are compared with the threshold. Defaults to 1.
        """
        self._many = self._kernel_pays(num_states)
        if self.mode == "fast":
            states = self._flat(tensordict)
            finite = self.layout.read(states).isfinite().all(-1)
            if bool(finite.any()):
                self._find_range(states[finite], smoothing)

    def _flat(self, tensordict: TensorDictBase) -> TensorDictBase:
        states = tensordict.select(*self.layout.in_keys, strict=False)
        return states.reshape(tensordict.batch_size.numel())

    def _kernel_pays(self, num_states: int) -> bool:
        return kernel_pays(num_states * self.layout.num_entities * self.num_actions**2)

    def _score(
        self, states: TensorDictBase, near: tuple[float, float] | None
    ) -> torch.Tensor:
        """Scores ``[n, N]`` of states ``[n]``, exact within a range (``None``: all)."""
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
        """Returns a function that predicts Gaussians under some of the actions."""
        model = self.model
        # A quarter of the memory, for the activations of two layers and the outputs of
        # both heads.
        most = self.max_memory // 4 // 3
        if self.actions.device.type == "cpu":
            most = min(most, _CPU_NETWORK_BYTES)
        width = max(*model.hidden_sizes, 2 * model.predict_dim)
        rows = max(1, most // (model.loc_head.weight.element_size() * width))
        return model.for_actions(self.actions[actions], rows=rows)

    def _states_at_once(self, num_actions: int) -> int:
        """Returns the number of states whose Gaussians fit into the memory."""
        most = self.max_memory // 4 // _GAUSSIAN_TENSORS
        if self.actions.device.type == "cpu":
            most = min(most, _CPU_GAUSSIAN_BYTES)
        size = self.model.loc_head.weight.element_size()
        return max(1, most // (size * num_actions * self.model.predict_dim))

    def _influence(
        self, loc: torch.Tensor, var: torch.Tensor, fused: bool
    ) -> torch.Tensor:
        """Scores ``[b, N]`` from Gaussians ``[b, K, P]``."""
        check_gaussians(loc, var)
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
        """Returns whether any entity that is not fixed is within the range, ``[n]``."""
        names, fixed = self.layout.names, self.layout.fixed
        free = [i for i, name in enumerate(names) if name not in fixed]
        return ((scores > near[0]) & (scores < near[1]))[:, free].any(-1)

    def _find_range(self, states: TensorDictBase, smoothing: int) -> None:
        """Finds the range of estimates that the fast mode replaces by exact scores."""
        threshold = self.threshold or math.nan
        if len(states) > _SAMPLE:
            states = states[spread_rows(len(states), _SAMPLE)]
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
                "fast mode: scores from %.3g to %.3g, in %.0f %% of the sample, are "
                "computed exactly; %.3f %% of the masks agree",
                *(*near, 100 * unsure.double().mean().item(), 100 * agreement),
            )
            return
        self._near = None
        warnings.warn(
            f"the fast mode cannot be used: masks at the threshold {threshold:g} agree "
            f"with the exact ones on {agreement:.2%} of a sample, expected "
            f"{_LEAST_AGREEMENT:.2%}. All scores are computed exactly, which is slower",
            RuntimeWarning,
            stacklevel=3,
        )

    def extra_repr(self) -> str:
        """Returns the settings, for ``repr``."""
        text = f"num_actions={self.num_actions}, approximation={self.approximation!r}"
        if self.mode == "fast":
            text += f", mode='fast', threshold={self.threshold:g}"
        return text


def _spread(actions: torch.Tensor, count: int) -> list[int]:
    """Returns some of the actions ``[K, A]``, each far from the previous ones."""
    unit = actions / actions.std(0).clamp_min(1e-9)
    distance = (unit - unit.mean(0)).norm(dim=-1)
    chosen = [int(distance.argmax())]
    distance.fill_(math.inf)
    while len(chosen) < count:
        distance = torch.minimum(distance, (unit - unit[chosen[-1]]).norm(dim=-1))
        chosen.append(int(distance.argmax()))
    return chosen


def _bounds(
    model: GaussianWorldModel, spec: Bounded | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the bounds between which actions are drawn, ``[A]`` each."""
    known = model.action_bounds
    if known is not None:
        known = known[0].cpu(), known[1].cpu()
    if spec is not None:
        given = spec_bounds(spec, model.action_dim)
        given = given[0].cpu(), given[1].cpu()
        columns = [] if known is None else differing_bounds(given, known)
        if known is not None and columns:
            warnings.warn(
                f"action_spec has the bounds {bounds_text(given)}, but the model was "
                f"fitted to actions in {bounds_text(known)}, which differ in the "
                f"columns {columns}: what the model has not seen is extrapolated. "
                "Leave action_spec out, or fit the model to data with these actions",
                stacklevel=3,
            )
        return given
    if known is not None:
        return known
    warnings.warn(
        "the bounds of the actions are not known, and actions are drawn from [-1, 1]: "
        "pass action_spec, or fit the model with fit_world_model, which records them",
        stacklevel=3,
    )
    return -torch.ones(model.action_dim), torch.ones(model.action_dim)
