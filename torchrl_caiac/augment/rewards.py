"""Sparse rewards of goals, recognised in a dataset."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._keys import floating, get_leaf
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms.rewards import goal_vectors

__all__ = ["SparseReward", "ends_at_goals", "find_sparse_reward"]

_CHUNK = 1 << 16  # rows read at a time
_AGREE = 0.999  # share of rows in which a sparse reward must be the stored one
# The same of the rows with each of the two rewards. Where one of them is rare, a rule
# that never gives it agrees with nearly all rows.
_AGREE_EACH = 0.99
_FEWEST = 5  # rows with each of the two rewards, from which a rule can be proven


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
        near = self.is_reached(next_achieved, desired)
        return torch.where(near, self.high, self.low)

    def is_reached(
        self, next_achieved: torch.Tensor, desired: torch.Tensor
    ) -> torch.Tensor:
        """Returns whether the goals are reached, bool ``[C]``."""
        return self.distance(next_achieved, desired) <= self.tolerance

    def distance(
        self, next_achieved: torch.Tensor, desired: torch.Tensor
    ) -> torch.Tensor:
        """Returns the largest distance of a group from its goal, ``[C]``."""
        gap = floating(next_achieved) - floating(desired)
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
        SparseReward: which agrees with the stored rewards in 99.9 % of the rows, and in
        99 % of the rows with each of the two rewards.

    Raises:
        KeyError: the data have no rewards or goals.
        ValueError: the stored rewards have more than two values, or fewer than 5 rows
            have one of them; or no sparse reward, or not that with this tolerance,
            agrees with them.

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
        ...         "desired_goal": torch.zeros(15, 1),
        ...         "next": {
        ...             "observation": torch.tensor([[0.0], [0.1], [0.5]]).repeat(5, 1),
        ...             "reward": torch.tensor([[0.0], [0.0], [-1.0]]).repeat(5, 1),
        ...         },
        ...     },
        ...     [15],
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
    low, high = float(values[0]), float(values[-1])
    reached = reward == high
    counts = int(reached.sum()), int((~reached).sum())
    if len(values) < 2 or min(counts) < _FEWEST:
        found_text = (
            f"all {len(reward)} stored rewards are {high:g}"
            if len(values) < 2
            else f"{counts[0]} stored rewards are {high:g} and {counts[1]} are {low:g}"
        )
        raise ValueError(
            f"{found_text}, expected at least {_FEWEST} rows with each of two rewards: "
            "no sparse reward can be proven on so few; use the stored rewards, or "
            "recompute them in your own code with CAIACTransform(reward_fn=...)"
        )
    fits = []
    for groups in _forms(data, layout):
        rule = SparseReward(groups, 0.0, low, high)
        gaps = _distances(rule, data, layout)
        rule.tolerance = _between(gaps, reached) if tolerance is None else tolerance
        right = (gaps <= rule.tolerance) == reached
        each = [float(right[rows].double().mean()) for rows in (reached, ~reached)]
        fits.append((rule, float(right.double().mean()), each))
    best, overall, each = max(fits, key=lambda fit: min(fit[2]))
    if overall < _AGREE or min(each) < _AGREE_EACH:
        hint = "" if tolerance is None else "another tolerance, or "
        raise ValueError(
            f"{best!r} agrees with the stored rewards in {overall:.2%} of all rows, "
            f"in {each[0]:.2%} of the {counts[0]} with the reward {high:g} and in "
            f"{each[1]:.2%} of the {counts[1]} with {low:g}, expected at least "
            f"{_AGREE:.1%} of all and {_AGREE_EACH:.0%} of each: give {hint}the stored "
            "rewards"
        )
    return best


def ends_at_goals(
    rule: SparseReward,
    data: TensorDictBase,
    layout: EntityLayout,
    *,
    terminated_key: NestedKey = ("next", "terminated"),
) -> bool:
    """Returns whether the task ends where goals are reached, or never.

    Args:
        rule (SparseReward): says which goals are reached.
        data (TensorDictBase): transitions ``[T]`` with goals.
        layout (EntityLayout): the entities, with goals.

    Keyword Args:
        terminated_key (NestedKey): whether the task ends. Defaults to ``("next",
            "terminated")``.

    Returns:
        bool: ``True`` if it ends exactly where the goals are reached, ``False`` if it
        never ends or the data do not say.

    Raises:
        ValueError: it ends in other rows.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.augment import SparseReward
        >>> from torchrl_caiac.augment.rewards import ends_at_goals
        >>> layout = EntityLayout(
        ...     {"cup": [0]}, goal={"cup": [0]}, achieved={"cup": [0]}
        ... )
        >>> data = TensorDict(
        ...     {
        ...         "desired_goal": torch.zeros(2, 1),
        ...         "next": {
        ...             "observation": torch.tensor([[0.0], [0.5]]),
        ...             "terminated": torch.tensor([[True], [False]]),
        ...         },
        ...     },
        ...     [2],
        ... )
        >>> ends_at_goals(SparseReward(((0,),), 0.1), data, layout)
        True
    """
    stored = data.get(terminated_key, None)
    if stored is None or not bool(stored.any()):
        return False
    ends = stored.as_subclass(torch.Tensor).flatten().bool()
    reached = _distances(rule, data, layout) <= rule.tolerance
    wrong = [int((ends & ~reached).sum()), int((reached & ~ends).sum())]
    counts = [int(ends.sum()), int(reached.sum())]
    shares = [w / max(c, 1) for w, c in zip(wrong, counts, strict=True)]
    if max(shares) > 1 - _AGREE_EACH:
        raise ValueError(
            f"{terminated_key!r} does not say where goals are reached: {wrong[0]} of "
            f"the {counts[0]} rows that end the task do not reach them, and {wrong[1]} "
            f"of the {counts[1]} rows that reach them do not end it, by {rule!r}. So "
            "the ends of counterfactuals cannot follow their new goals: use the stored "
            "rewards, or correct these flags"
        )
    return True


def _distances(
    rule: SparseReward, data: TensorDictBase, layout: EntityLayout
) -> torch.Tensor:
    """Returns the distance of each row from its goal, float64 ``[T]``."""
    return torch.cat(
        [
            rule.distance(*goal_vectors(data[i : i + _CHUNK], layout)).double()
            for i in range(0, len(data), _CHUNK)
        ]
    )


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
