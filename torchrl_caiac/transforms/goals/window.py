"""Goals for windows: a later state of the window's own trajectory."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._batches import with_leaves
from torchrl_caiac._keys import join, path
from torchrl_caiac._sampling import window_goals
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.trajectories import TrajectoryIndex, flat_rows
from torchrl_caiac.transforms.checks import LateCheck, check_window
from torchrl_caiac.transforms.goals.future import FutureGoal
from torchrl_caiac.transforms.goals.offsets import (
    STRATEGIES,
    GoalNumbers,
    draw_goal_numbers,
    draw_goal_offset,
    goal_offset,
    strategy_bounds,
)
from torchrl_caiac.transforms.indexing import pick_places, pick_rows, plain_tensor
from torchrl_caiac.transforms.keys import TransformKeys

__all__ = ["WindowGoal"]


class WindowGoal(FutureGoal):
    """Sets the goal of each window to that achieved in a later state of its trajectory.

    Pass the same object to a replay buffer twice: as its ``sample_unit``, which
    receives the sampled rows and draws a goal for each window, and as a transform,
    which writes these goals into the batch, the same for all rows of a window. Append
    it before :class:`~torchrl_caiac.CAIACTransform`, which then swaps goals with
    entities.

    The goal is that of the *next* state of a row (the state that is reached), so the
    last state of a trajectory can be a goal. Goals are read from ``layout.achieved``
    columns of the next observation, or from the stored next achieved goal where the
    layout names no such columns; a nested layout reads its ``achieved`` leaves and
    writes its ``goal`` leaves.

    :class:`~torchrl.data.SliceSampler` with ``strict_length=True`` (its default) never
    samples trajectories shorter than ``window``, and raises if all are shorter.

    Args:
        layout (EntityLayout): the entities and their goals.
        window (int): rows in a window, κ; 1 for transitions.

    Keyword Args:
        mixture (mapping of str to float, optional): the weights of the strategies
            ``"last"``, ``"uniform"`` and ``"geometric"``, see
            :func:`~torchrl_caiac.transforms.goals.offsets.draw_goal_offset`.
            Defaults to half ``"last"``, half ``"geometric"``.
        p (float): the parameter of ``"geometric"``. Defaults to 0.3.
        generator (torch.Generator, optional): source of randomness. Defaults to
            torch's default generator.
        keys (TransformKeys, optional): trajectory ids, end flags, and the flag of the
            augmentation that must come later. Defaults to ``TransformKeys()``.

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
        *,
        mixture: Mapping[str, float] | None = None,
        p: float = 0.3,
        generator: torch.Generator | None = None,
        keys: TransformKeys | None = None,
    ) -> None:
        super().__init__(layout, p=p, generator=generator, keys=keys)
        if mixture is None:
            mixture = {"last": 0.5, "geometric": 0.5}
        self.window = check_window(window)
        strategy_bounds(mixture)  # or raises
        self.mixture = dict(mixture)
        self.out_keys = [*self.goal_keys, self.keys.goal_steps]

    def _reset_state(self) -> None:
        super()._reset_state()
        self._late = LateCheck()

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
        rows = last.to(trajectories.device)
        offset = draw_goal_offset(
            trajectories.remaining(rows), self.mixture, p=self.p, generator=generator
        )
        return trajectories.later(rows, offset).to(last.device)

    def expand(
        self,
        index: torch.Tensor | tuple[torch.Tensor, ...],
        info: dict[str, Any],
        storage: Any,
    ) -> tuple[torch.Tensor | tuple[torch.Tensor, ...], dict[str, Any]]:
        """Draws and reads a goal for each sampled window.

        Args:
            index (torch.Tensor or tuple of torch.Tensor): the sampled rows
                ``[B * window]``, window by window, or their coordinates.
            info (dict): the sampler's information, returned as it is.
            storage (TensorStorage): the sampled storage.

        Returns:
            tuple: ``index`` and ``info``.

        Raises:
            ValueError: the rows do not make up windows within trajectories. On a CUDA
                device it is raised at a later sample, so that none waits.
        """
        rows = flat_rows(index, storage)
        if rows.shape[0] % self.window:
            raise ValueError(
                f"the sampler drew {rows.shape[0]} rows, not a multiple of the window "
                f"{self.window}: sample slices of this length, e.g. "
                f"SliceSampler(slice_len={self.window}), and a batch size that is a "
                "multiple of it"
            )
        data, trajectories = self.stored(storage)
        rows = rows.to(trajectories.device)
        numbers = draw_goal_numbers(
            torch.Size([rows.shape[0] // self.window]),
            self.mixture,
            p=self.p,
            device=rows.device,
            generator=self.generator,
        )
        goals = self._read_at_once(data, trajectories, rows, numbers)
        if goals is None:
            goals = self._read(data, trajectories, rows, numbers)
        self.keep_goals(goals)
        self.keep_own(data, rows)
        return index, info

    def _read_at_once(
        self,
        data: TensorDictBase,
        trajectories: TrajectoryIndex,
        rows: torch.Tensor,
        numbers: GoalNumbers,
    ) -> dict[NestedKey, torch.Tensor] | None:
        """Reads goals by one function of C; ``None`` where it cannot."""
        if LateCheck.needed(rows.device):  # the function raises at once
            return None
        drawn = numbers.chance, numbers.share, numbers.steps
        given = [x for x in drawn if x is not None]
        source = self.source_in_c(data, trajectories, rows, *given)
        if source is None:
            return None
        bounds = [(STRATEGIES.index(name), least) for name, least in numbers.bounds]
        left, columns = trajectories.left, self.goal_columns
        found = window_goals(rows, self.window, left, bounds, drawn, source, columns)
        if found is None:
            return None
        return {self.layout.desired_goal_key: found[0], self.keys.goal_steps: found[1]}

    def _read(
        self,
        data: TensorDictBase,
        trajectories: TrajectoryIndex,
        rows: torch.Tensor,
        numbers: GoalNumbers,
    ) -> dict[NestedKey, torch.Tensor]:
        """Checks windows, and reads the goals of their rows, and the steps to them."""
        windows = rows.view(-1, self.window)
        first, last = windows[:, 0], windows[:, -1]
        remaining = trajectories.remaining(first) - (self.window - 1)
        if self.window > 1:
            self._check_windows(windows, remaining, trajectories)
        # Below zero only if an error is raised later.
        offset = goal_offset(remaining.clamp_min(0), numbers)
        goals = self.read_goals(data, trajectories.later(last, offset))
        steps = offset.unsqueeze(-1)
        if self.window > 1:
            ahead = torch.arange(self.window - 1, -1, -1, device=steps.device)
            steps = (steps + ahead).reshape(-1, 1)
            goals = {
                key: goal.repeat_interleave(self.window, 0)
                for key, goal in goals.items()
            }
        return {**goals, self.keys.goal_steps: steps}

    def _check_windows(
        self,
        windows: torch.Tensor,
        remaining: torch.Tensor,
        trajectories: TrajectoryIndex,
    ) -> None:
        """Raises if rows are not windows; on an accelerator, some samples later."""
        steps = torch.arange(self.window, device=windows.device)
        follow = trajectories.later(windows[:, :1], steps)
        broken = (windows != follow).any() | (remaining < 0).any()
        if LateCheck.needed(windows.device):
            found = bool(self._late.found())
            self._late.add(torch.where(broken, math.nan, 0.0).unsqueeze(0))
        else:
            found = bool(broken)
        if found:
            raise ValueError(
                f"the sampler drew windows of {self.window} rows that are not "
                "consecutive rows of one trajectory according to "
                f"{self.keys.trajectory!r} and {self.keys.done!r}: use SliceSampler "
                f"with slice_len={self.window} and strict_length=True. If end flags do "
                "not end a trajectory in these data, pass keys=TransformKeys(done=None)"
            )

    def donor_goals(
        self,
        donors: TensorDictBase,
        rows: torch.Tensor,
        owner: int | torch.Tensor,
        key: NestedKey,
    ) -> torch.Tensor:
        """Reads the goals that entities get from donor windows.

        Args:
            donors (TensorDictBase): the donors' data, ``[T]``.
            rows (torch.Tensor): int64 ``[C, N]``, the rows drawn for each entity.
            owner (int or torch.Tensor): the one entity, or the entity of each goal
                column, int64 ``[G]``.
            key (NestedKey): the desired goal's key.

        Returns:
            torch.Tensor: ``[C, G]``, or ``[C, ...]`` for one entity.
        """
        if isinstance(owner, torch.Tensor):
            rows = rows.gather(1, owner.to(rows.device).expand(rows.shape[0], -1))
            if not self.reads_by_layout:
                (goals,) = self.read_goals(donors, rows.flatten()).values()
                return goals.unflatten(0, rows.shape).diagonal(dim1=1, dim2=2)
            source = self.flat_source(donors)
            where = self.goal_index(source.device)
            places = rows.to(source.device) * source.shape[-1] + where
            return pick_places(source, places.flatten()).view(places.shape)
        name = self.layout.names[owner]
        base = self.layout.goal[name]
        below = _below(key, base, self.layout.next(base))
        rows = rows[:, owner]
        if not self.reads_by_layout:
            return self.read_goals(donors, rows)[join(base, *below)]
        source = self.nested_source(donors, name)
        if below:
            source = plain_tensor(source.get(below))
        return pick_rows(source, rows)

    # --- writing ---------------------------------------------------------------------

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the goals that were drawn for this batch.

        Args:
            tensordict (TensorDictBase): the batch ``[B * window]``.

        Returns:
            TensorDictBase: a shallow copy with desired goals, also under ``next``
            where the batch has them there, and the steps from each row to its goal.

        Raises:
            RuntimeError: no goals were drawn for this batch, or it was augmented
                already.
        """
        self.warn_if_forked()
        self.check_own(tensordict)
        goals = self.take_goals()
        if goals is None:
            raise self.no_goals()
        if tensordict.get(self.keys.counterfactual, None) is not None:
            raise RuntimeError(
                "the batch already contains counterfactuals, whose goals would not "
                "follow the swap: append WindowGoal before the augmentation"
            )
        leaves: dict[NestedKey, torch.Tensor] = {}
        for key, goal in goals.items():
            if goal.shape[0] != tensordict.shape[0]:
                raise RuntimeError(
                    f"goals were drawn for {goal.shape[0]} rows, but the batch has "
                    f"{tensordict.shape[0]}: append WindowGoal first, before "
                    "transforms that change the batch size"
                )
            device = tensordict.device
            leaves[key] = goal if device is None else goal.to(device)
            if key != self.keys.goal_steps:
                after = self.layout.next(key)
                if tensordict.get(after, None) is not None:
                    leaves[after] = leaves[key]
        return with_leaves(tensordict, leaves)

    def clone(self) -> WindowGoal:
        """Returns a copy with its own mixture."""
        clone: WindowGoal = super().clone()
        clone.mixture = dict(self.mixture)
        return clone

    def extra_repr(self) -> str:
        """Returns the arguments, for ``repr``."""
        return f"window={self.window}, mixture={self.mixture}, p={self.p}"


def _below(key: NestedKey, *bases: NestedKey) -> tuple[str, ...]:
    parts = path(key)
    for base in bases:
        start = path(base)
        if parts[: len(start)] == start:
            return parts[len(start) :]
    raise ValueError(f"{key!r} is below none of {bases}")
