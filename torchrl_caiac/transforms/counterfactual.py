"""The base class of augmentations: from scores to counterfactual transitions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, Literal, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import (
    HERReplayBuffer,
    ReplayBuffer,
    ReplayBufferEnsemble,
    TensorStorage,
)

from torchrl_caiac._buffer_transform import RandomTransform
from torchrl_caiac._fingerprints import fingerprint_key
from torchrl_caiac._keys import as_key
from torchrl_caiac._torchrl import leaf_of, sampling_buffer
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms.batch_check import BatchCheck, CheckedScores
from torchrl_caiac.transforms.checks import (
    check_batch_shape,
    check_choice,
    check_generator,
    check_layout,
    check_number,
    check_relabeled_rows,
    check_window,
    check_windows,
)
from torchrl_caiac.transforms.donors import BufferDonors, unchanged_donors
from torchrl_caiac.transforms.draws import SwapDraw, draw_batch_donors, draw_windows
from torchrl_caiac.transforms.free_share import FreeShare
from torchrl_caiac.transforms.goals.window import WindowGoal
from torchrl_caiac.transforms.keys import TransformKeys
from torchrl_caiac.transforms.lookahead import (
    Lookahead,
    LookaheadArgument,
    check_lookahead,
    hold_entities,
)
from torchrl_caiac.transforms.repeated_swap import RepeatedSwap, SwapSettings
from torchrl_caiac.transforms.rewards import (
    GoalLeaves,
    RewardFn,
    TerminatedFn,
    goal_vectors,
)
from torchrl_caiac.transforms.swap import SwapPlan, SwapPlanner, apply_swap
from torchrl_caiac.transforms.thresholds import EntityThresholds, ThresholdArgument

__all__ = ["CounterfactualTransform"]

_Transform = TypeVar("_Transform", bound="CounterfactualTransform")


class CounterfactualTransform(RandomTransform, ABC):
    """Makes rows of a batch counterfactual, by their scores.

    A subclass defines what may be swapped (:meth:`swappable`) and how donors are drawn
    (:attr:`draw_in_batch`; :attr:`donors_class` for a donor buffer). The steps of a
    sample are: scores, check, draw, swap, rewards. See
    :class:`~torchrl_caiac.transforms.CAIACTransform` for the leaves that are added.

    Args:
        layout (EntityLayout): the entities; ``fixed`` ones are never swapped.
        threshold (float, mapping of str to float or str): scores above it count as
            influence, θ: for all entities, for each, or ``"auto"``.
        counterfactual_ratio (float): share of rows (or windows) that become
            counterfactual.

    Keyword Args:
        rows (str): which rows (or windows) become counterfactual: ``"random"`` or
            ``"last"``.
        swap_prob (float): probability of swapping what may be swapped.
        window (int): rows in a window, κ.
        lookahead (int or str, optional): how far ahead influence counts: steps,
            ``"next"`` or ``"goal"``.
        donors (ReplayBuffer or TensorStorage, optional): where donors are drawn from.
        score_key (NestedKey): the scores.
        unscored (str): what happens to rows without valid scores: ``"raise"`` or
            ``"keep"``.
        reward_fn (callable, optional): recomputes rewards of counterfactual rows.
        terminated_fn (callable, optional): recomputes their end flags.
        goals (WindowGoal, optional): draws the goals of donor windows.
        generator (torch.Generator, optional): source of randomness.
        keys (TransformKeys, optional): the other keys.
        check (bool): check the values of each batch.
    """

    #: Draws among the windows of the batch, from what :meth:`swappable` returned.
    draw_in_batch: ClassVar[Callable[..., SwapDraw]]
    donors_class: ClassVar[type[BufferDonors]] = BufferDonors
    _expected: ClassVar[str] = "one score for each of"

    def __init__(
        self,
        layout: EntityLayout,
        threshold: ThresholdArgument,
        counterfactual_ratio: float,
        *,
        rows: Literal["random", "last"],
        swap_prob: float,
        window: int,
        lookahead: LookaheadArgument = None,
        donors: ReplayBuffer | TensorStorage | None,
        score_key: NestedKey,
        unscored: Literal["raise", "keep"],
        reward_fn: RewardFn | None,
        terminated_fn: TerminatedFn | None = None,
        goals: WindowGoal | None,
        generator: torch.Generator | None,
        keys: TransformKeys | None,
        check: bool,
    ) -> None:
        super().__init__(check_generator(generator))
        self.layout = check_layout(layout)
        self._thresholds = EntityThresholds(layout, threshold)
        self.counterfactual_ratio = check_number(
            "counterfactual_ratio", counterfactual_ratio, 1.0
        )
        self.chosen_rows: Literal["random", "last"] = check_choice(
            "rows", rows, ("random", "last")
        )
        self.unscored: Literal["raise", "keep"] = check_choice(
            "unscored", unscored, ("raise", "keep")
        )
        self.swap_prob = check_number("swap_prob", swap_prob, 1.0)
        self.window = check_window(window)
        self.score_key = as_key(score_key)
        self.keys = keys or TransformKeys()
        self.check = bool(check)
        self._goal_leaves = GoalLeaves(
            reward_fn, terminated_fn, keys=self.keys, check=self.check
        )
        if goals is not None:
            self._check_goals(goals, donors)
        self.lookahead = check_lookahead(lookahead)
        self._lookahead: Lookahead | None = None
        if self.lookahead == "goal" and donors is not None:
            raise ValueError(
                "lookahead='goal' compares influence with the goals that rows of the "
                "batch have, but donors is a buffer, whose rows have none: leave out "
                "donors, to draw them from the batch, or use lookahead='next'"
            )
        if self.lookahead is not None:
            self._lookahead = Lookahead(
                self.lookahead,
                layout,
                score_key=self.score_key,
                keys=self.keys,
                free=self._free_rows,
                competing=self._competing,
            )
        # In a tuple, so that torch does not register the goals as a submodule.
        self._donors: tuple[BufferDonors, ...] = ()
        if donors is not None:
            self._donors = (
                self.donors_class(
                    donors,
                    layout,
                    thresholds=self._thresholds,
                    window=window,
                    score_key=self.score_key,
                    keys=self.keys,
                    goals=goals,
                    lookahead=self._lookahead,
                ),
            )
        self._planner = SwapPlanner(layout)
        self._batch_check = BatchCheck(
            layout,
            score_key=self.score_key,
            window=window,
            keys=self.keys,
            scores_name=self.donors_class.scores_name,
            unscored=self.unscored,
        )
        self._free_share = FreeShare(layout)
        self._repeated: RepeatedSwap | None = None
        self._no_donor = torch.zeros(len(layout), dtype=torch.int64)
        self._unscored = torch.zeros((), dtype=torch.int64)
        swapped = self._planner.keys
        self.in_keys = [
            *swapped,
            self.score_key,
            fingerprint_key(self.score_key),
            *self._goal_leaves.in_keys,
        ]
        self.out_keys = [
            *swapped,
            *self._goal_leaves.out_keys,
            self.keys.counterfactual,
            self.keys.swapped,
        ]

    def _check_goals(
        self, goals: Any, donors: ReplayBuffer | TensorStorage | None
    ) -> None:
        if not isinstance(goals, WindowGoal):
            raise TypeError(f"goals must be a WindowGoal, got {type(goals).__name__}")
        if donors is None:
            raise ValueError(
                "goals draws the goals of donor windows of a donor buffer, and there "
                "is none: donors in the batch keep their own goals"
            )
        if goals.window != self.window or goals.layout != self.layout:
            raise ValueError(
                f"goals has window {goals.window} and entities "
                f"{list(goals.layout.names)}, the transform window {self.window} and "
                f"{list(self.layout.names)}: give WindowGoal its window and its layout"
            )

    # --- defined by subclasses -------------------------------------------------------

    @property
    def feature_shape(self) -> tuple[int, ...]:
        """The shape of one row's scores, ``(N,)``."""
        return (len(self.layout),)

    @abstractmethod
    def swappable(self, scores: torch.Tensor) -> torch.Tensor:
        """Returns what may be swapped in each window.

        Args:
            scores (torch.Tensor): ``[B * window, *feature_shape]``.

        Returns:
            torch.Tensor: ``[B, N]``, zero for entities that may not be swapped.
        """

    def _free_rows(self, scores: torch.Tensor) -> torch.Tensor:
        """Returns what may be swapped in single rows ``[n]``, bool ``[n, N]``."""
        return self.swappable(scores.repeat_interleave(self.window, 0)) != 0

    def _competing(self) -> torch.Tensor:
        """Returns the entities that lookahead may lock, bool ``[N]``."""
        known = self._thresholds.numbers
        never = -1.0
        return torch.tensor([known.get(x, never) >= 0 for x in self.layout.names])

    # --- settings and state ----------------------------------------------------------

    @property
    def threshold(self) -> float | dict[str, float] | Literal["auto"]:
        """The threshold as it was given."""
        return self._thresholds.given

    @property
    def thresholds(self) -> dict[str, float]:
        """The threshold of each entity that is not fixed.

        Empty with ``threshold="auto"`` before the first sample. Below 0, an entity is
        never swapped.
        """
        return self._thresholds.numbers

    @property
    def reward_fn(self) -> RewardFn | None:
        """The function that recomputes rewards."""
        return self._goal_leaves.reward_fn

    @property
    def terminated_fn(self) -> TerminatedFn | None:
        """The function that recomputes end flags."""
        return self._goal_leaves.terminated_fn

    @property
    def donors(self) -> ReplayBuffer | TensorStorage | None:
        """The buffer that donors are drawn from; ``None`` for the batch."""
        return self._donors[0].donors if self._donors else None

    @property
    def no_donor_count(self) -> torch.Tensor:
        """The number of times that each entity had no donor.

        int64 ``[N]``, windows in which it was to be swapped, since the transform was
        created or :meth:`reset_no_donor_count` was called.
        """
        return self._no_donor.clone()

    def reset_no_donor_count(self) -> None:
        """Sets :attr:`no_donor_count` to zero."""
        self._no_donor.zero_()

    @property
    def unscored_count(self) -> int:
        """The number of sampled rows without valid scores, with ``unscored="keep"``."""
        return int(self._unscored)

    def refresh_donors(self) -> None:
        """Drops the index of eligible donors, so that it is built again.

        So is the table of ``lookahead``. Both are rebuilt after every write through the
        buffer or its storage; call this after writing to the storage's raw tensors.
        """
        for donors in self._donors:
            donors.refresh()
        if self._lookahead is not None:
            self._lookahead.refresh()

    def share_memory_(self: _Transform) -> _Transform:
        """Moves the counters to shared memory, for buffers of several processes."""
        self._no_donor.share_memory_()
        self._unscored.share_memory_()
        return self

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the state of the generator, and thresholds chosen by ``"auto"``."""
        state: dict[str, Any] = super().get_extra_state()
        if self.threshold == "auto" and self._thresholds.is_known:
            numbers = self.thresholds
            state["thresholds"] = torch.tensor(
                list(numbers.values()), dtype=torch.float64
            )
            state["threshold_names"] = list(numbers)
        return state

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`get_extra_state` returned.

        Raises:
            ValueError: the state has thresholds that ``"auto"`` chose, and they are
                those of other entities or not those of this transform.
        """
        if "thresholds" in state:  # before anything is changed
            self._thresholds.restore(state["thresholds"], state.get("threshold_names"))
            self.refresh_donors()  # whose index depends on them
        super().set_extra_state(state)

    # --- the two halves of an augmentation -------------------------------------------

    def num_counterfactual(self, windows: int) -> int:
        """Returns how many windows of a batch become counterfactual.

        Args:
            windows (int): windows in the batch, ``B``.

        Returns:
            int: ``round(counterfactual_ratio * B)``.
        """
        return round(self.counterfactual_ratio * windows)

    def generate_parameters(
        self, scores: torch.Tensor, generator: torch.Generator | None = None
    ) -> SwapDraw:
        """Draws what is swapped, and the donors.

        Args:
            scores (torch.Tensor): the batch's, ``[B * window, *feature_shape]``.
            generator (torch.Generator, optional): source of randomness. Defaults to
                the transform's own.

        Returns:
            SwapDraw: the draw, for the last ``C`` windows.

        Raises:
            RuntimeError: with ``lookahead``, which reads more than these scores.
        """
        if self._lookahead is not None:
            raise RuntimeError(
                f"lookahead={self.lookahead!r} reads the trajectories of the buffer "
                "that samples, but only the scores of a batch are given: call "
                "rb.sample(), or leave out lookahead"
            )
        return self._draw(scores, generator)

    def _draw(
        self, scores: torch.Tensor, generator: torch.Generator | None = None
    ) -> SwapDraw:
        """Draws by scores in which locked entities are held."""
        generator = self.generator if generator is None else generator
        free = self.swappable(scores)
        total = len(free)
        count = check_windows(self.num_counterfactual(total), total)
        chosen = None
        if self.chosen_rows == "random" and 0 < count < total:
            chosen = draw_windows(total, count, device=free.device, generator=generator)
            count = total
        if self._donors:
            return self._donors[0].draw(
                free[total - count :],
                swap_prob=self.swap_prob,
                chosen=chosen,
                generator=generator,
            )
        return self.draw_in_batch(
            free,
            count,
            window=self.window,
            swap_prob=self.swap_prob,
            chosen=chosen,
            generator=generator,
        )

    def apply_parameters(
        self, tensordict: TensorDictBase, draw: SwapDraw
    ) -> TensorDictBase:
        """Applies a draw: the same draw gives the same batch.

        Args:
            tensordict (TensorDictBase): the batch ``[B * window]``; it is not changed.
            draw (SwapDraw): from :meth:`generate_parameters`.

        Returns:
            TensorDictBase: the batch with counterfactual rows and their flags.
        """
        return self._swap(tensordict, *self._planner(tensordict), draw)

    def _swap(
        self,
        td: TensorDictBase,
        plan: SwapPlan,
        values: Sequence[torch.Tensor],
        draw: SwapDraw,
    ) -> TensorDictBase:
        if self._donors:
            out = self._donors[0].apply(td, plan, values, draw)
        else:
            out = apply_swap(td, plan, values, draw, window=self.window)
        swapped, chosen, window = draw.swapped, draw.chosen, self.window
        drawn = swapped.shape[0]
        first = td.shape[0] - drawn * window
        if window > 1:
            swapped = swapped.unsqueeze(1).expand(-1, window, -1).flatten(0, 1)
            if chosen is not None:
                chosen = chosen.unsqueeze(1).expand(-1, window).flatten()
        if self._goal_leaves and drawn:
            goals = goal_vectors(out, self.layout, first)
            leaves = self._goal_leaves(out, *goals, first=first, where=chosen)
            for key, leaf in leaves.items():
                out.set(key, leaf)
        if chosen is None:
            chosen = swapped.new_ones(drawn * window)
        chosen = chosen.unsqueeze(-1)
        if first:
            kept = swapped.new_zeros(first, swapped.shape[-1])
            swapped = torch.cat([kept, swapped])
            chosen = torch.cat([kept[:, :1], chosen])
        out.set(self.keys.counterfactual, chosen)
        out.set(self.keys.swapped, swapped)
        return out

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Makes rows of a batch counterfactual.

        Args:
            tensordict (TensorDictBase): the batch ``[B * window]``, with scores. With
                several batch dimensions, such as those of
                :class:`~torchrl.data.ReplayBufferEnsemble`, windows lie along the last
                one.

        Returns:
            TensorDictBase: a shallow copy with new leaves; the input is not changed.

        Raises:
            KeyError: scores, or a leaf that the layout names, are missing.
            RuntimeError: the batch was relabelled before, or a
                :class:`~torchrl.data.HERReplayBuffer` will relabel rows of it.
            ValueError: the batch does not fit the layout or the window, a value is not
                finite, a window is not one of successive rows, or a score belongs to
                another state.
        """
        self.warn_if_forked()
        self._check_buffer(tensordict.batch_size)
        shape = tensordict.batch_size
        repeated = self._repeated  # which another thread may replace
        if repeated is not None and repeated.settings == self._settings:
            with unchanged_donors(self._donors):
                done = repeated(
                    tensordict,
                    partial(self._swappable_in, tensordict),
                    self.num_counterfactual(shape[:1].numel() // self.window),
                    rows=self.chosen_rows,
                    swap_prob=self.swap_prob,
                    no_donor=self._no_donor,
                    generator=self.generator,
                    batch_check=self._batch_check,
                    donors=next(iter(self._donors), None),
                )
            if done is not None:
                return done
        if len(shape) != 1:
            check_batch_shape(tensordict, self.window)
            tensordict = tensordict.reshape(-1)
        scores = self._scores(tensordict)
        if not self._thresholds.is_known:
            self._thresholds.choose_from(sampling_buffer(), self.score_key)
        plan, values = self._planner(tensordict)
        checked: CheckedScores | None = None
        if self.check:
            checked = self._batch_check.before(tensordict, scores)
            scores = checked.scores
        if self._lookahead is not None:
            locked, differs = self._lookahead.sampled(tensordict)
            scores = hold_entities(scores, locked)
            if differs is not None and checked is not None:
                checked = checked._replace(differs=differs)
        if not self._free_share.is_done:
            free = self.swappable(scores)
            self._free_share.add(free, self._thresholds.expected)
        with unchanged_donors(self._donors):
            draw = self._draw(scores)
            if self.check and self._donors:
                draw = self._donors[0].verified(draw)
            out = self._swap(tensordict, plan, values, draw)
        if checked is not None:
            self._batch_check.after(out, checked, plan.states)
            if checked.unscored is not None:
                self._unscored = self._unscored.to(scores.device)
                self._unscored.add_(checked.unscored)
        self._no_donor = self._no_donor.to(draw.no_donor.device)
        self._no_donor.add_(draw.no_donor)
        if self._free_share.is_done:
            self._repeated = RepeatedSwap.of(
                tensordict, plan, self.layout, self._settings, self._repeated
            )
        return out if len(shape) == 1 else out.reshape(shape)

    @property
    def _settings(self) -> SwapSettings | None:
        """The settings of repeated swaps, ``None`` if all are done step by step."""
        is_usual = self.draw_in_batch is draw_batch_donors and all(
            type(x) is BufferDonors and x.goals is None for x in self._donors
        )
        if not is_usual or self._goal_leaves or self.unscored == "keep":
            return None
        on_gpu = self._lookahead is None and not self._donors
        return SwapSettings(self.window, self.score_key, self.keys, self.check, on_gpu)

    def _swappable_in(self, td: TensorDictBase, scores: torch.Tensor) -> torch.Tensor:
        """Returns what may be swapped in each window of a batch, ``[B, N]``."""
        if self._lookahead is not None:
            scores = hold_entities(scores, self._lookahead.sampled(td)[0])
        return self.swappable(scores)

    def _check_buffer(self, shape: torch.Size) -> None:
        """Raises if the buffer will relabel counterfactual rows of the batch."""
        buffer = sampling_buffer()
        if isinstance(buffer, HERReplayBuffer) and shape:
            rows, kept = shape[0], 0  # the first rows are never counterfactual
            if self.chosen_rows == "last" or self.counterfactual_ratio == 0:
                windows = rows // self.window
                kept = (windows - self.num_counterfactual(windows)) * self.window
            name, ratio = type(self).__name__, self.counterfactual_ratio
            check_relabeled_rows(int(rows * buffer.her_ratio), kept, rows, name, ratio)

    def _scores(self, td: TensorDictBase) -> torch.Tensor:
        if not td.shape[0]:
            raise ValueError(
                "the batch has no rows: sample from a buffer that is not empty"
            )
        if td.shape[0] % self.window:
            raise ValueError(
                f"the batch has {td.shape[0]} rows, not a multiple of the window "
                f"{self.window}: sample slices of this length, e.g. SliceSampler("
                f"slice_len={self.window}), and a batch size that is a multiple of it"
            )
        if leaf_of(td, self.keys.relabeled) is not None:
            raise RuntimeError(
                f"HindsightGoal relabelled this batch before {type(self).__name__}, so "
                "that its goals would be swapped as if they were stored: append "
                f"{type(self).__name__} first, HindsightGoal after it"
            )
        scores = leaf_of(td, self.score_key)
        if scores is None:
            donors, where = self.donors_class, "on the replay buffer"
            if isinstance(sampling_buffer(), ReplayBufferEnsemble):
                where = "on each buffer of the ensemble"
            raise KeyError(
                f"the batch has no {donors.scores_name} in {self.score_key!r}: call "
                f"score_buffer {where}, or open the data again if they were "
                f"scored since; another key is given by {donors.key_argument}"
            )
        expected = (td.shape[0], *self.feature_shape)
        if tuple(scores.shape) != expected:
            raise ValueError(
                f"{self.score_key!r} has shape {list(scores.shape)}, expected "
                f"{list(expected)}: {self._expected} the entities "
                f"{list(self.layout.names)}"
            )
        return scores

    def extra_repr(self) -> str:
        """Returns the arguments, for ``repr``."""
        donors = f"{type(self.donors).__name__}" if self._donors else "the batch"
        return (
            f"threshold={self._thresholds}, "
            f"counterfactual_ratio={self.counterfactual_ratio}, "
            f"rows={self.chosen_rows!r}, swap_prob={self.swap_prob}, "
            f"window={self.window}, lookahead={self.lookahead!r}, donors={donors}"
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.extra_repr()})"
