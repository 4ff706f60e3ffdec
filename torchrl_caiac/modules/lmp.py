"""Latent Motor Plans: posterior, prior and decoder of windows of actions."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.nn.probabilistic import interaction_type
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MLP

__all__ = [
    "ClosedLoopDecoder",
    "LMPModel",
    "OpenLoopDecoder",
    "PlanPosterior",
    "PlanPrior",
    "Standardize",
    "gaussian_plan",
]

LOG_STD_MIN = -10.0
LOG_STD_MAX = 2.0

_ROWS_PER_CHUNK = 65_536


def read_leaf(tensordict: TensorDictBase, key: NestedKey, width: int) -> Tensor:
    """Reads one leaf and checks that its last dimension has the wanted width.

    Args:
        tensordict: where to read.
        key: the leaf.
        width: the wanted size of its last dimension.

    Returns:
        The leaf, ``[*B, width]``.

    Raises:
        KeyError: if the leaf is missing.
        ValueError: if its last dimension has another size.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"observation": torch.zeros(4, 3)}, [4])
        >>> read_leaf(td, "observation", 3).shape
        torch.Size([4, 3])
    """
    value: Tensor | None = tensordict.get(key, None)
    if value is None:
        found = sorted(map(str, tensordict.keys(True, True)))
        raise KeyError(
            f"{key!r} is missing: found the keys {found}. Write it into the data, or "
            "name the leaf that holds it (the *_key arguments of LMPModel, set_keys "
            "of LMPLoss)."
        )
    if value.ndim == 0 or value.shape[-1] != width:
        raise ValueError(
            f"{key!r} has shape {tuple(value.shape)}, but its last dimension must be "
            f"{width}, as the model was built."
        )
    return value


def gaussian_plan(loc: Tensor, log_std: Tensor, noise: Tensor) -> Tensor:
    """Turns standard normal noise into a plan, with gradients to both parameters.

    Args:
        loc: mean of the plan, ``[*B, P]``.
        log_std: logarithm of its standard deviation, ``[*B, P]``.
        noise: draws from the standard normal distribution, ``[*B, P]``.

    Returns:
        The plan, ``[*B, P]``.

    Examples:
        >>> import torch
        >>> gaussian_plan(torch.ones(2), torch.zeros(2), torch.tensor([0.0, -1.0]))
        tensor([1., 0.])
    """
    return loc + log_std.exp() * noise


def plan_is_sampled(sample: bool) -> bool:
    """Says whether a plan is drawn, or its mean taken, in the current context.

    Args:
        sample: what to do where no exploration type is set.

    Returns:
        True under ``ExplorationType.RANDOM``, False under any other exploration
        type, ``sample`` where none is set.

    Examples:
        >>> from torchrl.envs.utils import ExplorationType, set_exploration_type
        >>> with set_exploration_type(ExplorationType.DETERMINISTIC):
        ...     plan_is_sampled(sample=True)
        False
        >>> plan_is_sampled(sample=True)
        True
    """
    mode = interaction_type()
    return sample if mode is None else mode is ExplorationType.RANDOM


class Standardize(nn.Module):
    """Shifts and scales features by fixed statistics, kept as buffers.

    It is the identity until :meth:`LMPModel.fit_statistics` (or :meth:`set`) is
    called. Deviations below ``floor`` are raised to it: a feature that hardly ever
    moves in the data would otherwise turn small differences at test time into
    inputs far outside what the networks saw.

    Args:
        width: number of features.
        floor: smallest deviation, in the units of the features.

    Examples:
        >>> import torch
        >>> standardize = Standardize(2, floor=0.5)
        >>> standardize.set(torch.tensor([1.0, 2.0]), torch.tensor([0.1, 2.0]))
        >>> standardize(torch.tensor([2.0, 2.0]))
        tensor([2., 0.])
    """

    mean: Tensor
    std: Tensor

    def __init__(self, width: int, floor: float) -> None:
        super().__init__()
        self.floor = floor
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("std", torch.ones(width))

    def set(self, mean: Tensor, std: Tensor) -> None:
        """Sets the statistics.

        Args:
            mean: means, ``[width]``.
            std: standard deviations, ``[width]``, raised to the floor here.
        """
        self.mean.copy_(mean)
        self.std.copy_(std.clamp_min(self.floor))

    def forward(self, value: Tensor) -> Tensor:
        """Standardizes features.

        Args:
            value: ``[*B, width]``, in physical units.

        Returns:
            The standardized features, ``[*B, width]``, in the statistics' dtype.
        """
        return ((value - self.mean) / self.std).to(self.mean.dtype)

    def extra_repr(self) -> str:
        """Names width and floor in the module's repr."""
        return f"width={self.mean.numel()}, floor={self.floor}"


