"""What learners of goal-conditioned networks share."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import torch
from omegaconf import ListConfig
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer

from learners.base import Learner
from torchrl_caiac.modules import GoalConditionedActor, GoalFeatures

__all__ = ["GoalConditioned", "descend"]

_STATISTICS_BATCHES = 100  # from which the features' mean and deviation are taken


class GoalConditioned(Learner):
    """A policy ``π(s, g)`` that reads :class:`~torchrl_caiac.modules.GoalFeatures`.

    It needs the settings ``steps``, ``checkpoint_every``, ``batch_size``,
    ``batches_at_once``, ``hidden_sizes`` and ``hidden_dtype``; ``policy_sizes`` are the
    hidden layers of the policy, if they differ.
    """

    rb: ReplayBuffer
    actor: GoalConditionedActor

    def check(self, steps: int | None = None) -> None:
        """Raises if a setting is wrong; see the base class."""
        super().check(steps)
        for name in ("hidden_sizes", "policy_sizes"):
            sizes = self.settings.get(name)
            if sizes is None and name == "policy_sizes":
                continue
            if not isinstance(sizes, ListConfig) or not all(
                type(size) is int and size > 0 for size in [*sizes] or [None]
            ):
                raise ValueError(
                    f"learner.{name} is {sizes!r}, expected a list of the widths of "
                    "hidden layers, integers from 1 on"
                )

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
        name = self.settings.hidden_dtype
        if name not in ("float32", "bfloat16"):
            raise ValueError(
                f"learner.hidden_dtype is {name!r}, expected auto, float32 or bfloat16"
            )
        return None if name == "float32" else torch.bfloat16

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
