"""The networks of Latent Motor Plans: posterior, prior and decoders."""

from __future__ import annotations

import torch
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MLP

from torchrl_caiac.modules.running_norm import RunningNorm

__all__ = [
    "ClosedLoopDecoder",
    "OpenLoopDecoder",
    "PlanPosterior",
    "PlanPrior",
    "gaussian_plan",
    "plan_is_sampled",
]

LOG_STD_MIN = -10.0
LOG_STD_MAX = 2.0


def gaussian_plan(loc: Tensor, log_std: Tensor, noise: Tensor) -> Tensor:
    """Returns a plan for standard normal noise, with gradients to both parameters.

    Args:
        loc (torch.Tensor): the mean of the plan, ``[*B, P]``.
        log_std (torch.Tensor): the logarithm of its standard deviation, ``[*B, P]``.
        noise (torch.Tensor): standard normal noise, ``[*B, P]``.

    Returns:
        torch.Tensor: the plan, ``[*B, P]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.lmp_parts import gaussian_plan
        >>> gaussian_plan(torch.ones(2), torch.zeros(2), torch.tensor([0.0, -1.0]))
        tensor([1., 0.])
    """
    return loc + log_std.exp() * noise


def plan_is_sampled(sample: bool) -> bool:
    """Returns whether the current exploration type requires a sampled plan.

    Args:
        sample (bool): the result if no exploration type is set.

    Returns:
        bool: ``True`` under ``ExplorationType.RANDOM``, ``False`` under any other
        exploration type.

    Examples:
        >>> from torchrl.envs.utils import ExplorationType, set_exploration_type
        >>> from torchrl_caiac.modules.lmp_parts import plan_is_sampled
        >>> with set_exploration_type(ExplorationType.DETERMINISTIC):
        ...     plan_is_sampled(sample=True)
        False
        >>> plan_is_sampled(sample=True)
        True
    """
    mode = interaction_type()
    return sample if mode is None else mode is ExplorationType.RANDOM


class _PlanHead(nn.Module):
    """Maps features to the mean and the bounded log standard deviation of a plan."""

    def __init__(self, in_features: int, plan_dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_features, 2 * plan_dim)

    def forward(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        loc, log_std = self.linear(hidden).chunk(2, dim=-1)
        return loc, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)


