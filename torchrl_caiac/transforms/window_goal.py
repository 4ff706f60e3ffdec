"""Goals for windows: a later state of the window's own trajectory."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import TensorStorage
from torchrl.data.replay_buffers import SampleUnit
from torchrl.envs.transforms import Transform

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms.donors import (
    StorageCache,
    TrajectoryIndex,
    _plain,
    _rand,
    _storage_td,
    goal_columns,
    trajectory_index,
)

__all__ = ["WindowGoal", "draw_goal_offset"]

_STRATEGIES = ("last", "uniform", "geometric")


def draw_goal_offset(
    remaining: torch.Tensor,
    mixture: Mapping[str, float],
    *,
    p: float = 0.3,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draws how many rows beyond a window the row lies whose next state is its goal.

    Offset 0 is the window's last row, whose next state is the first one after the
    window. Three strategies are mixed, window by window: ``last`` takes the
    trajectory's last row, ``uniform`` any row from the window's last one on, and
    ``geometric`` the state ``k >= 1`` steps after the window's last one with
    probability ``p * (1 - p) ** (k - 1)``, or the last one if the trajectory ends
    before.

    Args:
        remaining (torch.Tensor): int64 ``[*]``, rows of the trajectory after the
            window.
        mixture (mapping of str to float): the weight of each strategy.

    Keyword Args:
        p (float): the parameter of ``geometric``, in (0, 1]. Defaults to 0.3.
        generator (torch.Generator, optional): source of randomness.

    Returns:
        torch.Tensor: int64 ``[*]``, between 0 and ``remaining``.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.window_goal import draw_goal_offset
        >>> draw_goal_offset(torch.tensor([4, 0]), {"last": 1.0})
        tensor([4, 0])
    """
    weights = {name: weight for name, weight in mixture.items() if weight > 0}
    shape, device = remaining.shape, remaining.device
    chance = None
    if set(weights) != {"last"}:
        chance = _rand(
            torch.rand, (2, *shape), device=device, generator=generator
        ).double()
    offset = remaining
    below, total = 0.0, sum(weights.values())
    for name, weight in weights.items():
        if name == "last" or chance is None:
            drawn = remaining
        elif name == "uniform":
            drawn = (chance[1] * (remaining + 1)).long()
        else:
            # Inverse of the distribution function, from u in [0, 1).
            drawn = _geometric(chance[1], p)
        drawn = torch.minimum(drawn, remaining)
        if chance is None or below == 0.0:
            offset = drawn
        else:
            offset = torch.where(chance[0] >= below / total, drawn, offset)
        below += weight
    return offset


def _geometric(u: torch.Tensor, p: float) -> torch.Tensor:
    if p >= 1.0:
        return torch.zeros_like(u, dtype=torch.int64)
    log = torch.log1p(torch.tensor(-p, dtype=torch.float64)).item()
    return (torch.log1p(-u) / log).long()


