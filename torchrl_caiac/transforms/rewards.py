"""The leaves that depend on goals, stored and recomputed: rewards and end flags."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._keys import flatten
from torchrl_caiac._torchrl import leaf_of
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.trajectories import STEPS_KEY
from torchrl_caiac.transforms.checks import LateCheck, LateValue
from torchrl_caiac.transforms.goal_function import GoalFunction
from torchrl_caiac.transforms.keys import TransformKeys

__all__ = [
    "GoalLeaves",
    "RewardFn",
    "TerminatedFn",
    "alike",
    "call_reward",
    "goal_vectors",
    "holds",
    "stored_reward",
]

#: ``(next_achieved [B, G], desired [B, G])`` to rewards ``[B]`` or ``[B, 1]``; for
#: other forms see :class:`~torchrl_caiac.transforms.goal_function.GoalFunction`.
RewardFn = Callable[..., Any]
#: The same, to bool ``[B]`` or ``[B, 1]``: whether the task ends at this transition.
TerminatedFn = Callable[..., Any]

_FLAG_BATCHES = 10  # batches in which stored end flags are looked at


def goal_vectors(
    td: TensorDictBase, layout: EntityLayout, first: int = 0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the next achieved and the desired goals of the rows from ``first`` on.

    Args:
        td (TensorDictBase): the batch ``[B]``.
        layout (EntityLayout): the entities. A nested layout's goals are concatenated,
            flattened, in layout order.
        first (int): the first row. Defaults to 0.

    Returns:
        tuple of torch.Tensor: ``[B - first, G]`` each.

    Raises:
        KeyError: goals are missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms.rewards import goal_vectors
        >>> layout = EntityLayout(
        ...     {"cup": [0]}, goal={"cup": [0]}, achieved={"cup": [0]}
        ... )
        >>> td = TensorDict({
        ...     "desired_goal": torch.ones(2, 1),
        ...     "next": {"observation": torch.tensor([[0.0], [3.0]])}}, [2])
        >>> goal_vectors(td, layout, 1)
        (tensor([[3.]]), tensor([[1.]]))
    """
    achieved, desired = _goal_vectors(td, layout, first)
    if achieved is None or desired is None:
        what = "next achieved goals" if achieved is None else "desired goals"
        if layout.is_flat:
            keys = [layout.desired_goal_key]
            if not layout.achieved:
                keys.append(layout.next(layout.achieved_goal_key))
        else:
            keys = [key for key in layout.goal.values() if key is not None]
            keys += [layout.next(k) for k in layout.achieved.values() if k is not None]
            what = "goals"
        lacking = [key for key in keys if td.get(key, None) is None]
        raise KeyError(
            f"reward_fn or terminated_fn is given, but the batch has no {what}: it "
            f"lacks {lacking}. Store them, or correct goal and achieved of the layout"
        )
    return alike(achieved, desired)


