"""What augmentations share: batches, donors, goals, marks and checks."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import ReplayBuffer, TensorStorage
from torchrl.envs.transforms import Transform

from torchrl_caiac.entities import EntityLayout, _path
from torchrl_caiac.transforms.donors import (
    BufferDonors,
    RewardFn,
    SwapDraw,
    _number,
    apply_swap,
    recompute_reward,
)
from torchrl_caiac.transforms.hindsight_goal import take_back
from torchrl_caiac.transforms.late_check import LateCheck
from torchrl_caiac.transforms.window_goal import WindowGoal

__all__ = ["CounterfactualTransform"]

_Transform = TypeVar("_Transform", bound="CounterfactualTransform")


class CounterfactualTransform(Transform, ABC):
    """Makes the last rows of a batch counterfactual, by scores that the rows carry.

    A subclass says what may be swapped (:meth:`swappable`) and with whom
    (:attr:`draw_in_batch`; in :attr:`donors_class` for a donor buffer). Everything
    else is here: see :class:`~torchrl_caiac.transforms.CAIACTransform` for what a
    batch gains and for the arguments.

    Args:
        layout (EntityLayout): the entities; ``fixed`` ones are never swapped.

    Keyword Args:
        threshold (float): the largest score of what is no influence, θ.
        counterfactual_ratio (float): share of rows (or windows) that become
            counterfactual.
        swap_prob (float): probability of swapping what may be swapped.
        window (int): rows a window, κ.
        donors (ReplayBuffer or TensorStorage, optional): where donors are drawn.
        score_key (NestedKey): the scores.
        reward_fn (callable, optional): recomputes rewards of counterfactual rows.
        reward_key (NestedKey): the rewards.
        goals (WindowGoal, optional): draws the goals of donor windows.
        generator (torch.Generator, optional): source of randomness.
        counterfactual_key (NestedKey): the mark of counterfactual rows.
        swapped_key (NestedKey): the mark of swapped entities.
        relabeled_key (NestedKey): the mark of a relabelling done before.
        trajectory_key (NestedKey): trajectory ids.
        done_key (NestedKey): end flags, read where there are no ids.
        check (bool): check the values of each batch.
    """

    #: Draws among the windows of the batch, from what :meth:`swappable` gave.
    draw_in_batch: ClassVar[Callable[..., SwapDraw]]
    donors_class: ClassVar[type[BufferDonors]] = BufferDonors
    _what: ClassVar[str] = "scores"
    _key_argument: ClassVar[str] = "score_key"
    _wanted: ClassVar[str] = "one score for each of"

    def __init__(
        self,
        layout: EntityLayout,
        *,
        threshold: float,
        counterfactual_ratio: float,
        swap_prob: float,
        window: int,
        donors: ReplayBuffer | TensorStorage | None,
        score_key: NestedKey,
        reward_fn: RewardFn | None,
        reward_key: NestedKey,
        goals: WindowGoal | None,
        generator: torch.Generator | None,
        counterfactual_key: NestedKey,
        swapped_key: NestedKey,
        relabeled_key: NestedKey,
        trajectory_key: NestedKey,
        done_key: NestedKey,
        check: bool,
    ) -> None:
        super().__init__()
        if not isinstance(layout, EntityLayout):
            raise TypeError(f"layout is an EntityLayout, got {type(layout).__name__}")
        self.layout = layout
        self.threshold = _number("threshold", threshold, math.inf)
        self.counterfactual_ratio = _number(
            "counterfactual_ratio", counterfactual_ratio, 1.0
        )
        self.swap_prob = _number("swap_prob", swap_prob, 1.0)
        if isinstance(window, bool) or not isinstance(window, int):
            raise TypeError(f"window is a number of rows, an int; got {window!r}")
        if window < 1:
            raise ValueError(f"window is at least 1 row, got {window}")
        if reward_fn is not None and not callable(reward_fn):
            raise TypeError(
                "reward_fn is a function of the next achieved and the desired goals, "
                f"got {type(reward_fn).__name__}"
            )
        if generator is not None and not isinstance(generator, torch.Generator):
            raise TypeError(
                f"generator is a torch.Generator, got {type(generator).__name__}"
            )
        if goals is not None:
            if not isinstance(goals, WindowGoal):
                raise TypeError(f"goals is a WindowGoal, got {type(goals).__name__}")
            if donors is None:
                raise ValueError(
                    "goals draws the goals of donor windows of a donor buffer, and "
                    "there is none: donors in the batch bring their goals with them"
                )
            if goals.window != window or goals.layout != layout:
                raise ValueError(
                    f"goals has window {goals.window} and its own layout, the "
                    f"transform has window {window}: both must be the same"
                )
        self.window = window
        self.score_key = unravel_key(score_key)
        self.reward_fn = reward_fn
        self.reward_key = unravel_key(reward_key)
        self.generator = generator
        self.counterfactual_key = unravel_key(counterfactual_key)
        self.swapped_key = unravel_key(swapped_key)
        self.relabeled_key = unravel_key(relabeled_key)
        self.trajectory_key = unravel_key(trajectory_key)
        self.done_key = unravel_key(done_key)
        self.check = bool(check)
        # In a tuple, so that torch does not take goals for a submodule.
        self._donors: tuple[BufferDonors, ...] = ()
        if donors is not None:
            self._donors = (
                self.donors_class(
                    donors,
                    layout,
                    threshold=self.threshold,
                    window=window,
                    score_key=self.score_key,
                    trajectory_key=self.trajectory_key,
                    done_key=self.done_key,
                    goals=goals,
                ),
            )
        self._no_donor = torch.zeros(len(layout), dtype=torch.int64)
        self._late = LateCheck()

    # --- what augmentations differ in ------------------------------------------------

    @property
    def feature_shape(self) -> tuple[int, ...]:
        """The shape of one row's scores, ``(N,)``."""
        return (len(self.layout),)

    @abstractmethod
    def swappable(self, scores: torch.Tensor) -> torch.Tensor:
        """What may be swapped in each window.

        Args:
            scores (torch.Tensor): ``[B * window, *feature_shape]``.

        Returns:
            torch.Tensor: ``[B, N]``, zero for entities that may not be swapped.
        """

    # --- settings and state ----------------------------------------------------------

    @property
    def donors(self) -> ReplayBuffer | TensorStorage | None:
        """Where donors are drawn; ``None`` for the batch."""
        return self._donors[0].donors if self._donors else None

    @property
    def no_donor_count(self) -> torch.Tensor:
        """How often each entity should have been swapped and had no donor.

        int64 ``[N]``, in windows, since the transform was made or
        :meth:`reset_no_donor_count` was called.
        """
        return self._no_donor.clone()

    def reset_no_donor_count(self) -> None:
        """Sets :attr:`no_donor_count` to zero."""
        self._no_donor.zero_()

    def set_generator(self, generator: torch.Generator | None) -> None:
        """Sets the source of randomness.

        Args:
            generator (torch.Generator, optional): ``None`` for torch's default one.
        """
        self.generator = generator

    def refresh_donors(self) -> None:
        """Has the index of eligible donors built anew.

        It is rebuilt after every write through the buffer or its storage; call this
        after writing into the storage's raw tensors.
        """
        for donors in self._donors:
            donors.refresh()

    def share_memory_(self: _Transform) -> _Transform:
        """Moves the counter to shared memory, for buffers used by several processes."""
        self._no_donor.share_memory_()
        return self

    # --- the two halves of an augmentation -------------------------------------------

    def num_counterfactual(self, windows: int) -> int:
        """How many of the last windows of a batch become counterfactual.

        Args:
            windows (int): windows in the batch, ``B``.

        Returns:
            int: ``round(counterfactual_ratio * B)``.
        """
        return round(self.counterfactual_ratio * windows)

    def generate_parameters(
        self, scores: torch.Tensor, generator: torch.Generator | None = None
    ) -> SwapDraw:
        """Draws what is swapped, and with whom.

        Args:
            scores (torch.Tensor): the batch's, ``[B * window, *feature_shape]``.
            generator (torch.Generator, optional): source of randomness; the
                transform's own by default.

        Returns:
            SwapDraw: the draw, for the last ``C`` windows.
        """
        generator = self.generator if generator is None else generator
        free = self.swappable(scores)
        count = self.num_counterfactual(free.shape[0])
        if self._donors:
            return self._donors[0].draw(
                free[free.shape[0] - count :],
                swap_prob=self.swap_prob,
                generator=generator,
            )
        return self.draw_in_batch(
            free,
            count,
            window=self.window,
            swap_prob=self.swap_prob,
            generator=generator,
        )

    def apply_parameters(
        self, tensordict: TensorDictBase, draw: SwapDraw
    ) -> TensorDictBase:
        """Applies a draw: the same draw gives the same batch.

        Args:
            tensordict (TensorDictBase): the batch ``[B * window]``; it stays as it is.
            draw (SwapDraw): from :meth:`generate_parameters`.

        Returns:
            TensorDictBase: the batch with counterfactual rows, and marked.
        """
        if self._donors:
            out = self._donors[0].apply(tensordict, draw)
        else:
            out = apply_swap(tensordict, self.layout, draw, window=self.window)
        windows = draw.swapped.shape[0]
        changed, total = windows * self.window, tensordict.shape[0]
        if self.reward_fn is not None and changed:
            reward = recompute_reward(
                out, self.layout, self.reward_fn, changed, reward_key=self.reward_key
            )
            out.set(self.reward_key, reward)
        swapped = draw.swapped
        if self.window > 1:
            swapped = swapped.unsqueeze(1).expand(-1, self.window, -1).flatten(0, 1)
        kept = swapped.new_zeros(total - changed, swapped.shape[-1])
        counterfactual = swapped.new_zeros(total, 1)
        counterfactual[total - changed :].fill_(True)
        out.set(self.counterfactual_key, counterfactual)
        out.set(self.swapped_key, torch.cat([kept, swapped]))
        return out

    # --- the transform ---------------------------------------------------------------

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Makes the last rows of a batch counterfactual.

        Args:
            tensordict (TensorDictBase): the batch ``[B * window]``, with scores.

        Returns:
            TensorDictBase: a shallow copy with new leaves; the input stays as it is.

        Raises:
            KeyError: scores, or a leaf that the layout names, are missing.
            ValueError: the batch does not fit the layout or the window, or a value is
                not finite.
        """
        tensordict, relabel = take_back(tensordict, self.relabeled_key)
        scores = self._scores(tensordict)
        draw = self.generate_parameters(scores)
        out = self.apply_parameters(tensordict, draw)
        if self.check:
            self._check(tensordict, out, scores)
        if self._no_donor.device != draw.no_donor.device:
            self._no_donor = self._no_donor.to(draw.no_donor.device)
        self._no_donor += draw.no_donor
        return out if relabel is None else relabel(out)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # A row without a score of its own would keep that of the row it replaces.
        if tensordict.get(self.score_key, None) is None:
            nan = torch.full(
                (*tensordict.batch_size, *self.feature_shape),
                math.nan,
                device=tensordict.device,
            )
            tensordict.set(self.score_key, nan)
        return tensordict

    def _scores(self, td: TensorDictBase) -> torch.Tensor:
        if td.ndim != 1 or not td.shape[0]:
            raise ValueError(
                f"the batch has shape {list(td.shape)}, wanted [B * window] with rows "
                "in it: sample flat batches from a buffer that holds data (use "
                "rb.storage[...] to read rows as they are stored)"
            )
        if td.shape[0] % self.window:
            raise ValueError(
                f"the batch has {td.shape[0]} rows, which windows of {self.window} do "
                f"not divide: sample slices of this length, e.g. SliceSampler("
                f"slice_len={self.window}), and a batch size that is a multiple of it"
            )
        scores = td.get(self.score_key, None)
        if scores is None:
            raise KeyError(
                f"the batch has no {self._what} in {self.score_key!r}: call "
                "score_buffer on the replay buffer, or name their key by "
                f"{self._key_argument}"
            )
        wanted = (td.shape[0], *self.feature_shape)
        if tuple(scores.shape) != wanted:
            raise ValueError(
                f"{self.score_key!r} has shape {list(scores.shape)}, wanted "
                f"{list(wanted)}: {self._wanted} the entities "
                f"{list(self.layout.names)}"
            )
        return scores

    # --- checking --------------------------------------------------------------------

    def _observed(self, td: TensorDictBase) -> list[tuple[Any, torch.Tensor]]:
        found = []
        for key in self.layout.in_keys:
            for where in (key, self.layout.next(key)):
                value = td.get(where)
                if isinstance(value, torch.Tensor):
                    found.append((where, value))
                else:
                    found += [
                        ((where, *_path(below)), leaf)
                        for below, leaf in value.items(True, True)
                    ]
        return [(where, leaf) for where, leaf in found if leaf.is_floating_point()]

    def _check(
        self, before: TensorDictBase, after: TensorDictBase, scores: torch.Tensor
    ) -> None:
        """Raises where values make no sense: on CUDA devices, with a later batch."""
        observed = self._observed(after)
        neighbours = self._neighbours(before)
        leaves = [scores, *(leaf for _, leaf in observed)]
        # A sum is finite if all its terms are (unless it overflows: looked at below).
        if not LateCheck.needed(scores.device):
            finite = math.isfinite(sum(leaf.sum().item() for leaf in leaves))
            if not finite or not (neighbours is None or torch.equal(*neighbours)):
                self._explain(after, scores, neighbours)
            return
        found = self._late.found()
        if found:
            self._explain(after, scores, neighbours)  # it is likely wrong here too
            names = [self.score_key, *(key for key, _ in observed), "the windows"]
            raise ValueError(
                f"{[names[place] for place in found]} made no sense in a batch that "
                f"was sampled before this one: {self._what} or observations are NaN or "
                "infinite, or windows cross a trajectory's end. On a CUDA device "
                "errors come late; sample the same data on the CPU to learn the rows"
            )
        sums = [leaf.sum(dtype=torch.float64) for leaf in leaves]
        if neighbours is not None:
            crosses = (neighbours[0] != neighbours[1]).any()
            sums.append(torch.where(crosses, math.nan, 0.0).double())
        self._late.add(torch.stack(sums))

    def _neighbours(
        self, td: TensorDictBase
    ) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Two ``[B, window - 1]`` that are equal where windows stay in a trajectory."""
        if self.window == 1:
            return None
        ids = td.get(self.trajectory_key, None)
        if ids is not None:
            ids = ids.reshape(-1, self.window)
            return ids[:, 1:], ids[:, :-1]
        done = td.get(self.done_key, None)
        if done is None:
            return None
        done = done.reshape(-1, self.window)[:, :-1].bool()
        return done, torch.zeros_like(done)

    def _explain(
        self,
        after: TensorDictBase,
        scores: torch.Tensor,
        neighbours: tuple[torch.Tensor, torch.Tensor] | None,
    ) -> None:
        names = self.layout.names
        nan, infinite = scores.isnan(), scores.isinf()
        if nan.any():
            rows = int(nan.flatten(1).any(1).sum())
            who = [names[i] for i in _columns(nan)]
            raise ValueError(
                f"{self.score_key!r} is NaN, that is not scored, in {rows} of "
                f"{scores.shape[0]} rows for {who}: call score_buffer on the replay "
                "buffer after extending it"
            )
        if infinite.any():
            who = [names[i] for i in _columns(infinite)]
            raise ValueError(
                f"{self.score_key!r} is infinite for {who}: check the influence "
                "measure, then call score_buffer(..., overwrite=True)"
            )
        if neighbours is not None and not torch.equal(*neighbours):
            crosses = neighbours[0] != neighbours[1]
            window = int(crosses.any(1).nonzero()[0, 0])
            raise ValueError(
                f"window {window} of {self.window} rows crosses a trajectory's end: "
                f"use SliceSampler with slice_len={self.window} and "
                "strict_length=True, and trajectories of at least this length"
            )
        for key, leaf in self._observed(after):
            bad = ~leaf.isfinite()
            if bad.any():
                row = int(bad.flatten(1).any(1).nonzero()[0, 0])
                raise ValueError(
                    f"{key!r} is not finite (NaN or infinite) in {int(bad.sum())} "
                    f"values, first in row {row} of the batch: clean the data, or "
                    "the donors' data"
                )

    def extra_repr(self) -> str:
        """The arguments, for ``repr``."""
        donors = f"{type(self.donors).__name__}" if self._donors else "the batch"
        return (
            f"threshold={self.threshold}, "
            f"counterfactual_ratio={self.counterfactual_ratio}, "
            f"swap_prob={self.swap_prob}, window={self.window}, donors={donors}"
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.extra_repr()})"


def _columns(bad: torch.Tensor) -> list[int]:
    """The entities that have a bad score, ``[*, N]``."""
    return bad.reshape(-1, bad.shape[-1]).any(0).nonzero()[:, 0].tolist()
