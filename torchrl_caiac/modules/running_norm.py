"""Normalisation by the exact mean and variance of all that was seen."""

from __future__ import annotations

import torch
from torch import nn

__all__ = ["RunningNorm"]


class RunningNorm(nn.Module):
    """Centres and scales features by their running mean and standard deviation.

    In training mode every batch is first merged into the statistics, exactly (Chan's
    parallel form of Welford's update: each row counts once, whatever its batch); in
    evaluation mode the statistics are frozen. There are no affine parameters. The
    result depends on the statistics only, not on the other rows of the batch.

    A feature that has been constant so far is centred and left unscaled.

    Args:
        num_features (int): the size ``F`` of the last dimension.

    Attributes:
        count (torch.Tensor): float64 ``[]``, the rows merged so far.
        mean (torch.Tensor): float64 ``[F]``.
        m2 (torch.Tensor): float64 ``[F]``, the sum of squared deviations.

    Raises:
        ValueError: ``num_features`` is below 1, or an input has another width.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.running_norm import RunningNorm
        >>> norm = RunningNorm(1)
        >>> _ = norm(torch.tensor([[1.0]])), norm(torch.tensor([[3.0], [5.0]]))
        >>> norm.mean, norm.var
        (tensor([3.], dtype=torch.float64), tensor([2.6667], dtype=torch.float64))
        >>> norm.eval()(torch.tensor([[3.0]]))
        tensor([[0.]])
    """

    count: torch.Tensor
    mean: torch.Tensor
    m2: torch.Tensor

    def __init__(self, num_features: int) -> None:
        super().__init__()
        if num_features < 1:
            raise ValueError(f"num_features must be at least 1, got {num_features}")
        self.num_features = int(num_features)
        # float64: after 1e5 batches a float32 sum no longer notices a new one.
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(num_features, dtype=torch.float64))
        self.register_buffer("m2", torch.zeros(num_features, dtype=torch.float64))

    @property
    def var(self) -> torch.Tensor:
        """The (population) variance of each feature, ``[F]``; 0 before any row."""
        return self.m2 / self.count.clamp_min(1)

    @property
    def scale(self) -> torch.Tensor:
        """The deviation of each feature, ``[F]``; 1 where it is constant."""
        var = self.var
        # A constant that float32 cannot represent exactly must not be blown up.
        constant = var <= (1e-6 * self.mean).square().clamp_min(1e-24)
        return torch.where(constant, torch.ones_like(var), var.sqrt())

    @torch.no_grad()
    def update(self, x: torch.Tensor) -> None:
        """Merges rows into the statistics, in any mode.

        Args:
            x (torch.Tensor): ``[*B, F]``; no row is no change.
        """
        self._check(x)
        rows = x.reshape(-1, self.num_features).to(self.mean.dtype)
        if not len(rows):
            return
        var, mean = torch.var_mean(rows, 0, correction=0)
        delta = mean - self.mean
        total = self.count + len(rows)
        self.mean.add_(delta * (len(rows) / total))
        self.m2.add_(
            var * len(rows) + delta.square() * (self.count * len(rows) / total)
        )
        self.count.copy_(total)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalises; in training mode merges the rows first.

        Args:
            x (torch.Tensor): ``[*B, F]``.

        Returns:
            torch.Tensor: ``[*B, F]`` of the dtype of ``x``.
        """
        if self.training:
            self.update(x)
        else:
            self._check(x)
        return (x - self.mean.to(x.dtype)) * self.scale.reciprocal().to(x.dtype)

    def extra_repr(self) -> str:
        """The size, for ``repr``."""
        return str(self.num_features)

    def _check(self, x: torch.Tensor) -> None:
        if x.ndim < 1 or x.shape[-1] != self.num_features:
            raise ValueError(
                f"expected [*B, {self.num_features}] features, got the shape "
                f"{list(x.shape)}"
            )
