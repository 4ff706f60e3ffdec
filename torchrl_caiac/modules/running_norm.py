"""Normalisation by the mean and the standard deviation of the data."""

from __future__ import annotations

import math

import torch
from tensordict.utils import NestedKey
from torch import nn

from torchrl_caiac._keys import floating

__all__ = ["RunningNorm", "gather_statistics"]

_ROWS_PER_CHUNK = 65_536


# TorchRL's VecNorm is an environment transform and averages exponentially, which
# depends on the order of the data; ObservationNorm reads its statistics from rollouts.
# Here every row counts the same, and the layer is a part of the network.
class RunningNorm(nn.Module):
    """Centres and scales features by the mean and standard deviation of all rows.

    Each batch is merged into the statistics exactly (Chan's parallel form of Welford's
    update): every row counts once, whatever its batch. There are no affine parameters.
    The result depends on the statistics only, not on the other rows of the batch.
    Without statistics the input is returned unchanged.

    In training mode :meth:`forward` first merges its input into the statistics; in
    evaluation mode, or with ``frozen``, it does not change them.

    Args:
        num_features (int): the size ``F`` of the last dimension.

    Keyword Args:
        floor (float): the smallest standard deviation to divide by, in the units of the
            features: a feature that hardly varies in the data would otherwise turn
            small differences into large inputs. Defaults to ``0.0``: a constant feature
            is centred and not scaled.
        frozen (bool): whether :meth:`forward` leaves the statistics as they are in
            training mode too, for statistics that are taken from data in advance.
            Defaults to ``False``.

    Attributes:
        count (torch.Tensor): float64 ``[]``, the number of rows merged so far.
        mean (torch.Tensor): float64 ``[F]``.
        m2 (torch.Tensor): float64 ``[F]``, the sum of squared deviations.
        shift (torch.Tensor): ``[F]``, the mean in the dtype of the layer.
        gain (torch.Tensor): ``[F]``, one over :attr:`scale` in the dtype of the layer.
        divisor (torch.Tensor): ``[F]``, :attr:`scale` in the dtype of the layer; used
            instead of the gain with ``frozen``.

    Raises:
        ValueError: ``num_features`` is below 1, the floor is negative or not finite, or
            an input has another width.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules import RunningNorm
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
    shift: torch.Tensor
    gain: torch.Tensor
    divisor: torch.Tensor

    def __init__(
        self, num_features: int, *, floor: float = 0.0, frozen: bool = False
    ) -> None:
        super().__init__()
        if num_features < 1:
            raise ValueError(f"num_features must be at least 1, got {num_features}")
        if not 0.0 <= floor < math.inf:
            raise ValueError(f"floor must be finite and not negative, got {floor!r}")
        self.num_features = int(num_features)
        self.floor = float(floor)
        self.frozen = frozen
        # float64: a float32 sum stops growing after 1e5 batches.
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(num_features, dtype=torch.float64))
        self.register_buffer("m2", torch.zeros(num_features, dtype=torch.float64))
        # What forward applies: cached, since computing it takes longer than using it.
        self.register_buffer("shift", torch.zeros(num_features))
        self.register_buffer("gain", torch.ones(num_features))
        self.register_buffer("divisor", torch.ones(num_features))

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the normalised features."""
        return self.shift.dtype

    @property
    def var(self) -> torch.Tensor:
        """The (population) variance of each feature, ``[F]``; 0 before any row."""
        return self.m2 / self.count.clamp_min(1)

    @property
    def scale(self) -> torch.Tensor:
        """The standard deviation that each feature is divided by, ``[F]``."""
        var = self.var
        scale = var.sqrt().clamp_min(self.floor)
        if self.floor:
            unscaled = (self.count == 0) & var.isfinite()
        else:
            # The rounding errors of a constant must not be scaled up.
            unscaled = var <= (1e-6 * self.mean).square().clamp_min(1e-24)
        return torch.where(unscaled, torch.ones_like(scale), scale)

    @torch.no_grad()
    def update(self, x: torch.Tensor) -> None:
        """Merges rows into the statistics, in any mode.

        Args:
            x (torch.Tensor): ``[*B, F]``; nothing changes if there is no row.
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
        self._refresh()

    @torch.no_grad()
    def replace(self, other: RunningNorm) -> None:
        """Copies the statistics of another layer, but keeps its own floor.

        Args:
            other (RunningNorm): the layer, of the same number of features.

        Examples:
            >>> import torch
            >>> from torchrl_caiac.modules import RunningNorm
            >>> gathered, norm = RunningNorm(1), RunningNorm(1, floor=0.5, frozen=True)
            >>> gathered.update(torch.tensor([[0.9], [1.1]]))
            >>> norm.replace(gathered)
            >>> norm(torch.tensor([[2.0]]))
            tensor([[2.]])
        """
        for name in ("count", "mean", "m2"):
            getattr(self, name).copy_(getattr(other, name))
        self._refresh()

    @torch.no_grad()
    def ignore(self, mask: torch.Tensor) -> None:
        """Ignores features: they become zero until :meth:`replace` is called.

        Use it for features that are constant in the data. The weights that read them
        keep their initial values, so other values at test time disturb the output.

        Args:
            mask (torch.Tensor): bool ``[F]``, true for the features to ignore.

        Raises:
            ValueError: the mask has another dtype or shape.

        Examples:
            >>> import torch
            >>> from torchrl_caiac.modules import RunningNorm
            >>> norm = RunningNorm(2, frozen=True)
            >>> norm.ignore(torch.tensor([False, True]))
            >>> norm(torch.tensor([[3.0, 4.0]]))
            tensor([[3., 0.]])
        """
        if mask.dtype != torch.bool or mask.shape != self.mean.shape:
            raise ValueError(
                f"expected a bool mask [{self.num_features}], got {mask.dtype} "
                f"{list(mask.shape)}"
            )
        # An infinite variance stays infinite in further updates.
        self.m2.masked_fill_(mask.to(self.m2.device), math.inf)
        self._refresh()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalises features.

        Args:
            x (torch.Tensor): ``[*B, F]``.

        Returns:
            torch.Tensor: ``[*B, F]``, in the dtype of the layer.
        """
        if self.training and not self.frozen:
            self.update(x)
        else:
            self._check(x)
        # In float64, features far from zero keep their small differences.
        x = floating(x)
        x = x - (self.mean if x.dtype == torch.float64 else self.shift)
        # A quotient rounds once. A product is faster, but rounds twice.
        x = x / self.divisor if self.frozen else x * self.gain
        return x.to(self.dtype)

    def extra_repr(self) -> str:
        """Returns the arguments, for ``repr``."""
        return f"{self.num_features}, floor={self.floor}, frozen={self.frozen}"

    def _refresh(self) -> None:
        self.shift.copy_(self.mean)
        scale = self.scale
        self.gain.copy_(scale.reciprocal())
        self.divisor.copy_(scale)

    def _check(self, x: torch.Tensor) -> None:
        if x.ndim < 1 or x.shape[-1] != self.num_features:
            raise ValueError(
                f"expected [*B, {self.num_features}] features, got the shape "
                f"{list(x.shape)}"
            )


