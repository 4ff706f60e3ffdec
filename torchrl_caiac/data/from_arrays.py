"""Arrays as TorchRL transitions in memory-mapped files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import Any

from tensordict import TensorDict

from torchrl_caiac.data.array_parts import (
    ArraySet,
    FlatArrays,
    LostRows,
    episode_parts,
    next_states,
)
from torchrl_caiac.data.array_trees import episode_list, plain_tree, with_goals
from torchrl_caiac.data.write_episodes import Part, write_episodes

__all__ = ["from_arrays"]


def from_arrays(
    observations: Any,
    actions: Any,
    path: str | os.PathLike[str],
    *,
    rewards: Any = None,
    next_observations: Any = None,
    terminals: Any = None,
    timeouts: Any = None,
    dones: Any = None,
    episode_lengths: Any = None,
    episode_ids: Any = None,
    achieved_goals: Any = None,
    desired_goals: Any = None,
    next_achieved_goals: Any = None,
    info: Mapping[str, Any] | None = None,
    action_bounds: tuple[Any, Any] | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Writes arrays as TorchRL transitions, and opens them.

    Each argument is an array or a nested mapping of arrays. An array is a NumPy array,
    also a memory-mapped one, a tensor, an HDF5 dataset, or anything else that has a
    shape and can be sliced. It is read in parts, so it may be larger than the memory.
    A tensordict counts as a mapping. There are two forms:

    - **a list with one array for each episode**, for everything. (Or a mapping of such
      lists.)
    - **flat arrays**, with the episodes one after another. Pass at least one of
      ``terminals``, ``timeouts``, ``dones``, ``episode_lengths`` and ``episode_ids``,
      which say where the episodes end. If you pass several, they must agree.

    In both, an episode with ``L`` actions has

    - ``L + 1`` observations, or
    - ``L`` observations and ``L`` ``next_observations``, or
    - ``L`` observations only. The state after its last action is then unknown. **This
      transition is left out**, with its reward and flags, and the one before it counts
      as truncated. A message in the log says so.

    The transitions ``[T]`` are those of
    :func:`~torchrl_caiac.data.episode_transitions`, with ``"episode"``, int64 ``[T]``.
    The last row of an episode is always done. A second call with the same data opens
    the folder.

    Args:
        observations (array or mapping of arrays): the states, see above. If a mapping
            has the entry ``"observation"``, its entries become entries of the root;
            any other mapping becomes a nested ``"observation"``.
        actions (array): ``L`` actions an episode.
        path (path): the folder to write. It is written atomically.

    Keyword Args:
        rewards (array, optional): one for each action. Defaults to ``None``: the
            transitions have no rewards.
        next_observations (array or mapping of arrays, optional): the states after the
            actions. Defaults to ``None``.
        terminals (array of bool, optional): one flag for each action: the task ended,
            and no value follows. Defaults to ``None``: it never did.
        timeouts (array of bool, optional): one flag for each action: the time or the
            recording ended. Defaults to ``None``: where an episode ends and the task
            did not.
        dones (array of bool, optional): one flag for each action, at the end of an
            episode of either kind. Needs ``terminals`` or ``timeouts`` beside it.
            Defaults to ``None``.
        episode_lengths (array of int, optional): the number of actions of each episode,
            ``[E]``. For flat arrays. Defaults to ``None``.
        episode_ids (array of int, optional): the id of the episode of each action.
            Those of an episode are consecutive. For flat arrays. Defaults to ``None``.
        achieved_goals (array or mapping of arrays, optional): one for each observation.
            Defaults to ``None``.
        desired_goals (array or mapping of arrays, optional): one for each observation.
            With ``next_observations``, the next state has the goal of the state before.
            Defaults to ``None``.
        next_achieved_goals (array or mapping of arrays, optional): one for each of
            ``next_observations``. Defaults to ``None``.
        info (mapping of arrays, optional): further entries, for each action or each
            observation. Row ``t`` of an episode gets entry ``t``, with its type, under
            ``"info"``. Defaults to ``None``.
        action_bounds (tuple of sequence, optional): the lowest and the highest action,
            ``[A]`` each, see :func:`~torchrl_caiac.data.action_bounds`. Defaults to
            ``None``: unknown.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileExistsError: ``path`` exists, has other data, and ``overwrite`` is
            ``False``.
        OSError: the disk is full.
        ValueError: the ends are unknown, contradictory or do not cover the data; arrays
            have other numbers of entries than the others need, or have NaN, infinite
            values, texts or objects; episodes differ in their entries, shapes or
            types; an episode has no actions, or only one state.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_caiac.data import from_arrays
        >>> folder = tempfile.TemporaryDirectory()
        >>> states, actions = np.random.rand(1000, 10), np.random.rand(1000, 4)
        >>> data = from_arrays(
        ...     states,
        ...     actions,
        ...     f"{folder.name}/data",
        ...     episode_lengths=[600, 400],
        ...     action_bounds=([0, 0, 0, 0], [1, 1, 1, 1]),
        ...     progress=False,
        ... )
        >>> len(data)  # without the last action of each episode
        998
        >>> folder.cleanup()
    """
    observations, actions = plain_tree(observations), plain_tree(actions)
    next_observations = plain_tree(next_observations)
    given = ArraySet(
        observations=with_goals(observations, achieved_goals, desired_goals),
        actions=actions,
        rewards=rewards,
        next_observations=next_states(
            next_observations, achieved_goals, desired_goals, next_achieved_goals
        ),
        terminals=terminals,
        timeouts=timeouts,
        dones=dones,
        info=plain_tree(info),
    )
    lost = LostRows()
    if episode_list(actions, "actions") is None:
        spans = FlatArrays(given, "the arrays", episode_lengths, episode_ids)
        parts: Iterator[Part] = spans.parts(lost)
        rows, total = spans.rows, len(spans.units)
    else:
        for name, value in (
            ("episode_lengths", episode_lengths),
            ("episode_ids", episode_ids),
        ):
            if value is not None:
                raise ValueError(
                    f"{name} is given, but a list has one array for each episode: "
                    f"leave out {name}, or give flat arrays"
                )
        episodes = given.episodes()
        parts, rows, total = episode_parts(episodes, lost), None, len(episodes)
    return write_episodes(
        lost.told(parts),
        path,
        action_bounds=action_bounds,
        overwrite=overwrite,
        progress=progress,
        rows=rows,
        total=total,
        description="writing episodes",
    )
