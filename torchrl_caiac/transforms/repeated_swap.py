"""Swaps in batches that are like an earlier one, by few calls."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._batches import KnownBatch
from torchrl_caiac._fingerprints import fingerprint_key, leaf_weights, upper_half
from torchrl_caiac._sampling import (
    MOST_LEAVES,
    DonorRows,
    batch_fits,
    is_native,
    rows_fit,
    swap_batch,
)
from torchrl_caiac._torchrl import leaf_of
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.trajectories import COLLECTOR_KEY, STEPS_KEY, end_flag_keys
from torchrl_caiac.transforms.batch_check import BatchCheck, CheckedScores
from torchrl_caiac.transforms.checks import LateCheck
from torchrl_caiac.transforms.donors import BufferDonors
from torchrl_caiac.transforms.draws import (
    donor_numbers,
    draw_windows,
    window_numbers,
)
from torchrl_caiac.transforms.keys import TransformKeys
from torchrl_caiac.transforms.swap import SwapPlan

__all__ = ["RepeatedSwap", "SwapSettings"]

_UNKNOWN = 2  # neither true nor false


class SwapSettings(NamedTuple):
    """Settings of a transform on which its :class:`RepeatedSwap` depends.

    Attributes:
        window (int): rows in a window.
        score_key (NestedKey): the scores.
        keys (TransformKeys): the other keys.
        check (bool): whether to check the values of batches.
        on_gpu (bool): whether it may be used on a CUDA device.
    """

    window: int
    score_key: NestedKey
    keys: TransformKeys
    check: bool
    on_gpu: bool


class RepeatedSwap:
    """Swaps entities in batches that have the structure of an earlier batch.

    It gives what :class:`~torchrl_caiac.transforms.CAIACTransform` computes step by
    step, to the bit, but reads the structure of a batch only once. Where something is
    unusual it leaves the batch to those steps, which handle it or raise an error.

    Attributes:
        settings (SwapSettings): those of the transform.
        is_unfit (bool): whether an earlier batch has shown that batches have to be
            swapped step by step: states of windows on a CUDA device are not the next
            states before them, what may be swapped is not bool ``[B, N]``, or donors of
            a buffer need torch.

    Args:
        td (TensorDictBase): the earlier batch, ``[B * window]``, before it was swapped.
        plan (SwapPlan): its plan.
        layout (EntityLayout): the entities.
        settings (SwapSettings): those of the transform.

    Raises:
        TypeError: such batches have to be swapped step by step.
    """

    def __init__(
        self,
        td: TensorDictBase,
        plan: SwapPlan,
        layout: EntityLayout,
        settings: SwapSettings,
    ) -> None:
        self._plan, self.settings = plan, settings
        window, score_key, keys, check, _ = settings
        states = layout.in_keys
        after = [layout.next(key) for key in states]
        known = fingerprint_key(score_key)
        read = {
            "swapped": [leaf.key for leaf in plan.leaves],
            "state": states if check else [],
            "next": after if check else [],
            "known": [known] if check and leaf_of(td, known) is not None else [],
            "ids": _trajectory_ids(td, keys) if check and window > 1 else [],
            "flags": end_flag_keys(td, keys.done) if check and window > 1 else [],
            "scores": [score_key],
        }
        if not settings.on_gpu and td.get(score_key).is_cuda:
            raise TypeError("the batch is on a CUDA device")
        if not plan.leaves:
            raise TypeError("all entities are fixed")
        if window > 1 and leaf_of(td, STEPS_KEY) is not None:
            raise TypeError("next states are several steps later")
        if check and window > 1 and not (read["ids"] or read["flags"]):
            raise TypeError("windows have neither trajectory ids nor end flags")
        swapped = read["swapped"]
        # Places among what is swapped, or keys of leaves that are not.
        finite = plan.states if check else ()
        self._finite = [swapped.index(k) for k in finite if k in swapped]
        read["kept"] = [k for k in finite if k not in swapped]
        self._batch = KnownBatch(td, [key for part in read.values() for key in part])
        self._parts = {name: len(part) for name, part in read.items()}
        leaves = self._leaves(td)
        if leaves is None:
            raise TypeError("there are leaves that need torch")
        self._need(leaves)
        self._weights = [
            leaf_weights(leaf.shape[1], number, leaf.device)
            for number, leaf in enumerate(leaves["state"])
        ]
        self._runs = [leaf.runs for leaf in plan.leaves]
        self._upper = upper_half(layout.names)
        self.is_unfit = False
        # Whether each batch fits, which arrives on the host later, and the batch.
        self._pending: deque[tuple[torch.Tensor, TensorDictBase]] = deque()

    @classmethod
    def of(
        cls,
        td: TensorDictBase,
        plan: SwapPlan,
        layout: EntityLayout,
        settings: SwapSettings | None,
        before: RepeatedSwap | None = None,
    ) -> RepeatedSwap | None:
        """Returns what swaps entities in batches like this one, if it can.

        Args:
            td (TensorDictBase): the batch.
            plan (SwapPlan): its plan.
            layout (EntityLayout): the entities.
            settings (SwapSettings, optional): those of the transform, ``None`` if all
                of its batches are swapped step by step.
            before (RepeatedSwap, optional): the one for batches before.

        Returns:
            RepeatedSwap, optional: ``None`` if such batches are swapped step by step.
        """
        if settings is None or (before is not None and before.is_unfit):
            return before
        try:
            return cls(td, plan, layout, settings)
        except TypeError:
            return None

    def _leaves(self, td: TensorDictBase) -> dict[str, list[torch.Tensor]] | None:
        found = self._batch.leaves(td)
        if found is None or not is_native(*found):
            return None
        leaves, begin = {}, 0
        for name, number in self._parts.items():
            leaves[name] = found[begin : begin + number]
            begin += number
        return leaves

    def _need(self, leaves: dict[str, list[torch.Tensor]]) -> None:
        """Raises where values are of other types than the functions in C read."""
        rows = len(leaves["scores"][0])
        if max(map(len, leaves.values())) > MOST_LEAVES:
            raise TypeError("there are many leaves")
        for here, there in zip(leaves["state"], leaves["next"], strict=True):
            if here.shape != there.shape or here.ndim != 2 or not here.numel():
                raise TypeError("states and next states have other shapes")
        floats = [*leaves["state"], *leaves["next"], *leaves["scores"]]
        floats += [*leaves["kept"], *(leaves["swapped"][i] for i in self._finite)]
        for name, kind in (
            (floats, torch.float32),
            (leaves["ids"] + leaves["known"], torch.int64),
            (leaves["flags"], torch.bool),
        ):
            for leaf in name:
                if leaf.dtype is not kind or len(leaf) != rows:
                    raise TypeError(f"values are {leaf.dtype}")
        for leaf in leaves["ids"] + leaves["flags"] + leaves["known"]:
            if leaf.numel() != rows:
                raise TypeError("there is not one value for each row")

    def __call__(
        self,
        td: TensorDictBase,
        swappable: Callable[[torch.Tensor], torch.Tensor],
        count: int,
        *,
        rows: Literal["random", "last"],
        swap_prob: float,
        no_donor: torch.Tensor,
        generator: torch.Generator | None,
        batch_check: BatchCheck,
        donors: BufferDonors | None,
    ) -> TensorDictBase | None:
        """Swaps entities in a batch.

        Args:
            td (TensorDictBase): the batch, ``[B * window]``; it is not changed.
            swappable (callable): from scores ``[B * window, N]`` to the entities of
                each window that may be swapped, bool ``[B, N]``.
            count (int): the number of windows that become counterfactual.

        Keyword Args:
            rows (str): which windows these are, ``"random"`` or ``"last"``.
            swap_prob (float): probability of swapping each of these entities.
            no_donor (torch.Tensor): int64 ``[N]``, the windows in which an entity had
                no donor, which are counted.
            generator (torch.Generator, optional): source of randomness.
            batch_check (BatchCheck): raises the errors.
            donors (BufferDonors, optional): the donor buffer; ``None`` for the batch.

        Returns:
            TensorDictBase, optional: the batch with counterfactual windows; ``None`` if
            it has to be swapped step by step; nothing was drawn for it.

        Raises:
            IndexError: a donor is not a row of its storage.
            KeyError: the donors lack scores or a leaf of the batch.
            ValueError: a state is not finite; on a CUDA device in an earlier batch, or
                its rows or scores were wrong. Or the donors have another layout.
        """
        leaves = None if self.is_unfit else self._leaves(td)
        window, _, keys, check, _ = self.settings
        if leaves is None:
            return None
        scores = leaves["scores"][0]
        if not 0 < count <= len(scores) // window:
            return None
        states = list(zip(leaves["state"], leaves["next"], self._weights, strict=True))
        known, ids = (next(iter(leaves[name]), None) for name in ("known", "ids"))
        rest = self._upper, ids, leaves["flags"], window
        is_late = LateCheck.needed(scores.device)
        valid: torch.Tensor | None = None
        if check and is_late:
            if known is not None or window > 1:
                valid = rows_fit(states, known, *rest)
                if window > 1 and not self._were_valid(valid, td, batch_check):
                    return None
        elif check and not batch_fits(states, scores, known, *rest):
            return None
        donor_rows: DonorRows | None = None
        if donors is not None:
            donor_rows = donors.rows(self._plan, leaves["swapped"], check)
            self.is_unfit = donor_rows is None
        windows, entities = len(scores) // window, scores.shape[1]
        free = swappable(scores).contiguous()
        self.is_unfit = self.is_unfit or not (
            (free.shape, free.dtype) == ((windows, entities), torch.bool)
            and is_native(free, no_donor)
        )
        if self.is_unfit:
            return None
        order, drawn = None, count
        if rows == "random" and count < windows:
            source: dict[str, Any] = {"device": free.device, "generator": generator}
            if is_late:
                order = draw_windows(windows, count, **source)
            else:
                order = window_numbers(windows, **source)
            drawn = windows
        chance, share = donor_numbers(
            entities, drawn, swap_prob, device=free.device, generator=generator
        )
        new = swap_batch(
            free,
            order,
            chance,
            share,
            count,
            window,
            swap_prob,
            list(zip(leaves["swapped"], self._runs, strict=True)),
            [*self._finite, *leaves["kept"]],
            no_donor,
            donor_rows,
        )
        if donors is not None and new.is_stale:
            donors.refresh()
        found = {
            leaf.key: value
            for leaf, value in zip(self._plan.leaves, new.leaves, strict=True)
        }
        found[keys.counterfactual] = new.counterfactual
        found[keys.swapped] = new.swapped
        out = self._batch.copy(td, found)
        if check and is_late:
            seen = CheckedScores(scores, is_valid=valid if window == 1 else None)
            batch_check.after(out, seen, self._plan.states)
        elif not new.is_finite:
            batch_check.explain_states(out, self._plan.states)
        return out

    def _were_valid(
        self, valid: torch.Tensor, td: TensorDictBase, batch_check: BatchCheck
    ) -> bool:
        """Returns whether the rows of all earlier batches that are known of fit.

        A batch is kept until that is known, since what does not fit may still be right:
        states and next states may be separate recordings, which are compared by
        distance.

        Args:
            valid (torch.Tensor): bool ``[B * window]``, of the newest batch.
            td (TensorDictBase): the newest batch.
            batch_check (BatchCheck): looks at a batch that does not fit, on the CPU.

        Returns:
            bool: false from the first batch on that does not fit, but is right.

        Raises:
            ValueError: an earlier batch is wrong.
        """
        while self._pending and not self.is_unfit:
            fits, batch = pending = self._pending.popleft()
            if int(fits) == _UNKNOWN:
                self._pending.appendleft(pending)
                break
            if not int(fits):
                batch = batch.to("cpu")
                batch_check.before(batch, batch.get(self.settings.score_key))
                self.is_unfit = True
        if self.is_unfit:
            self._pending.clear()
            return False
        fits = torch.full(
            (), _UNKNOWN, dtype=torch.uint8, device="cpu", pin_memory=valid.is_cuda
        )
        fits.copy_(valid.all().to(torch.uint8), non_blocking=True)
        self._pending.append((fits, td))
        return True

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_pending": deque()}


def _trajectory_ids(td: TensorDictBase, keys: TransformKeys) -> Sequence[NestedKey]:
    """Returns the key of the trajectory ids, if there are any."""
    if keys.trajectory is None:
        return []
    wanted = keys.trajectory, COLLECTOR_KEY
    return [key for key in wanted if leaf_of(td, key) is not None][:1]
