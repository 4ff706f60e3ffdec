"""The buffer that learners of values sample: all rows, with goals in hindsight."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from pydantic import Field
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler, Storage

from learners.goal_conditioned import GoalConditioned
from learners.settings import Positive, Share
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.trajectories import trajectory_index
from torchrl_caiac.transforms import HindsightGoal, TransformKeys

__all__ = [
    "UNEXPLAINED",
    "HindsightLearner",
    "ShareSampler",
    "until_success",
]

#: True where the goal is one that another row achieves, bool ``[B, 1]``.
UNEXPLAINED: NestedKey = ("hindsight", "unexplained")


def until_success(rows: TensorDictBase) -> torch.Tensor:
    """Returns the rows of successful trajectories up to their first success.

    Args:
        rows (TensorDictBase): transitions ``[T]`` whose reward is 0 where the desired
            goal is reached and negative elsewhere.

    Returns:
        torch.Tensor: bool ``[T]``.
    """
    index = trajectory_index(rows)
    order = index.rows(torch.arange(len(rows)))  # trajectories may be interleaved
    success = rows["next", "reward"].reshape(-1)[order] >= 0
    total = success.cumsum(0)
    # Successes before the trajectory, and in the whole of it, for each row.
    ends = total[index.ends]
    before = torch.cat([ends.new_zeros(1), ends[:-1]])
    solved = (ends > before).repeat_interleave(index.lengths)
    earlier = total - success.long() - before.repeat_interleave(index.lengths)
    return torch.empty_like(solved).index_copy_(0, order, solved & (earlier == 0))


class ShareSampler(RandomSampler):
    """Draws rows of a part of the data with a probability, all rows otherwise.

    Args:
        part (torch.Tensor): bool ``[T]``, true for the rows of the part.
        share (float): the probability of drawing from the part alone.
    """

    def __init__(self, part: torch.Tensor, share: float) -> None:
        super().__init__()
        self.share = share
        self.rows = part.nonzero().flatten()
        if not len(self.rows):
            raise ValueError(
                f"no row is of a successful episode, but learner.successful is {share}:"
                " collect some, or set it to null"
            )

    def sample(
        self, storage: Storage, batch_size: int
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """Draws rows with replacement, in random order."""
        anywhere, info = super().sample(storage, batch_size)
        picked = self.rows[torch.randint(len(self.rows), (batch_size,))]
        return torch.where(torch.rand(batch_size) < self.share, picked, anywhere), info


class HindsightLearner(GoalConditioned):
    """Learns values of rewards for goals, from all rows of the environment."""

    class Settings(GoalConditioned.Settings):
        """What the settings may be."""

        successful: Share | None = None
        random_goals: bool = True
        layer_norm: bool = False
        gamma: Annotated[float, Field(ge=0, lt=1)]
        tau: Annotated[float, Field(gt=0, le=1)]
        lr: Positive

    extendable = True
    reads = (
        *GoalConditioned.reads,
        *[("next", name) for name in ("reward", "terminated")],
    )

    def check(self, further: int = 0) -> None:
        """Raises if a setting is wrong; see the base class."""
        super().check(further)
        if self.environment.reward_fn is None:
            raise ValueError(
                f"learner={self.settings.name} needs rewards for goals, which "
                f"{type(self.environment).__name__} does not have: set its reward_fn, "
                "or choose another learner"
            )
        try:
            self.make_goals()
        except (TypeError, ValueError) as error:
            given = self.augmentation.get("hindsight")
            raise ValueError(
                f"env.augmentation.hindsight is {given}: {error} (without "
                "counterfactuals, random is half of counterfactual_ratio)"
            ) from error
        share = self.settings.get("successful")
        if share is not None and not self.environment.episodes_have_goals:
            raise ValueError(
                f"learner.successful is {share}, but no episode of "
                f"{type(self.environment).__name__} has a goal of its own that it "
                "could reach: set it to null"
            )

    def make_goals(self) -> HindsightGoal:
        """Returns what draws goals in hindsight.

        Half of the counterfactuals have goals that others achieve. Without augmentation
        there are as many random goals as counterfactuals would have (A.5.2). With the
        setting ``random_goals: false`` there are none: no action explains them, which
        matters to a learner that repeats actions.
        """
        environment, augmentation = self.environment, self.augmentation
        random = 0.5 if self.settings.get("random_goals", True) else 0.0
        share = augmentation.get("counterfactual_ratio", 0.5)
        return HindsightGoal(
            environment.layout,
            environment.reward_fn,
            random=random * share if self.counterfactuals() is None else 0.0,
            counterfactual=random,
            keys=TransformKeys(unexplained=UNEXPLAINED),
            **augmentation.get("hindsight", {}),
        )

    def rows(self) -> TensorDictBase:
        """Returns what learning reads, in memory."""
        return self.learning_rows(self.environment.goal_rows())

    def learning_rows(self, stored: TensorDictBase) -> TensorDictBase:
        """Returns what learning reads of stored transitions, in memory."""
        return self.read_leaves(stored)

    def make_online_buffer(self, rows: TensorDictBase) -> TensorDictReplayBuffer:
        """Makes the buffer of collected rows, in which no episode may succeed."""
        share = self.settings.get("successful")
        if share is not None and not bool(until_success(rows).any()):
            share = None
        return self._make_buffer(rows, share)

    def make_buffer(self, rows: TensorDictBase) -> TensorDictReplayBuffer:
        """Makes the buffer of transitions, counterfactuals, and hindsight goals."""
        return self._make_buffer(rows, self.settings.get("successful"))

    def _make_buffer(
        self, rows: TensorDictBase, share: float | None
    ) -> TensorDictReplayBuffer:
        augmentation, goals = self.counterfactuals(), self.make_goals()
        options: dict[str, Any] = {}
        if share is not None:
            options["sampler"] = ShareSampler(until_success(rows), share)
        rb = offline_buffer(rows, self.rows_at_once, sample_unit=goals, **options)
        if augmentation is not None:
            rb.append_transform(augmentation)
        rb.append_transform(goals)
        return rb
