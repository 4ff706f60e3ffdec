"""The loss of Latent Motor Plans: reconstruction and a balanced KL divergence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_caiac._keys import floating
from torchrl_caiac._random import draw_numbers
from torchrl_caiac._torchrl import loss_masks
from torchrl_caiac.modules.lmp import LMPModel, read_leaf
from torchrl_caiac.modules.lmp_parts import gaussian_plan

__all__ = ["LMPLoss", "balanced_kl", "gaussian_kl"]


def gaussian_kl(
    loc_q: Tensor, log_std_q: Tensor, loc_p: Tensor, log_std_p: Tensor
) -> Tensor:
    """Returns the KL divergence of two diagonal Gaussians, summed over dimensions.

    Args:
        loc_q (torch.Tensor): the mean of q, ``[*B, P]``.
        log_std_q (torch.Tensor): the log standard deviation of q, ``[*B, P]``.
        loc_p (torch.Tensor): the mean of p, ``[*B, P]``.
        log_std_p (torch.Tensor): the log standard deviation of p, ``[*B, P]``.

    Returns:
        torch.Tensor: KL(q || p) in nats, ``[*B]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.objectives.lmp import gaussian_kl
        >>> zero = torch.zeros(2)
        >>> gaussian_kl(torch.ones(2), zero, zero, zero)
        tensor(1.)
    """
    log_ratio = log_std_q - log_std_p
    distance = (loc_q - loc_p) * torch.exp(-log_std_p)
    # The formula needs variances, hence twice the log standard deviations. expm1 keeps
    # the precision if both distributions are nearly the same.
    per_dim = 0.5 * (torch.expm1(2.0 * log_ratio) + distance.square()) - log_ratio
    return per_dim.sum(-1)


def balanced_kl(
    loc_q: Tensor,
    log_std_q: Tensor,
    loc_p: Tensor,
    log_std_p: Tensor,
    balance: float | Tensor,
) -> Tensor:
    """Returns KL(q || p), with its gradient divided between p and q (paper, A.5.1).

    The value is that of :func:`gaussian_kl`. The gradient of p's parameters is
    multiplied by ``balance``, that of q's by ``1 - balance``. Early in training, the
    posterior is thereby not pulled towards an untrained prior.

    Args:
        loc_q (torch.Tensor): the mean of q, ``[*B, P]``.
        log_std_q (torch.Tensor): the log standard deviation of q, ``[*B, P]``.
        loc_p (torch.Tensor): the mean of p, ``[*B, P]``.
        log_std_p (torch.Tensor): the log standard deviation of p, ``[*B, P]``.
        balance (float or torch.Tensor): the fraction of the gradient for p's
            parameters, in [0, 1].

    Returns:
        torch.Tensor: KL(q || p) in nats, ``[*B]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.objectives.lmp import balanced_kl
        >>> q = torch.ones(1, requires_grad=True)
        >>> p = torch.zeros(1, requires_grad=True)
        >>> zero = torch.zeros(1)
        >>> balanced_kl(q, zero, p, zero, 0.75).sum().backward()
        >>> q.grad, p.grad
        (tensor([0.2500]), tensor([-0.7500]))
    """
    for_prior = gaussian_kl(loc_q.detach(), log_std_q.detach(), loc_p, log_std_p)
    for_posterior = gaussian_kl(loc_q, log_std_q, loc_p.detach(), log_std_p.detach())
    return balance * for_prior + (1.0 - balance) * for_posterior


class LMPLoss(LossModule):
    """The loss of Latent Motor Plans on windows (paper, A.5.1).

    The posterior encodes each window, a plan is drawn with the reparameterisation
    trick, and the decoder reconstructs the actions. The result has two losses, whose
    sum is minimised: ``"loss_reconstruction"`` is the squared error, summed over the
    action dimensions and averaged over the valid steps, times
    ``reconstruction_weight``; ``"loss_kl"`` is KL(posterior || prior) times
    ``kl_weight``, with its gradient balanced between the two. The prior reads the first
    state and the first goal of a window.

    A batch contains windows: leaves of the shape ``[*B, κ, ...]``. Samples of a
    ``SliceSampler`` are flat; ``batch.reshape(-1, κ)`` turns them into windows. Windows
    that are padded at their end have a bool leaf ``"mask"``, ``[*B, κ]`` or
    ``[*B, κ, 1]``, true for the valid steps. TorchRL's own masks (``loss_mask_key`` of
    :class:`~torchrl.objectives.LossModule`) are applied too.

    The loss is not functional: its parameters are the model's.

    Args:
        model (LMPModel): the model to train.
        kl_weight (float): the weight of the KL divergence, a buffer that may be
            assigned to. Defaults to ``1.0``.
        kl_balance (float): the fraction of the KL divergence's gradient for the prior,
            a buffer. Defaults to ``0.8``.
        reconstruction_weight (float): the weight of the squared error, a buffer.
            Defaults to ``2.0``.

    Keyword Args:
        reduction (str): ``"mean"`` or ``"sum"`` over the windows, or ``"none"``, which
            gives ``[*B]``. Defaults to ``"mean"``.
        generator (torch.Generator, optional): the generator of the noise of plans, on
            any device. Defaults to the global one.

    Raises:
        ValueError: a weight, the balance or the reduction is out of range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.modules import LMPModel
        >>> from torchrl_caiac.objectives import LMPLoss
        >>> model = LMPModel(observation_dim=5, goal_dim=2, action_dim=3, window=10)
        >>> loss = LMPLoss(model)
        >>> flat = TensorDict(
        ...     {
        ...         "observation": torch.randn(80, 5),
        ...         "action": torch.rand(80, 3),
        ...         "desired_goal": torch.randn(80, 2),
        ...     },
        ...     batch_size=[80],
        ... )
        >>> losses = loss(flat.reshape(-1, 10))
        >>> sorted(losses.keys())
        ['kl', 'loss_kl', 'loss_reconstruction', 'mse']
        >>> (losses["loss_reconstruction"] + losses["loss_kl"]).backward()
    """

    @dataclass
    class _AcceptedKeys:
        """The keys that ``set_keys`` accepts. They default to those of the model.

        Attributes:
            observation (NestedKey): states ``[*B, κ, D]``.
            action (NestedKey): actions ``[*B, κ, A]``.
            desired_goal (NestedKey): goals ``[*B, κ, G]``; the first of each window is
                read.
            mask (NestedKey): bool ``[*B, κ]`` or ``[*B, κ, 1]``, true for the valid
                steps; optional.
        """

        observation: NestedKey = "observation"
        action: NestedKey = "action"
        desired_goal: NestedKey = "desired_goal"
        mask: NestedKey = "mask"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    out_keys: ClassVar[list[NestedKey]] = [
        "loss_reconstruction",
        "loss_kl",
        "kl",
        "mse",
    ]
    _schedulable_buffers = frozenset(
        {"kl_weight", "kl_balance", "reconstruction_weight"}
    )

    model: LMPModel
    kl_weight: Tensor
    kl_balance: Tensor
    reconstruction_weight: Tensor

    def __init__(
        self,
        model: LMPModel,
        kl_weight: float = 1.0,
        kl_balance: float = 0.8,
        reconstruction_weight: float = 2.0,
        *,
        reduction: Literal["none", "mean", "sum"] = "mean",
        generator: torch.Generator | None = None,
    ) -> None:
        if not kl_weight >= 0.0:
            raise ValueError(f"kl_weight must be at least 0, got {kl_weight}")
        if not 0.0 <= kl_balance <= 1.0:
            raise ValueError(f"kl_balance must be in [0, 1], got {kl_balance}")
        if not reconstruction_weight >= 0.0:
            raise ValueError(
                f"reconstruction_weight must be at least 0, got {reconstruction_weight}"
            )
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(
                f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}"
            )
        super().__init__()
        self.model = model
        self.register_buffer("kl_weight", torch.tensor(float(kl_weight)))
        self.register_buffer("kl_balance", torch.tensor(float(kl_balance)))
        self.register_buffer(
            "reconstruction_weight", torch.tensor(float(reconstruction_weight))
        )
        self.reduction = reduction
        self.generator = generator
        self.set_keys(
            observation=model.observation_key,
            action=model.action_key,
            desired_goal=model.goal_key,
            mask=model.mask_key,
        )

    @property
    def functional(self) -> bool:
        """``False``: the model keeps its parameters."""
        return False

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        self._in_keys = [keys.observation, keys.action, keys.desired_goal]

    @property
    def in_keys(self) -> list[NestedKey]:
        """The required leaves, without the optional mask."""
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes both losses.

        Args:
            tensordict (TensorDictBase): windows, ``[*B, κ]``.

        Returns:
            TensorDictBase: ``"loss_reconstruction"``, ``"loss_kl"`` and, detached,
            ``"kl"`` (without its weight) and ``"mse"`` (the squared error, also
            averaged over the action dimensions); scalars, or ``[*B]`` with the
            reduction ``"none"``.

        Raises:
            KeyError: a leaf is missing.
            ValueError: a leaf has the wrong shape, the windows have another length than
                the model's, the mask is not true for the first steps of a window and
                false for the others, or a value is not finite.
        """
        model = self.model
        observation, action, goal, mask = self._read(tensordict)
        *batch, window, _ = observation.shape

        encoded = TensorDict(batch_size=batch)
        encoded.set(model.observation_key, observation)
        encoded.set(model.action_key, action)
        if mask is not None:
            encoded.set(model.mask_key, mask)
        encoded = model.posterior(encoded)
        loc_q = encoded.get(model.posterior_loc_key)
        log_std_q = encoded.get(model.posterior_log_std_key)

        predicted = TensorDict(batch_size=batch)
        predicted.set(model.observation_key, observation[..., 0, :])
        predicted.set(model.goal_key, goal[..., 0, :])
        predicted = model.prior(predicted)
        loc_p = predicted.get(model.prior_loc_key)
        log_std_p = predicted.get(model.prior_log_std_key)

        # Losses run with the deterministic exploration type, under which a
        # probabilistic module would not sample.
        noise = draw_numbers(
            torch.randn,
            loc_q.shape,
            generator=self.generator,
            dtype=loc_q.dtype,
            device=loc_q.device,
        )
        decoded = TensorDict(batch_size=batch)
        decoded.set(model.plan_key, gaussian_plan(loc_q, log_std_q, noise))
        decoded.set(model.observation_key, observation)
        decoded = model.decoder(decoded)
        prediction = decoded.get(model.actions_key)[..., :window, :]

        error = (prediction - action.to(prediction.dtype)).square().sum(-1)
        if mask is None:
            error = error.mean(-1)
        else:
            error = error.where(mask, torch.zeros_like(error)).sum(-1) / mask.sum(-1)
        kl = balanced_kl(loc_q, log_std_q, loc_p, log_std_p, self.kl_balance)
        error, kl = self._reduce(error), self._reduce(kl)
        if not (error.isfinite().all() and kl.isfinite().all()):
            self._name_non_finite(observation, action, goal[..., 0, :])
        return TensorDict(
            {
                "loss_reconstruction": self.reconstruction_weight * error,
                "loss_kl": self.kl_weight * kl,
                "kl": kl.detach(),
                "mse": error.detach() / model.action_dim,
            },
            batch_size=batch if self.reduction == "none" else [],
        )

    def _reduce(self, value: Tensor) -> Tensor:
        if self.reduction == "mean":
            return value.mean()
        return value.sum() if self.reduction == "sum" else value

    def _read(
        self, tensordict: TensorDictBase
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        model, keys = self.model, self.tensor_keys
        observation, action, goal = (
            floating(read_leaf(tensordict, key, width))
            for key, width in (
                (keys.observation, model.observation_dim),
                (keys.action, model.action_dim),
                (keys.desired_goal, model.goal_dim),
            )
        )
        if observation.ndim < 2:
            raise ValueError(
                f"{keys.observation!r} has the shape {list(observation.shape)}, "
                f"expected windows [*B, {model.window}, {model.observation_dim}]: "
                f"reshape a flat batch with batch.reshape(-1, {model.window})"
            )
        rows = observation.shape[:-1]
        for key, value in ((keys.action, action), (keys.desired_goal, goal)):
            if value.shape[:-1] != rows:
                raise ValueError(
                    f"{key!r} has the shape {list(value.shape)}, but "
                    f"{keys.observation!r} has {list(observation.shape)}: all "
                    "dimensions but the last must agree"
                )
        if rows.numel() == 0:
            raise ValueError(
                f"{keys.observation!r} has the shape {list(observation.shape)}: the "
                "batch has no window"
            )
        mask = self._read_mask(tensordict, rows)
        length = rows[-1]
        if length > model.window or (length < model.window and mask is None):
            raise ValueError(
                f"{keys.observation!r} has the shape {list(observation.shape)}, "
                f"windows of {length} steps, expected {model.window}: reshape a flat "
                f"batch with batch.reshape(-1, {model.window}), or pad shorter windows "
                f"and flag their valid steps in {keys.mask!r}"
            )
        if mask is not None:
            # Padding may contain anything, and must not reach a network.
            blank = ~mask.unsqueeze(-1)
            observation = observation.masked_fill(blank, 0.0)
            action = action.masked_fill(blank, 0.0)
        return observation, action, goal, mask

    def _read_mask(self, tensordict: TensorDictBase, rows: torch.Size) -> Tensor | None:
        found: Tensor | None = None
        for key in (self.tensor_keys.mask, *loss_masks(self)):
            mask = tensordict.get(key, None)
            if mask is None:
                continue
            if mask.dtype != torch.bool or mask.shape not in (rows, (*rows, 1)):
                raise ValueError(
                    f"{key!r} is {mask.dtype} of the shape {list(mask.shape)}, "
                    f"expected bool {list(rows)}, true for the valid steps"
                )
            mask = mask.reshape(rows)
            if not mask[..., 0].all() or (mask[..., 1:] & ~mask[..., :-1]).any():
                raise ValueError(
                    f"{key!r} must be true for the first steps of every window, at "
                    "least one, and false for the others: pad windows at their end only"
                )
            found = mask if found is None else found & mask
        return found

    def _name_non_finite(
        self, observation: Tensor, action: Tensor, goal: Tensor
    ) -> None:
        """Raises if the input is the cause of a non-finite loss."""
        keys = self.tensor_keys
        for key, value in (
            (keys.observation, observation),
            (keys.action, action),
            (keys.desired_goal, goal),
        ):
            count = int((~value.isfinite()).sum())
            if count:
                raise ValueError(
                    f"{key!r} has {count} non-finite values in a batch of the shape "
                    f"{list(value.shape)}: remove or repair these rows in the data"
                )
