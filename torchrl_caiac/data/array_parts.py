"""Sets of arrays, and the transitions of the episodes in them."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from torchrl_caiac.data.array_trees import (
    check_arrays,
    copied,
    cut,
    entries,
    episode_list,
    is_floating,
    row_bytes,
    with_goals,
)
from torchrl_caiac.data.episode_ends import find_episode_ends
from torchrl_caiac.data.episodes import episode_transitions
from torchrl_caiac.data.write_episodes import Part

__all__ = ["ArraySet", "FlatArrays", "LostRows", "episode_parts", "next_states"]

_logger = logging.getLogger("torchrl_caiac.data.from_arrays")

# Arrays are read in parts of this size, in bytes.
_CHUNK = 16 << 20


@dataclasses.dataclass(frozen=True)
class ArraySet:
    """The arrays of one episode, or of several one after another."""

    observations: Any
    actions: Any
    rewards: Any = None
    next_observations: Any = None
    terminals: Any = None
    timeouts: Any = None
    dones: Any = None
    info: Any = None

    def given(self) -> dict[str, Any]:
        """Returns the arrays that are there, by their names."""
        return {
            field.name: value
            for field in dataclasses.fields(self)
            if (value := getattr(self, field.name)) is not None
        }

    def cut(self, rows: slice) -> ArraySet:
        """Returns some rows of all arrays."""
        return ArraySet(
            **{name: cut(value, rows) for name, value in self.given().items()}
        )

    def copied(self) -> ArraySet:
        """Returns copies of all arrays."""
        return ArraySet(**{name: copied(value) for name, value in self.given().items()})

    def episodes(self) -> list[ArraySet]:
        """Returns the arrays of each episode, of lists."""
        lists = {
            name: episode_list(value, name) for name, value in self.given().items()
        }
        flat = [name for name, episodes in lists.items() if episodes is None]
        if flat:
            raise ValueError(
                f"actions is a list with one array for each episode, but {flat} "
                "are not: give lists for all, or flat arrays for all"
            )
        counts = {name: len(episodes or ()) for name, episodes in lists.items()}
        if len(set(counts.values())) > 1 or not counts["actions"]:
            raise ValueError(
                f"the lists have {counts} episodes, expected the same number, at least "
                "one: give one array for each episode"
            )
        return [
            ArraySet(**{name: (found or ())[n] for name, found in lists.items()})
            for n in range(counts["actions"])
        ]


@dataclasses.dataclass
class LostRows:
    """Counts the rows that are left out, to say so once."""

    episodes: int = 0
    terminal: int = 0
    rewards: bool = False

    def told(self, parts: Iterator[Part]) -> Iterator[Part]:
        """Yields the parts, then logs how many rows were left out."""
        yield from parts
        if not self.episodes:
            return
        matters = self.terminal or self.rewards
        _logger.log(
            logging.WARNING if matters else logging.INFO,
            "the last action of each of %d episodes is left out%s, because nothing "
            "says where it led; to keep it, give one observation more for each "
            "episode, or next_observations",
            self.episodes,
            f" (with its reward and flags; {self.terminal} were terminal)"
            if matters
            else "",
        )


class FlatArrays:
    """Flat arrays, and the rows of each of their episodes."""

    def __init__(
        self, arrays: ArraySet, where: str, lengths: Any = None, ids: Any = None
    ) -> None:
        self._arrays, self._where = arrays, where
        self._read_ones = {
            name: value
            for name, value in arrays.given().items()
            if name not in ("terminals", "timeouts", "dones")
        }
        for name, value in self._read_ones.items():
            check_arrays(value, name, where)
        self._check_columns()
        steps = entries(arrays.actions, "actions", where)
        if not steps:
            raise ValueError(
                f"{where} has no actions: give at least one, and the states before and "
                "after it"
            )
        self.ends = find_episode_ends(
            steps,
            terminals=arrays.terminals,
            timeouts=arrays.timeouts,
            dones=arrays.dones,
            episode_lengths=lengths,
            episode_ids=ids,
        )
        self._starts = np.r_[0, self.ends.rows[:-1] + 1]
        states = entries(arrays.observations, "observations", where)
        count = len(self.ends.rows)
        self._extra = self._extra_states(steps, states, count)
        # The last action of each episode, whose next state is unknown.
        self.lost = int(arrays.next_observations is None and not self._extra)
        self._check_entries(steps, states)
        self._info_is_by_state = (
            arrays.info is not None
            and entries(arrays.info, "info", where) == states != steps
        )
        self.rows = steps - self.lost * count
        width = sum(map(row_bytes, self._read_ones.values()))
        self._most = max(_CHUNK // max(width, 1), 1)
        self.units = list(self._units())

    def _check_columns(self) -> None:
        states, name = self._arrays.observations, "observations"
        if isinstance(states, Mapping) and "observation" in states:
            states, name = states["observation"], "observations['observation']"
        for value, label in ((states, name), (self._arrays.actions, "actions")):
            # Actions without columns may be numbers of choices.
            flat = not isinstance(value, Mapping) and len(value.shape) == 1
            if flat and (value is states or is_floating(value)):
                raise ValueError(
                    f"{label} of {self._where} has shape {list(value.shape)}, expected "
                    "[steps, columns]: give one column as [:, None]; if it is one step "
                    "of a list of steps, convert the list with numpy.stack"
                )

    def _extra_states(self, steps: int, states: int, count: int) -> int:
        """Returns how many states an episode has more than actions."""
        wanted = {steps: "one for each action"}
        if self._arrays.next_observations is None:
            wanted[steps + count] = f"one more for each of {count} episodes"
        if states not in wanted:
            expected = " or ".join(f"{n} ({why})" for n, why in wanted.items())
            raise ValueError(
                f"{self._where} has {states} observations for {steps} actions, "
                f"expected {expected}: correct the arrays, or what says where episodes "
                "end"
            )
        return int(states != steps)

    def _check_entries(self, steps: int, states: int) -> None:
        for name in ("rewards", "next_observations", "info"):
            if name not in self._read_ones:
                continue
            found = entries(self._read_ones[name], name, self._where)
            wanted = {steps, states} if name == "info" else {steps}
            if found not in wanted:
                raise ValueError(
                    f"{name} of {self._where} has {found} entries, expected "
                    f"{' or '.join(map(str, sorted(wanted)))}, since there are {steps} "
                    "actions: correct it"
                )

    def _units(self) -> Iterator[tuple[int, int, int, bool]]:
        """Yields episode, first row, last row plus one, and whether it ends there."""
        for number, (start, end) in enumerate(
            zip(self._starts.tolist(), self.ends.rows.tolist(), strict=True)
        ):
            stop = end + 1 - self.lost
            if stop <= start:
                raise ValueError(
                    f"{self._name(number)} has one observation and one action, and "
                    "the state after the action is unknown: leave it out, or give "
                    "next_observations"
                )
            for first in range(start, stop, self._most):
                after = min(first + self._most, stop)
                yield number, first, after, after == stop

    def _name(self, number: int) -> str:
        if len(self.ends.rows) == 1:
            return self._where
        first, last = self._starts[number], self.ends.rows[number]
        return f"episode {number} (rows {first} to {last}) of {self._where}"

    def parts(self, lost: LostRows) -> Iterator[Part]:
        """Yields transitions, reading many short episodes at a time."""
        if self.lost:
            lost.episodes += len(self.ends.rows)
            lost.terminal += int(self.ends.terminated[self.ends.rows].sum())
            lost.rewards |= "rewards" in self._read_ones
        block: list[tuple[int, int, int, bool]] = []
        for unit in self.units:
            if block and unit[2] - block[0][1] > self._most:
                yield from self._read(block)
                block = []
            block.append(unit)
        yield from self._read(block)

    def _read(self, block: list[tuple[int, int, int, bool]]) -> Iterator[Part]:
        ends, extra = self.ends, self._extra
        follows = int("next_observations" not in self._read_ones)
        begin, stop = block[0][1], block[-1][2]
        rows = slice(begin, stop)
        # With one state more for each episode, states lie behind actions.
        shift = block[0][0] * extra
        states = slice(begin + shift, stop + block[-1][0] * extra + follows)
        read = {
            name: cut(value, states if self._is_by_state(name) else rows)
            for name, value in self._read_ones.items()
        }
        for number, first, after, is_end in block:
            own = slice(first - begin, after - begin)
            moved = number * extra - shift
            with_next = slice(own.start + moved, own.stop + moved + follows)
            own_read = {
                name: cut(value, with_next if self._is_by_state(name) else own)
                for name, value in read.items()
            }
            where = self._name(number)
            transitions = episode_transitions(
                **own_read,
                where=where,
                terminated=ends.terminated[first:after],
                truncated=ends.truncated[first:after],
                ends=is_end,
            )
            yield Part(transitions, where, is_end)

    def _is_by_state(self, name: str) -> bool:
        return name == "observations" or (name == "info" and self._info_is_by_state)


def episode_parts(episodes: Iterable[ArraySet], lost: LostRows) -> Iterator[Part]:
    """Yields the transitions of the arrays of episodes.

    Args:
        episodes (iterable of ArraySet): the arrays of one episode each.
        lost (LostRows): counts what is left out.

    Yields:
        Part: an episode, or a part of a long one.

    Raises:
        ValueError: see :func:`~torchrl_caiac.data.from_arrays`.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_parts import ArraySet, LostRows, episode_parts
        >>> episode = ArraySet(np.zeros((4, 5)), np.zeros((3, 2)))
        >>> [len(part.rows) for part in episode_parts([episode], LostRows())]
        [3]
    """
    first: int | None = None
    for number, arrays in enumerate(episodes):
        where = f"episode {number}"
        check_arrays(arrays.actions, "actions", where)
        steps = entries(arrays.actions, "actions", where)
        _check_flags(arrays, steps, where)
        spans = FlatArrays(arrays, where, [steps])
        first = spans.lost if first is None else first
        if spans.lost != first:
            counts = ["one observation for each action", "one observation more"]
            raise ValueError(
                f"episode 0 has {counts[1 - first]}, {where} has "
                f"{counts[1 - spans.lost]}: give the same for all"
            )
        yield from spans.parts(lost)


def _check_flags(arrays: ArraySet, steps: int, where: str) -> None:
    """Raises if a flag of an end is set within the arrays of one episode.

    Other errors say what is wrong with arrays of another length, or of other values.
    """
    for name in ("terminals", "timeouts", "dones"):
        flags = getattr(arrays, name)
        found = np.zeros(0) if flags is None else np.asarray(flags).reshape(-1)
        early = found[:-1]
        if len(found) == steps and np.isin(found, (0, 1)).all() and early.any():
            raise ValueError(
                f"{name} of {where} is set in row {int(early.argmax())}, before the "
                "last one, but an episode ends at such a flag: cut it there, or give a "
                "lasting flag as info"
            )


def next_states(states: Any, achieved: Any, desired: Any, next_achieved: Any) -> Any:
    """Returns the next observations with their goals.

    Args:
        states (tree or list of trees, optional): the next observations.
        achieved (tree or list of trees, optional): the achieved goals.
        desired (tree or list of trees, optional): the desired goals.
        next_achieved (tree or list of trees, optional): the next achieved goals.

    Returns:
        tree or list of trees, optional: the next observations, with goals where the
        observations have them.

    Raises:
        ValueError: next observations and next achieved goals do not go together.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.data.array_parts import next_states
        >>> sorted(next_states(np.zeros((3, 2)), None, np.zeros((3, 1)), None))
        ['desired_goal', 'observation']
    """
    if states is None:
        if next_achieved is not None:
            raise ValueError(
                "next_achieved_goals is given without next_observations: leave it out, "
                "or give both"
            )
        return None
    if (achieved is None) != (next_achieved is None):
        raise ValueError(
            "with next_observations, give both of achieved_goals and "
            "next_achieved_goals, or none"
        )
    return with_goals(states, next_achieved, desired)