class _PlanHead(nn.Module):
    """Linear map to the mean and the bounded log deviation of a plan."""

    def __init__(self, in_features: int, plan_dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_features, 2 * plan_dim)

    def forward(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        loc, log_std = self.linear(hidden).chunk(2, dim=-1)
        return loc, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)


class PlanPosterior(nn.Module):
    """The sequence encoder q(z | τ): an LSTM over a window's actions and states.

    The plan's distribution is read off the LSTM's state after the window's last
    valid step, so padding at a window's end changes nothing, whatever it holds.

    Args:
        observation_norm: standardization of the states.
        action_norm: standardization of the actions.
        plan_dim: size of the plan.
        hidden_size: size of the LSTM's state.

    Examples:
        >>> import torch
        >>> posterior = PlanPosterior(Standardize(5, 0.02), Standardize(3, 0.05), 4, 8)
        >>> loc, log_std = posterior(torch.zeros(2, 7, 5), torch.zeros(2, 7, 3))
        >>> loc.shape, log_std.shape
        (torch.Size([2, 4]), torch.Size([2, 4]))
    """

    def __init__(
        self,
        observation_norm: Standardize,
        action_norm: Standardize,
        plan_dim: int,
        hidden_size: int,
    ) -> None:
        super().__init__()
        self.observation_norm = observation_norm
        self.action_norm = action_norm
        width = observation_norm.mean.numel() + action_norm.mean.numel()
        self.lstm = nn.LSTM(width, hidden_size, batch_first=True)
        self.head = _PlanHead(hidden_size, plan_dim)

    def forward(
        self, observation: Tensor, action: Tensor, mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Encodes windows.

        Args:
            observation: states, ``[*B, κ, D]``.
            action: actions, ``[*B, κ, A]``.
            mask: bool ``[*B, κ]``, True at the valid steps, which come first in
                every window; None when all are valid.

        Returns:
            Mean and log deviation of the plan, ``[*B, P]`` each.
        """
        inputs = torch.cat(
            [self.action_norm(action), self.observation_norm(observation)], dim=-1
        )
        *batch, window, width = inputs.shape
        inputs = inputs.reshape(-1, window, width)
        if mask is None:
            hidden = self.lstm(inputs)[0][:, -1]
        else:
            mask = mask.reshape(-1, window)
            # Padding may hold anything, NaN too: its zero gradient times NaN would
            # still poison the weights, hence it never enters the LSTM.
            inputs = inputs.where(mask.unsqueeze(-1), torch.zeros_like(inputs))
            last = mask.sum(-1, keepdim=True).unsqueeze(-1) - 1
            hidden = self.lstm(inputs)[0].take_along_dim(last, dim=1).squeeze(1)
        loc, log_std = self.head(hidden)
        return loc.reshape(*batch, -1), log_std.reshape(*batch, -1)


class PlanPrior(nn.Module):
    """The goal-conditioned prior p(z | s, g): an MLP on a state and a goal.

    Args:
        observation_norm: standardization of the states.
        goal_norm: standardization of the goals.
        plan_dim: size of the plan.
        hidden_size: width of the hidden layers.
        depth: number of hidden layers.

    Examples:
        >>> import torch
        >>> prior = PlanPrior(Standardize(5, 0.02), Standardize(2, 0.02), 4, 8, 3)
        >>> loc, log_std = prior(torch.zeros(6, 5), torch.zeros(6, 2))
        >>> loc.shape
        torch.Size([6, 4])
    """

    def __init__(
        self,
        observation_norm: Standardize,
        goal_norm: Standardize,
        plan_dim: int,
        hidden_size: int,
        depth: int,
    ) -> None:
        super().__init__()
        self.observation_norm = observation_norm
        self.goal_norm = goal_norm
        width = observation_norm.mean.numel() + goal_norm.mean.numel()
        self.network = MLP(
            width,
            hidden_size,
            depth=depth - 1,
            num_cells=hidden_size,
            activation_class=nn.ReLU,
            activate_last_layer=True,
        )
        self.head = _PlanHead(hidden_size, plan_dim)

    def forward(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Proposes plans.

        Args:
            observation: the state in which a plan starts, ``[*B, D]``.
            goal: the desired goal, ``[*B, G]``.

        Returns:
            Mean and log deviation of the plan, ``[*B, P]`` each.
        """
        inputs = torch.cat(
            [self.observation_norm(observation), self.goal_norm(goal)], dim=-1
        )
        loc, log_std = self.head(self.network(inputs))
        return loc, log_std


class OpenLoopDecoder(nn.Module):
    """The open-loop decoder π(a_t, ..., a_{t+κ-1} | z): an MLP on the plan alone.

    It never sees the state. With expert data the state nearly determines the
    action, and a decoder that sees it learns to do without the plan (paper A.5.1).

    Args:
        action_dim: number of actions A.
        window: number of steps κ.
        plan_dim: size of the plan.
        hidden_size: width of the hidden layers.
        depth: number of hidden layers.

    Examples:
        >>> import torch
        >>> OpenLoopDecoder(3, 7, 4, 8, 3)(torch.zeros(2, 4)).shape
        torch.Size([2, 7, 3])
    """

    def __init__(
        self, action_dim: int, window: int, plan_dim: int, hidden_size: int, depth: int
    ) -> None:
        super().__init__()
        self.window = window
        self.network = MLP(
            plan_dim,
            window * action_dim,
            depth=depth,
            num_cells=hidden_size,
            activation_class=nn.ReLU,
        )

    def forward(self, plan: Tensor) -> Tensor:
        """Decodes plans.

        Args:
            plan: ``[*B, P]``.

        Returns:
            The actions of a whole window, ``[*B, κ, A]``, within [-1, 1].
        """
        actions: Tensor = self.network(plan).tanh()
        return actions.unflatten(-1, (self.window, -1))


class ClosedLoopDecoder(nn.Module):
    """The closed-loop decoder π(a | z, s): an MLP on plan and current state.

    Args:
        observation_norm: standardization of the states.
        action_dim: number of actions A.
        plan_dim: size of the plan.
        hidden_size: width of the hidden layers.
        depth: number of hidden layers.

    Examples:
        >>> import torch
        >>> decoder = ClosedLoopDecoder(Standardize(5, 0.02), 3, 4, 8, 3)
        >>> decoder(torch.zeros(2, 4), torch.zeros(2, 5)).shape
        torch.Size([2, 3])
        >>> decoder(torch.zeros(2, 4), torch.zeros(2, 7, 5)).shape
        torch.Size([2, 7, 3])
    """

    def __init__(
        self,
        observation_norm: Standardize,
        action_dim: int,
        plan_dim: int,
        hidden_size: int,
        depth: int,
    ) -> None:
        super().__init__()
        self.observation_norm = observation_norm
        self.network = MLP(
            plan_dim + observation_norm.mean.numel(),
            action_dim,
            depth=depth,
            num_cells=hidden_size,
            activation_class=nn.ReLU,
        )

    def forward(self, plan: Tensor, observation: Tensor) -> Tensor:
        """Decodes the action of a step, or of every step of a window.

        Args:
            plan: ``[*B, P]``.
            observation: states, ``[*B, D]``, or ``[*B, κ, D]`` for whole windows.

        Returns:
            The actions, ``[*B, A]`` or ``[*B, κ, A]``, within [-1, 1].
        """
        if observation.ndim == plan.ndim + 1:
            plan = plan.unsqueeze(-2).expand(*observation.shape[:-1], plan.shape[-1])
        inputs = torch.cat([plan, self.observation_norm(observation)], dim=-1)
        action: Tensor = self.network(inputs).tanh()
        return action


class LMPModel(TensorDictModuleBase):
    """Latent Motor Plans: a posterior, a goal-conditioned prior and a decoder.

    A plan z stands for the actions of a window of κ steps. While learning, the
    posterior q(z | τ) reads the window, the decoder gives the actions back, and the
    prior p(z | s, g) learns to foretell the plan from the window's first state and
    a later goal. To act, a plan is drawn from the prior every κ steps
    (:class:`~torchrl_caiac.modules.lmp_actor.LMPActor`). Paper A.5.1.

    The three parts are tensordict modules, usable and replaceable on their own
    (``*B`` is any batch shape, P the plan's size):

    - ``posterior``: observation ``[*B, κ, D]``, action ``[*B, κ, A]``, mask
      ``[*B, κ]`` (optional) to ``("posterior", "loc")`` and
      ``("posterior", "log_std")``, ``[*B, P]``;
    - ``prior``: observation ``[*B, D]``, goal ``[*B, G]`` to ``("prior", "loc")``
      and ``("prior", "log_std")``, ``[*B, P]``;
    - ``decoder``: plan ``[*B, P]`` to actions ``[*B, κ, A]``; the closed-loop
      decoder reads the observation too, ``[*B, D]`` for one step or
      ``[*B, κ, D]`` for a window, and gives one action for each.

    Called on a tensordict, the model does what acting does: it reads one state and
    a goal, draws a plan from the prior and decodes it.

    States, goals and actions are standardized inside, by statistics that
    :meth:`fit_statistics` takes from the data. Decoded actions lie in [-1, 1].

    Denormal numbers slow the LSTM's backward pass down on CPUs once many units are
    saturated; ``torch.set_flush_denormal(True)`` in the training script avoids it.

    Args:
        observation_dim: number of observation columns D.
        goal_dim: number of goal columns G.
        action_dim: number of actions A.
        window: number of steps κ of a plan.
        plan_dim: size of the plan.
        hidden_size: width of the LSTM and of all hidden layers.
        depth: number of hidden layers of the prior and the decoder.
        decoder: ``"open_loop"`` decodes a whole window from the plan alone;
            ``"closed_loop"`` decodes step by step from plan and state.

    Keyword Args:
        observation_key: leaf of the states.
        goal_key: leaf of the goals.
        action_key: leaf of the actions.
        mask_key: leaf that marks the valid steps of padded windows.
        plan_key: leaf where plans are written.
        actions_key: leaf where decoded actions are written.
        observation_floor: smallest deviation used to standardize states.
        goal_floor: smallest deviation used to standardize goals.
        action_floor: smallest deviation used to standardize actions.

    Raises:
        ValueError: if a size, a floor or the decoder's name is out of range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> model = LMPModel(observation_dim=5, goal_dim=2, action_dim=3, window=10)
        >>> td = TensorDict(
        ...     {"observation": torch.zeros(4, 5), "desired_goal": torch.zeros(4, 2)},
        ...     batch_size=[4],
        ... )
        >>> td = model(td)
        >>> td["plan"].shape, td["lmp", "actions"].shape
        (torch.Size([4, 10]), torch.Size([4, 10, 3]))
    """

    posterior_loc_key: NestedKey = ("posterior", "loc")
    posterior_log_std_key: NestedKey = ("posterior", "log_std")
    prior_loc_key: NestedKey = ("prior", "loc")
    prior_log_std_key: NestedKey = ("prior", "log_std")

    def __init__(
        self,
        observation_dim: int,
        goal_dim: int,
        action_dim: int,
        window: int,
        plan_dim: int = 10,
        hidden_size: int = 128,
        depth: int = 3,
        decoder: Literal["open_loop", "closed_loop"] = "open_loop",
        *,
        observation_key: NestedKey = "observation",
        goal_key: NestedKey = "desired_goal",
        action_key: NestedKey = "action",
        mask_key: NestedKey = "mask",
        plan_key: NestedKey = "plan",
        actions_key: NestedKey = ("lmp", "actions"),
        observation_floor: float = 0.02,
        goal_floor: float = 0.02,
        action_floor: float = 0.05,
    ) -> None:
        sizes = {
            "observation_dim": observation_dim,
            "goal_dim": goal_dim,
            "action_dim": action_dim,
            "window": window,
            "plan_dim": plan_dim,
            "hidden_size": hidden_size,
            "depth": depth,
        }
        for name, size in sizes.items():
            if size < 1:
                raise ValueError(f"{name} must be at least 1, found {size}.")
        floors = {
            "observation_floor": observation_floor,
            "goal_floor": goal_floor,
            "action_floor": action_floor,
        }
        for name, floor in floors.items():
            if not (0.0 < floor < math.inf):
                raise ValueError(f"{name} must be positive and finite, found {floor}.")
        if decoder not in ("open_loop", "closed_loop"):
            raise ValueError(
                f"decoder must be 'open_loop' or 'closed_loop', found {decoder!r}."
            )
        super().__init__()
        self.observation_dim = observation_dim
        self.goal_dim = goal_dim
        self.action_dim = action_dim
        self.window = window
        self.plan_dim = plan_dim
        self.decoder_kind: Literal["open_loop", "closed_loop"] = decoder
        self.observation_key = observation_key
        self.goal_key = goal_key
        self.action_key = action_key
        self.mask_key = mask_key
        self.plan_key = plan_key
        self.actions_key = actions_key
        self._config: dict[str, Any] = {
            **sizes,
            "decoder": decoder,
            "observation_key": observation_key,
            "goal_key": goal_key,
            "action_key": action_key,
            "mask_key": mask_key,
            "plan_key": plan_key,
            "actions_key": actions_key,
            **floors,
        }

        # The parts share these modules, so that each works on its own and one call
        # of fit_statistics reaches them all.
        self.observation_norm = Standardize(observation_dim, observation_floor)
        self.goal_norm = Standardize(goal_dim, goal_floor)
        self.action_norm = Standardize(action_dim, action_floor)
        self.posterior = TensorDictModule(
            PlanPosterior(
                self.observation_norm, self.action_norm, plan_dim, hidden_size
            ),
            in_keys=[observation_key, action_key, mask_key],
            out_keys=[self.posterior_loc_key, self.posterior_log_std_key],
        )
        self.prior = TensorDictModule(
            PlanPrior(
                self.observation_norm, self.goal_norm, plan_dim, hidden_size, depth
            ),
            in_keys=[observation_key, goal_key],
            out_keys=[self.prior_loc_key, self.prior_log_std_key],
        )
        if decoder == "open_loop":
            self.decoder = TensorDictModule(
                OpenLoopDecoder(action_dim, window, plan_dim, hidden_size, depth),
                in_keys=[plan_key],
                out_keys=[actions_key],
            )
        else:
            self.decoder = TensorDictModule(
                ClosedLoopDecoder(
                    self.observation_norm, action_dim, plan_dim, hidden_size, depth
                ),
                in_keys=[plan_key, observation_key],
                out_keys=[actions_key],
            )
        self.in_keys = [observation_key, goal_key]
        self.out_keys = [
            self.prior_loc_key,
            self.prior_log_std_key,
            plan_key,
            actions_key,
        ]

    @property
    def config(self) -> dict[str, Any]:
        """The arguments the model was built with, ``LMPModel(**config)``."""
        return dict(self._config)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Draws a plan from the prior and decodes it.

        The plan is the prior's mean under ``ExplorationType.DETERMINISTIC``.

        Args:
            tensordict: holds one state ``[*B, D]`` and one goal ``[*B, G]`` a row.

        Returns:
            The same tensordict with the prior's parameters, the plan and the
            decoded actions added.

        Raises:
            KeyError: if a leaf is missing.
            ValueError: if a leaf has the wrong width.
        """
        read_leaf(tensordict, self.observation_key, self.observation_dim)
        read_leaf(tensordict, self.goal_key, self.goal_dim)
        tensordict = self.prior(tensordict)
        plan = tensordict.get(self.prior_loc_key)
        if plan_is_sampled(sample=True):
            noise = torch.randn_like(plan)
            log_std = tensordict.get(self.prior_log_std_key)
            plan = gaussian_plan(plan, log_std, noise)
        tensordict.set(self.plan_key, plan)
        return self.decoder(tensordict)

    def fit_statistics(
        self, tensordict: TensorDictBase, *, goals: Tensor | None = None
    ) -> LMPModel:
        """Takes the standardization of states, goals and actions from data.

        Means and deviations are computed in float64, a chunk of rows at a time, so
        that a memory-mapped data set is never loaded whole. Steps that the mask
        leaf marks as padding are left out. Nothing changes if an error is raised.

        Args:
            tensordict: rows of data, flat or in windows.

        Keyword Args:
            goals: goals as they will be asked for, ``[*, G]``; by default the leaf
                of the goals is read. Give them where goals are relabelled while
                sampling, for example the achieved goals of all rows.

        Returns:
            The model itself.

        Raises:
            KeyError: if a leaf is missing.
            ValueError: if a leaf is empty, has the wrong width, holds non-finite
                values, or if actions lie outside [-1, 1].

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> data = TensorDict(
            ...     {
            ...         "observation": torch.randn(100, 5) + 3.0,
            ...         "action": torch.rand(100, 3),
            ...         "desired_goal": torch.randn(100, 2),
            ...     },
            ...     batch_size=[100],
            ... )
            >>> model = LMPModel(5, 2, 3, window=10).fit_statistics(data)
            >>> bool((model.observation_norm.mean > 2.0).all())
            True
        """
        mask = tensordict.get(self.mask_key, None)
        rows = None if mask is None else mask.reshape(-1)
        observation = read_leaf(tensordict, self.observation_key, self.observation_dim)
        action = read_leaf(tensordict, self.action_key, self.action_dim)
        statistics = [
            (self.observation_norm, _moments(observation, self.observation_key, rows)),
            (self.action_norm, _moments(action, self.action_key, rows, bound=1.0)),
        ]
        if goals is None:
            goals = read_leaf(tensordict, self.goal_key, self.goal_dim)
            moments = _moments(goals, self.goal_key, rows)
        else:
            if goals.ndim == 0 or goals.shape[-1] != self.goal_dim:
                raise ValueError(
                    f"goals has shape {tuple(goals.shape)}, but its last dimension "
                    f"must be {self.goal_dim}, as the model was built."
                )
            moments = _moments(goals, "goals", None)
        statistics.append((self.goal_norm, moments))
        for norm, (mean, std) in statistics:
            norm.set(mean, std)
        return self


def _moments(
    value: Tensor, key: NestedKey, mask: Tensor | None, bound: float | None = None
) -> tuple[Tensor, Tensor]:
    """Mean and deviation over all leading dimensions, chunk by chunk, float64."""
    value = value.detach().reshape(-1, value.shape[-1])
    if mask is not None and mask.numel() != value.shape[0]:
        raise ValueError(
            f"the mask has {mask.numel()} entries, but {key!r} has {value.shape[0]} "
            "rows: give one bool a row, True where the row is valid."
        )
    count = 0
    mean = torch.zeros(value.shape[-1], dtype=torch.float64, device=value.device)
    squares = torch.zeros_like(mean)
    for start in range(0, value.shape[0], _ROWS_PER_CHUNK):
        stop = start + _ROWS_PER_CHUNK
        chunk = value[start:stop].to(torch.float64)
        if mask is not None:
            chunk = chunk[mask[start:stop]]
        if chunk.shape[0] == 0:
            continue
        finite = chunk.isfinite()
        if not finite.all():
            row = int((~finite.all(-1)).nonzero()[0])
            raise ValueError(
                f"{key!r} holds {int((~finite).sum())} non-finite values in the rows "
                f"{start} to {start + chunk.shape[0] - 1} (first at row {start + row} "
                "of the valid rows of this part): remove or repair these rows."
            )
        if bound is not None and (chunk.abs() > bound * (1.0 + 1e-4)).any():
            raise ValueError(
                f"{key!r} reaches {float(chunk.abs().max()):.4g}, but the decoder's "
                f"actions lie within [-{bound:g}, {bound:g}]: rescale the actions."
            )
        # Chan's update: the mean of all rows so far, and the squares around it.
        size = chunk.shape[0]
        chunk_mean = chunk.mean(0)
        delta = chunk_mean - mean
        total = count + size
        squares += (chunk - chunk_mean).square().sum(0)
        squares += delta.square() * (count * size / total)
        mean += delta * (size / total)
        count = total
    if count == 0:
        raise ValueError(
            f"{key!r} has shape {tuple(value.shape)}: there are no (valid) rows to "
            "take statistics from."
        )
    return mean, (squares / count).sqrt()
