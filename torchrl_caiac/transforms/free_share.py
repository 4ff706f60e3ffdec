"""Warns of entities that are swapped in all rows, or in none."""

from __future__ import annotations

import warnings
from collections.abc import Collection

import torch

from torchrl_caiac.entities import EntityLayout

__all__ = ["FreeShare"]

# What is counted before a warning: batches, and windows.
_BATCHES = 20
_WINDOWS = 2000


class FreeShare:
    """Counts how often each entity may be swapped, in the first batches.

    After 20 batches and 2,000 windows it warns once of entities that were never free to
    be swapped, or always, since the threshold or the scores may be wrong. The counts
    stay on the device; an accelerator is not waited for.

    Args:
        layout (EntityLayout): the entities; fixed ones are not counted.

    Examples:
        >>> import torch, warnings
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms.free_share import FreeShare
        >>> share = FreeShare(EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"]))
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     for _ in range(20):
        ...         share.add(torch.zeros(100, 2, dtype=torch.bool))
        >>> "['cup'] in none of the first 2000 windows" in str(caught[0].message)
        True
    """

    def __init__(self, layout: EntityLayout) -> None:
        self.layout = layout
        self._counts: torch.Tensor | None = None
        self._arrived: torch.Tensor | None = None
        self._batches = 0
        self._windows = 0
        self.is_done = False

    def add(self, free: torch.Tensor, expected: Collection[str] = ()) -> None:
        """Counts one batch; warns when there were enough.

        Args:
            free (torch.Tensor): ``[B, N]``, zero where an entity may not be swapped.
            expected (collection of str): entities for which it is known that they are
                swapped in all rows or in none.
        """
        if self.is_done:
            return
        if self._arrived is not None:
            self._report(self._arrived, expected)
            return
        counts = self._counts
        if counts is None or counts.device != free.device:
            counts = self._counts = torch.zeros(
                free.shape[-1], dtype=torch.int64, device=free.device
            )
            self._batches = self._windows = 0
        counts += (free != 0).sum(0)
        self._batches += 1
        self._windows += len(free)
        if self._batches < _BATCHES or self._windows < _WINDOWS:
            return
        if not counts.is_cuda:
            self._report(counts, expected)
            return
        # Read at a later batch, when the copy has arrived; until then it is negative.
        self._arrived = torch.full(counts.shape, -1, pin_memory=True)
        self._arrived.copy_(counts, non_blocking=True)

    def _report(self, counts: torch.Tensor, expected: Collection[str]) -> None:
        numbers = counts.tolist()
        if min(numbers) < 0:
            return
        self.is_done = True
        self._counts = self._arrived = None
        names = self.layout.names
        shares = {
            name: number / self._windows
            for name, number in zip(names, numbers, strict=True)
            if name not in self.layout.fixed and name not in expected
        }
        never = [name for name, share in shares.items() if share == 0]
        always = [name for name, share in shares.items() if share == 1]
        if not never and not always:
            return
        found = []
        if never:
            found.append(
                f"{never} in none of the first {self._windows} windows: nothing of "
                "them is ever swapped, so the threshold is too low, their scores are "
                "too high, rows are not scored, or lookahead keeps what always comes "
                "next"
            )
        if always:
            found.append(
                f"{always} in all of the first {self._windows} windows: this is right "
                "only if the agent never influences them, else the threshold is too "
                "high, or their scores are too low"
            )
        warnings.warn(
            "entities are free to be swapped: "
            + "; and ".join(found)
            + ". See suggest_thresholds(rb, layout), and give each entity its "
            "threshold",
            stacklevel=2,
        )
