"""What learners of goal-conditioned networks share."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer

from learners.base import Learner
from learners.settings import Count, Sizes
from torchrl_caiac.modules import GoalConditionedActor, GoalFeatures

__all__ = ["GoalConditioned", "descend"]

_STATISTICS_BATCHES = 100  # from which the features' mean and deviation are taken


class GoalConditioned(Learner):
    """A policy ``π(s, g)`` that reads :class:`~torchrl_caiac.modules.GoalFeatures`.

    ``policy_sizes`` are the hidden layers of the policy, if they differ.
    """

    class Settings(Learner.Settings):
        """What the settings may be."""

        batch_size: Count
        hidden_sizes: Sizes
        policy_sizes: Sizes | None = None
        hidden_dtype: Literal["auto", "float32", "bfloat16"] = "float32"

    rb: ReplayBuffer
    actor: GoalConditionedActor

    def start(self, rows: TensorDictBase, seed: int) -> GoalFeatures:
        """Makes the buffer; returns features with the statistics of some batches.

        All methods of a seed then create the same networks.
        """
        torch.manual_seed(seed)
        self.rb = self.make_buffer(rows)
        features = self.make_features()
        # Before the networks are created: they copy it.
        features.fit_statistics(
            torch.cat(list(islice(self.batches(), _STATISTICS_BATCHES)))
        )
        torch.manual_seed(seed)
        return features

    def make_features(self) -> GoalFeatures:
        """Creates the input of the networks, with relative positions and goals."""
        return GoalFeatures(
            self.environment.layout, reference=self.environment.goal_reference
        )

    def make_actor(
        self, features: GoalFeatures, action_key: NestedKey = "action"
    ) -> GoalConditionedActor:
        """Returns the policy."""
        sizes = self.settings.get("policy_sizes")
        return GoalConditionedActor(
            features,
            self.environment.action_dim,
            tuple(self.settings.hidden_sizes if sizes is None else sizes),
            hidden_dtype=self.hidden_dtype,
            action_key=action_key,
        )

    @property
    def hidden_dtype(self) -> torch.dtype | None:
        """The dtype of the products of the hidden layers."""
        is_bfloat16 = self.settings.get("hidden_dtype") == "bfloat16"
        return torch.bfloat16 if is_bfloat16 else None

    @property
    def rows_at_once(self) -> int:
        """The number of transitions in one sample."""
        return int(self.settings.batch_size * self.at_once)

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields batches, several from one sample, which saves time."""
        while True:
            yield from self.split(self.rb.sample())

    def policy_state(self) -> dict[str, Any]:
        """Returns the state of the policy."""
        return self.actor.state_dict()

    def load_policy(self, state: dict[str, Any]) -> Any:
        """Returns the policy."""
        actor = self.make_actor(self.make_features())
        actor.load_state_dict(state)
        return actor.eval()


def descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    """Takes one step of an optimizer."""
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
