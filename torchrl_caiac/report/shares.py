"""How often each entity is influenced, and how often it may be swapped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac.check.ends import find_ids
from torchrl_caiac.trajectories import TrajectoryIndex

__all__ = ["EntityShares", "choose_trajectories", "entity_shares", "trajectory_ids"]


@dataclass(frozen=True)
class EntityShares:
    """How often an entity may be swapped.

    Attributes:
        rows (float): the share of transitions in which its score is at most the
            threshold.
        windows (dict of int to float): for each length κ, the share of the windows of κ
            successive transitions in which this holds throughout. A length is missing
            if no trajectory is as long.
    """

    rows: float
    windows: dict[int, float]


def entity_shares(
    influenced: torch.Tensor, index: TrajectoryIndex, windows: Sequence[int]
) -> list[EntityShares]:
    """Counts transitions and windows in which each entity may be swapped.

    Args:
        influenced (torch.Tensor): bool ``[T, N]``.
        index (TrajectoryIndex): the trajectories.
        windows (sequence of int): the lengths κ.

    Returns:
        list of EntityShares: one for each entity.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.report.shares import entity_shares
        >>> from torchrl_caiac.trajectories import trajectory_index
        >>> episode = torch.tensor([0, 0, 0, 1, 1])
        >>> index = trajectory_index(TensorDict({"episode": episode}, [5]))
        >>> influenced = torch.tensor([[False], [False], [True], [False], [False]])
        >>> entity_shares(influenced, index, [2, 4])
        [EntityShares(rows=0.8, windows={2: 0.666...})]
    """
    order = index.rows(torch.arange(index.length))
    left = index.remaining(order)
    found = []
    for column in influenced.unbind(-1):
        # How many of the rows before each position are influenced.
        before = torch.nn.functional.pad(column[order].cumsum(0), (1, 0))
        shares = {}
        for window in windows:
            start = (left >= window - 1).nonzero()[:, 0]
            if len(start):
                free = before[start + window] == before[start]
                shares[window] = free.double().mean().item()
        found.append(EntityShares((~column).double().mean().item(), shares))
    return found


def choose_trajectories(
    influenced: torch.Tensor, index: TrajectoryIndex, count: int, seed: int
) -> list[int]:
    """Draws trajectories, so that each entity is influenced in one of them if possible.

    One is drawn for each entity, among those in which it is influenced at some time,
    unless one that was drawn before shows it. The rest are drawn among all.

    Args:
        influenced (torch.Tensor): bool ``[T, N]``, of the entities to show.
        index (TrajectoryIndex): the trajectories.
        count (int): how many to draw, at most.
        seed (int): the seed of the draws.

    Returns:
        list of int: the numbers of the trajectories, ascending.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.report.shares import choose_trajectories
        >>> from torchrl_caiac.trajectories import trajectory_index
        >>> episode = torch.arange(30) // 3
        >>> index = trajectory_index(TensorDict({"episode": episode}, [30]))
        >>> influenced = (episode == 7)[:, None]
        >>> choose_trajectories(influenced, index, 1, seed=0)
        [7]
    """
    total = len(index.ends)
    generator = torch.Generator().manual_seed(seed)
    shown = torch.zeros(total, influenced.shape[-1], dtype=torch.bool)
    rows, entities = influenced.nonzero(as_tuple=True)
    shown[index.numbers()[rows], entities] = True
    drawn: list[int] = []
    for has in shown.unbind(-1):
        candidates = has.nonzero()[:, 0]
        if len(drawn) == count or not len(candidates) or has[drawn].any():
            continue
        pick = torch.randint(len(candidates), (), generator=generator)
        drawn.append(int(candidates[pick]))
    for number in torch.randperm(total, generator=generator).tolist():
        if len(drawn) == min(count, total):
            break
        if number not in drawn:
            drawn.append(number)
    return sorted(drawn)


def trajectory_ids(
    data: TensorDictBase, index: TrajectoryIndex, trajectory_key: NestedKey | None
) -> list[int]:
    """Returns how people find trajectories in the data: by their stored ids.

    Args:
        data (TensorDictBase): the transitions, ``[T]``.
        index (TrajectoryIndex): the trajectories.
        trajectory_key (NestedKey, optional): the trajectory ids.

    Returns:
        list of int: the id of each trajectory, in the order of the index; without ids,
        its number, from 0.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.report.shares import trajectory_ids
        >>> from torchrl_caiac.trajectories import trajectory_index
        >>> data = TensorDict({"episode": torch.tensor([7, 7, 3])}, [3])
        >>> trajectory_ids(data, trajectory_index(data), "episode")
        [7, 3]
    """
    key = find_ids(data, trajectory_key)
    if key is None:
        return list(range(len(index.ends)))
    ids = data.get(key)[index.starts].reshape(len(index.ends), -1)[:, 0]
    return [int(number) for number in ids]