def gather_statistics(
    value: torch.Tensor,
    key: NestedKey,
    *,
    mask: torch.Tensor | None = None,
    bound: float | None = None,
) -> RunningNorm:
    """Computes the statistics of data, one chunk of rows at a time.

    Memory-mapped data are thereby never loaded as a whole.

    Args:
        value (torch.Tensor): ``[*B, F]``.
        key (NestedKey): the name of the data in errors.

    Keyword Args:
        mask (torch.Tensor, optional): bool, one value for each row, true for the rows
            to read. Defaults to all rows.
        bound (float, optional): the largest absolute value that is allowed. Defaults
            to no bound.

    Returns:
        RunningNorm: a new layer with the statistics, on the device of the data.

    Raises:
        ValueError: there is no row, a value is not finite or exceeds the bound, or the
            mask has another number of rows.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.modules.running_norm import gather_statistics
        >>> gather_statistics(torch.tensor([[1.0], [3.0]]), "action").mean
        tensor([2.], dtype=torch.float64)
    """
    value = value.detach().reshape(-1, value.shape[-1])
    if mask is not None and mask.numel() != len(value):
        raise ValueError(
            f"the mask has {mask.numel()} entries, but {key!r} has {len(value)} rows: "
            "give one bool for each row, true for valid rows"
        )
    statistics = RunningNorm(value.shape[-1]).to(value.device)
    for start in range(0, len(value), _ROWS_PER_CHUNK):
        stop = min(start + _ROWS_PER_CHUNK, len(value))
        rows = value[start:stop]
        valid = None if mask is None else mask.reshape(-1)[start:stop]
        rows = floating(rows if valid is None else rows[valid])
        finite = rows.isfinite()
        if not finite.all():
            raise ValueError(
                f"{key!r} has {int((~finite).sum())} non-finite values in the rows "
                f"{start} to {stop - 1}: remove or repair these rows"
            )
        if bound is not None and (rows.abs() > bound * (1.0 + 1e-4)).any():
            raise ValueError(
                f"{key!r} has values up to {float(rows.abs().max()):.4g}, expected "
                f"values in [-{bound:g}, {bound:g}]: rescale it"
            )
        statistics.update(rows)
    if not statistics.count:
        raise ValueError(
            f"{key!r} has the shape {list(value.shape)} and no (valid) rows to take "
            "statistics from"
        )
    return statistics
