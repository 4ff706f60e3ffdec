"""Where the episodes of flat arrays end, and how."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_caiac.data.array_trees import to_numpy

__all__ = ["EpisodeEnds", "find_episode_ends"]


class EpisodeEnds(NamedTuple):
    """The ends of the episodes of flat arrays.

    Attributes:
        rows (numpy.ndarray): int64 ``[E]``, the last row of each episode, ascending.
        terminated (numpy.ndarray): bool ``[T]``.
        truncated (numpy.ndarray): bool ``[T]``. Ends without a kind are truncated.
    """

    rows: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


def find_episode_ends(
    steps: int,
    *,
    terminals: Any = None,
    timeouts: Any = None,
    dones: Any = None,
    episode_lengths: Any = None,
    episode_ids: Any = None,
) -> EpisodeEnds:
    """Finds the ends of the episodes of flat arrays, and checks that they agree.

    Args:
        steps (int): the number of actions, ``T``.

    Keyword Args:
        terminals (array of bool, optional): ``[T]`` or ``[T, 1]``, the ends at which
            the task has ended, so that no value follows.
        timeouts (array of bool, optional): ``[T]`` or ``[T, 1]``, the ends at which the
            recording or the time has ended.
        dones (array of bool, optional): ``[T]`` or ``[T, 1]``, all ends. Needs
            ``terminals`` or ``timeouts`` beside it: the others are of the other kind.
        episode_lengths (array of int, optional): ``[E]``, the number of actions of each
            episode.
        episode_ids (array of int, optional): ``[T]`` or ``[T, 1]``. An episode has one
            id, and its rows are consecutive.

    Returns:
        EpisodeEnds: the ends.

    Raises:
        ValueError: nothing says where the episodes end; what is given is contradictory,
            does not cover all rows, has another number of entries or other values; an
            id comes back; or ``dones`` stands alone.

    Examples:
        >>> from torchrl_caiac.data.episode_ends import find_episode_ends
        >>> flags = [0, 1, 0, 0, 0]
        >>> ends = find_episode_ends(5, terminals=flags, episode_lengths=[2, 3])
        >>> ends.rows, ends.truncated
        (array([1, 4]), array([False, False, False, False,  True]))
    """
    terminated, truncated, done = (
        None if flags is None else _flags(name, flags, steps)
        for name, flags in (
            ("terminals", terminals),
            ("timeouts", timeouts),
            ("dones", dones),
        )
    )
    if done is not None:
        terminated, truncated = _kinds(done, terminated, truncated)
    # All ends, by what says it.
    ends: dict[str, NDArray[np.bool_]] = {}
    if episode_lengths is not None:
        ends["episode_lengths"] = _from_lengths(episode_lengths, steps)
    if episode_ids is not None:
        ends["episode_ids"] = _from_ids(episode_ids, steps)
    if done is not None:
        ends["dones"] = done
    flagged = np.zeros(steps, bool)
    for name, flags in (("terminals", terminated), ("timeouts", truncated)):
        if flags is not None:
            flagged = flagged | flags
            for other, mask in ends.items():
                _check_agree(other, mask, name, flags & ~mask)
    names = list(ends)
    for name in names[1:]:
        first = ends[names[0]]
        _check_agree(names[0], first, name, first ^ ends[name])
    if not ends and terminated is None and truncated is None:
        raise ValueError(
            "nothing says where the episodes end: give terminals or timeouts (with "
            f"one flag for each of the {steps} actions), episode_lengths or "
            f"episode_ids; episode_lengths=[{steps}] if all rows are one episode"
        )
    found = ends[names[0]] if ends else flagged
    if not found[-1]:
        given = " and ".join(names) or "terminals and timeouts"
        last = int(found.nonzero()[0][-1]) if found.any() else None
        after = "there is no end" if last is None else f"the last end is at row {last}"
        raise ValueError(
            f"{given} do not cover the data: {after}, but there are {steps} rows. If "
            f"the recording stops there, set timeouts[{steps - 1}] (make sure that all "
            "ends by a time limit are in timeouts too); else leave out the rest"
        )
    terminated = np.zeros(steps, bool) if terminated is None else terminated
    truncated = np.zeros(steps, bool) if truncated is None else truncated
    return EpisodeEnds(
        found.nonzero()[0], terminated, truncated | (found & ~terminated)
    )


def _kinds(
    done: NDArray[np.bool_],
    terminated: NDArray[np.bool_] | None,
    truncated: NDArray[np.bool_] | None,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    if terminated is None and truncated is None:
        raise ValueError(
            "dones do not say whether the task ended (no value follows) or the time "
            "did: give them as terminals or as timeouts, or give one of these, too"
        )
    if terminated is None:
        assert truncated is not None
        return done & ~truncated, truncated
    if truncated is None:
        return terminated, done & ~terminated
    _check_agree(
        "dones", done, "terminals or timeouts", done ^ (terminated | truncated)
    )
    return terminated, truncated


def _check_agree(
    name: str, ends: NDArray[np.bool_], other: str, differ: NDArray[np.bool_]
) -> None:
    if not differ.any():
        return
    row = int(differ.argmax())
    says = "an episode ends" if ends[row] else "no episode ends"
    raise ValueError(
        f"{name} and {other} contradict each other at row {row}, and in "
        f"{int(differ.sum())} rows altogether: by {name}, {says} there; correct one of "
        "them, or leave it out"
    )


def _flags(name: str, value: Any, steps: int) -> NDArray[np.bool_]:
    array = _one_each(name, value, steps)
    numbers = array.dtype.kind in "biuf"
    flags = array.astype(bool) if numbers else np.zeros(len(array), bool)
    if not numbers or not (flags == array).all():
        raise ValueError(
            f"{name} are not flags: they have the dtype {array.dtype} and values such "
            f"as {array[flags != array][:1]}, expected 0 and 1 (or False and True)"
        )
    return flags


def _one_each(name: str, value: Any, steps: int) -> NDArray[Any]:
    array = to_numpy(value)
    if array.shape not in ((steps,), (steps, 1)):
        raise ValueError(
            f"{name} have shape {list(array.shape)}, expected [{steps}] or "
            f"[{steps}, 1], one for each action: give flat arrays, or lists with one "
            "array an episode for everything"
        )
    return array.reshape(steps)


def _from_lengths(value: Any, steps: int) -> NDArray[np.bool_]:
    lengths = to_numpy(value)
    if lengths.ndim != 1 or not len(lengths) or lengths.dtype.kind not in "iu":
        raise ValueError(
            f"episode_lengths have shape {list(lengths.shape)} and dtype "
            f"{lengths.dtype}, expected one integer for each episode"
        )
    if lengths.min() < 1:
        raise ValueError(
            f"episode_lengths has {lengths.min()} at episode {int(lengths.argmin())}, "
            "expected at least 1: leave out episodes without actions"
        )
    total = int(lengths.astype(np.int64).sum())
    if total != steps:
        states = total - len(lengths) == steps
        raise ValueError(
            f"episode_lengths sum to {total}, but there are {steps} actions: "
            + (
                "they count states, subtract 1 from each"
                if states
                else "correct them, or the arrays"
            )
        )
    ends = np.zeros(steps, bool)
    ends[np.cumsum(lengths.astype(np.int64)) - 1] = True
    return ends


def _from_ids(value: Any, steps: int) -> NDArray[np.bool_]:
    ids = _one_each("episode_ids", value, steps)
    if ids.dtype.kind not in "iu":
        raise ValueError(
            f"episode_ids have the dtype {ids.dtype}, expected integers: convert them"
        )
    ends = np.ones(steps, bool)
    ends[:-1] = ids[1:] != ids[:-1]
    rows = ends.nonzero()[0]
    _, first, counts = np.unique(ids[rows], return_index=True, return_counts=True)
    if (counts > 1).any():
        again = ids[rows][first[counts > 1][0]]
        runs = (ids[rows] == again).nonzero()[0]
        row = int(rows[runs[1] - 1]) + 1
        raise ValueError(
            f"the id {again} of episode_ids comes back at row {row}, after another "
            "episode: sort the rows by episode (and time), or number the episodes anew"
        )
    return ends
