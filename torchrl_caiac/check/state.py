"""The states of a sample, with the names and the tolerances of their columns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from tensordict.utils import NestedKey

from torchrl_caiac.check.entries import state_leaves
from torchrl_caiac.check.sample import Sample
from torchrl_caiac.entities import EntityLayout

__all__ = ["States", "read_states"]

_CHUNK = 16_384  # rows that are compared at once
_ULPS = 4
_RELATIVE = 1e-5  # of a column's standard deviation: the same state


@dataclass(frozen=True)
class States:
    """The features of all entities in the rows of a sample.

    Args:
        now (torch.Tensor): the states, ``[n, W]``.
        after (torch.Tensor, optional): the next states, ``[n, W]``.
        labels (tuple of str): the name of each column, ``W`` of them.
        slices (dict of str to slice): the columns of each entity.
        scale (torch.Tensor): the standard deviation of each column, ``[W]``.
        rounding (torch.Tensor): how far rounding moves each column, ``[W]``.
        eps (float): the relative precision of the stored numbers.
    """

    now: torch.Tensor
    after: torch.Tensor | None
    labels: tuple[str, ...]
    slices: dict[str, slice]
    scale: torch.Tensor
    rounding: torch.Tensor
    eps: float

    @property
    def owners(self) -> list[str]:
        """The entity of each column, ``W`` of them."""
        return [
            n for n, own in self.slices.items() for _ in range(own.stop - own.start)
        ]

    @property
    def tolerance(self) -> torch.Tensor:
        """How far apart two records of the same state may be, ``[W]``."""
        return _RELATIVE * self.scale + self.rounding

    @property
    def next(self) -> torch.Tensor:
        """The next states, which must have been read."""
        assert self.after is not None
        return self.after

    def keep(self, mask: torch.Tensor) -> States:
        """Returns the states without the rows where ``mask`` ``[n]`` is false."""
        if bool(mask.all()):
            return self  # no second copy of the largest tensors
        after = None if self.after is None else self.after[mask]
        return _with_scales(replace(self, now=self.now[mask], after=after))

    def close(
        self,
        left: torch.Tensor,
        left_rows: torch.Tensor,
        right: torch.Tensor,
        right_rows: torch.Tensor,
        tolerance: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Returns whether rows of two tensors ``[*, W]`` agree, bool ``[p]``."""
        limit = self.tolerance if tolerance is None else tolerance
        parts = [
            ((left[i] - right[j]).abs() <= limit).all(1)
            for i, j in zip(
                left_rows.split(_CHUNK), right_rows.split(_CHUNK), strict=True
            )
        ]
        return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.bool)

    def distance(
        self,
        left: torch.Tensor,
        left_rows: torch.Tensor,
        right: torch.Tensor,
        right_rows: torch.Tensor,
    ) -> torch.Tensor:
        """Returns distances in standard deviations of the columns, ``[p]``."""
        varies = self.scale > self.rounding
        scale = self.scale[varies]
        parts = [
            ((left[i] - right[j])[:, varies] / scale).square().mean(1).sqrt()
            for i, j in zip(
                left_rows.split(_CHUNK), right_rows.split(_CHUNK), strict=True
            )
        ]
        return torch.cat(parts) if parts else torch.zeros(0)


def read_states(layout: EntityLayout, sample: Sample, *, read_next: bool) -> States:
    """Reads the features of all entities in the rows of a sample.

    Args:
        layout (EntityLayout): the entities. The data have all their entries.
        sample (Sample): the rows.

    Keyword Args:
        read_next (bool): whether to read the next states.

    Returns:
        States: the features in layout order.
    """
    slices: dict[str, slice] = {}
    labels: list[str] = []
    keys = state_leaves(layout, sample.data)
    if layout.is_flat:
        columns = [c for own in layout.columns.values() for c in own]
        now, after = _read(layout, sample, keys, columns, read_next)
        for name, own in layout.columns.items():
            slices[name] = slice(len(labels), len(labels) + len(own))
            labels += [f"{name} (column {c})" for c in own]
    else:
        now, after = _read(layout, sample, keys, None, read_next)
        for name, width in layout.widths(sample.data[:1]).items():
            slices[name] = slice(len(labels), len(labels) + width)
            labels += [f"{name} (feature {i})" for i in range(width)]
    zeros = torch.zeros(now.shape[1])
    eps = max(_precision(sample, key) for key in _stored(layout, keys, read_next))
    return _with_scales(States(now, after, tuple(labels), slices, zeros, zeros, eps))


def _stored(
    layout: EntityLayout, keys: list[NestedKey], read_next: bool
) -> list[NestedKey]:
    return [*keys, *(layout.next(key) for key in keys)] if read_next else keys


def _precision(sample: Sample, key: NestedKey) -> float:
    dtype = sample.data.get(key).dtype
    return torch.finfo(dtype).eps if dtype.is_floating_point else 0.0


def _read(
    layout: EntityLayout,
    sample: Sample,
    keys: list[NestedKey],
    columns: list[int] | None,
    read_next: bool,
) -> tuple[torch.Tensor, torch.Tensor | None]:
    def all_of(keys: list[NestedKey]) -> torch.Tensor:
        parts = [sample.read(key, columns) for key in keys]
        return parts[0] if len(parts) == 1 else torch.cat(parts, 1)

    after = all_of([layout.next(key) for key in keys]) if read_next else None
    now = all_of(keys)
    if after is not None and after.dtype != now.dtype:
        now, after = now.double(), after.double()
    return now, after


def _with_scales(states: States) -> States:
    """Returns the states with scales and rounding computed from their rows."""
    now = states.now
    if not len(now):
        return states
    # Column by column: a whole copy in float64 would double the memory.
    scale = [float(x.double().std(correction=0)) for x in now.unbind(1)]
    size = torch.maximum(now.amax(0), -now.amin(0))
    if states.after is not None:
        after = states.after
        size = torch.maximum(size, torch.maximum(after.amax(0), -after.amin(0)))
    return replace(
        states,
        scale=torch.tensor(scale, dtype=now.dtype),
        rounding=_ULPS * states.eps * size,
    )
