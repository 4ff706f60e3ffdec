"""Hindsight goals for transitions: relabelling real and counterfactual ones (A.5.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._batches import with_leaves
from torchrl_caiac._keys import floating
from torchrl_caiac._random import draw_numbers
from torchrl_caiac._sampling import hindsight_sources, is_native, relabel_rows
from torchrl_caiac._torchrl import leaf_of
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.trajectories import flat_rows
from torchrl_caiac.transforms.checks import LateCheck, check_number
from torchrl_caiac.transforms.goals.future import FutureGoal
from torchrl_caiac.transforms.goals.offsets import draw_goal_offset, draw_steps
from torchrl_caiac.transforms.goals.repeated_relabel import RepeatedRelabel, unexplained
from torchrl_caiac.transforms.indexing import window_starts
from torchrl_caiac.transforms.keys import TransformKeys
from torchrl_caiac.transforms.rewards import (
    GoalLeaves,
    RewardFn,
    TerminatedFn,
    alike,
    holds,
    stored_reward,
)

__all__ = ["HindsightDraw", "HindsightGoal"]

Goals = dict[NestedKey, torch.Tensor]


class HindsightDraw(NamedTuple):
    """The draw for one batch of ``B`` rows: the source of each desired goal.

    Attributes:
        source (torch.Tensor): int64 ``[B]``. Below ``B``: the row's own desired goal;
            ``B + i``: the next achieved goal of row ``i`` of the batch; ``2 B + i``:
            the future goal of row ``i``.
        future (dict, optional): the future goals ``[B, ...]`` by desired-goal leaf.
    """

    source: torch.Tensor
    future: Mapping[NestedKey, torch.Tensor] | None = None


class HindsightGoal(FutureGoal):
    """Relabels the goals of transitions, real and counterfactual ones (A.5.2).

    Real transitions get, with probability ``future``, a goal that was achieved later
    in their own trajectory and, with probability ``random``, the goal that a random
    real transition of the batch achieves. Counterfactual transitions get, with
    probability ``counterfactual``, the goal that a random counterfactual transition of
    the batch achieves after swapping. All others keep their desired goals. "Achieves"
    means the next state: goals are read as by
    :class:`~torchrl_caiac.transforms.WindowGoal`, so that a transition whose goal is
    its own next achieved goal is a success.

    The rewards of relabelled and of counterfactual transitions are recomputed by
    ``reward_fn`` from the *next* achieved goal, so
    :class:`~torchrl_caiac.CAIACTransform` needs no ``reward_fn`` of its own. So are
    their end flags if there is a ``terminated_fn``, for tasks that end at their goal.
    Without it they stay as they were stored, and a warning says so once if some of them
    end the task.

    Append it after the augmentation; in the other order the augmentation raises.

    If ``future`` is not 0, pass the same object to the buffer as ``sample_unit``, so
    that it receives the sampled rows and draws goals from the storage. If it is 0, all
    goals come from the batch, and a :class:`~torchrl.data.HERReplayBuffer` can relabel
    the real transitions, see :meth:`her_reward`.

    The paper's methods, with half of each batch counterfactual:

    ==================  ==========================================================
    ``caiac``           ``CAIACTransform(layout)``, ``HindsightGoal(layout, r)``
    ``relabel_only``    ``CAIACTransform(layout, swap_prob=0.0)``,
                        ``HindsightGoal(layout, r)``: the same transitions are
                        relabelled as counterfactuals, nothing is swapped
    ``none``            ``HindsightGoal(layout, r, random=0.25)`` alone: the share of
                        random goals that the other methods have
    ==================  ==========================================================

    Args:
        layout (EntityLayout): the entities and their goals.
        reward_fn (callable): ``(next_achieved [B, G], desired [B, G])`` to rewards
            ``[B]`` or ``[B, 1]``, with tensors. Or the form of Gymnasium,
            ``compute_reward(achieved_goal, desired_goal, info)``, such as
            ``env.unwrapped.compute_reward``, with NumPy arrays and an empty ``info``;
            goals on a CUDA device are copied to the host for it, which waits for them.
            In both forms a further parameter named ``action`` gets the actions
            ``[B, K]``. Goals that are stored as integers are passed in floating point;
            a nested layout's goals are concatenated, flattened, in layout order.
            Rewards keep the stored dtype if it holds what the function returns, else
            (integers, and a function with fractions) all rewards of the batch are in
            torch's default dtype.

    Keyword Args:
        terminated_fn (callable, optional): the same forms, to bool ``[B]`` or
            ``[B, 1]``: whether the task ends at this transition. It sets
            ``keys.terminated`` of relabelled and counterfactual transitions, and their
            ``keys.done`` (unless it is ``None``) to terminated or truncated. Defaults
            to ``None``: end flags are kept.
        future (float): share of real transitions with a goal of their future. Defaults
            to 0.5.
        random (float): share of real transitions with a goal of another one; the sum of
            ``future`` and ``random`` is at most 1. Defaults to 0.
        counterfactual (float): share of counterfactual transitions with a goal of
            counterfactual ones. Defaults to 0.5.
        strategy (str): how future goals are drawn. ``"geometric"``: the state
            ``k >= 1`` steps after the transition's own with probability
            ``p * (1 - p) ** (k - 1)``, or the trajectory's last one; ``"uniform"``: any
            later state. Defaults to ``"geometric"``.
        p (float): the parameter of ``"geometric"``. Defaults to 0.2.
        generator (torch.Generator, optional): source of randomness. Defaults to
            torch's default generator. The same state gives the same batch.
        keys (TransformKeys, optional): rewards, actions, trajectory ids, end flags,
            the flag of counterfactuals that is read and the flag ``relabeled``, bool
            ``[B, 1]``, that is written. Defaults to ``TransformKeys()``.

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: an argument is out of range, the layout has no goals, or a function
            has other parameters.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms import HindsightGoal
        >>> layout = EntityLayout(
        ...     {"cup": [0]}, goal={"cup": [0]}, achieved={"cup": [0]}
        ... )
        >>> def reward(achieved, desired):
        ...     return -(achieved != desired).any(-1).float()
        >>> goals = HindsightGoal(layout, reward, future=1.0, p=1.0)  # the next state
        >>> rb = ReplayBuffer(
        ...     storage=LazyTensorStorage(8), sample_unit=goals, batch_size=3
        ... )
        >>> rb.append_transform(goals)  # doctest: +ELLIPSIS
        ReplayBuffer(...)
        >>> state = torch.arange(8.0).unsqueeze(-1)
        >>> _ = rb.extend(TensorDict({
        ...     "observation": state, "desired_goal": -torch.ones(8, 1),
        ...     "episode": torch.zeros(8, dtype=torch.int64),
        ...     "next": {"observation": state + 1, "reward": -torch.ones(8, 1)}}, [8]))
        >>> batch = rb.sample()
        >>> (batch["desired_goal"] - batch["observation"]).flatten()
        tensor([1., 1., 1.])
        >>> batch["next", "reward"].flatten()
        tensor([-0., -0., -0.])
    """

    # Relabels batches like the last one, if it can.
    _repeated: RepeatedRelabel | None

    def __init__(
        self,
        layout: EntityLayout,
        reward_fn: RewardFn,
        *,
        terminated_fn: TerminatedFn | None = None,
        future: float = 0.5,
        random: float = 0.0,
        counterfactual: float = 0.5,
        strategy: Literal["geometric", "uniform"] = "geometric",
        p: float = 0.2,
        generator: torch.Generator | None = None,
        keys: TransformKeys | None = None,
    ) -> None:
        super().__init__(layout, p=p, generator=generator, keys=keys)
        if strategy not in ("geometric", "uniform"):
            raise ValueError(
                f"strategy must be 'geometric' or 'uniform', got {strategy!r}"
            )
        if reward_fn is None:
            raise TypeError("reward_fn must be a function of goals, got None")
        self._goal_leaves = GoalLeaves(reward_fn, terminated_fn, keys=self.keys)
        self.future = check_number("future", future, 1.0)
        self.random = check_number("random", random, 1.0)
        self.counterfactual = check_number("counterfactual", counterfactual, 1.0)
        if self.future + self.random > 1.0:
            raise ValueError(
                "future and random are shares of the real rows, with a sum of at most "
                f"1; got {future!r} and {random!r}"
            )
        self.strategy = strategy
        self.in_keys = [
            *self.achieved_keys,
            *self.goal_keys,
            *self._goal_leaves.in_keys,
            self.keys.counterfactual,
        ]
        self.out_keys = [
            *self.goal_keys,
            *self._goal_leaves.out_keys,
            self.keys.relabeled,
        ]
        if self.keys.unexplained is not None:
            self.out_keys.append(self.keys.unexplained)

    @property
    def reward_fn(self) -> RewardFn | None:
        """The function that recomputes rewards."""
        return self._goal_leaves.reward_fn

    @property
    def terminated_fn(self) -> TerminatedFn | None:
        """The function that recomputes end flags."""
        return self._goal_leaves.terminated_fn

    # --- drawing ---------------------------------------------------------------------

    def expand(
        self,
        index: torch.Tensor | tuple[torch.Tensor, ...],
        info: dict[str, Any],
        storage: Any,
    ) -> tuple[torch.Tensor | tuple[torch.Tensor, ...], dict[str, Any]]:
        """Draws and reads a future goal for each sampled row.

        Args:
            index (torch.Tensor or tuple of torch.Tensor): the sampled rows ``[B]``, or
                their coordinates.
            info (dict): the sampler's information, returned as it is.
            storage (TensorStorage): the sampled storage.

        Returns:
            tuple: ``index`` and ``info``.
        """
        if self.future > 0:
            data, trajectories = self.stored(storage)
            rows = flat_rows(index, storage).to(trajectories.device)
            generator = self.generator
            if self.strategy == "geometric":
                steps = draw_steps(rows.shape, self.p, rows.device, generator)
                goals = self.read_goals_ahead(data, trajectories, rows, steps)
            else:
                steps = draw_goal_offset(
                    trajectories.remaining(rows), {"uniform": 1.0}, generator=generator
                )
                goals = self.read_goals(data, trajectories.later(rows, steps))
            self.keep_goals(goals)
            self.keep_own(data, rows)
        return index, info

    def generate_parameters(
        self,
        counterfactual: torch.Tensor,
        future: Mapping[NestedKey, torch.Tensor] | None = None,
        generator: torch.Generator | None = None,
    ) -> HindsightDraw:
        """Draws which rows are relabelled, and the sources of their goals.

        Args:
            counterfactual (torch.Tensor): bool ``[B, 1]``, the augmentation's flag.
            future (mapping, optional): future goals ``[B, ...]`` by desired-goal leaf;
                needed where :attr:`future` is not 0.
            generator (torch.Generator, optional): source of randomness; the
                transform's own by default.

        Returns:
            HindsightDraw: the draw.
        """
        if self.future > 0 and future is None:
            raise ValueError(
                f"a share of {self.future} of the real transitions needs future goals, "
                "and none are given"
            )
        generator = self.generator if generator is None else generator
        flags = counterfactual.reshape(-1)
        rows, device = flags.shape[0], flags.device
        chance, pick = draw_numbers(
            torch.rand,
            (2, rows),
            device=device,
            generator=generator,
            dtype=torch.float64,
        )
        shares = self.future, self.random, self.counterfactual
        if flags.dtype is torch.bool and is_native(flags, chance, pick):
            return HindsightDraw(
                hindsight_sources(flags, chance, pick, *shares), future
            )
        own = window_starts(rows, 1, device)
        # Counterfactual rows first: each kind draws among its own places.
        order = torch.argsort(flags.byte(), stable=True, descending=True)
        size, first = flags.sum(), None
        if self.random > 0:
            first = torch.where(flags, 0, size)
            size = torch.where(flags, size, rows - size)
        place = (pick * size).long()
        goal = order.index_select(0, place if first is None else place + first) + rows
        if self.future > 0:
            is_future = chance < self.future
            later = own + 2 * rows
            if self.random > 0:
                later = torch.where(is_future, later, goal)
            goal = torch.where(flags, goal, later)
        is_new = chance < self.future + self.random
        if self.counterfactual != self.future + self.random:
            is_new = torch.where(flags, chance < self.counterfactual, is_new)
        return HindsightDraw(torch.where(is_new, goal, own), future)

    # --- applying --------------------------------------------------------------------

    def _desired(
        self, td: TensorDictBase, key: NestedKey, achieved: torch.Tensor
    ) -> torch.Tensor:
        desired = leaf_of(td, key)
        if desired is None:
            raise KeyError(
                f"the batch has no desired goals in {key!r}: store them, or correct "
                "the layout's desired-goal key"
            )
        if desired.shape != achieved.shape:
            raise ValueError(
                f"{key!r} has shape {list(desired.shape)}, but the goals that are "
                f"achieved have {list(achieved.shape)}: correct the layout's goals, or "
                "the data"
            )
        return desired

    def _relabel(self, td: TensorDictBase, draw: HindsightDraw) -> Goals:
        """Returns the leaves that a draw changes or adds."""
        flags = leaf_of(td, self.keys.counterfactual)
        found = None
        if self.layout.is_flat and self.reads_by_layout:
            found = self._relabel_vectors(td, draw)
        goals: Goals = {}
        if found is None:
            goals, reached, relabeled = self._relabel_leaves(td, draw)
            desired = _vector(goals)
        else:
            desired, reached, relabeled = found
            goals[self.layout.desired_goal_key] = desired
        is_new = relabeled if flags is None else relabeled | flags
        leaves = self._goal_leaves(td, reached, desired, where=is_new.reshape(-1))
        if self.keys.unexplained is not None:
            leaves[self.keys.unexplained] = unexplained(draw.source)
        after = {self.layout.next(key): goal for key, goal in goals.items()}
        return {
            **goals,
            **{k: goal for k, goal in after.items() if leaf_of(td, k) is not None},
            **leaves,
            self.keys.relabeled: relabeled,
        }

    def _relabel_vectors(
        self, td: TensorDictBase, draw: HindsightDraw
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None:
        """Returns goals, achieved goals and which are new, in C or CUDA.

        ``None`` if these data need torch.
        """
        key = self.layout.desired_goal_key
        values = self.flat_source(td)
        desired = leaf_of(td, key)
        future = None if draw.future is None else draw.future[key]
        columns = self.goal_columns
        goals = [x for x in (desired, future) if x is not None]
        wanted = len(values), len(columns)
        if (
            desired is None
            or draw.source.dtype is not torch.int64
            or draw.source.shape != values.shape[:1]
            or any((x.shape, x.dtype) != (wanted, values.dtype) for x in goals)
            or not is_native(draw.source, values, *goals)
        ):
            return None
        return relabel_rows(desired, values, columns, future, draw.source)

    def _relabel_leaves(
        self, td: TensorDictBase, draw: HindsightDraw
    ) -> tuple[Goals, torch.Tensor, torch.Tensor]:
        """Returns goals, achieved goals and which are new."""
        relabeled = (draw.source >= td.shape[0]).unsqueeze(-1)
        goals: Goals = {}
        achieved: Goals = {}
        for key, reached in self.read_goals(td).items():
            desired = self._desired(td, key, reached)
            # Stored integers must not cut the goals that are reached.
            if not holds(desired.dtype, reached.dtype):
                desired = floating(desired).to(floating(reached).dtype)
            # Rewards compare numbers that are rounded alike.
            achieved[key] = reached.to(desired)
            parts = [desired, achieved[key]]
            if draw.future is not None:
                parts.append(draw.future[key].to(desired))
            goals[key] = torch.cat(parts).index_select(0, draw.source)
        return goals, _vector(achieved), relabeled

    def apply_parameters(
        self, tensordict: TensorDictBase, draw: HindsightDraw
    ) -> TensorDictBase:
        """Applies a draw: the same draw gives the same batch.

        Args:
            tensordict (TensorDictBase): the batch ``[B]``; it is not changed.
            draw (HindsightDraw): from :meth:`generate_parameters`.

        Returns:
            TensorDictBase: a shallow copy with goals, also under ``next`` where the
            batch has them there, rewards and the flag of relabelled ones.

        Raises:
            KeyError: goals or rewards are missing.
            ValueError: goals or rewards have the wrong shape.
        """
        return with_leaves(tensordict, self._relabel(tensordict, draw))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relabels a batch.

        Args:
            tensordict (TensorDictBase): the batch ``[*B]``.

        Returns:
            TensorDictBase: a shallow copy with new leaves; the input is not changed.

        Raises:
            RuntimeError: no future goals were drawn for this batch, or it was
                relabelled already.
            KeyError: goals or rewards are missing.
            ValueError: goals or rewards have the wrong shape.
        """
        self.warn_if_forked()
        self.check_own(tensordict)
        goals = self.take_goals()
        repeated = self._repeated  # which another thread may replace
        if repeated is not None and repeated.keys == self.keys:
            shares = self.future, self.random, self.counterfactual
            done = repeated(
                tensordict, goals, shares, self._goal_leaves, self.generator
            )
            if done is not None:
                return done
        shape = tensordict.batch_size
        if len(shape) != 1:
            tensordict = tensordict.reshape(-1)
        rows = tensordict.shape[0]
        if self.future > 0:
            if goals is None:
                raise self.no_goals(
                    "; or give future=0, where goals of the batch are enough"
                )
            for goal in goals.values():
                if goal.shape[0] != rows:
                    raise RuntimeError(
                        f"future goals were drawn for {goal.shape[0]} rows, but the "
                        f"batch has {rows}: append HindsightGoal before transforms "
                        "that change the batch size"
                    )
        if leaf_of(tensordict, self.keys.relabeled) is not None:
            raise RuntimeError(
                f"the batch is already relabelled, see {self.keys.relabeled!r}: "
                "append one HindsightGoal only"
            )
        flags = leaf_of(tensordict, self.keys.counterfactual)
        if flags is not None and flags.shape != (rows, 1):
            raise ValueError(
                f"{self.keys.counterfactual!r} has shape {list(flags.shape)}, expected "
                f"[{rows}, 1]"
            )
        if flags is None:
            device = stored_reward(tensordict, self.keys.reward).device
            flags = torch.zeros(rows, 1, dtype=torch.bool, device=device)
        draw = self.generate_parameters(flags, goals)
        out = self.apply_parameters(tensordict, draw)
        self._repeated = self._repeated_from(tensordict)
        return out if len(shape) == 1 else out.reshape(shape)

    def _reset_state(self) -> None:
        super()._reset_state()
        self._repeated = None

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_repeated": None}

    def _repeated_from(self, td: TensorDictBase) -> RepeatedRelabel | None:
        """Returns what relabels batches like this one, if it can."""
        own, base = type(self), HindsightGoal
        if (
            not (self.layout.is_flat and self.reads_by_layout)
            or own.generate_parameters is not base.generate_parameters
            or own.apply_parameters is not base.apply_parameters
        ):
            return None
        key, columns = self.achieved_keys[0], self.goal_columns
        try:
            return RepeatedRelabel(td, self.layout, key, columns, self.keys)
        except TypeError:
            return None

    def her_reward(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Computes the rewards for a :class:`~torchrl.data.HERReplayBuffer`.

        That buffer relabels the *first* ``int(her_ratio * B)`` rows of a batch after
        all transforms, from a uniformly drawn later row of the trajectory. With
        ``her_ratio`` at most ``1 - counterfactual_ratio`` these are real rows, and a
        ``HindsightGoal`` with ``future=0`` relabels the counterfactual ones after them.
        The flag ``keys.relabeled`` is set for both, and so are end flags if there is a
        ``terminated_fn``. Append the augmentation with ``rows="last"``. That buffer
        identifies trajectories by their end flags only, and in TorchRL 0.14 it must not
        be written to once it is full.

        Args:
            tensordict (TensorDictBase): the rows that the buffer relabelled.

        Returns:
            torch.Tensor: their rewards, shape and dtype as stored.

        Raises:
            ValueError: there are counterfactual rows among them.

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from torchrl.data import HERReplayBuffer, LazyTensorStorage
            >>> from torchrl_caiac import CAIACTransform, EntityLayout
            >>> from torchrl_caiac.transforms import HindsightGoal
            >>> layout = EntityLayout(
            ...     {"cup": [0], "box": [1]}, goal={"cup": [0], "box": [1]}
            ... )
            >>> def reward(achieved, desired):
            ...     return -(achieved != desired).any(-1).float()
            >>> goals = HindsightGoal(layout, reward, future=0.0)
            >>> rb = HERReplayBuffer(
            ...     goals.her_reward, her_ratio=0.25, batch_size=8,
            ...     achieved_goal_key=("next", "achieved_goal"),
            ...     storage=LazyTensorStorage(20),
            ... )
            >>> state, end = torch.rand(20, 2), torch.zeros(20, 1, dtype=torch.bool)
            >>> _ = rb.extend(TensorDict({
            ...     "observation": state, "achieved_goal": state,
            ...     "desired_goal": torch.zeros(20, 2),
            ...     "next": {"observation": state, "achieved_goal": state,
            ...         "reward": -torch.ones(20, 1), "done": end},
            ...     ("caiac", "score"): torch.zeros(20, 2)}, [20]))
            >>> _ = rb.append_transform(CAIACTransform(layout, rows="last"))
            >>> _ = rb.append_transform(goals)
            >>> rb.sample()["hindsight", "relabeled"][:4].flatten()
            tensor([ True,  True, False, False])
        """
        flags = tensordict.get(self.keys.counterfactual, None)
        # On an accelerator the augmentation alone refuses the buffer, without waiting.
        reads = flags is not None and not LateCheck.needed(flags.device)
        if flags is not None and reads and bool(flags.any()):
            raise ValueError(
                f"HERReplayBuffer relabels the first {tensordict.shape[0]} rows of the "
                f"batch, {int(flags.sum())} of which are counterfactual and have no "
                "future of their own: give it a her_ratio of at most "
                "1 - counterfactual_ratio"
            )
        achieved = self.read_goals(tensordict)
        desired = {
            key: self._desired(tensordict, key, goal) for key, goal in achieved.items()
        }
        relabeled = tensordict.get(self.keys.relabeled, None)
        if relabeled is not None:
            relabeled.fill_(True)  # a view of the batch's flag, like all of these rows
        stored = stored_reward(tensordict, self.keys.reward)
        goals = alike(_vector(achieved), _vector(desired))
        leaves = self._goal_leaves(tensordict, *goals)
        reward = leaves.pop(self.keys.reward)
        for key, flags in leaves.items():
            tensordict.get(key).copy_(flags)  # views as well
        if reward.dtype != stored.dtype:
            raise ValueError(
                f"{self.keys.reward!r} is stored as {stored.dtype}, in which "
                f"HERReplayBuffer would cut rewards of {reward.dtype}: store rewards "
                "in floating point"
            )
        return reward

    def extra_repr(self) -> str:
        """Returns the arguments, for ``repr``."""
        return (
            f"future={self.future}, random={self.random}, "
            f"counterfactual={self.counterfactual}, strategy={self.strategy!r}, "
            f"p={self.p}"
        )


def _vector(goals: Goals) -> torch.Tensor:
    leaves = list(goals.values())
    if len(leaves) == 1 and leaves[0].ndim == 2:
        return leaves[0]
    return torch.cat([leaf.reshape(len(leaf), -1) for leaf in leaves], -1)
