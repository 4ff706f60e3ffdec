"""Sparse rewards of goals, recognised in a dataset."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._keys import get_leaf
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms.rewards import goal_vectors

__all__ = ["SparseReward", "find_sparse_reward"]

_CHUNK = 1 << 16  # rows read at a time
_AGREE = 0.999  # share of rows in which a sparse reward must be the stored one


class SparseReward:
    """A reward with two values: the goal is reached, or it is not.

    It is reached if every group of goal columns is within the tolerance of its goal, by
    Euclidean distance.

    Args:
        groups (tuple of tuple of int): the columns of each group of the goal vectors.
        tolerance (float): the largest distance that counts as reached, in the units of
            the goals.
        low (float): the reward if it is not reached. Defaults to -1.
        high (float): the reward if it is reached. Defaults to 0.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.augment import SparseReward
        >>> reward = SparseReward(((0,), (1,)), tolerance=0.25)
        >>> reward(torch.tensor([[0.0, 0.0], [0.0, 1.0]]), torch.zeros(2, 2))
        tensor([ 0., -1.])
    """

    def __init__(
        self,
        groups: tuple[tuple[int, ...], ...],
        tolerance: float,
        low: float = -1.0,
        high: float = 0.0,
    ) -> None:
        self.groups, self.tolerance = groups, float(tolerance)
        self.low, self.high = float(low), float(high)

    def __call__(
        self, next_achieved: torch.Tensor, desired: torch.Tensor
    ) -> torch.Tensor:
        """Returns the rewards.

        Args:
            next_achieved (torch.Tensor): the achieved goals of the next states,
                ``[C, G]``.
            desired (torch.Tensor): the desired goals, ``[C, G]``.

        Returns:
            torch.Tensor: ``[C]``.
        """
        near = self.distance(next_achieved, desired) <= self.tolerance
        return torch.where(near, self.high, self.low)

    def distance(
        self, next_achieved: torch.Tensor, desired: torch.Tensor
    ) -> torch.Tensor:
        """Returns the largest distance of a group from its goal, ``[C]``."""
        gap = next_achieved - desired
        parts = [gap[:, list(group)].norm(dim=-1) for group in self.groups]
        return torch.stack(parts, -1).amax(-1)

    def __repr__(self) -> str:
        return (
            f"SparseReward(tolerance={self.tolerance:g}, low={self.low:g}, "
            f"high={self.high:g}, groups={len(self.groups)})"
        )


def find_sparse_reward(
    data: TensorDictBase,
    layout: EntityLayout,
    tolerance: float | None = None,
    *,
    reward_key: NestedKey = ("next", "reward"),
) -> SparseReward:
    """Finds the sparse reward of a dataset, and proves it on the stored rewards.

    The reward may look at each entity's goal alone, or at the distance of the goal as a
    whole: the form that agrees with the stored rewards is taken.

    Args:
        data (TensorDictBase): transitions ``[T]`` with goals.
        layout (EntityLayout): the entities, with goals.
        tolerance (float, optional): the largest distance that counts as reached.
            Defaults to ``None``: the number with the fewest digits that lies between
            the distances of the rows that reach their goals and of those that do not.

    Keyword Args:
        reward_key (NestedKey): the rewards. Defaults to ``("next", "reward")``.

    Returns:
        SparseReward: which agrees with the stored rewards in 99.9 % of the rows.

    Raises:
        KeyError: the data have no rewards or goals.
        ValueError: the stored rewards have more than two values; or no sparse reward,
            or not that with this tolerance, agrees with them.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.augment import find_sparse_reward
        >>> layout = EntityLayout(
        ...     {"cup": [0]}, goal={"cup": [0]}, achieved={"cup": [0]}
        ... )
        >>> data = TensorDict(
        ...     {
        ...         "desired_goal": torch.zeros(3, 1),
        ...         "next": {
        ...             "observation": torch.tensor([[0.0], [0.1], [0.5]]),
        ...             "reward": torch.tensor([[0.0], [0.0], [-1.0]]),
        ...         },
        ...     },
        ...     [3],
        ... )
        >>> find_sparse_reward(data, layout).tolerance
        0.2
    """
    stored = get_leaf(
        data, reward_key, "the data lack the reward", "use the stored rewards"
    )
    reward = stored.as_subclass(torch.Tensor).flatten().double()
    values = reward.unique()
    if len(values) > 2:
        raise ValueError(
            f"the stored rewards {reward_key!r} have {len(values)} values, a sparse "
            "reward has two: use the stored rewards, or recompute them in your own "
            "code with CAIACTransform(reward_fn=...)"
        )
    found = []
    for groups in _forms(data, layout):
        rule = SparseReward(groups, 0.0)
        gaps = torch.cat(
            [
                rule.distance(*goal_vectors(data[i : i + _CHUNK], layout)).double()
                for i in range(0, len(data), _CHUNK)
            ]
        )
        found.append(_fitted(rule, gaps, reward, values, tolerance))
    best, agreement = max(found, key=lambda pair: pair[1])
    if agreement < _AGREE:
        hint = "" if tolerance is None else "another tolerance, or "
        raise ValueError(
            f"{best!r} agrees with the stored rewards in {agreement:.1%} of the rows, "
            f"expected at least {_AGREE:.1%}: give {hint}the stored rewards"
        )
    return best


def _forms(
    data: TensorDictBase, layout: EntityLayout
) -> list[tuple[tuple[int, ...], ...]]:
    """Returns the goal columns by entity, and all of them together."""
    width = goal_vectors(data[:1], layout)[0].shape[-1]
    if layout.is_flat:
        each = tuple(tuple(layout.goal[name]) for name in layout.goal)
    else:
        each, begin = (), 0
        for name in layout.names:
            key = layout.goal.get(name)
            if key is not None:
                size = data.get(key)[0].numel()
                each = (*each, tuple(range(begin, begin + size)))
                begin += size
    each = tuple(group for group in each if group)
    everything = (tuple(range(width)),)
    return [each] if each == everything else [each, everything]


def _fitted(
    rule: SparseReward,
    gaps: torch.Tensor,
    reward: torch.Tensor,
    values: torch.Tensor,
    tolerance: float | None,
) -> tuple[SparseReward, float]:
    """Returns a rule with its values and tolerance, and its share of right rewards."""
    low, high = float(values[0]), float(values[-1])
    if len(values) == 1:  # always, or never reached
        never = tolerance is not None and bool((gaps > tolerance).all())
        low, high = (low, low + 1) if never else (high - 1, high)
        if tolerance is None:
            raise ValueError(
                f"all stored rewards are {low if never else high}, from which no "
                "tolerance can be found: give one, or use the stored rewards"
            )
    reached = reward == high
    if tolerance is None:
        tolerance = _between(gaps, reached)
    agree = ((gaps <= tolerance) == reached).double().mean()
    return SparseReward(rule.groups, tolerance, low, high), float(agree)


def _between(gaps: torch.Tensor, reached: torch.Tensor) -> float:
    """Returns the distance that separates two kinds of rows with the fewest errors."""
    order = gaps.argsort()
    hits = reached[order].double()
    # Errors if everything up to here counts as reached.
    errors = (1 - hits).cumsum(0) + hits.sum() - hits.cumsum(0)
    place = int(errors.argmin())
    here = float(gaps[order[place]])
    after = float(gaps[order[place + 1]]) if place + 1 < len(order) else 2 * here
    return _roundest(here, after)


def _roundest(low: float, high: float) -> float:
    """Returns the number in ``[low, high)`` with the fewest digits, such as 0.05."""
    if not 0 < low < high:
        return low
    for digits in range(1, 7):
        step = 10.0 ** (math.floor(math.log10(high)) + 1 - digits)
        found = round(math.ceil(low / step) * step, 12)
        if low <= found < high:
            return found
    return low
