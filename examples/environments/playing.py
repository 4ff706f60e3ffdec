"""Episodes that several simulators play side by side, with one call of the policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from tensordict import TensorDict

__all__ = ["Recording", "Split", "check_episode", "play_together"]

Split: TypeAlias = Literal["validation", "test"]
"""The starts that choose a training step, and those that are reported."""

Step: TypeAlias = Callable[[int, np.ndarray], tuple[Mapping[str, np.ndarray], bool]]


class Recording(NamedTuple):
    """An episode that can be looked at.

    Attributes:
        task (str): what was asked for.
        states (numpy.ndarray): ``[L + 1, S]``, what :attr:`render` takes.
        render (Callable): takes states ``[F, S]``, returns frames ``[F, 240, 320, 3]``.
        success (bool): whether the episode succeeded.
        seconds (float): the duration of a step.
    """

    task: str
    states: np.ndarray
    render: Callable[[np.ndarray], np.ndarray]
    success: bool
    seconds: float


def check_episode(episode: int, number: int) -> None:
    """Raises ValueError if there is no such test episode among a number of them."""
    if not 0 <= episode < number:
        raise ValueError(
            f"episode is {episode}, expected 0 to {number - 1}: so many test episodes "
            "of a task are played"
        )


def play_together(
    actor: Any, states: Sequence[Mapping[str, np.ndarray]], step: Step
) -> None:
    """Plays an episode from each of the states, until all episodes are over.

    The policy sees all of them at once in every step, also those that are over, so that
    an episode does not depend on how long the others take.

    Args:
        actor (TensorDictModule): the policy. What it writes under ``"next"`` is carried
            to the next step, for example a plan.
        states (sequence of Mapping): the first observation of each episode.
        step (Callable): takes the number of an episode and an action, and returns the
            next observation and whether the episode is over.
    """
    states, batch = list(states), [len(states)]
    carried = TensorDict({"is_init": torch.ones(*batch, 1, dtype=torch.bool)}, batch)
    running = list(range(len(states)))
    while running:
        inputs = {k: np.stack([state[k] for state in states]) for k in states[0]}
        with torch.no_grad():
            output = actor(TensorDict(inputs, batch).update(carried))
        actions = output["action"].numpy()
        carried = output.get("next", TensorDict({}, batch))
        for number in tuple(running):
            states[number], over = step(number, actions[number])
            if over:
                running.remove(number)