class PlanPosterior(nn.Module):
    """The sequence encoder q(z | τ): an LSTM over the actions and states of a window.

    The distribution of the plan is read from the LSTM's state after the last valid
    step, so that padding at the end of a window does not matter, whatever it contains.

    Args:
        observation_norm (RunningNorm): the normalisation of the states.
        action_norm (RunningNorm): the normalisation of the actions.
        plan_dim (int): the size ``P`` of the plan.
        hidden_size (int): the size of the LSTM's state.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.lmp_parts import PlanPosterior
        >>> from torchrl_caiac.modules import RunningNorm
        >>> posterior = PlanPosterior(RunningNorm(5), RunningNorm(3), 4, 8)
        >>> loc, log_std = posterior(torch.randn(2, 7, 5), torch.randn(2, 7, 3))
        >>> loc.shape, log_std.shape
        (torch.Size([2, 4]), torch.Size([2, 4]))
    """

    def __init__(
        self,
        observation_norm: RunningNorm,
        action_norm: RunningNorm,
        plan_dim: int,
        hidden_size: int,
    ) -> None:
        super().__init__()
        self.observation_norm = observation_norm
        self.action_norm = action_norm
        width = observation_norm.num_features + action_norm.num_features
        self.lstm = nn.LSTM(width, hidden_size, batch_first=True)
        self.head = _PlanHead(hidden_size, plan_dim)

    def forward(
        self, observation: Tensor, action: Tensor, mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Encodes windows.

        Args:
            observation (torch.Tensor): states, ``[*B, κ, D]``.
            action (torch.Tensor): actions, ``[*B, κ, A]``.
            mask (torch.Tensor, optional): bool ``[*B, κ]``, true for the valid steps,
                which come first in every window. Defaults to all steps.

        Returns:
            tuple of torch.Tensor: the mean and the log standard deviation of the plan,
            ``[*B, P]`` each.
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
            # Padding may contain NaN. Its gradient is zero, but zero times NaN is NaN
            # in the gradient of the weights, so it must not enter the LSTM.
            inputs = inputs.where(mask.unsqueeze(-1), torch.zeros_like(inputs))
            last = mask.sum(-1, keepdim=True).unsqueeze(-1) - 1
            hidden = self.lstm(inputs)[0].take_along_dim(last, dim=1).squeeze(1)
        loc, log_std = self.head(hidden)
        return loc.reshape(*batch, -1), log_std.reshape(*batch, -1)


class PlanPrior(nn.Module):
    """The goal-conditioned prior p(z | s, g): an MLP on a state and a goal.

    Args:
        observation_norm (RunningNorm): the normalisation of the states.
        goal_norm (RunningNorm): the normalisation of the goals.
        plan_dim (int): the size ``P`` of the plan.
        hidden_size (int): the width of the hidden layers.
        depth (int): the number of hidden layers.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.lmp_parts import PlanPrior
        >>> from torchrl_caiac.modules import RunningNorm
        >>> prior = PlanPrior(RunningNorm(5), RunningNorm(2), 4, 8, 3)
        >>> loc, log_std = prior(torch.randn(6, 5), torch.randn(6, 2))
        >>> loc.shape
        torch.Size([6, 4])
    """

    def __init__(
        self,
        observation_norm: RunningNorm,
        goal_norm: RunningNorm,
        plan_dim: int,
        hidden_size: int,
        depth: int,
    ) -> None:
        super().__init__()
        self.observation_norm = observation_norm
        self.goal_norm = goal_norm
        self.network = MLP(
            observation_norm.num_features + goal_norm.num_features,
            hidden_size,
            depth=depth - 1,
            num_cells=hidden_size,
            activation_class=nn.ReLU,
            activate_last_layer=True,
        )
        self.head = _PlanHead(hidden_size, plan_dim)

    def forward(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Computes the distribution of plans.

        Args:
            observation (torch.Tensor): the states in which plans start, ``[*B, D]``.
            goal (torch.Tensor): the desired goals, ``[*B, G]``.

        Returns:
            tuple of torch.Tensor: the mean and the log standard deviation of the plan,
            ``[*B, P]`` each.
        """
        inputs = torch.cat(
            [self.observation_norm(observation), self.goal_norm(goal)], dim=-1
        )
        loc, log_std = self.head(self.network(inputs))
        return loc, log_std


class OpenLoopDecoder(nn.Module):
    """The open-loop decoder π(a_t, ..., a_{t+κ-1} | z): an MLP on the plan alone.

    It does not read the state. With expert data the state nearly determines the
    action, and a decoder that reads it learns to ignore the plan (paper, A.5.1).

    Args:
        action_dim (int): the size ``A`` of the action.
        window (int): the number of steps κ.
        plan_dim (int): the size ``P`` of the plan.
        hidden_size (int): the width of the hidden layers.
        depth (int): the number of hidden layers.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.lmp_parts import OpenLoopDecoder
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
            plan (torch.Tensor): ``[*B, P]``.

        Returns:
            torch.Tensor: the actions of whole windows, ``[*B, κ, A]``, in [-1, 1].
        """
        actions: Tensor = self.network(plan).tanh()
        return actions.unflatten(-1, (self.window, -1))


class ClosedLoopDecoder(nn.Module):
    """The closed-loop decoder π(a | z, s): an MLP on a plan and the current state.

    Args:
        observation_norm (RunningNorm): the normalisation of the states.
        action_dim (int): the size ``A`` of the action.
        plan_dim (int): the size ``P`` of the plan.
        hidden_size (int): the width of the hidden layers.
        depth (int): the number of hidden layers.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.lmp_parts import ClosedLoopDecoder
        >>> from torchrl_caiac.modules import RunningNorm
        >>> decoder = ClosedLoopDecoder(RunningNorm(5), 3, 4, 8, 3)
        >>> decoder(torch.zeros(2, 4), torch.zeros(2, 5)).shape
        torch.Size([2, 3])
        >>> decoder(torch.zeros(2, 4), torch.zeros(2, 7, 5)).shape
        torch.Size([2, 7, 3])
    """

    def __init__(
        self,
        observation_norm: RunningNorm,
        action_dim: int,
        plan_dim: int,
        hidden_size: int,
        depth: int,
    ) -> None:
        super().__init__()
        self.observation_norm = observation_norm
        self.network = MLP(
            plan_dim + observation_norm.num_features,
            action_dim,
            depth=depth,
            num_cells=hidden_size,
            activation_class=nn.ReLU,
        )

    def forward(self, plan: Tensor, observation: Tensor) -> Tensor:
        """Decodes the action of one step, or of every step of a window.

        Args:
            plan (torch.Tensor): ``[*B, P]``.
            observation (torch.Tensor): states ``[*B, D]``, or ``[*B, κ, D]`` for whole
                windows.

        Returns:
            torch.Tensor: the actions, ``[*B, A]`` or ``[*B, κ, A]``, in [-1, 1].
        """
        if observation.ndim == plan.ndim + 1:
            plan = plan.unsqueeze(-2).expand(*observation.shape[:-1], plan.shape[-1])
        inputs = torch.cat([plan, self.observation_norm(observation)], dim=-1)
        action: Tensor = self.network(inputs).tanh()
        return action
