"""The keys that the transforms share."""

from __future__ import annotations

from dataclasses import dataclass, fields

from tensordict.utils import NestedKey

from torchrl_caiac._keys import as_key

__all__ = ["TransformKeys"]


@dataclass(frozen=True)
class TransformKeys:
    """The keys, other than those of the layout, that transforms read and write.

    Pass the same object to every transform of a buffer.

    Args:
        reward (NestedKey): the rewards, ``[*B]`` or ``[*B, 1]``. Defaults to
            ``("next", "reward")``.
        trajectory (NestedKey, optional): the trajectory ids, ``[*B]`` or ``[*B, 1]``;
            ``None`` to separate trajectories by end flags alone. Defaults to
            ``"episode"``.
        done (NestedKey, optional): the end flags, ``[*B]`` or ``[*B, 1]``; ``None`` to
            ignore them. Defaults to ``("next", "done")``.
        counterfactual (NestedKey): the flag of counterfactual transitions, bool
            ``[*B, 1]``. Defaults to ``("caiac", "counterfactual")``.
        swapped (NestedKey): the flags of swapped entities, bool ``[*B, N]``. Defaults
            to ``("caiac", "swapped")``.
        relabeled (NestedKey): the flag of transitions with another goal, bool
            ``[*B, 1]``. Defaults to ``("hindsight", "relabeled")``.
        action (NestedKey): the actions, ``[*B, K]``, for reward functions that need
            them. Defaults to ``"action"``.
        terminated (NestedKey): the flags of transitions that end the task, ``[*B]`` or
            ``[*B, 1]``. Defaults to ``("next", "terminated")``.
        truncated (NestedKey): the flags of transitions after which the trajectory was
            cut off, ``[*B]`` or ``[*B, 1]``. Defaults to ``("next", "truncated")``.
        goal_steps (NestedKey): the rows from a transition to the one whose next state
            is its goal, int64 ``[*B, 1]``, which
            :class:`~torchrl_caiac.transforms.WindowGoal` writes. Swaps and later
            relabelling change goals, not this leaf. Defaults to
            ``("hindsight", "steps")``.
        unexplained (NestedKey, optional): the flag of transitions whose goal a random
            transition of the batch achieves, so that their own action need not lead to
            it, bool ``[*B, 1]``, which
            :class:`~torchrl_caiac.transforms.HindsightGoal` writes. Learners that
            repeat actions leave these out. Defaults to ``None``: it is not written.

    Raises:
        TypeError: a key is not a ``str`` or a tuple of them.

    Examples:
        >>> from torchrl_caiac.transforms import TransformKeys
        >>> keys = TransformKeys(trajectory=("collector", "traj_ids"))
        >>> keys.reward, keys.trajectory
        (('next', 'reward'), ('collector', 'traj_ids'))
    """

    reward: NestedKey = ("next", "reward")
    trajectory: NestedKey | None = "episode"
    done: NestedKey | None = ("next", "done")
    counterfactual: NestedKey = ("caiac", "counterfactual")
    swapped: NestedKey = ("caiac", "swapped")
    relabeled: NestedKey = ("hindsight", "relabeled")
    action: NestedKey = "action"
    terminated: NestedKey = ("next", "terminated")
    truncated: NestedKey = ("next", "truncated")
    goal_steps: NestedKey = ("hindsight", "steps")
    unexplained: NestedKey | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            key = getattr(self, field.name)
            if key is None and field.name in ("trajectory", "done", "unexplained"):
                continue
            object.__setattr__(self, field.name, as_key(key))
