"""The check of a dataset as a whole."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer

from torchrl_caiac._checks import check_int, check_local
from torchrl_caiac._keys import as_key
from torchrl_caiac._torchrl import last_written, storage_rows
from torchrl_caiac.check.columns import check_columns, check_goals, unowned_columns
from torchrl_caiac.check.ends import check_end_entries, check_ends, find_ids
from torchrl_caiac.check.entries import check_entries, goal_entries
from torchrl_caiac.check.grouping import check_grouping
from torchrl_caiac.check.kinds import finding
from torchrl_caiac.check.motion import check_jumps, check_motion
from torchrl_caiac.check.regression import Regression
from torchrl_caiac.check.report import DatasetError, DatasetReport, Finding
from torchrl_caiac.check.sample import Sample, take_sample
from torchrl_caiac.check.state import States, read_states
from torchrl_caiac.check.succession import Succession, check_succession
from torchrl_caiac.check.values import (
    check_action,
    check_finite,
    find_padding,
    named,
)
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules._predicted_columns import checked_predict
from torchrl_caiac.modules._variance_floor import checked_floor
from torchrl_caiac.trajectories import STEPS_KEY, TrajectoryIndex, trajectory_index

__all__ = ["check_before_use", "check_dataset"]

_LOGGER = logging.getLogger("torchrl_caiac.check")
_QUICK_ROWS = 20_000  # rows that are checked before fitting and scoring
_MAX_STARTS = 50_000  # first states that next states are compared with
_TIMES: tuple[NestedKey, ...] = ("step_count", "step")
# Findings after which others would mislead, or repeat them.
_MISLEADING = {
    "next_equals_state",
    "next_of_other_rows",
    "next_skips_rows",
    "rows_out_of_order",
}
_BREAKS = {"end_missing", "next_not_following"}
# Errors of swaps alone, which refuse such data.
_LATER = {"goals_not_mapped"}
# Warnings that this process has logged.
_LOGGED: set[tuple[Any, ...]] = set()


def check_dataset(
    data: TensorDictBase | ReplayBuffer,
    layout: EntityLayout,
    *,
    action_key: NestedKey | None = "action",
    reward_key: NestedKey | None = ("next", "reward"),
    trajectory_key: NestedKey | None = "episode",
    done_key: NestedKey | None = ("next", "done"),
    time_keys: Sequence[NestedKey] = _TIMES,
    read_next: bool = True,
    action_spec: Any = None,
    variance_floor: float | Mapping[str, float | Sequence[float]] | None = None,
    predict: Mapping[str, Iterable[int]] | None = None,
    max_rows: int = 200_000,
) -> DatasetReport:
    r"""Checks a dataset for what would make counterfactuals or scores wrong.

    It looks for entries that are missing or have other shapes; next states that are
    not the states of the following rows; ids and end flags that are missing or
    contradict each other; rows in the wrong order; columns that are copies, constant,
    or functions of swapped columns that the swap does not change; columns that move
    with another entity, or that move and have none; entities that never or always move;
    jumps; a variance floor in other units; actions that are out of
    bounds or never vary; and values that are not finite. Each finding says what it does
    to counterfactuals, and what to do.

    Errors make results wrong or make a later step fail. Warnings may describe what was
    intended. In large data, only whole trajectories or parts of them are checked. They
    are spread evenly and the same in every call.

    Args:
        data (TensorDictBase or ReplayBuffer): the transitions ``[T]``, in memory or
            memory-mapped.
        layout (EntityLayout): the entities.

    Keyword Args:
        action_key (NestedKey, optional): the action, ``[T, A]``; ``None`` if nothing
            reads it. Defaults to ``"action"``.
        reward_key (NestedKey, optional): the reward, looked for if the data have goals
            that the layout maps; ``None`` if nothing reads it. Defaults to
            ``("next", "reward")``.
        trajectory_key (NestedKey, optional): the trajectory ids, as in
            :func:`~torchrl_caiac.trajectories.trajectory_index`. Defaults to
            ``"episode"``.
        done_key (NestedKey, optional): the end flags, as there. Defaults to
            ``("next", "done")``.
        time_keys (sequence of NestedKey): entries that count the steps of a trajectory,
            ``[T]`` or ``[T, 1]``; the first one that exists is used. Defaults to
            ``("step_count", "step")``.
        read_next (bool): whether next states are read. Defaults to ``True``.
        action_spec (Bounded or pair, optional): the action space, or its lowest and
            highest values, each a number or ``[A]``. Defaults to ``None``: bounds are
            not checked.
        variance_floor (float or Mapping, optional): that of the world model, see
            :class:`~torchrl_caiac.modules.GaussianWorldModel`. Defaults to ``None``:
            units are not checked.
        predict (Mapping, optional): the predicted columns of the world model, which
            ``variance_floor`` describes. Defaults to all columns.
        max_rows (int): the largest number of transitions to check. Defaults to
            ``200_000``.

    Returns:
        DatasetReport: the findings, errors first.

    Raises:
        TypeError: an argument has another type.
        ValueError: the data are empty, or an argument is out of range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout, check_dataset
        >>> walk = torch.randn(201, 2, generator=torch.Generator().manual_seed(0))
        >>> walk = walk.cumsum(0)
        >>> data = TensorDict(
        ...     {
        ...         "observation": walk[:-1],
        ...         "action": walk[1:, :1] - walk[:-1, :1],
        ...         "episode": torch.zeros(200, dtype=torch.int64),
        ...         "next": {"observation": walk[1:].clone()},
        ...     },
        ...     [200],
        ... )
        >>> layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])
        >>> data["next", "observation"][50] = 0.0
        >>> report = check_dataset(data, layout)
        >>> [(f.code, f.severity, f.rows) for f in report.errors]
        [('next_not_following', 'error', (50,))]
    """
    if not isinstance(layout, EntityLayout):
        raise TypeError(f"layout must be an EntityLayout, got {type(layout).__name__}")
    check_int("max_rows", max_rows, 1)
    check = _Check(
        data,
        layout,
        action_key=_key(action_key),
        reward_key=_key(reward_key),
        trajectory_key=_key(trajectory_key),
        done_key=_key(done_key),
        time_keys=[as_key(key) for key in time_keys],
        read_next=read_next,
        bounds=_bounds(action_spec),
    )
    check.floors = check.find_floors(variance_floor, predict)
    return check.run(max_rows)


def check_before_use(
    data: TensorDictBase | ReplayBuffer, layout: EntityLayout, **kwargs: Any
) -> None:
    """Checks a sample of a dataset before something costly is done with it.

    Warnings are logged, each once in a process for data with the same layout. So are
    goals that the layout does not name: they matter to swaps, which refuse them.

    Args:
        data (TensorDictBase or ReplayBuffer): the transitions ``[T]``.
        layout (EntityLayout): the entities.
        **kwargs: the keyword arguments of :func:`check_dataset`. At most 20,000
            transitions are checked.

    Raises:
        DatasetError: the check found errors.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.check import check_before_use
        >>> td = TensorDict({"observation": torch.rand(5, 2)}, [5])
        >>> check_before_use(td, EntityLayout({"cup": [0, 1]}))
        Traceback (most recent call last):
        ...
        torchrl_caiac.check.report.DatasetError: checked 5 of 5 transitions, ...
    """
    report = check_dataset(data, layout, **{"max_rows": _QUICK_ROWS, **kwargs})
    if {found.code for found in report.errors} - _LATER:
        raise DatasetError(report)
    for found in report.findings:
        kind = (layout, found.code, found.key, found.columns)
        if kind not in _LOGGED:
            _LOGGED.add(kind)
            _LOGGER.warning(
                "%s: %s. Effect: %s. To do: %s",
                found.code,
                found.message,
                found.effect,
                found.remedy,
            )


class _Check:
    """One check of one dataset: what to read, and what is known about it."""

    def __init__(
        self,
        data: TensorDictBase | ReplayBuffer,
        layout: EntityLayout,
        *,
        action_key: NestedKey | None,
        reward_key: NestedKey | None,
        trajectory_key: NestedKey | None,
        done_key: NestedKey | None,
        time_keys: Sequence[NestedKey],
        read_next: bool,
        bounds: tuple[torch.Tensor, torch.Tensor] | None,
    ) -> None:
        self.source, self.layout = data, layout
        self.action_key, self.reward_key = action_key, reward_key
        self.trajectory_key, self.done_key = trajectory_key, done_key
        self.time_keys, self.read_next, self.bounds = time_keys, read_next, bounds
        self.data, self.newest = _rows(data)
        self.floors: dict[str, dict[int, float]] | None = None
        self.findings: list[Finding] = []
        self.has_bad_goals = False

    def run(self, max_rows: int) -> DatasetReport:
        """Runs all checks that the entries of the data allow."""
        data, layout = self.data, self.layout
        self.findings = check_entries(
            data,
            layout,
            action_key=self.action_key,
            reward_key=self.reward_key,
            read_next=self.read_next,
        )
        bad = {found.key for found in self.findings if found.severity == "error"}
        # Errors of goals do not hide what is wrong with the state.
        goals = {x for key in _goal_keys(layout) for x in (key, layout.next(key))}
        self.has_bad_goals = bool(bad & goals)
        bad -= goals
        complete = not bad
        ends = check_end_entries(data, self.trajectory_key, self.done_key)
        self.findings += ends
        index = self._index(ends)
        sample = take_sample(data, index, max_rows)
        action = None
        if self.action_key is not None and self.action_key not in bad:
            action = self._check_action(sample)
            complete = complete or bad <= {self.action_key}
        elif bad == {self.action_key}:
            complete = True
        if not layout.fixed and len(layout) > 1:
            message = f"no entity of the layout is fixed: it has {named(layout.names)}"
            self.findings.append(finding("none_fixed", message))
        if complete:
            self._check_states(sample, index, action)
        errors_first = sorted(self.findings, key=lambda f: f.severity != "error")
        return DatasetReport(
            tuple(errors_first),
            len(data),
            len(sample),
            0 if index is None else len(index.ends),
        )

    def _index(self, ends: list[Finding]) -> TrajectoryIndex | None:
        """Returns the trajectories, ``None`` if ids and flags do not tell them."""
        codes = {found.code for found in ends}
        if codes & {"ends_missing", "wrong_shape"}:
            return None
        ids = None if "ids_missing" in codes else self.trajectory_key
        return trajectory_index(self.source, trajectory_key=ids, done_key=self.done_key)

    def _check_action(self, sample: Sample) -> torch.Tensor:
        assert self.action_key is not None  # there is an action
        action = sample.read(self.action_key)
        labels = [f"column {c}" for c in range(action.shape[1])]
        found, finite = check_finite(sample, self.action_key, action, labels)
        self.findings += found
        self.findings += check_action(
            sample.keep(finite), self.action_key, action[finite], self.bounds
        )
        return action

    def _check_states(
        self,
        sample: Sample,
        index: TrajectoryIndex | None,
        action: torch.Tensor | None,
    ) -> None:
        layout, data = self.layout, self.data
        states = read_states(layout, sample, read_next=self.read_next)
        state_key = layout.observation_key or "state"
        found, good = check_finite(sample, state_key, states.now, states.labels)
        self.findings += found
        if states.after is not None:
            key = layout.next(state_key)
            found, finite = check_finite(sample, key, states.after, states.labels)
            self.findings += found
            good &= finite
        self._check_goal_values(sample)
        found, padded = find_padding(data, sample, states, action)
        self.findings += found
        good &= ~padded
        if not bool(good.all()):
            sample, states = sample.keep(good), states.keep(good)
        if not len(sample):
            return
        still: set[str] = set()
        whole: torch.Tensor | None = None
        if states.after is not None:
            links = self._check_succession(sample, states, index)
            if not bool(padded.any()):  # flags are set before the padding
                self._check_flags(states, index, links)
            if not {found.code for found in links.findings} & _MISLEADING:
                whole = ~links.broken
                chosen = sample.keep(whole), states.keep(whole)
                found = check_motion(
                    *chosen,
                    layout.fixed,
                    self.floors,
                    None if action is None else action[good][whole],
                )
                found += check_jumps(*chosen)
                self.findings += found
            still = {
                column
                for found in self.findings
                if found.code in ("never_moves", "next_equals_state")
                for column in found.columns
            }
        left_out = [self.action_key, self.reward_key, self.trajectory_key]
        unowned = unowned_columns(
            layout, data, sample, [*left_out, self.done_key, *self.time_keys]
        )
        regression = Regression.of(sample, states, layout)
        self.findings += check_columns(
            layout, sample, states, regression, unowned, still
        )
        if not self.has_bad_goals:
            self.findings += check_goals(layout, sample, data)
        if whole is not None:
            known = {
                column
                for found in self.findings
                if found.code in ("duplicate_columns", "stale_columns", "mixed_columns")
                for column in found.columns
            }
            self.findings += check_grouping(
                layout, sample, states, whole, regression, known
            )

    def _check_goal_values(self, sample: Sample) -> None:
        """Finds goals and rewards that are not finite."""
        keys = goal_entries(self.layout)
        keys += [self.layout.next(key) for key in keys]
        if self.layout.goal and self.reward_key is not None:
            keys.append(self.reward_key)
        for key in keys:
            if isinstance(self.data.get(key, None), torch.Tensor):
                values = sample.read(key)
                labels = [f"column {c}" for c in range(values.shape[1])]
                self.findings += check_finite(sample, key, values, labels)[0]

    def _check_succession(
        self, sample: Sample, states: States, index: TrajectoryIndex | None
    ) -> Succession:
        data = self.data
        steps = torch.ones(len(sample), dtype=torch.long)
        if data.get(STEPS_KEY, None) is not None:
            steps = sample.read(STEPS_KEY)[:, 0].long()
        times = [key for key in self.time_keys if data.get(key, None) is not None]
        time = None
        if times and data.get(times[0])[:1].numel() == 1:
            time = sample.read(times[0])[:, 0]
        starts = states.now[:0]
        if index is not None:
            first = index.starts[:: -(-len(index.ends) // _MAX_STARTS)].cpu()
            starts = read_states(self.layout, sample.at(first), read_next=False).now.to(
                states.now.dtype
            )
        next_key = self.layout.next(self.layout.observation_key or "state")
        links = check_succession(sample, states, starts, steps, time, next_key)
        self.findings += links.findings
        return links

    def _check_flags(
        self, states: States, index: TrajectoryIndex | None, links: Succession
    ) -> None:
        """Compares end flags with ids and with where next states lead elsewhere."""
        codes = {found.code for found in links.findings}
        if index is None or codes & _MISLEADING:
            return

        def continues(rows: torch.Tensor, later: torch.Tensor) -> torch.Tensor:
            device = self.data.device
            after = self.layout.read(self.data[rows.to(device)], next=True).cpu()
            now = self.layout.read(self.data[later.to(device)]).cpu()
            return ((after - now).abs() <= states.tolerance).all(1)

        found = check_ends(
            self.data,
            self.trajectory_key,
            self.done_key,
            len(index.ends),
            self.newest,
            continues,
        )
        breaks = [f for f in links.findings if f.code in _BREAKS]
        never = [f for f in found if f.code == "ends_never_set"]
        if breaks and never and find_ids(self.data, self.trajectory_key) is None:
            # Each break is an end without a flag.
            self.findings = [f for f in self.findings if f not in breaks]
            broken = replace(
                never[0],
                severity="error",
                message=f"{never[0].message}, also where {breaks[0].message}",
                rows=breaks[0].rows,
                count=breaks[0].count,
            )
            found = [broken if f is never[0] else f for f in found]
        self.findings += found

    def find_floors(
        self,
        floor: float | Mapping[str, float | Sequence[float]] | None,
        predict: Mapping[str, Iterable[int]] | None,
    ) -> dict[str, dict[int, float]] | None:
        """Returns the variance floor of each predicted column, by entity."""
        layout = self.layout
        if floor is None or (isinstance(floor, str) and floor == "auto"):
            return None  # "auto" is known once a model is fitted
        try:
            widths = layout.widths(None if layout.is_flat else self.data[:1])
        except KeyError:
            return None  # an entry is missing, which is a finding
        positions = checked_predict(layout, widths, predict)
        values = iter(checked_floor(floor, positions))
        return {
            name: {position: next(values) for position in own}
            for name, own in positions.items()
        }


def _goal_keys(layout: EntityLayout) -> list[NestedKey]:
    """Returns the keys of goals, whether the layout maps them or not."""
    keys = [layout.desired_goal_key, layout.achieved_goal_key]
    return [*goal_entries(layout), *(key for key in keys if key is not None)]


def _key(key: NestedKey | None) -> NestedKey | None:
    return None if key is None else as_key(key)


def _rows(data: TensorDictBase | ReplayBuffer) -> tuple[TensorDictBase, torch.Tensor]:
    """Returns the transitions ``[T]``, and the rows that were written last."""
    check_local("data", data)
    newest = None
    if isinstance(data, ReplayBuffer):
        storage = data.storage
        rows = storage_rows(storage)[: len(storage)]
        newest = last_written(data)
        if newest is not None:
            streams = storage.shape[1:].numel() if storage.ndim > 1 else 1
            return rows, newest * streams + torch.arange(streams)
    elif not isinstance(data, TensorDictBase):
        raise TypeError(
            f"data must be a TensorDict or a ReplayBuffer, got {type(data).__name__}"
        )
    elif data.batch_dims < 1 or not data.batch_size.numel():
        raise ValueError(
            f"the data have the batch size {list(data.batch_size)}, expected at least "
            "one transition [T]"
        )
    else:
        rows = data if data.batch_dims == 1 else data.reshape(-1)
    return rows, torch.tensor([len(rows) - 1])


def _bounds(spec: Any) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Returns the lowest and the highest action."""
    if spec is None:
        return None
    pair = spec
    if not isinstance(spec, (tuple, list)):
        space: Any = getattr(spec, "space", None)
        if not hasattr(space, "low") or not hasattr(space, "high"):
            raise TypeError(
                f"action_spec must be a torchrl Bounded spec or a pair of bounds, got "
                f"{type(spec).__name__}"
            )
        pair = (space.low, space.high)
    if len(pair) != 2:
        raise ValueError(f"action_spec must be a pair of bounds, got {spec!r}")
    low, high = (torch.as_tensor(b, dtype=torch.float64).reshape(-1) for b in pair)
    if not bool((low <= high).all()):
        raise ValueError(f"the bounds of action_spec must be ordered, got {spec!r}")
    return low, high
