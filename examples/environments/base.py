"""The base class of environments."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.data import Bounded

from environments.playing import Recording, Split
from torchrl_caiac import EntityLayout
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence import score_buffer

__all__ = ["Environment", "Evaluation"]


class Evaluation(NamedTuple):
    """The episodes that one policy played.

    Attributes:
        method (str): the name of the method.
        seed (int): of the run.
        step (int): gradient steps of the policy.
        split (str): ``"validation"`` or ``"test"``.
        seconds (float): processor time.
        episodes (list of dict): one dictionary for each episode, as
            :meth:`Environment.play` returns them.
    """

    method: str
    seed: int
    step: int
    split: Split
    seconds: float
    episodes: list[dict[str, Any]]


class Environment(ABC):
    """Data, simulator and evaluation of an environment.

    A subclass in a module of this folder, with a file ``conf/env/<name>.yaml`` that has
    its settings, is all that a new environment needs.

    Args:
        settings (DictConfig): ``cfg.env``.
        out (Path): the folder that all steps write.

    Keyword Args:
        workers (int): processes that collect data and query the simulator.
    """

    layout: EntityLayout
    action_dim: int
    predicted: Mapping[str, Sequence[int]] | None = None
    """The columns that world models predict; ``None`` for all."""
    inputs: Mapping[str, Sequence[int]] | None = None
    """The columns that world models read; ``None`` for all."""
    goal_reference: str | None = None
    """The entity that positions are given relative to; ``None`` for none."""
    reward_fn: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] | None = None
    """Rewards of achieved and desired goals, -1 or 0; ``None`` where it has none."""
    episodes_have_goals: ClassVar[bool] = True
    """Whether an episode was recorded to reach its goal, so that it can succeed."""
    demonstrations_have_goals: ClassVar[bool] = True
    """Whether :meth:`demonstrations` have the goals of their episodes."""
    data_name: ClassVar[str] = "data"
    """The name of the data in the list of stages."""
    success_key: ClassVar[str] = "success"
    """The entry that defines the success of an episode, see :meth:`play`."""

    def __init__(self, settings: DictConfig, out: Path, *, workers: int = 1) -> None:
        self.settings = settings
        self.out = out
        self.workers = workers

    @property
    def action_spec(self) -> Bounded:
        """The action space, ``[A]``: [-1, 1] in every dimension."""
        return Bounded(-1.0, 1.0, (self.action_dim,))

    @property
    def folder(self) -> Path:
        """The folder of everything that depends on the training data."""
        return self.out

    def check(self) -> None:
        """Raises if a setting of the evaluation is wrong, before data are collected."""
        settings = self.settings.get("evaluate")
        if not isinstance(settings, DictConfig):
            raise ValueError(
                f"env.evaluate is {settings}, but it should be a group of settings"
            )
        for name, least in (
            ("episodes", 1),
            ("validation_episodes", 1),
            ("seed", 0),
            ("validation_seed", 0),
        ):
            if name not in settings:  # an environment may do without
                continue
            number = settings[name]
            if type(number) is not int or number < least:
                raise ValueError(
                    f"env.evaluate.{name} is {number!r}, expected an integer of at "
                    f"least {least}"
                )

    @property
    def has_demonstrations(self) -> bool:
        """Whether there are demonstrations to imitate, by the settings."""
        return True

    @abstractmethod
    def collect(self, *, progress: bool = False) -> None:
        """Collects what is missing of the data."""

    @abstractmethod
    def rows(self) -> TensorDictBase:
        """Returns the transitions to learn from, ``[T]``, memory-mapped."""

    def goal_rows(self) -> TensorDictBase:
        """Returns the same transitions with desired goals and rewards."""
        return self.rows()

    def demonstrations(self) -> TensorDictBase:
        """Returns the transitions that imitation learners copy, memory-mapped.

        Methods score them. Defaults to :meth:`rows`.
        """
        return self.rows()

    def model_rows(self) -> list[TensorDictBase]:
        """Returns the datasets that world models are fitted to."""
        return [self.rows()]

    def held_out(self) -> TensorDictBase:
        """Returns transitions that are not trained on, to check the scores."""
        return load_transitions(self.out / "held_out")

    @abstractmethod
    def simulator(self, num_actions: int) -> Any:
        """Returns the estimator that queries the simulator, some actions per state."""

    @abstractmethod
    def distance_rule(self, *, action_only: bool) -> Any:
        """Returns the estimator that links entities which are close to each other."""

    def ground_truth(self, *, progress: bool = False) -> torch.Tensor:
        """Returns what the action moves in the held-out states, bool ``[T, N]``."""
        held_out = self.held_out()
        score_buffer(
            offline_buffer(held_out, batch_size=1),
            self.simulator(self.settings.truth.actions),
            key=("oracle", "score"),
            batch_size=self.settings.truth.batch_size,
            lookahead=0,
            progress=progress,
        )
        return held_out["oracle", "score"] > 0.5

    @abstractmethod
    def play(
        self, actor: Any, seed: int, folder: Path, *, split: Split = "test"
    ) -> list[dict[str, Any]]:
        """Plays the episodes of an evaluation.

        Args:
            actor (TensorDictModule): the policy.
            seed (int): of the run.
            folder (Path): for figures of episodes, if any.

        Keyword Args:
            split (str): ``"validation"``, from which the best policy of a run is
                chosen, or ``"test"``, which is reported. They have no start in common.

        Returns:
            list of dict: one dictionary for each episode, JSON values.
        """

    def record(
        self, actor: Any, seed: int, task: str | None = None, *, episode: int = 0
    ) -> Recording:
        """Plays the test episodes of a task again, and returns one.

        Args:
            actor (TensorDictModule): the policy.
            seed (int): of the run.
            task (str, optional): one of the tasks that are evaluated. Defaults to
                ``None``: the first.

        Keyword Args:
            episode (int): from 0, among those of the task. Defaults to 0.

        Returns:
            Recording: the episode.

        Raises:
            ValueError: there is no such task or episode.
        """
        raise NotImplementedError(f"{type(self).__name__} records no episodes")

    @abstractmethod
    def measures(self, episodes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Returns the results of an evaluation.

        Args:
            episodes (sequence of dict): as :meth:`play` returns them.

        Returns:
            list of dict: for each task and measure ``"task"``, ``"measure"``, the
            number of ``"episodes"``, and their mean ``"value"``. The first measure is
            that of success.
        """

    def draw(self, folder: Path, name: str, *, threshold: float) -> list[str]:
        """Draws figures of its own. Defaults to none.

        Args:
            folder (Path): where they are written.
            name (str): of the study, the prefix of the files.

        Keyword Args:
            threshold (float): θ of CAIAC.

        Returns:
            list of str: remarks, for example on figures that were left out.
        """
        return []
