"""Rewards from goals: those that are stored, and those that are recomputed."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._keys import flatten
from torchrl_caiac.entities import EntityLayout

__all__ = ["RewardFn", "call_reward", "recompute_reward", "stored_reward"]

#: ``(next_achieved [B, G], desired [B, G])`` to rewards ``[B]`` or ``[B, 1]``.
RewardFn = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def _goal_vectors(
    td: TensorDictBase, layout: EntityLayout
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Returns the next achieved and the desired goals."""
    if layout.is_flat:
        desired = td.get(layout.desired_goal_key, None)
        achieved = td.get(layout.next(layout.achieved_goal_key), None)
        if achieved is None and layout.achieved:
            achieved = layout.achieved_goal(td, next=True)
        return (
            achieved,
            desired,
        )
    achieved_parts: list[torch.Tensor] = []
    desired_parts: list[torch.Tensor] = []
    for name in layout.names:
        key = layout.goal.get(name)
        if key is None:
            continue
        for parts, where in (
            (
                achieved_parts,
                layout.achieved.get(name) and layout.next(layout.achieved[name]),
            ),
            (desired_parts, key),
        ):
            value = None if where is None else td.get(where, None)
            if value is None:
                return None, None
            if isinstance(value, torch.Tensor):
                parts.append(value.reshape(len(value), -1))
            else:
                parts.append(flatten(value, 1))
    if not desired_parts:
        return None, None
    return torch.cat(achieved_parts, -1), torch.cat(desired_parts, -1)


def recompute_reward(
    td: TensorDictBase,
    layout: EntityLayout,
    reward_fn: RewardFn,
    chosen: torch.Tensor,
    *,
    reward_key: NestedKey = ("next", "reward"),
) -> torch.Tensor:
    """Computes the rewards of some rows from their *next* achieved goals.

    Args:
        td (TensorDictBase): the batch after swapping, ``[R]``.
        layout (EntityLayout): the entities. A nested layout's goals are concatenated,
            flattened, in layout order.
        reward_fn (callable): ``(next_achieved [R, G], desired [R, G])`` to rewards
            ``[R]`` or ``[R, 1]``.
        chosen (torch.Tensor): bool ``[R, 1]``, the rows whose rewards are recomputed.

    Keyword Args:
        reward_key (NestedKey): the rewards ``[R]`` or ``[R, 1]``.

    Returns:
        torch.Tensor: all rewards, in the shape of the stored ones; in floating point if
        the new ones are.

    Raises:
        KeyError: goals or rewards are missing.
        ValueError: the function returned another number of rewards.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms.rewards import recompute_reward
        >>> layout = EntityLayout(
        ...     {"cup": [0]}, goal={"cup": [0]}, achieved={"cup": [0]}
        ... )
        >>> td = TensorDict(
        ...     {
        ...         "desired_goal": torch.ones(2, 1),
        ...         "next": {
        ...             "observation": torch.tensor([[0.0], [3.0]]),
        ...             "reward": torch.zeros(2, 1),
        ...         },
        ...     },
        ...     [2],
        ... )
        >>> last = torch.tensor([[False], [True]])
        >>> recompute_reward(td, layout, lambda a, d: -(a - d).norm(dim=-1), last)
        tensor([[ 0.],
                [-2.]])
    """
    reward = stored_reward(td, reward_key)
    achieved, desired = _goal_vectors(td, layout)
    if achieved is None or desired is None:
        what = "next achieved goals" if achieved is None else "desired goals"
        raise KeyError(
            f"reward_fn is given, but the batch has no {what}: the layout looks under "
            f"{layout.desired_goal_key!r} and {layout.achieved_goal_key!r} (or its "
            "`goal` and `achieved` keys)"
        )
    new = call_reward(reward_fn, achieved, desired, reward)
    return torch.where(chosen.view_as(reward), new, reward.to(new.dtype))


def stored_reward(td: TensorDictBase, reward_key: NestedKey) -> torch.Tensor:
    """Returns the rewards of a batch.

    Args:
        td (TensorDictBase): the batch ``[B]``.
        reward_key (NestedKey): the rewards.

    Returns:
        torch.Tensor: ``[B]`` or ``[B, 1]``.

    Raises:
        KeyError: there are none.
        ValueError: there is not one for each row.
    """
    reward = td.get(reward_key, None)
    if reward is None:
        raise KeyError(
            f"reward_fn is given, but the batch has no {reward_key!r}: name the "
            "rewards with keys=TransformKeys(reward=...)"
        )
    if reward.numel() != td.shape[0]:
        raise ValueError(
            f"{reward_key!r} has shape {list(reward.shape)}, expected "
            f"[{td.shape[0]}, 1]: one reward for each row"
        )
    return reward


def call_reward(
    reward_fn: RewardFn,
    achieved: torch.Tensor,
    desired: torch.Tensor,
    like: torch.Tensor,
) -> torch.Tensor:
    """Calls a reward function, and returns its rewards in the shape of stored ones.

    Args:
        reward_fn (callable): ``(next_achieved [B, G], desired [B, G])`` to rewards
            ``[B]`` or ``[B, 1]``.
        achieved (torch.Tensor): ``[B, G]``, the next achieved goals.
        desired (torch.Tensor): ``[B, G]``.
        like (torch.Tensor): rewards ``[B]`` or ``[B, 1]``.

    Returns:
        torch.Tensor: the rewards, in the shape and on the device of ``like``, and in
        its dtype unless that would cut them to integers.

    Raises:
        ValueError: the function returned another number of rewards.
    """
    new = reward_fn(achieved, desired)
    rows = achieved.shape[0]
    shape = tuple(new.shape) if isinstance(new, torch.Tensor) else None
    if shape not in ((rows,), (rows, 1)):
        found = type(new).__name__ if shape is None else list(shape)
        raise ValueError(
            f"reward_fn returned {found} for goals {list(achieved.shape)}, expected "
            f"[{rows}] or [{rows}, 1]"
        )
    cuts = new.is_floating_point() and not like.is_floating_point()
    return new.reshape(like.shape).to(like.device, new.dtype if cuts else like.dtype)