def alike(
    achieved: torch.Tensor, desired: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns goals in one dtype, so that a goal that is reached equals its copy.

    Args:
        achieved (torch.Tensor): ``[B, G]``.
        desired (torch.Tensor): ``[B, G]``.

    Returns:
        tuple of torch.Tensor: achieved goals in the dtype of desired ones, if that
        holds them, and desired goals.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.rewards import alike
        >>> achieved = torch.tensor([[0.1]], dtype=torch.float64)
        >>> achieved, desired = alike(achieved, achieved.float())
        >>> bool(achieved == desired)
        True
    """
    if holds(desired.dtype, achieved.dtype):
        achieved = achieved.to(desired.dtype)
    return achieved, desired


def _goal_vectors(
    td: TensorDictBase, layout: EntityLayout, first: int
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    if layout.is_flat:
        desired = td.get(layout.desired_goal_key, None)
        achieved = td.get(layout.next(layout.achieved_goal_key), None)
        if achieved is None and layout.achieved:
            achieved = layout.achieved_goal(td, next=True)
        return (
            None if achieved is None else achieved[first:],
            None if desired is None else desired[first:],
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
            parts.append(flatten(value[first:], 1))
    if not desired_parts:
        return None, None
    return torch.cat(achieved_parts, -1), torch.cat(desired_parts, -1)


class GoalLeaves:
    """Recomputes rewards and end flags where the goal or what it describes changed.

    Rewards that are NaN or infinite are an error. On a CUDA device nothing waits for
    the result: the error is raised at a later batch.

    Args:
        reward_fn (callable, optional): see
            :class:`~torchrl_caiac.transforms.goal_function.GoalFunction`.
        terminated_fn (callable, optional): the same, to bool.

    Keyword Args:
        keys (TransformKeys): rewards, actions and end flags.
        check (bool): check that the rewards are finite. Defaults to ``True``.

    Raises:
        TypeError: one of them is not a function.
        ValueError: one of them has other parameters.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac.transforms import TransformKeys
        >>> from torchrl_caiac.transforms.rewards import GoalLeaves
        >>> leaves = GoalLeaves(
        ...     lambda achieved, desired: -(achieved - desired).norm(dim=-1),
        ...     None,
        ...     keys=TransformKeys(),
        ... )
        >>> td = TensorDict({"next": {"reward": torch.zeros(2, 1)}}, [2])
        >>> goals = torch.tensor([[3.0]]), torch.tensor([[1.0]])
        >>> leaves(td, *goals, first=1)
        {('next', 'reward'): tensor([[ 0.],
                [-2.]])}
    """

    def __init__(
        self,
        reward_fn: RewardFn | None,
        terminated_fn: TerminatedFn | None,
        *,
        keys: TransformKeys,
        check: bool = True,
    ) -> None:
        self._reward = None if reward_fn is None else GoalFunction(reward_fn)
        self._terminated = (
            None
            if terminated_fn is None
            else GoalFunction(terminated_fn, "terminated_fn")
        )
        self.keys = keys
        self.check = check
        self._late = LateCheck()
        self._late_flags = LateCheck()
        # Batches whose stored end flags are still looked at.
        self._flag_batches = _FLAG_BATCHES if self._terminated is None else 0

    @property
    def reward_fn(self) -> RewardFn | None:
        """The function of rewards, as it was given."""
        return None if self._reward is None else self._reward.function

    @property
    def terminated_fn(self) -> TerminatedFn | None:
        """The function of end flags, as it was given."""
        return None if self._terminated is None else self._terminated.function

    @property
    def out_keys(self) -> list[NestedKey]:
        """The leaves that are recomputed, if a batch has them."""
        keys, found = self.keys, []
        if self._reward is not None:
            found.append(keys.reward)
        if self._terminated is not None:
            found.append(keys.terminated)
            found += [] if keys.done is None else [keys.done]
        return found

    @property
    def in_keys(self) -> list[NestedKey]:
        """The leaves that are read."""
        keys, found = self.keys, self.out_keys
        if self._terminated is not None:
            found.append(keys.truncated)
        if self._needs_action:
            found.append(keys.action)
        return found

    @property
    def _needs_action(self) -> bool:
        functions = (self._reward, self._terminated)
        return any(f is not None and f.needs_action for f in functions)

    def __bool__(self) -> bool:
        """Whether there is a function."""
        return not (self._reward is None and self._terminated is None)

    def __call__(
        self,
        td: TensorDictBase,
        achieved: torch.Tensor,
        desired: torch.Tensor,
        *,
        first: int = 0,
        where: torch.Tensor | None = None,
    ) -> dict[NestedKey, torch.Tensor]:
        """Recomputes the leaves of some rows.

        Args:
            td (TensorDictBase): the batch ``[B]``; it is not changed.
            achieved (torch.Tensor): the achieved goals of the next states,
                ``[B - first, G]``.
            desired (torch.Tensor): the desired goals, ``[B - first, G]``.

        Keyword Args:
            first (int): the first of the rows. Defaults to 0.
            where (torch.Tensor, optional): bool ``[B - first]``, true for the rows that
                get new values. Defaults to all of them.

        Returns:
            dict: the new leaves ``[B]`` or ``[B, 1]``, with those of other rows as they
            were. Rewards keep their dtype if it holds what the function returned; else
            (stored integers, and a function with fractions) all rewards of the batch
            are in torch's default dtype. End flags keep their dtype.

        Raises:
            KeyError: rewards, actions or end flags are missing.
            ValueError: a leaf or the result of a function has the wrong shape or dtype,
                a reward is NaN or infinite, or the rewards are sums over several steps.
        """
        keys = self.keys
        if leaf_of(td, STEPS_KEY) is not None:
            raise ValueError(
                f"the batch has {STEPS_KEY!r}, so that {keys.reward!r} is a sum of "
                "rewards over several steps, but reward_fn and terminated_fn see the "
                "last state alone: leave out MultiStepTransform, or these functions"
            )
        action = self._action(td)[first:] if self._needs_action else None
        leaves: dict[NestedKey, torch.Tensor] = {}
        if self._reward is not None:
            stored = stored_reward(td, keys.reward)
            like = stored[first:] if first else stored
            new = call_reward(self._reward, achieved, desired, like, action)
            if self.check:
                self._check_finite(new, achieved, desired, first, where)
            leaves[keys.reward] = _merge(stored, new, first, where)
        if self._terminated is not None:
            leaves |= self._end_flags(td, achieved, desired, action, first, where)
        elif self._flag_batches and len(achieved):
            self._flag_batches -= 1
            self._warn_of_end_flags(td)
        return leaves

    def _action(self, td: TensorDictBase) -> torch.Tensor:
        action = td.get(self.keys.action, None)
        if action is None:
            raise KeyError(
                f"reward_fn or terminated_fn has a parameter action, but the batch has "
                f"no {self.keys.action!r}: name the actions with "
                "keys=TransformKeys(action=...)"
            )
        return action.reshape(td.shape[0], -1)

    def _check_finite(
        self,
        reward: torch.Tensor,
        achieved: torch.Tensor,
        desired: torch.Tensor,
        first: int,
        where: torch.Tensor | None,
    ) -> None:
        if not reward.is_floating_point():
            return
        is_late = LateCheck.needed(reward.device)
        # A sum is finite if all its terms are.
        if not is_late and math.isfinite(reward.sum().item()):
            return
        flat = reward.detach().reshape(-1)
        if not is_late:
            if where is not None:
                flat = flat.where(where, torch.zeros_like(flat))
            bad = ~flat.isfinite()
            if not bool(bad.any()):
                return
            row = int(bad.nonzero()[0, 0])
            raise ValueError(
                f"reward_fn returned {flat[row].item()} for row {first + row} of the "
                f"batch ({int(bad.sum())} of {len(flat)} rows are NaN or infinite), "
                f"with the next achieved goal {achieved[row].tolist()} and the desired "
                f"goal {desired[row].tolist()}: correct the function, or these goals"
            )
        if self._late.found():
            raise ValueError(
                "reward_fn returned NaN or infinite rewards in an earlier batch. On a "
                "CUDA device errors are late; sample the same data on the CPU to find "
                "the rows"
            )
        self._late.look([LateValue(flat, "not finite", where)])

    def _end_flags(
        self,
        td: TensorDictBase,
        achieved: torch.Tensor,
        desired: torch.Tensor,
        action: torch.Tensor | None,
        first: int,
        where: torch.Tensor | None,
    ) -> dict[NestedKey, torch.Tensor]:
        keys = self.keys
        assert self._terminated is not None
        new = self._terminated(achieved, desired, action)
        if new.dtype != torch.bool:
            raise ValueError(
                f"terminated_fn returned {new.dtype}, expected bool: whether the task "
                "ends at each transition"
            )
        rows = td.shape[0]
        terminated = _flags(td, keys.terminated, rows)
        if terminated is None:
            raise KeyError(
                f"terminated_fn is given, but the batch has no {keys.terminated!r}: "
                "name the flags with keys=TransformKeys(terminated=...)"
            )
        flags = new.to(terminated.dtype)
        leaves = {keys.terminated: _merge(terminated, flags, first, where)}
        done = None if keys.done is None else _flags(td, keys.done, rows)
        if done is not None:
            truncated = _flags(td, keys.truncated, rows)
            if truncated is None:  # what ended for another reason still ends
                truncated = done.bool() & ~terminated.bool().reshape(done.shape)
            ends = new | truncated[first:].reshape(-1).bool()
            assert keys.done is not None
            leaves[keys.done] = _merge(done, ends.to(done.dtype), first, where)
        return leaves

    def _warn_of_end_flags(self, td: TensorDictBase) -> None:
        """Warns once if stored transitions end their task; late on an accelerator."""
        terminated = td.get(self.keys.terminated, None)
        if terminated is None:
            return
        any_ends = terminated.any()
        if LateCheck.needed(terminated.device):
            found = bool(self._late_flags.found())
            self._late_flags.add(torch.where(any_ends, math.nan, 0.0).unsqueeze(0))
        else:
            found = bool(any_ends)
        if found:
            self._flag_batches = 0
            warnings.warn(
                f"{self.keys.terminated!r} is true in some transitions, and those with "
                "another goal or state keep it as it was stored. If the task ends at "
                "its goal, give terminated_fn=..., (next_achieved, desired) to bool; "
                "else ignore this warning",
                stacklevel=2,
            )


def _flags(td: TensorDictBase, key: NestedKey, rows: int) -> torch.Tensor | None:
    flags = td.get(key, None)
    if flags is not None and flags.numel() != rows:
        raise ValueError(
            f"{key!r} has shape {list(flags.shape)}, expected [{rows}, 1]: one flag "
            "for each row"
        )
    return flags


def _merge(
    stored: torch.Tensor, new: torch.Tensor, first: int, where: torch.Tensor | None
) -> torch.Tensor:
    """Returns stored values ``[B, ...]`` with new ones from row ``first`` on."""
    stored = stored.to(new.dtype)
    tail = stored[first:] if first else stored
    if new.shape != tail.shape or new.device != stored.device:
        new = new.reshape(tail.shape).to(stored.device)
    if where is not None:
        new = torch.where(where.view(tail.shape), new, tail)
    return torch.cat([stored[:first], new]) if first else new


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
    reward = leaf_of(td, reward_key)
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
    reward_fn: GoalFunction | RewardFn,
    achieved: torch.Tensor,
    desired: torch.Tensor,
    like: torch.Tensor,
    action: torch.Tensor | None = None,
) -> torch.Tensor:
    """Calls a reward function, and returns its rewards in the shape of stored ones.

    Args:
        reward_fn (callable): ``(next_achieved [B, G], desired [B, G])`` to rewards
            ``[B]`` or ``[B, 1]``, or another form of
            :class:`~torchrl_caiac.transforms.goal_function.GoalFunction`.
        achieved (torch.Tensor): ``[B, G]``, the next achieved goals.
        desired (torch.Tensor): ``[B, G]``.
        like (torch.Tensor): rewards ``[B]`` or ``[B, 1]``.
        action (torch.Tensor, optional): ``[B, K]``, where the function needs it.

    Returns:
        torch.Tensor: the rewards, in the shape and on the device of ``like``; in its
        dtype if that holds what the function returned, else in torch's default dtype.

    Raises:
        ValueError: the function returned another number of rewards.
    """
    if not isinstance(reward_fn, GoalFunction):
        reward_fn = GoalFunction(reward_fn)
    new = reward_fn(achieved, desired, action)
    dtype = like.dtype if holds(like.dtype, new.dtype) else torch.get_default_dtype()
    return new.reshape(like.shape).to(like.device, dtype)


def holds(wide: torch.dtype, narrow: torch.dtype) -> bool:
    """Returns whether a dtype holds the values of another, up to rounding.

    Args:
        wide (torch.dtype): the dtype.
        narrow (torch.dtype): the other.

    Returns:
        bool: ``False`` if fractions would be cut, or numbers would wrap around.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.rewards import holds
        >>> holds(torch.float32, torch.int64), holds(torch.uint8, torch.int64)
        (True, False)
    """
    if wide == narrow or wide.is_floating_point:
        return True
    if narrow.is_floating_point or wide == torch.bool:
        return False
    if narrow == torch.bool:
        return True
    outer, inner = torch.iinfo(wide), torch.iinfo(narrow)
    return outer.min <= inner.min and inner.max <= outer.max
