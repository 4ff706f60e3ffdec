"""The base class of augmentation methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer
from torchrl.envs import Transform

from environments.base import Environment
from torchrl_caiac import EntityLayout
from torchrl_caiac.influence import score_buffer

__all__ = ["Estimator", "Method", "Scoring"]

Estimator = Callable[[TensorDictBase], torch.Tensor]


@dataclass(frozen=True)
class Scoring:
    """The inputs from which methods create their estimators.

    Attributes:
        environment (Environment): where the data come from.
        model (callable): the fitted world model of a name, ``"world_model"`` or
            ``"transformer"``.
        settings (DictConfig): ``env.score``.
        progress (bool): whether to show progress bars.
    """

    environment: Environment
    model: Callable[[str], Any]
    settings: DictConfig
    progress: bool = False


class Method(ABC):
    """An augmentation: the scores that it needs, and the transform that it appends.

    A subclass in a module of this folder, with a file ``conf/method/<name>.yaml`` that
    has its arguments, is all that a new method needs.
    """

    label: ClassVar[str] = ""
    """Its name in figures; empty for the name in the configuration."""
    models: ClassVar[tuple[str, ...]] = ()
    """The world models that are fitted for it."""
    fits_itself: ClassVar[bool] = False
    """Whether :meth:`estimator` fits something that takes time."""
    env_settings: ClassVar[tuple[str, ...]] = ()
    """The parts of ``env`` that its scores depend on, besides ``env.score``."""
    score_key: ClassVar[NestedKey | None] = None
    """The leaf of its scores; ``None`` where it needs none."""

    def estimator(self, scoring: Scoring) -> Estimator:
        """Returns the estimator of its scores."""
        raise NotImplementedError(f"{type(self).__name__} needs no scores")

    @abstractmethod
    def transform(
        self, layout: EntityLayout, counterfactual_ratio: float = 0.5, **options: Any
    ) -> Transform | None:
        """Returns the transform that it appends to a replay buffer, if any."""

    def score(self, rb: ReplayBuffer, scoring: Scoring) -> None:
        """Writes its scores into a buffer; finished ones are skipped."""
        if self.score_key is not None:
            score_buffer(
                rb,
                self.estimator(scoring),
                key=self.score_key,
                progress=scoring.progress,
                **self.scoring_options(scoring),
            )

    def scoring_options(self, scoring: Scoring) -> dict[str, Any]:
        """Returns options of ``score_buffer``, by default those of ``env.score``.

        Scores are those of single states: transforms look ahead.
        """
        settings = scoring.settings
        return {
            "batch_size": settings.batch_size,
            "smoothing": settings.smoothing,
            "lookahead": 0,
        }
