"""Whole counterfactual trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_caiac.scored import ScoredDataset
from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index
from torchrl_caiac.transforms import CAIACTransform
from torchrl_caiac.transforms.draws import SwapDraw

__all__ = ["TrajectoryPlan", "counterfactual_trajectories"]


class TrajectoryPlan:
    """Which trajectories become counterfactual, and where their entities come from.

    An entity is swapped if it is uninfluenced in all rows of the trajectory. Its donor
    is another trajectory, at least as long, in whose first rows, as many as are needed,
    it is uninfluenced too. Row ``t`` takes the entity from row ``t`` of the donor.

    Args:
        scored (ScoredDataset): the dataset.
        count (int): the number of counterfactual trajectories. They are drawn with
            replacement from those in which an entity can be swapped.
        generator (torch.Generator): source of randomness.

    Attributes:
        index (TrajectoryIndex): the trajectories of the dataset.
        chosen (torch.Tensor): int64 ``[count]``, the numbers of the trajectories.
        rows (int): the number of rows of all of them.
        possible (int): the number of trajectories that they were drawn from.

    Raises:
        ValueError: no entity of any trajectory can be swapped.
    """

    def __init__(
        self, scored: ScoredDataset, count: int, generator: torch.Generator
    ) -> None:
        self.scored, self.generator = scored, generator
        self.index = trajectory_index(scored.data)
        self._lengths = self.index.lengths
        self._free = _free_from_begin(scored.is_free, self.index)  # [E, N]
        whole = self._free == self._lengths.unsqueeze(-1)
        # The number of donors: a trajectory that is free throughout is its own donor.
        donors = torch.stack(
            [self._num_donors(n) for n in range(self._free.shape[1])], -1
        )
        self._swappable = whole & (donors > 1)
        possible = self._swappable.any(-1).nonzero()[:, 0]
        self.possible = len(possible)
        if not self.possible:
            raise ValueError(
                "no trajectory has an entity that is uninfluenced from beginning to "
                "end, with another trajectory to take it from: write transitions "
                "instead of trajectories, or lower the lookahead of the scores"
            )
        drawn = torch.randint(self.possible, (count,), generator=generator)
        self.chosen = possible[drawn]
        self.rows = int(self._lengths[self.chosen].sum())

    def _num_donors(self, entity: int) -> torch.Tensor:
        """Returns how many trajectories may donate an entity to each one, ``[E]``."""
        free = self._free[:, entity].sort().values
        return len(free) - torch.searchsorted(free, self._lengths)

    def draw(self, number: int) -> dict[int, int]:
        """Draws the donors of a trajectory.

        Args:
            number (int): the trajectory.

        Returns:
            dict of int to int: the donor's number for each entity that is swapped.
        """
        donors = {}
        for entity in self._swappable[number].nonzero()[:, 0].tolist():
            others = self._free[:, entity] >= self._lengths[number]
            others[number] = False
            candidates = others.nonzero()[:, 0]
            place = torch.randint(len(candidates), (), generator=self.generator)
            donors[entity] = int(candidates[place])
        return donors


def _free_from_begin(is_free: torch.Tensor, index: TrajectoryIndex) -> torch.Tensor:
    """Returns in how many first rows of a trajectory an entity is free, ``[E, N]``."""
    position = torch.arange(index.length)
    number = torch.searchsorted(index.ends, position)
    begin = index.ends - index.lengths + 1
    step = position - begin[number]
    free = is_free[index.rows(position)]
    ends = torch.where(free, index.lengths[number].unsqueeze(-1), step.unsqueeze(-1))
    first = index.lengths.unsqueeze(-1).expand(-1, free.shape[-1]).clone()
    return first.scatter_reduce_(
        0, number.unsqueeze(-1).expand_as(ends), ends, "amin", include_self=True
    )


def counterfactual_trajectories(
    plan: TrajectoryPlan, data: TensorDictBase, **options: Any
) -> Iterator[TensorDictBase]:
    """Yields counterfactual trajectories.

    Args:
        plan (TrajectoryPlan): what is drawn.
        data (TensorDictBase): the transitions of the plan's dataset, ``[T]``, with the
            entries that are wanted.
        **options (Any): further arguments of
            :class:`~torchrl_caiac.transforms.CAIACTransform`, such as ``reward_fn``.

    Yields:
        TensorDictBase: the rows ``[L]`` of one trajectory, with the transform's flags.
    """
    layout, index = plan.scored.layout, plan.index
    lengths, begin = index.lengths, index.ends - index.lengths + 1
    for number in plan.chosen.tolist():
        length, donors = int(lengths[number]), plan.draw(number)
        others = sorted(set(donors.values()))
        starts = [int(begin[other]) for other in (*others, number)]
        position = torch.tensor(starts).unsqueeze(-1) + torch.arange(length)
        batch = data[index.rows(position.flatten())].to_tensordict()
        swapped = torch.zeros(1, len(layout), dtype=torch.bool)
        first = torch.zeros(1, len(layout), dtype=torch.int64)
        for entity, donor in donors.items():
            swapped[0, entity] = True
            first[0, entity] = others.index(donor) * length
        transform = CAIACTransform(layout, window=length, check=False, **options)
        draw = SwapDraw(first, swapped, torch.zeros(len(layout), dtype=torch.int64))
        yield transform.apply_parameters(batch, draw)[-length:]