class WindowGoal(Transform, SampleUnit):
    """Gives each window a goal: the goal achieved in a later state of its trajectory.

    One object does two things in a replay buffer. As its ``sample_unit`` it sees the
    rows that were sampled and draws a goal for each window; as a transform it writes
    these goals into the batch, the same for all rows of a window. Append it before
    :class:`~torchrl_caiac.CAIACTransform`, which then swaps goals with entities.

    The goal is that of the *next* state of a row (the state reached), so the last
    state of a trajectory can be a goal. Goals are read from ``layout.achieved``
    columns of the next observation, or from the stored next achieved goal where the
    layout names no such columns; a nested layout reads its ``achieved`` leaves and
    writes its ``goal`` leaves.

    Trajectories shorter than ``window`` are never sampled by
    :class:`~torchrl.data.SliceSampler` with ``strict_length=True`` (its default),
    which raises when there is no longer one.

    Args:
        layout (EntityLayout): the entities and their goals.
        window (int): rows a window, κ; 1 for transitions.
        mixture (mapping of str to float, optional): the weights of the strategies
            ``"last"``, ``"uniform"`` and ``"geometric"``, see
            :func:`draw_goal_offset`. Defaults to half ``"last"``, half
            ``"geometric"``.
        p (float): the parameter of ``"geometric"``. Defaults to 0.3.
        trajectory_key (NestedKey): trajectory ids in the storage. Defaults to
            ``"episode"``; without such a leaf, trajectories end at ``done_key``.

    Keyword Args:
        done_key (NestedKey): end flags. Defaults to ``("next", "done")``.
        generator (torch.Generator, optional): source of randomness; the default
            generator of torch without it.
        counterfactual_key (NestedKey): the mark of the augmentation that must come
            later. Defaults to ``("caiac", "counterfactual")``.

    Raises:
        ValueError: an argument is out of range, or the layout has no goals.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer, SliceSampler
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms import WindowGoal
        >>> layout = EntityLayout(
        ...     {"cup": [0]}, goal={"cup": [0]}, achieved={"cup": [0]}
        ... )
        >>> goals = WindowGoal(layout, window=2, mixture={"last": 1.0})
        >>> rb = ReplayBuffer(
        ...     storage=LazyTensorStorage(8),
        ...     sampler=SliceSampler(slice_len=2, traj_key="episode"),
        ...     sample_unit=goals,
        ...     batch_size=4,
        ... )
        >>> rb.append_transform(goals)  # doctest: +ELLIPSIS
        ReplayBuffer(...)
        >>> state = torch.arange(8.0).unsqueeze(-1)
        >>> _ = rb.extend(TensorDict({
        ...     "observation": state, ("next", "observation"): state + 1,
        ...     "episode": torch.zeros(8, dtype=torch.int64)}, [8]))
        >>> rb.sample()["desired_goal"].flatten()
        tensor([8., 8., 8., 8.])
    """

    def __init__(
        self,
        layout: EntityLayout,
        window: int,
        mixture: Mapping[str, float] | None = None,
        p: float = 0.3,
        trajectory_key: NestedKey = "episode",
        *,
        done_key: NestedKey = ("next", "done"),
        generator: torch.Generator | None = None,
        counterfactual_key: NestedKey = ("caiac", "counterfactual"),
    ) -> None:
        super().__init__()
        if mixture is None:
            mixture = {"last": 0.5, "geometric": 0.5}
        if isinstance(window, bool) or not isinstance(window, int) or window < 1:
            raise ValueError(
                f"window is a number of rows of at least 1, got {window!r}"
            )
        unknown = [name for name in mixture if name not in _STRATEGIES]
        if unknown or not mixture:
            raise ValueError(
                f"mixture maps strategies among {list(_STRATEGIES)} to weights, got "
                f"{dict(mixture)}"
            )
        weights = list(mixture.values())
        if not all(0 <= w < float("inf") for w in weights) or sum(weights) <= 0:
            raise ValueError(
                "the weights of mixture are at least 0, finite, and not all 0; got "
                f"{dict(mixture)}"
            )
        if not 0 < p <= 1:
            raise ValueError(f"p, of the geometric strategy, lies in (0, 1], got {p!r}")
        if not any(layout.goal.values()):
            raise ValueError(
                "the layout has no goals: give EntityLayout(..., goal=..., "
                "achieved=...)"
            )
        if not layout.is_flat:
            blind = [
                name
                for name, key in layout.goal.items()
                if key is not None and layout.achieved.get(name) is None
            ]
            if blind:
                raise ValueError(
                    f"the layout does not say where the achieved goals of {blind} lie: "
                    "give EntityLayout.from_keys(..., achieved=...)"
                )
        self.layout = layout
        self.window = window
        self.mixture = dict(mixture)
        self.p = float(p)
        self.trajectory_key = unravel_key(trajectory_key)
        self.done_key = unravel_key(done_key)
        self.counterfactual_key = unravel_key(counterfactual_key)
        self.generator = generator
        self._reset_state()

    def _reset_state(self) -> None:
        self._pending = threading.local()
        self._cache = StorageCache(self._trajectories)

    def _trajectories(self, storage: TensorStorage) -> TrajectoryIndex:
        return trajectory_index(
            storage, trajectory_key=self.trajectory_key, done_key=self.done_key
        )

    def set_generator(self, generator: torch.Generator | None) -> None:
        """Sets the source of randomness.

        Args:
            generator (torch.Generator, optional): ``None`` for torch's default one.
        """
        self.generator = generator

    # --- drawing ---------------------------------------------------------------------

    def draw_rows(
        self,
        last: torch.Tensor,
        trajectories: TrajectoryIndex,
        *,
        generator: torch.Generator | None = None,
    ) -> torch.Tensor:
        """Draws the rows whose next states are goals.

        Args:
            last (torch.Tensor): int64 ``[*]``, the last row of each window.
            trajectories (TrajectoryIndex): the trajectories of the storage.

        Keyword Args:
            generator (torch.Generator, optional): source of randomness.

        Returns:
            torch.Tensor: int64 ``[*]``, rows of the same storage.
        """
        rows = last.to(trajectories.ends.device)
        offset = draw_goal_offset(
            trajectories.remaining(rows), self.mixture, p=self.p, generator=generator
        )
        return ((rows + offset) % trajectories.length).to(last.device)

    def expand(
        self,
        index: torch.Tensor | tuple[torch.Tensor, ...],
        info: dict[str, Any],
        storage: Any,
    ) -> tuple[torch.Tensor | tuple[torch.Tensor, ...], dict[str, Any]]:
        """Draws and reads a goal for each sampled window; the rows stay as they are.

        Args:
            index (torch.Tensor): the sampled rows ``[B * window]``, window by window.
            info (dict): the sampler's information, returned as it is.
            storage (TensorStorage): what is sampled.

        Returns:
            tuple: ``index`` and ``info``.

        Raises:
            ValueError: the rows do not make up windows within trajectories.
        """
        rows = index[0] if isinstance(index, tuple) else index
        data = _storage_td(storage, "the buffer")
        rows = rows.reshape(-1)
        if rows.shape[0] % self.window:
            raise ValueError(
                f"the sampler drew {rows.shape[0]} rows, which windows of "
                f"{self.window} do not divide: sample slices of this length, e.g. "
                f"SliceSampler(slice_len={self.window}), of a batch size that is a "
                "multiple of it"
            )
        trajectories = self._cache.get(storage)
        rows = rows.to(trajectories.ends.device)
        windows = rows.view(-1, self.window)
        last = windows[:, -1]
        remaining = trajectories.remaining(last)
        if self.window > 1:
            position = trajectories.position(windows)
            steps = torch.arange(self.window, device=rows.device)
            # Consecutive, and the first row's trajectory does not end before.
            broken = (position != position[:, :1] + steps).any() | (
                trajectories.remaining(windows[:, 0]) != remaining + self.window - 1
            ).any()
            if broken.item():
                raise ValueError(
                    f"the sampler drew windows of {self.window} rows that are not "
                    "consecutive rows of one trajectory: use SliceSampler with "
                    f"slice_len={self.window} and strict_length=True, and trajectories "
                    f"in {self.trajectory_key!r}"
                )
        offset = draw_goal_offset(
            remaining, self.mixture, p=self.p, generator=self.generator
        )
        goal_rows = (last + offset) % trajectories.length
        self._pending.goals = self.read_goals(data, goal_rows)
        return index, info

    # --- reading ---------------------------------------------------------------------

    def _flat_source(self, data: TensorDictBase) -> tuple[torch.Tensor, list[int]]:
        layout = self.layout
        if layout.achieved:
            key: NestedKey = layout.next(layout.observation_key)
            columns = goal_columns(layout)
        else:
            key = layout.next(layout.achieved_goal_key)
            columns = list(range(layout.goal_width))
        source = data.get(key, None)
        if source is None:
            raise KeyError(
                f"goals are read from {key!r}, which the data lacks: give the layout "
                "`achieved` columns, or store the achieved goals"
            )
        if source.shape[-1] <= max(columns):
            raise ValueError(
                f"{key!r} has {source.shape[-1]} columns, but the layout's goals need "
                f"at least {max(columns) + 1}: correct the layout, or the data"
            )
        return _plain(source), columns

    def read_goals(
        self, data: TensorDictBase, rows: torch.Tensor
    ) -> dict[NestedKey, torch.Tensor]:
        """Reads the goals that the next states of rows achieve.

        Args:
            data (TensorDictBase): what ``rows`` are rows of, ``[T]``.
            rows (torch.Tensor): int64 ``[M]``.

        Returns:
            dict: the goals ``[M, ...]`` by the desired-goal key they belong under.

        Raises:
            KeyError: the data lacks the leaf that goals are read from.
        """
        layout = self.layout
        if layout.is_flat:
            source, columns = self._flat_source(data)
            where = layout._index_tensor("goal", columns, source.device)
            goals = source[rows.to(source.device).unsqueeze(-1), where]
            return {layout.desired_goal_key: goals}
        found: dict[NestedKey, torch.Tensor] = {}
        for name, key in layout.goal.items():
            if key is not None:
                found[key] = self._nested_source(data, name)[rows]
        return found

    def _nested_source(self, data: TensorDictBase, name: str) -> Any:
        key = self.layout.next(self.layout.achieved[name])
        source = data.get(key, None)
        if source is None:
            raise KeyError(
                f"the goals of {name!r} are read from {key!r}, which the data lacks: "
                "correct `achieved` in EntityLayout.from_keys"
            )
        return _plain(source) if isinstance(source, torch.Tensor) else source

    def donor_goals(
        self,
        donors: TensorDictBase,
        rows: torch.Tensor,
        entity: int | torch.Tensor,
        key: NestedKey,
    ) -> torch.Tensor:
        """Reads the goals that entities take over from donor windows.

        Args:
            donors (TensorDictBase): the donors' data, ``[T]``.
            rows (torch.Tensor): int64 ``[C, N]``, the rows drawn for each entity.
            entity (int or torch.Tensor): the one entity, or the entity of each goal
                column, int64 ``[G]``.
            key (NestedKey): the desired goal's key.

        Returns:
            torch.Tensor: ``[C, G]``, or ``[C, ...]`` for one entity.
        """
        if isinstance(entity, torch.Tensor):
            source, columns = self._flat_source(donors)
            where = self.layout._index_tensor("goal", columns, source.device)
            return source[rows[:, entity].to(source.device), where]
        name = self.layout.names[entity]
        base = self.layout.goal[name]
        source = self._nested_source(donors, name)
        below = _below(key, base, self.layout.next(base))
        if below:
            source = _plain(source.get(below))
        return source[rows[:, entity].to(source.device)]

    # --- writing ---------------------------------------------------------------------

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the goals that were drawn for this batch.

        Args:
            tensordict (TensorDictBase): the batch ``[B * window]``.

        Returns:
            TensorDictBase: a shallow copy with desired goals, also under ``next``
            where the batch has them there.

        Raises:
            RuntimeError: no goals were drawn for this batch, or it was augmented
                already.
        """
        goals = self._pending.__dict__.pop("goals", None)
        if goals is None:
            raise RuntimeError(
                "no goals were drawn for this batch: pass the same WindowGoal as "
                "sample_unit=... of the replay buffer, and get data by rb.sample() "
                "(rb.storage[...] reads rows as they are stored)"
            )
        if tensordict.get(self.counterfactual_key, None) is not None:
            raise RuntimeError(
                "the batch holds counterfactuals already, whose goals would not follow "
                "the swap: append WindowGoal before the augmentation"
            )
        out = tensordict.copy()
        for key, goal in goals.items():
            if goal.shape[0] * self.window != out.shape[0]:
                raise RuntimeError(
                    f"goals were drawn for {goal.shape[0]} windows of {self.window} "
                    f"rows, but the batch has {out.shape[0]} rows: append WindowGoal "
                    "first, before transforms that change the batch size"
                )
            rows = goal.repeat_interleave(self.window, 0) if self.window > 1 else goal
            if out.device is not None:
                rows = rows.to(out.device)
            out.set(key, rows)
            after = self.layout.next(key)
            if out.get(after, None) is not None:
                out.set(after, rows)
        return out

    def extra_repr(self) -> str:
        """The arguments, for ``repr``."""
        return f"window={self.window}, mixture={self.mixture}, p={self.p}"

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.extra_repr()})"

    def clone(self) -> WindowGoal:
        """A copy with its own pending goals."""
        clone: WindowGoal = super().clone()
        clone._reset_state()
        return clone

    def __getstate__(self) -> dict[str, Any]:
        state: dict[str, Any] = super().__getstate__()
        del state["_pending"], state["_cache"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._reset_state()


def _below(key: NestedKey, *bases: NestedKey) -> tuple[str, ...]:
    path = (key,) if isinstance(key, str) else tuple(key)
    for base in bases:
        start = (base,) if isinstance(base, str) else tuple(base)
        if path[: len(start)] == start:
            return path[len(start) :]
    raise ValueError(f"{key!r} lies under none of {bases}")
