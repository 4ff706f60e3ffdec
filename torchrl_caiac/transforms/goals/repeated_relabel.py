"""Relabelling batches that are like an earlier one, by few calls."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._batches import KnownBatch
from torchrl_caiac._random import draw_numbers
from torchrl_caiac._sampling import is_native, relabel_batch
from torchrl_caiac._torchrl import leaf_of
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms.keys import TransformKeys
from torchrl_caiac.transforms.rewards import GoalLeaves

__all__ = ["RepeatedRelabel", "unexplained"]


def unexplained(source: torch.Tensor) -> torch.Tensor:
    """Returns which rows have goals that random rows of the batch achieve.

    Args:
        source (torch.Tensor): int64 ``[B]``, see
            :class:`~torchrl_caiac.transforms.goals.hindsight.HindsightDraw`.

    Returns:
        torch.Tensor: bool ``[B, 1]``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.goals.repeated_relabel import unexplained
        >>> unexplained(torch.tensor([0, 3, 7])).flatten()
        tensor([False,  True, False])
    """
    rows = source.shape[0]
    return ((source >= rows) & (source < 2 * rows)).unsqueeze(-1)


class RepeatedRelabel:
    """Relabels batches that have the structure of an earlier batch.

    It gives what :class:`~torchrl_caiac.transforms.HindsightGoal` computes step by
    step, to the bit, but reads the structure of a batch only once. Where something is
    unusual it leaves the batch to those steps, which handle it or raise an error.

    Attributes:
        keys (TransformKeys): the keys other than those of the layout.

    Args:
        td (TensorDictBase): the earlier batch, ``[B]``, before it was relabelled.
        layout (EntityLayout): the entities and their goals, in one leaf.
        achieved_key (NestedKey): what goals are achieved in.
        columns (tuple of int): its columns that are the achieved goals.
        keys (TransformKeys): the other keys.

    Raises:
        TypeError: such batches have to be relabelled step by step.
    """

    def __init__(
        self,
        td: TensorDictBase,
        layout: EntityLayout,
        achieved_key: NestedKey,
        columns: tuple[int, ...],
        keys: TransformKeys,
    ) -> None:
        desired_key = layout.desired_goal_key
        read = [achieved_key, desired_key]
        if leaf_of(td, keys.counterfactual) is not None:
            read.append(keys.counterfactual)
        if any(leaf_of(td, key) is None for key in read):
            raise TypeError("there are no goals")
        self._batch = KnownBatch(td, read)
        self._columns, self.keys = columns, keys
        self._desired_key = desired_key
        after = layout.next(desired_key)
        # Desired goals under ``next`` are written where the batch has them.
        self._written = [desired_key, after]
        if leaf_of(td, after) is None:
            self._written = [desired_key]
        leaves = self._batch.leaves(td)
        if leaves is None or not is_native(*leaves):
            raise TypeError("there are leaves that need torch")
        values, desired, *flags = leaves
        rows = td.shape[0]
        if values.ndim != 2 or values.shape[1] <= max(columns):
            raise TypeError("goals are not columns of rows")
        if (desired.shape, desired.dtype) != ((rows, len(columns)), values.dtype):
            raise TypeError("desired goals are others than achieved ones")
        if any((x.shape, x.dtype) != ((rows, 1), torch.bool) for x in flags):
            raise TypeError("there is not one flag for each row")

    def __call__(
        self,
        td: TensorDictBase,
        future: Mapping[NestedKey, torch.Tensor] | None,
        shares: tuple[float, float, float],
        goal_leaves: GoalLeaves,
        generator: torch.Generator | None,
    ) -> TensorDictBase | None:
        """Relabels a batch.

        Args:
            td (TensorDictBase): the batch, ``[B]``; it is not changed.
            future (mapping, optional): future goals ``[B, G]`` by desired-goal leaf.
            shares (tuple of float): the shares ``future``, ``random`` and
                ``counterfactual`` of rows.
            goal_leaves (GoalLeaves): recomputes rewards and end flags.
            generator (torch.Generator, optional): source of randomness.

        Returns:
            TensorDictBase, optional: the batch with other goals; ``None`` if it has to
            be relabelled step by step; nothing was drawn for it.

        Raises:
            KeyError: rewards are missing.
            ValueError: a reward is NaN or infinite, or rewards have the wrong shape.
        """
        leaves = self._batch.leaves(td)
        later = None if future is None else future.get(self._desired_key)
        if leaves is None or (later is None and shares[0] > 0):
            return None
        values, desired, *given = leaves
        if later is not None:
            leaves = [*leaves, later]
            if (later.shape, later.dtype) != (desired.shape, desired.dtype):
                return None
        if not is_native(*leaves):
            return None
        flags = next(iter(given), None)
        if flags is None:
            flags = desired.new_zeros(desired.shape[0], 1, dtype=torch.bool)
        numbers = draw_numbers(
            torch.rand,
            (2, desired.shape[0]),
            device=desired.device,
            generator=generator,
            dtype=torch.float64,
        )
        new = relabel_batch(
            flags, numbers, shares, desired, values, self._columns, later
        )
        found = dict.fromkeys(self._written, new.goals)
        found |= goal_leaves(td, new.achieved, new.goals, where=new.changed)
        found[self.keys.relabeled] = new.relabeled
        if self.keys.unexplained is not None:
            found[self.keys.unexplained] = unexplained(new.source)
        return self._batch.copy(td, found)
