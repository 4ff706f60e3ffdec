"""Latent Motor Plans: a model that plans windows of actions."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_caiac._keys import get_leaf
from torchrl_caiac.modules.lmp_parts import (
    ClosedLoopDecoder,
    OpenLoopDecoder,
    PlanPosterior,
    PlanPrior,
    gaussian_plan,
    plan_is_sampled,
)
from torchrl_caiac.modules.running_norm import RunningNorm, gather_statistics

__all__ = ["LMPModel"]


def read_leaf(tensordict: TensorDictBase, key: NestedKey, width: int) -> Tensor:
    """Reads a leaf whose last dimension has a given size.

    Args:
        tensordict (TensorDictBase): the data.
        key (NestedKey): the leaf.
        width (int): the size ``W`` of its last dimension.

    Returns:
        torch.Tensor: the leaf, ``[*B, W]``.

    Raises:
        KeyError: the leaf is missing.
        ValueError: its last dimension has another size.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.modules.lmp import read_leaf
        >>> td = TensorDict({"observation": torch.zeros(4, 3)}, [4])
        >>> read_leaf(td, "observation", 3).shape
        torch.Size([4, 3])
    """
    value = get_leaf(
        tensordict,
        key,
        "the data lack",
        "add it, or give the key of its leaf (the *_key arguments of LMPModel, "
        "set_keys of LMPLoss)",
    )
    if value.ndim == 0 or value.shape[-1] != width:
        raise ValueError(
            f"{key!r} has the shape {list(value.shape)}, expected [*B, {width}]: the "
            "model was made for other data"
        )
    return value


class LMPModel(TensorDictModuleBase):
    """Latent Motor Plans: a posterior, a goal-conditioned prior and a decoder.

    A plan z represents the actions of a window of κ steps. In training, the posterior
    q(z | τ) reads the window, the decoder reconstructs its actions, and the prior
    p(z | s, g) learns to predict the plan from the window's first state and a later
    goal. To act, a plan is drawn from the prior every κ steps
    (:class:`~torchrl_caiac.modules.LMPActor`). See the paper, A.5.1.

    The three parts are tensordict modules, which can be used and replaced on their own
    (``*B`` is any batch shape, ``P`` the size of the plan):

    - ``posterior``: observation ``[*B, κ, D]``, action ``[*B, κ, A]`` and mask
      ``[*B, κ]`` (optional) to ``("posterior", "loc")`` and
      ``("posterior", "log_std")``, ``[*B, P]``;
    - ``prior``: observation ``[*B, D]`` and goal ``[*B, G]`` to ``("prior", "loc")``
      and ``("prior", "log_std")``, ``[*B, P]``;
    - ``decoder``: plan ``[*B, P]`` to actions ``[*B, κ, A]``; the closed-loop decoder
      also reads the observation, ``[*B, D]`` for one step or ``[*B, κ, D]`` for a
      window, and returns one action for each.

    Called on a tensordict, the model performs the steps of acting: it reads one state
    and a goal, draws a plan from the prior and decodes it.

    The model normalises states, goals and actions, by statistics that
    :meth:`fit_statistics` computes from the data. Decoded actions are in [-1, 1].

    Denormal numbers slow down the LSTM's backward pass on CPUs once many units are
    saturated; ``torch.set_flush_denormal(True)`` in the training script avoids that.

    Args:
        observation_dim (int): the number of observation columns ``D``.
        goal_dim (int): the number of goal columns ``G``.
        action_dim (int): the size ``A`` of the action.
        window (int): the number of steps κ of a plan.
        plan_dim (int): the size ``P`` of the plan. Defaults to ``10``.
        hidden_size (int): the width of the LSTM and of all hidden layers. Defaults to
            ``128``.
        depth (int): the number of hidden layers of the prior and of the decoder.
            Defaults to ``3``.
        decoder (str): ``"open_loop"`` decodes a whole window from the plan alone;
            ``"closed_loop"`` decodes step by step from plan and state. Defaults to
            ``"open_loop"``.

    Keyword Args:
        observation_key (NestedKey): the states. Defaults to ``"observation"``.
        goal_key (NestedKey): the goals. Defaults to ``"desired_goal"``.
        action_key (NestedKey): the actions. Defaults to ``"action"``.
        mask_key (NestedKey): the flags of the valid steps of padded windows. Defaults
            to ``"mask"``.
        plan_key (NestedKey): where plans are written. Defaults to ``"plan"``.
        actions_key (NestedKey): where decoded actions are written. Defaults to
            ``("lmp", "actions")``.
        observation_floor (float): the smallest standard deviation that states are
            divided by. Defaults to ``0.02``.
        goal_floor (float): the same for goals. Defaults to ``0.02``.
        action_floor (float): the same for actions. Defaults to ``0.05``.

    Attributes:
        observation_norm (RunningNorm): the normalisation of the states.
        goal_norm (RunningNorm): the normalisation of the goals.
        action_norm (RunningNorm): the normalisation of the actions.

    Raises:
        ValueError: a size, a floor or the decoder's name is out of range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.modules import LMPModel
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
                raise ValueError(f"{name} must be at least 1, got {size}")
        floors = {
            "observation_floor": observation_floor,
            "goal_floor": goal_floor,
            "action_floor": action_floor,
        }
        for name, floor in floors.items():
            if not (0.0 < floor < math.inf):
                raise ValueError(f"{name} must be positive and finite, got {floor}")
        if decoder not in ("open_loop", "closed_loop"):
            raise ValueError(
                f"decoder must be 'open_loop' or 'closed_loop', got {decoder!r}"
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

        # The parts share these modules: each can be used on its own, and one call of
        # fit_statistics sets the statistics of all.
        self.observation_norm = RunningNorm(
            observation_dim, floor=observation_floor, frozen=True
        )
        self.goal_norm = RunningNorm(goal_dim, floor=goal_floor, frozen=True)
        self.action_norm = RunningNorm(action_dim, floor=action_floor, frozen=True)
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
        """The arguments of the model, for ``LMPModel(**config)``."""
        return dict(self._config)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Draws a plan from the prior and decodes it.

        The plan is the prior's mean under ``ExplorationType.DETERMINISTIC``.

        Args:
            tensordict (TensorDictBase): states ``[*B, D]`` and goals ``[*B, G]``.

        Returns:
            TensorDictBase: the same tensordict with the prior's parameters, the plan
            and the decoded actions.

        Raises:
            KeyError: a leaf is missing.
            ValueError: a leaf has the wrong width.
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
        """Computes the statistics of states, goals and actions from data.

        The data are read in chunks, so that memory-mapped data are never loaded as a
        whole. Steps that the mask leaf flags as padding are left out. Nothing changes
        if an error is raised.

        Args:
            tensordict (TensorDictBase): transitions, flat or in windows.

        Keyword Args:
            goals (torch.Tensor, optional): the goals that the model will be conditioned
                on, ``[*, G]``, such as the achieved goals of all transitions if goals
                are relabelled while sampling. Defaults to the leaf of the goals.

        Returns:
            LMPModel: the model itself.

        Raises:
            KeyError: a leaf is missing.
            ValueError: a leaf is empty, has the wrong width or contains non-finite
                values, or actions are outside [-1, 1].

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from torchrl_caiac.modules import LMPModel
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
        observation = read_leaf(tensordict, self.observation_key, self.observation_dim)
        action = read_leaf(tensordict, self.action_key, self.action_dim)
        if goals is None:
            goals = read_leaf(tensordict, self.goal_key, self.goal_dim)
            of_goals = gather_statistics(goals, self.goal_key, mask=mask)
        elif goals.ndim == 0 or goals.shape[-1] != self.goal_dim:
            raise ValueError(
                f"goals has the shape {list(goals.shape)}, expected "
                f"[*, {self.goal_dim}]: the model was made for other goals"
            )
        else:
            of_goals = gather_statistics(goals, "goals")
        of_states = gather_statistics(observation, self.observation_key, mask=mask)
        of_actions = gather_statistics(action, self.action_key, mask=mask, bound=1.0)
        self.observation_norm.replace(of_states)
        self.goal_norm.replace(of_goals)
        self.action_norm.replace(of_actions)
        return self
