"""The base class of learners."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Literal

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer
from torchrl.envs import Transform

from environments.base import Environment
from learners.settings import (
    AugmentationSettings,
    BaseSettings,
    Count,
    check_settings_of,
)
from methods.base import Method
from torchrl_caiac.data.digests import content_digests

__all__ = ["Learner"]


class Learner(ABC):
    """Learns a policy from the rows of an environment, augmented by a method.

    A subclass in a module of this folder, with a file ``conf/learner/<name>.yaml`` that
    has its settings, is all that a new learner needs. ``train.py`` reads those of
    :class:`Settings`; a subclass adds the types and ranges of its own.

    Args:
        settings (DictConfig): ``cfg.learner``.
        environment (Environment): where the data come from.
        method (Method): the augmentation.
        augmentation (DictConfig): ``cfg.env.augmentation``.
    """

    class Settings(BaseSettings):
        """What the settings may be."""

        steps: Count
        log_every: Count
        checkpoint_every: Count
        keep_every: Count | None
        logger: Literal["csv", "tensorboard", "wandb"]
        batches_at_once: Count | None = None

    extendable: ClassVar[bool] = False
    """Whether ``steps`` may be raised later, for finished runs to be extended."""

    reads: ClassVar[tuple[NestedKey, ...]] = (
        "observation",
        "action",
        "episode",
        *[("next", name) for name in ("observation", "done")],
    )
    """The leaves of the rows that learning reads, besides scores and goals."""

    def __init__(
        self,
        settings: DictConfig,
        environment: Environment,
        method: Method,
        augmentation: DictConfig,
    ) -> None:
        self.settings = settings
        self.environment = environment
        self.method = method
        self.augmentation = augmentation
        self.parts: dict[str, Any] = {}

    def kept_settings(self, seed: int) -> dict[str, Any]:
        """Returns what the results of a run depend on: settings, data and scores."""
        settings: dict[str, Any] = OmegaConf.to_container(self.settings, resolve=True)
        if self.extendable:
            settings.pop("steps")
        return {
            **settings,
            "method": {"class": type(self.method).__name__, **vars(self.method)},
            "augmentation": OmegaConf.to_container(self.augmentation, resolve=True),
            "seed": seed,
            "layout": self.environment.layout.to_dict(),
            "data": content_digests(self.stored_rows(), self.method.score_key),
        }

    def stored_rows(self) -> TensorDictBase:
        """Returns the memory-mapped transitions that the method scores.

        Defaults to all rows of the environment.
        """
        return self.environment.rows()

    def rows(self) -> TensorDictBase:
        """Returns the training data, by default :meth:`stored_rows`."""
        return self.stored_rows()

    def read_leaves(
        self, rows: TensorDictBase, *further: NestedKey, goals: bool = True
    ) -> TensorDictBase:
        """Returns what learning reads of the rows, in memory.

        Args:
            rows (TensorDictBase): all rows, ``[T]``.
            *further (NestedKey): leaves besides :attr:`reads`.

        Keyword Args:
            goals (bool): whether desired goals are among them.

        Raises:
            KeyError: a leaf is missing.
        """
        scores = [] if self.method.score_key is None else [self.method.score_key]
        desired: list[NestedKey] = ["desired_goal"] if goals else []
        keys = [*self.reads, *desired, *scores, *further]
        present = rows.keys(include_nested=True)
        missing = [key for key in keys if key not in present]
        if missing:
            raise KeyError(
                f"the rows of {type(self.environment).__name__} lack {missing}, which "
                f"learner={self.settings.name} reads: score the data first (score.py), "
                "and for desired goals choose learner.goals=future if the learner has "
                "it"
            )
        return rows.select(*keys).clone()

    @property
    def at_once(self) -> int:
        """The number of batches in one sample, ``batches_at_once``, by default 1."""
        number = self.settings.get("batches_at_once")
        return 1 if number is None else int(number)

    def check(self, further: int = 0) -> None:
        """Raises if a setting is wrong, before anything is read or written.

        Args:
            further (int): steps that follow in ``online.py``. Defaults to 0.
        """
        settings = self.settings
        check_settings_of("learner", settings, self.Settings)
        check_settings_of("env.augmentation", self.augmentation, AugmentationSettings)
        if (settings.keep_every or 1) > settings.steps:
            raise ValueError(
                f"learner.keep_every is {settings.keep_every}, expected at most "
                f"learner.steps, {settings.steps}, or null for the last policy: none "
                "would be kept"
            )
        for name in ("steps", "checkpoint_every"):
            if settings[name] % self.at_once:
                raise ValueError(
                    f"learner.{name} is {settings[name]}, expected a multiple of "
                    f"learner.batches_at_once, {self.at_once}: a run could not resume "
                    "in the middle of a sample"
                )
        self._check_counterfactuals()

    def _check_counterfactuals(self) -> None:
        try:
            augmentation = self.counterfactuals()
        except (TypeError, ValueError) as error:
            raise ValueError(f"env.augmentation, or the method: {error}") from error
        if (
            augmentation is not None
            and self.augmentation.get("lookahead") == "goal"
            and not self.swaps_after_goals
        ):
            raise ValueError(
                "env.augmentation.lookahead is 'goal', but "
                f"learner={self.settings.name} draws no goals before the swap: set it "
                "to next, or learner.goals=future or learner.future_goals if the "
                "learner has it. (A learner of your own that draws them has the "
                "property swaps_after_goals.)"
            )

    @property
    def swaps_after_goals(self) -> bool:
        """Whether goals are drawn before the swap, for ``lookahead: goal``."""
        return False

    def split(self, sample: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yields the batches of one sample."""
        # In strides: the last rows of a sample, and so of each, are counterfactual.
        yield from (sample[first :: self.at_once] for first in range(self.at_once))

    def counterfactuals(self, **options: Any) -> Transform | None:
        """Returns the method's transform with the settings of the environment.

        Args:
            **options (Any): further arguments of the transform, such as ``window``.

        Returns:
            Transform, optional: to append to the buffer; ``None`` without augmentation.
        """
        for name in ("counterfactual_ratio", "swap_prob", "lookahead"):
            if self.augmentation.get(name) is not None:
                options[name] = self.augmentation[name]
        return self.method.transform(self.environment.layout, **options)

    @abstractmethod
    def make_buffer(self, rows: TensorDictBase) -> ReplayBuffer:
        """Creates the replay buffer: rows, the method's transform, and goals."""

    @abstractmethod
    def setup(self, rows: TensorDictBase, seed: int) -> None:
        """Creates buffer, networks and optimizers.

        Everything that must be saved for a run to resume is added to ``parts``, by
        name, with ``state_dict`` and ``load_state_dict``.
        """

    @abstractmethod
    def batches(self) -> Iterator[TensorDictBase]:
        """Yields batches endlessly."""

    @abstractmethod
    def step(self, batch: TensorDictBase, step: int) -> dict[str, torch.Tensor]:
        """Takes one gradient step.

        Args:
            batch (TensorDictBase): of :meth:`batches`.
            step (int): the number of the step, from 1.

        Returns:
            dict: scalars to log; the log has their means.
        """

    @abstractmethod
    def policy_state(self) -> dict[str, Any]:
        """Returns the state of the policy, only tensors."""

    @abstractmethod
    def load_policy(self, state: dict[str, Any]) -> Any:
        """Returns the policy of a state, for evaluation, without :meth:`setup`."""

    def share_swapped(self, batch: TensorDictBase) -> dict[str, torch.Tensor]:
        """Returns the share of rows with a swap, for the log, if there are any."""
        swapped = batch.get(("caiac", "swapped"), None)
        if swapped is None:
            return {}
        return {"share_swapped": swapped.any(-1).float().mean()}
