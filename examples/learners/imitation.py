"""The buffer of goals that are drawn before the counterfactuals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase
from torchrl.data import SliceSampler, TensorDictReplayBuffer

from learners.base import Learner
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.transforms import WindowGoal

__all__ = ["check_demonstrations", "future_goals", "imitation_buffer", "window_goals"]


def check_demonstrations(learner: Learner) -> None:
    """Raises if the environment has no demonstrations to imitate."""
    environment = learner.environment
    if not environment.has_demonstrations:
        raise ValueError(
            f"{type(environment).__name__} has no demonstrations to imitate, as "
            "env.demonstrations is null: set how many successful episodes to learn from"
        )


def future_goals(learner: Learner, window: int = 1) -> WindowGoal:
    """Returns what draws later states as goals, by the setting ``future_goals``.

    Raises:
        ValueError: the setting is not a mixture of strategies.
    """
    given = learner.settings.future_goals
    wanted = "weights of strategies, and p of geometric offsets"
    if not isinstance(given, Mapping):
        raise ValueError(f"learner.future_goals is {given!r}, expected {wanted}")
    mixture = dict(given)
    offset = {"p": mixture.pop("p")} if "p" in mixture else {}
    if offset and not mixture.get("geometric"):
        raise ValueError(
            f"learner.future_goals is {given}, expected {wanted}: without geometric "
            "offsets p has no effect"
        )
    return window_goals(learner, "future_goals", mixture, window, **offset)


def window_goals(
    learner: Learner, name: str, mixture: Mapping[str, Any], window: int, **offset: Any
) -> WindowGoal:
    """Returns what draws later states as goals.

    Args:
        learner (Learner): has the layout.
        name (str): the setting with the weights, for the error.
        mixture (mapping): the weights of strategies.
        window (int): rows in a window.
        **offset (Any): ``p`` of geometric offsets.

    Raises:
        ValueError: these are no weights of strategies.
    """
    try:
        return WindowGoal(
            learner.environment.layout, window=window, mixture=mixture, **offset
        )
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"learner.{name} is {learner.settings[name]}: {error}"
        ) from error


def imitation_buffer(
    learner: Learner,
    rows: TensorDictBase,
    *,
    batch_size: int,
    window: int = 1,
    goals: WindowGoal | None = None,
) -> TensorDictReplayBuffer:
    """Creates a buffer of windows, their goals, and counterfactuals.

    Goals come before the counterfactuals, whose goals follow the swap: a swapped entity
    takes the goal of its donor.

    Args:
        learner (Learner): has the method.
        rows (TensorDictBase): rows to learn from, ``[T]``.

    Keyword Args:
        batch_size (int): rows in a sample, a multiple of ``window``.
        window (int): rows that follow each other. Defaults to 1.
        goals (WindowGoal, optional): draws later states as goals. Defaults to
            ``None``: the desired goals of the rows.

    Returns:
        TensorDictReplayBuffer: the buffer.
    """
    options: dict[str, Any] = {}
    if window > 1:
        options["sampler"] = SliceSampler(
            slice_len=window,
            traj_key="episode",
            cache_values=True,
            truncated_key=None,  # no learner here reads the ends of windows
        )
    if goals is not None:
        options["sample_unit"] = goals
    rb = offline_buffer(rows, batch_size, **options)
    if goals is not None:
        rb.append_transform(goals)
    augmentation = learner.counterfactuals(window=window)
    if augmentation is not None:
        rb.append_transform(augmentation)
    return rb
