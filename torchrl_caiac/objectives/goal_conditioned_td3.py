"""TD3 with goals, bounded targets and optional behaviour cloning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torchrl.data.tensor_specs import TensorSpec
from torchrl.objectives import TD3Loss
from torchrl.objectives.utils import distance_loss

from torchrl_caiac._keys import as_key
from torchrl_caiac._torchrl import priority_weight, reduce_loss, vmap_loss
from torchrl_caiac.modules._action_bounds import check_actions
from torchrl_caiac.modules.goal_features import read_leaves
from torchrl_caiac.modules.goal_networks import takes_params

__all__ = ["GoalConditionedTD3Loss"]

_ACTION_CHECKS = 10  # calls of a loss in which the actions are checked


class GoalConditionedTD3Loss(TD3Loss):
    """TorchRL's TD3 loss for goal-conditioned, offline and relabelled data.

    It differs from :class:`~torchrl.objectives.TD3Loss` as follows (paper, A.5.2):

    - The next state is evaluated with the goal of its own transition.
      ``("next", "desired_goal")`` is never read: a relabelled batch lacks it, or has
      the goal from before the relabelling. A missing next state raises an error.
    - Targets are clamped to the range of possible returns, as in Hindsight Experience
      Replay: rewards in ``reward_bounds`` give returns in those bounds over ``1 - γ``.
    - ``("next", "terminated")`` is required, and values are bootstrapped unless it is
      true: the time limit of an episode does not end the task.
    - The loss of the policy may have a penalty on actions and a behaviour cloning term
      (TD3+BC, Fujimoto & Gu 2021): ``-λ Q(s, g, π) + |π - a|² / A`` with
      ``λ = bc_alpha / mean |Q|``. Transitions can be left out of the latter, such as
      random ones. Counterfactual ones contain the action of the expert before the
      swap: it suits the swapped state too if the swap leaves out the entity that the
      action is for (``CAIACTransform(lookahead="next")``).
    - The loss of the policy evaluates the first critic only.
    - Actions of the data outside of their bounds are an error: the policy cannot return
      them. The first ten calls are checked, on an accelerator only the first one, and
      none of a compiled loss.
    - The networks of this package are called with the parameters of the loss, those of
      all critics at once, which saves a fifth of the time of a step. Parameters of
      other networks are swapped in and out as in TorchRL, with ``deactivate_vmap``.

    Everything else, such as :meth:`make_value_estimator` with the discount,
    ``set_keys`` and :class:`~torchrl.objectives.SoftUpdate`, is as in TorchRL.

    Args:
        actor_network (TensorDictModule): the policy ``π(s, g)``, such as a
            :class:`~torchrl_caiac.modules.GoalConditionedActor`.
        qvalue_network (TensorDictModule or list of TensorDictModule): the critic
            ``Q(s, g, a)``. With a list of one module for each critic, their weights are
            kept; TorchRL copies a single one and draws new weights.

    Keyword Args:
        bounds (tuple of float, optional): the bounds of the actions. Defaults to
            ``(-1.0, 1.0)`` if there is no ``action_spec``.
        action_spec (TensorSpec, optional): the bounds as a spec, instead of ``bounds``.
        num_qvalue_nets (int): the number of critics, unless they are a list. Defaults
            to ``2``.
        reward_bounds (tuple of float, optional): the smallest and the largest reward,
            which determine the bounds of the targets. Defaults to ``(-1.0, 0.0)``.
        target_bounds (tuple of float, optional): the bounds of the targets, instead of
            ``reward_bounds``. Targets are not clamped if both are ``None``.
        action_penalty (float): the weight of the policy's mean squared action. Defaults
            to ``0.0``.
        bc_alpha (float, optional): the weight of the value relative to the behaviour
            cloning term (TD3+BC: 2.5). Defaults to ``None``: no such term.
        bc_mask_key (NestedKey, optional): a bool leaf, ``[*B]`` or ``[*B, 1]``, true
            for the transitions to leave out of the behaviour cloning term, such as
            those of failed episodes. Defaults to ``None``: none is left out.
        policy_noise (float): the standard deviation of the noise on the action of the
            target policy, in units of the action. Defaults to ``0.2``.
        noise_clip (float): the largest such noise. Defaults to ``0.5``.
        loss_function (str): ``"l2"``, ``"l1"`` or ``"smooth_l1"``. Defaults to
            ``"l2"``, as in TD3.
        **kwargs: further arguments of :class:`~torchrl.objectives.TD3Loss`, such as
            ``reduction`` (``"mean"``, ``"sum"`` or ``"none"``).

    Returns:
        TensorDict: ``"loss_actor"`` and ``"loss_qvalue"`` (the sum over critics); and
        detached, for each transition, ``"pred_value"`` (``[C, *B]`` for ``C`` critics),
        ``"state_action_value_actor"``, ``"next_state_value"`` and ``"target_value"``
        (``[*B]``); with ``bc_alpha`` also the scalars ``"bc_loss"`` and ``"lmbd"``.

    Raises:
        ValueError: bounds are given twice or out of order, a weight is negative, or
            there is a ``bc_mask_key`` without ``bc_alpha``; in a call, an action is
            outside of the bounds by more than 1e-3 of their width.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules import (
        ...     GoalConditionedActor,
        ...     GoalConditionedCritic,
        ...     GoalFeatures,
        ... )
        >>> from torchrl_caiac.objectives import GoalConditionedTD3Loss
        >>> layout = EntityLayout(
        ...     {"cube": [0, 1]}, goal={"cube": [0]}, achieved={"cube": [0]}
        ... )
        >>> features = GoalFeatures(layout)
        >>> loss = GoalConditionedTD3Loss(
        ...     GoalConditionedActor(features, 2, (16, 16)),
        ...     [GoalConditionedCritic(features, 2, (16, 16)) for _ in range(2)],
        ... )
        >>> _ = loss.make_value_estimator(gamma=0.97)
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> td = TensorDict(
        ...     {
        ...         "observation": torch.randn(8, 2),
        ...         "desired_goal": torch.randn(8, 1),
        ...         "action": torch.rand(8, 2),
        ...         "next": {
        ...             "observation": torch.randn(8, 2),
        ...             "reward": -torch.ones(8, 1),
        ...             "terminated": torch.zeros(8, 1, dtype=torch.bool),
        ...             "done": torch.zeros(8, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     [8],
        ... )
        >>> losses = loss(td)
        >>> (losses["loss_actor"] + losses["loss_qvalue"]).backward()
        >>> updater.step()
    """

    @dataclass
    class _AcceptedKeys(TD3Loss._AcceptedKeys):
        """The keys that ``set_keys`` accepts: those of TD3Loss and the goal.

        Attributes:
            desired_goal (NestedKey): the goal, ``[*B, G]``, an input of the networks.
                Defaults to ``"desired_goal"``.
        """

        desired_goal: NestedKey = "desired_goal"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    out_keys: Sequence[NestedKey] = (
        "loss_actor",
        "loss_qvalue",
        "pred_value",
        "state_action_value_actor",
        "next_state_value",
        "target_value",
    )

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        bounds: tuple[float, float] | None = None,
        action_spec: TensorSpec | None = None,
        num_qvalue_nets: int = 2,
        reward_bounds: tuple[float, float] | None = (-1.0, 0.0),
        target_bounds: tuple[float, float] | None = None,
        action_penalty: float = 0.0,
        bc_alpha: float | None = None,
        bc_mask_key: NestedKey | None = None,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        loss_function: str = "l2",
        **kwargs: Any,
    ) -> None:
        if target_bounds is not None:
            if reward_bounds not in (None, (-1.0, 0.0)):
                raise ValueError(
                    f"got target_bounds={target_bounds!r} and "
                    f"reward_bounds={reward_bounds!r}: give one of them"
                )
            reward_bounds = None
        for name, pair in (
            ("reward_bounds", reward_bounds),
            ("target_bounds", target_bounds),
        ):
            if pair is not None and not pair[0] < pair[1]:
                raise ValueError(f"{name} must be a pair (low, high), got {pair!r}")
        if not action_penalty >= 0.0:
            raise ValueError(f"action_penalty must be at least 0, got {action_penalty}")
        if bc_alpha is not None and not bc_alpha >= 0.0:
            raise ValueError(f"bc_alpha must be at least 0 or None, got {bc_alpha}")
        if bc_mask_key is not None and bc_alpha is None:
            raise ValueError(
                f"bc_mask_key={bc_mask_key!r} is for the behaviour cloning term, which "
                "bc_alpha=None leaves out: give bc_alpha"
            )
        if isinstance(qvalue_network, Sequence):
            num_qvalue_nets = len(qvalue_network)
        if bounds is None and action_spec is None:
            bounds = (-1.0, 1.0)
        super().__init__(
            actor_network,
            qvalue_network,
            bounds=bounds,
            action_spec=action_spec,
            num_qvalue_nets=num_qvalue_nets,
            policy_noise=policy_noise,
            noise_clip=noise_clip,
            loss_function=loss_function,
            **kwargs,
        )
        self.reward_bounds = reward_bounds
        self._target_bounds = target_bounds
        self.action_penalty = action_penalty
        self.bc_alpha = bc_alpha
        self.bc_mask_key = None if bc_mask_key is None else as_key(bc_mask_key)
        if bc_alpha is not None:
            self.out_keys = [*self.out_keys, "bc_loss", "lmbd"]
        self._action_checks = _ACTION_CHECKS

    # --- keys --------------------------------------------------------------------

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        self._in_keys = list(
            dict.fromkeys(
                as_key(key)
                for key in (
                    keys.action,
                    *self._state_keys,
                    *(("next", key) for key in self._state_keys if not self._goal(key)),
                    ("next", keys.reward),
                    ("next", keys.done),
                    ("next", keys.terminated),
                    *([] if self.bc_mask_key is None else [self.bc_mask_key]),
                )
            )
        )

    @property
    def _state_keys(self) -> list[NestedKey]:
        """The inputs of the networks without the action."""
        inputs = [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
        keys = [key for key in dict.fromkeys(inputs) if key != self.tensor_keys.action]
        if not any(map(self._goal, keys)):
            raise ValueError(
                f"the networks read {keys}, but not the goal "
                f"{self.tensor_keys.desired_goal!r}: name its key with "
                "set_keys(desired_goal=...)"
            )
        return keys

    def _goal(self, key: NestedKey) -> bool:
        return as_key(key) == as_key(self.tensor_keys.desired_goal)

    # --- targets -----------------------------------------------------------------

    def make_value_estimator(
        self, value_type: Any = None, **hyperparams: Any
    ) -> GoalConditionedTD3Loss:
        """Sets the estimator of the targets, as in TorchRL.

        Args:
            value_type (ValueEstimators, ValueEstimatorBase or type, optional): the
                estimator, its kind, or its class. Defaults to ``ValueEstimators.TD0``.
            **hyperparams: arguments of the estimator, such as ``gamma``, which defaults
                to ``0.99``.

        Returns:
            GoalConditionedTD3Loss: the loss itself.

        Raises:
            ValueError: ``gamma`` is not below 1, so that rewards in ``reward_bounds``
                give unbounded targets.
        """
        super().make_value_estimator(value_type, **hyperparams)
        # Passes the keys of the loss to an estimator that was given as an object.
        self.set_keys()
        gamma = float(self.value_estimator.gamma)
        if self.reward_bounds is not None and not gamma < 1.0:
            raise ValueError(
                f"gamma is {gamma}, expected less than 1, else returns of rewards in "
                f"{self.reward_bounds} are unbounded: give target_bounds, or "
                "reward_bounds=None"
            )
        return self

    @property
    def target_bounds(self) -> tuple[Any, Any] | None:
        """The bounds of the targets, ``None`` if they are not clamped."""
        if self.reward_bounds is None:
            return self._target_bounds
        low, high = self.reward_bounds
        horizon = 1.0 / (1.0 - self.value_estimator.gamma)
        return low * horizon, high * horizon

    # --- losses ------------------------------------------------------------------

    def actor_loss(
        self, tensordict: TensorDictBase
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Computes the loss of the policy, without gradients for the critics.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]``, not changed.

        Returns:
            tuple of torch.Tensor and dict: the loss; and detached
            ``"state_action_value_actor"`` ``[*B]`` and, with ``bc_alpha``, the scalars
            ``"bc_loss"`` and ``"lmbd"``.
        """
        self._check_actions(tensordict)
        weights = priority_weight(self, tensordict)
        inputs = self._inputs(tensordict, self._state_keys)
        inputs = _call(self.actor_network, inputs, self.actor_network_params)
        action = inputs.get(self.tensor_keys.action)
        # Not detach(): tensordict caches it, and the cache survives a change of dtype.
        critic = self.qvalue_network_params.data[0]
        inputs = _call(self.qvalue_network, inputs, critic)
        value = inputs.get(self.tensor_keys.state_action_value).squeeze(-1)
        metadata = {"state_action_value_actor": value.detach()}
        loss = -value
        if self.bc_alpha is not None:
            size = reduce_loss(self, value.detach().abs(), tensordict, reduction="mean")
            metadata["lmbd"] = self.bc_alpha / size.clamp_min(1e-8)
            error = self._cloning_error(action, tensordict)
            metadata["bc_loss"] = reduce_loss(
                self, error.detach(), tensordict, reduction="mean"
            )
            loss = metadata["lmbd"] * loss + error
        if self.action_penalty:
            loss = loss + self.action_penalty * action.square().mean(-1)
        loss = reduce_loss(self, loss, tensordict, weights=weights)
        return loss, metadata

    def value_loss(
        self, tensordict: TensorDictBase
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Computes the loss of the critics, without gradients for the policy.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]``, not changed.

        Returns:
            tuple of torch.Tensor and dict: the loss; and detached ``"td_error"`` and
            ``"pred_value"`` ``[C, *B]``, ``"next_state_value"`` and ``"target_value"``
            ``[*B]``.
        """
        self._check_actions(tensordict)
        keys = self.tensor_keys
        weights = priority_weight(self, tensordict)
        inputs = self._inputs(tensordict, [*self._state_keys, keys.action])
        action = inputs.get(keys.action)
        noise = (torch.randn_like(action) * self.policy_noise).clamp(
            -self.noise_clip, self.noise_clip
        )
        with torch.no_grad():
            after = self._inputs(tensordict, self._state_keys, after=True)
            after = _call(self.actor_network, after, self.target_actor_network_params)
            after.set(
                keys.action,
                (after.get(keys.action) + noise).clamp(
                    self.min_action, self.max_action
                ),
            )
            next_value = self._values(after, self.target_qvalue_network_params).amin(0)
            target = self._target(tensordict, next_value)
        value = self._values(inputs, self.qvalue_network_params)
        loss = distance_loss(value, target.expand_as(value), self.loss_function).sum(0)
        metadata = {
            "td_error": (value.detach() - target).square(),
            "next_state_value": next_value,
            "pred_value": value.detach(),
            "target_value": target,
        }
        loss = reduce_loss(self, loss, tensordict, weights=weights)
        return loss, metadata

    def _make_vmap(self) -> None:
        super()._make_vmap()
        # All critics have the same input: only their weights are mapped over.
        self._vmap_qvalue_networkN0 = vmap_loss(
            self.qvalue_network,
            (None, 0),
            randomness=self.vmap_randomness,
            pseudo_vmap=self.deactivate_vmap,
        )

    def _values(self, inputs: TensorDictBase, params: TensorDictBase) -> torch.Tensor:
        """Returns the values of all critics, ``[C, *B]``."""
        if takes_params(self.qvalue_network):
            out = self.qvalue_network(inputs.unsqueeze(0), params)
        else:
            out = self._vmap_qvalue_networkN0(inputs, params)
        value: torch.Tensor = out.get(self.tensor_keys.state_action_value)
        return value.squeeze(-1)

    def _target(
        self, tensordict: TensorDictBase, next_value: torch.Tensor
    ) -> torch.Tensor:
        keys = self.tensor_keys
        for name in (keys.reward, keys.terminated):
            shape = read_leaves(tensordict, [("next", name)])[0].shape
            if shape != (*next_value.shape, 1):
                raise ValueError(
                    f"{('next', name)!r} has the shape {list(shape)}, expected "
                    f"{[*next_value.shape, 1]}"
                )
        target: torch.Tensor = self.value_estimator.value_estimate(
            tensordict, next_value=next_value.unsqueeze(-1)
        ).squeeze(-1)
        bounds = self.target_bounds
        return target if bounds is None else target.clamp(*bounds)

    def _cloning_error(
        self, action: torch.Tensor, tensordict: TensorDictBase
    ) -> torch.Tensor:
        """Returns errors ``[*B]``, whose mean is that over unmasked transitions."""
        (expert,) = read_leaves(tensordict, [self.tensor_keys.action])
        error = (action - expert).square().mean(-1)
        if self.bc_mask_key is None:
            return error
        (masked,) = read_leaves(tensordict, [self.bc_mask_key])
        if masked.dtype != torch.bool or masked.numel() != error.numel():
            raise ValueError(
                f"{self.bc_mask_key!r} is {masked.dtype} of the shape "
                f"{list(masked.shape)}, expected bool {[*error.shape, 1]}, true for "
                "transitions to leave out"
            )
        kept = ~masked.reshape(error.shape)
        error = error.where(kept, torch.zeros_like(error))
        return error * (kept.numel() / kept.sum().clamp_min(1))

    # --- reading -----------------------------------------------------------------

    def _check_actions(self, tensordict: TensorDictBase) -> None:
        # A compiled loss cannot raise errors that depend on values.
        if torch.compiler.is_compiling() or not self._action_checks:
            return
        (action,) = read_leaves(tensordict, [self.tensor_keys.action])
        check_actions(
            action,
            self.min_action,
            self.max_action,
            self.tensor_keys.action,
            tolerance=1e-3,
            remedy="give bounds or action_spec of these actions (and low and high of "
            "the policy), or rescale the actions of the data",
        )
        # On an accelerator the host waits for the result, so only once.
        on_cpu = action.device.type == "cpu"
        self._action_checks = self._action_checks - 1 if on_cpu else 0

    def _inputs(
        self,
        tensordict: TensorDictBase,
        keys: Sequence[NestedKey],
        *,
        after: bool = False,
    ) -> TensorDict:
        """Returns the inputs of the networks, of the next state if ``after``."""
        sources = [
            ("next", key) if after and not self._goal(key) else key for key in keys
        ]
        return TensorDict(
            dict(zip(keys, read_leaves(tensordict, sources), strict=True)),
            tensordict.batch_size,
            device=tensordict.device,
        )


def _call(
    network: TensorDictModule, inputs: TensorDictBase, params: TensorDictBase
) -> TensorDictBase:
    """Calls a network with parameters of the loss."""
    if takes_params(network):
        return network(inputs, params)
    with params.to_module(network, preserve_module_state=False):
        return network(inputs)
