"""Donors from a replay buffer: finding its eligible windows, and reading them."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch.nn.functional import pad
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac._checks import check_local
from torchrl_caiac._fingerprints import (
    fingerprint_key,
    hashed_leaves,
    matches,
    upper_half,
)
from torchrl_caiac._sampling import DonorRows, is_native
from torchrl_caiac._torchrl import (
    leaf_of,
    sampling_buffer,
    storage_revision,
    storage_rows,
    writes_paused,
)
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.score_leaf import valid_scores
from torchrl_caiac.influence.score_record import check_scored_layout, read_record
from torchrl_caiac.trajectories import TrajectoryIndex, trajectory_index
from torchrl_caiac.transforms.draws import (
    DonorBits,
    DonorIndex,
    SwapDraw,
    draw_buffer_donors,
    is_native_index,
)
from torchrl_caiac.transforms.indexing import plain_tensor
from torchrl_caiac.transforms.keys import TransformKeys
from torchrl_caiac.transforms.lookahead import BUILDING, Lookahead, hold_entities
from torchrl_caiac.transforms.swap import SwapLeaf, SwapPlan, apply_swap
from torchrl_caiac.transforms.thresholds import EntityThresholds

if TYPE_CHECKING:
    from torchrl_caiac.transforms.goals.window import WindowGoal

__all__ = ["BufferDonors", "eligible_starts", "scan_donors", "unchanged_donors"]

# Rows of the storage that are read together while an index is built.
_CHUNK = 1 << 17
# The most rows of an index as numbers: 128 MiB.
_MOST_LISTED = 1 << 25


@contextmanager
def unchanged_donors(donors: Sequence[BufferDonors]) -> Iterator[None]:
    """Has others wait before they write to the donors.

    Donors are drawn by an index of what the storage has, and read afterwards.

    Args:
        donors (sequence of BufferDonors): the donors, if they are of a buffer.

    Examples:
        >>> from torchrl_caiac.transforms.donors import unchanged_donors
        >>> with unchanged_donors([]):
        ...     pass
    """
    if not donors or torch.compiler.is_compiling():
        yield
        return
    # Always in this order, in which the lookahead takes them too. That has processes
    # wait for no other buffer, since two may be the donors of each other.
    with BUILDING, writes_paused(donors[0].donors, processes=True):
        yield


def scan_donors(
    values: torch.Tensor,
    step: int,
    window: int,
    trajectories: TrajectoryIndex | None,
    what: str,
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Reads a leaf of the donors part by part, in the order of time.

    A part is the rows of ``step`` windows, so that parts overlap by ``window - 1``.

    Args:
        values (torch.Tensor): ``[T, ...]``.
        step (int): windows in a part.
        window (int): rows in a window.
        trajectories (TrajectoryIndex, optional): needed for windows of several rows.
        what (str): the name of the values in error messages.

    Yields:
        tuple of torch.Tensor: the rows ``[R]`` and their values ``[R, ...]``.

    Raises:
        ValueError: a value is infinite.
    """
    if window > 1 and trajectories is None:
        raise ValueError("windows of several rows need the trajectories of the storage")
    length = values.shape[0]
    for begin in range(0, length - window + 1, step):
        end = min(begin + step + window - 1, length)
        rows = torch.arange(begin, end, device=values.device)
        if trajectories is not None:
            rows = trajectories.rows(rows)
        part = values[rows]
        infinite = torch.isinf(part)
        if infinite.any():
            row = int(rows[infinite.flatten(1).any(1).nonzero()[0, 0]])
            raise ValueError(
                f"the {what} of the donors are infinite in row {row}: score the buffer "
                "again with score_buffer(..., overwrite=True)"
            )
        yield rows, part


def eligible_starts(
    scores: torch.Tensor,
    threshold: float | torch.Tensor,
    swappable: torch.Tensor,
    *,
    window: int = 1,
    trajectories: TrajectoryIndex | None = None,
) -> DonorIndex | DonorBits:
    """Finds the rows at which windows start in which an entity is uninfluenced.

    All rows of such a window belong to one trajectory and have scores of at most
    ``threshold``; a row without a score (NaN) is never part of one. The index takes
    4 bytes for each pair of row and entity that is eligible, at most 128 MiB. One that
    would be larger takes 0.375 bytes for each pair, and more time to draw from.

    Args:
        scores (torch.Tensor): ``[T, N]``, NaN where a row was not scored.
        threshold (float or torch.Tensor): the largest score of an uninfluenced entity,
            θ; one number, or ``[N]``.
        swappable (torch.Tensor): bool ``[N]``; other entities get no rows.

    Keyword Args:
        window (int): rows in a window. Defaults to 1.
        trajectories (TrajectoryIndex, optional): needed for windows of several rows.

    Returns:
        DonorIndex or DonorBits: the rows of every entity.

    Raises:
        ValueError: a score is infinite.

    Examples:
        >>> import torch
        >>> from torchrl_caiac.transforms.donors import eligible_starts
        >>> scores = torch.tensor([[0.0], [0.2], [float("nan")], [0.01]])
        >>> eligible_starts(scores, 0.05, torch.tensor([True])).starts
        tensor([0, 3], dtype=torch.int32)
    """
    length, entities = scores.shape
    device = scores.device
    words = torch.zeros(entities, -(-length // 16), dtype=torch.int16, device=device)
    bits = (1 << torch.arange(16, device=device)).to(torch.int16)
    is_in_order = trajectories is None or trajectories.is_storage_order
    chosen = swappable.nonzero()[:, 0].tolist()
    step = -(-_CHUNK // 16) * 16  # parts begin at whole words
    for rows, part in scan_donors(scores, step, window, trajectories, "scores"):
        free = part <= threshold
        if window > 1 and trajectories is not None:
            held = (~free).cumsum(0, dtype=torch.int32)
            before = torch.cat([torch.zeros_like(held[:1]), held])
            free = before[window:] == before[:-window]
            rows = rows[: free.shape[0]]
            free &= (trajectories.remaining(rows) >= window - 1).unsqueeze(-1)
        word = rows // 16
        bit = bits[rows % 16]
        for entity in chosen:
            value = bit * free[:, entity]
            if is_in_order:
                value = pad(value, (0, -len(value) % 16)).view(-1, 16)
                first = int(word[0])
                words[entity, first : first + len(value)] = value.sum(
                    -1, dtype=torch.int16
                )
            else:
                words[entity].index_add_(0, word, value)
    found = DonorBits.of_words(words)
    return found if int(found.size.sum()) > _MOST_LISTED else found.listed()


def _are(some: Sequence[Any], others: Sequence[Any]) -> bool:
    """Returns whether two sequences have the same objects."""
    return len(some) == len(others) and all(map(operator.is_, some, others))


class BufferDonors:
    """A replay buffer whose windows are donors of entities.

    The index of eligible windows is built at the first draw, and again after each
    write to the buffer. Rows are read leaf by leaf, and of each leaf only what an
    entity needs.

    Args:
        donors (ReplayBuffer or TensorStorage): the donors, with the same entities as
            the batch, and scores in ``score_key``.
        layout (EntityLayout): the entities.

    Keyword Args:
        thresholds (EntityThresholds): the largest scores of uninfluenced entities.
        window (int): rows in a window.
        score_key (NestedKey): the scores, ``[T, N]``.
        keys (TransformKeys): trajectory ids and end flags.
        goals (WindowGoal, optional): draws the goals of donor windows.
        lookahead (Lookahead, optional): what rows lock by later influence.

    Raises:
        TypeError: ``donors`` is not a buffer or storage.
    """

    scores_name: ClassVar[str] = "scores"
    key_argument: ClassVar[str] = "score_key"

    def __init__(
        self,
        donors: ReplayBuffer | TensorStorage,
        layout: EntityLayout,
        *,
        thresholds: EntityThresholds,
        window: int,
        score_key: NestedKey,
        keys: TransformKeys,
        goals: WindowGoal | None = None,
        lookahead: Lookahead | None = None,
    ) -> None:
        check_local("donors", donors)
        if not isinstance(donors, (ReplayBuffer, TensorStorage)):
            raise TypeError(
                "donors must be a ReplayBuffer (or its storage), or None to draw from "
                f"the batch; got {type(donors).__name__}"
            )
        self.donors = donors
        self.layout = layout
        self.thresholds = thresholds
        self.window = window
        self.score_key = score_key
        self.keys = keys
        self.goals = goals
        self.lookahead = lookahead
        self._built: tuple[Any, Any, TrajectoryIndex | None, TensorDictBase] | None = (
            None
        )
        # The donors' leaves for the last plan, and what they were read from.
        self._read: tuple[SwapPlan, list[Any], list[torch.Tensor]] | None = None
        # The same for functions in C, and whether fingerprints are compared.
        self._rows: (
            tuple[SwapPlan, DonorIndex, bool, list[Any], DonorRows | None] | None
        ) = None

    @property
    def feature_shape(self) -> tuple[int, ...]:
        """The shape of one row's scores, ``(N,)``."""
        return (len(self.layout),)

    @property
    def storage(self) -> TensorStorage:
        """The storage of the donors."""
        if isinstance(self.donors, TensorStorage):
            return self.donors
        return self.donors.storage

    def eligible(
        self, scores: torch.Tensor, trajectories: TrajectoryIndex | None
    ) -> Any:
        """Finds the windows that may donate, see :func:`eligible_starts`."""
        return eligible_starts(
            scores,
            self.thresholds.limit(scores),
            ~self.layout.fixed_mask.to(scores.device),
            window=self.window,
            trajectories=trajectories,
        )

    def choose(self, free: torch.Tensor, index: Any, **kwargs: Any) -> SwapDraw:
        """Draws among the windows of :meth:`eligible`."""
        return draw_buffer_donors(free, index, **kwargs)

    def index(self) -> tuple[Any, TrajectoryIndex | None, TensorDictBase]:
        """Returns the eligible windows, the trajectories if needed, and the rows.

        Raises:
            KeyError: the donors have no scores.
            ValueError: the buffer is empty, or its scores have the wrong width.
        """
        # With the storage, since the buffer may have got another one.
        revision, built = (self.storage, storage_revision(self.storage)), self._built
        if built is None or built[0] != revision:
            self._built = built = (revision, *self._build())
            self._read = self._rows = None
        return built[1:]

    def _build(self) -> tuple[Any, TrajectoryIndex | None, TensorDictBase]:
        storage = self.storage
        data = storage_rows(storage, "the donor buffer")
        scores = data.get(self.score_key, None)
        if scores is None:
            raise KeyError(
                f"the donor buffer has no {self.scores_name} in {self.score_key!r}: "
                f"call score_buffer on it, or name their key with {self.key_argument}"
            )
        expected = (scores.shape[0], *self.feature_shape)
        if tuple(scores.shape) != expected:
            raise ValueError(
                f"the donor buffer's {self.score_key!r} has shape "
                f"{list(scores.shape)}, expected {list(expected)} for the entities "
                f"{list(self.layout.names)}: it has another layout"
            )
        trajectories = None
        if self.window > 1 or self.goals is not None:
            trajectories = trajectory_index(
                self.donors,
                trajectory_key=self.keys.trajectory,
                done_key=self.keys.done,
            )
        check_scored_layout(storage, data, self.score_key, self.layout)
        self._check_estimator(storage, data)
        scores = valid_scores(data, self.score_key, self.layout, len(storage))
        if self.lookahead is not None:
            locked = self.lookahead.table(self.donors)
            length = min(len(scores), len(locked))  # rows may be added meanwhile
            scores = hold_entities(scores[:length], locked[:length])
        return self.eligible(scores, trajectories), trajectories, data

    def _check_estimator(self, storage: TensorStorage, data: TensorDictBase) -> None:
        """Raises if donors have scores of another estimator than what is sampled."""
        buffer = sampling_buffer()
        sampled = None if buffer is None else buffer.storage
        if sampled is storage or not isinstance(sampled, TensorStorage):
            return
        rows = storage_rows(sampled, "the buffer")
        records = [
            read_record(of, td, self.score_key)
            for of, td in ((sampled, rows), (storage, data))
        ]
        found = {r["settings"]["estimator"] for r in records if r is not None}
        if len(found) > 1:
            raise ValueError(
                f"{self.score_key!r} of the donors was computed by another estimator "
                "than that of the buffer, so that one threshold does not suit both: "
                "score both with the same one, score_buffer(..., overwrite=True)"
            )

    def draw(
        self,
        free: torch.Tensor,
        *,
        swap_prob: float = 1.0,
        chosen: torch.Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> SwapDraw:
        """Draws donors, and the goals of donor windows.

        Args:
            free (torch.Tensor): bool ``[C, N]``, the entities that may be swapped.

        Keyword Args:
            swap_prob (float): probability of swapping a free entity. Defaults to 1.
            chosen (torch.Tensor, optional): bool ``[C]``, which of these windows become
                counterfactual. Defaults to all of them.
            generator (torch.Generator, optional): source of randomness.

        Returns:
            SwapDraw: donors and goals as rows of the donor storage.
        """
        index, trajectories, _ = self.index()
        draw = self.choose(
            free, index, swap_prob=swap_prob, chosen=chosen, generator=generator
        )
        if self.goals is None or trajectories is None:
            return draw
        last = trajectories.later(draw.donors, self.window - 1)
        rows = self.goals.draw_rows(last, trajectories, generator=generator)
        return draw._replace(goal_rows=rows)

    def verified(self, draw: SwapDraw) -> SwapDraw:
        """Takes back swaps whose donors were written to after they were scored.

        The index of donors is built again after each write that the storage notices. It
        does not notice those of other processes, nor those to its raw tensors. Of each
        window, the first and the last row are compared with their fingerprints. On an
        accelerator nothing is compared, since that would wait for it.

        Args:
            draw (SwapDraw): from :meth:`draw`.

        Returns:
            SwapDraw: the draw, without these swaps, which count as having no donor.
        """
        _, trajectories, data = self.index()
        known = data.get(fingerprint_key(self.score_key), None)
        if known is None or {known.device.type, draw.swapped.device.type} != {"cpu"}:
            return draw
        rows = draw.donors.masked_select(draw.swapped)
        if not len(rows):
            return draw
        every = rows
        if self.window > 1 and trajectories is not None:
            every = torch.cat([rows, trajectories.later(rows, self.window - 1)])
        layout = self.layout
        is_valid = matches(
            data,
            plain_tensor(known),
            layout.in_keys,
            [layout.next(key) for key in layout.in_keys],
            layout.names,
            every,
        )
        if bool(is_valid.all()):
            return draw
        self.refresh()
        is_valid = is_valid.view(-1, len(rows)).all(0)
        lost = draw.swapped.nonzero()[~is_valid]
        taken_back = torch.zeros_like(draw.swapped)
        taken_back[lost[:, 0], lost[:, 1]] = True
        return draw._replace(
            swapped=draw.swapped & ~taken_back,
            no_donor=draw.no_donor + taken_back.sum(0),
        )

    def apply(
        self,
        td: TensorDictBase,
        plan: SwapPlan,
        values: Sequence[torch.Tensor],
        draw: SwapDraw,
    ) -> TensorDictBase:
        """Applies what :meth:`draw` returned, see :func:`apply_swap`.

        Args:
            td (TensorDictBase): the batch, ``[B * window]``.
            plan (SwapPlan): its plan.
            values (sequence of torch.Tensor): its leaves.
            draw (SwapDraw): the draw.

        Returns:
            TensorDictBase: a shallow copy with new leaves.
        """
        _, trajectories, data = self.index()
        # Fewer rows than a window has are never donors.
        if not len(draw.swapped) or len(data) < self.window:
            return td.copy()
        known, entries = self._read, [data, *self._entries(data, plan)]
        if known is None or known[0] is not plan or not _are(known[1], entries):
            own = [values[leaf.place] for leaf in plan.leaves]
            self._read = known = plan, entries, self._sources(data, plan, own)
        sources, goals = known[2], self.goals

        def donor_goals(leaf: SwapLeaf) -> torch.Tensor:
            assert goals is not None and draw.goal_rows is not None
            return goals.donor_goals(data, draw.goal_rows, leaf.owner, leaf.key)

        is_in_order = trajectories is None or trajectories.is_storage_order
        return apply_swap(
            td,
            plan,
            values,
            draw,
            window=self.window,
            sources=sources,
            trajectories=None if is_in_order else trajectories,
            goals=None if goals is None else donor_goals,
        )

    def _sources(
        self, data: TensorDictBase, plan: SwapPlan, batch: Sequence[torch.Tensor]
    ) -> list[torch.Tensor]:
        """Returns the donors' leaves in the order of the batch's, of the same rows."""
        found = []
        for leaf, own in zip(plan.leaves, batch, strict=True):
            if leaf.is_desired and self.goals is not None:
                found.append(torch.empty(0))  # is not read
                continue
            source = data.get(leaf.key, None)
            if source is None:
                remedy = (
                    "give goals=WindowGoal(...), which draws them from the donors, or "
                    "add the leaf to it"
                    if leaf.is_desired
                    else "it has another layout"
                )
                raise KeyError(
                    f"the donor buffer has no {leaf.key!r}, which the batch has: "
                    f"{remedy}"
                )
            if (
                not isinstance(source, torch.Tensor)
                or source.shape[1:] != own.shape[1:]
                or source.dtype != own.dtype
            ):
                kind = (
                    f"{list(source.shape[1:])} {source.dtype}"
                    if isinstance(source, torch.Tensor)
                    else type(source).__name__
                )
                raise ValueError(
                    f"the donor buffer's {leaf.key!r} has rows of {kind}, those of "
                    f"the batch are {list(own.shape[1:])} {own.dtype}: donors need the "
                    "same layout"
                )
            found.append(plain_tensor(source))
        return found

    def rows(
        self, plan: SwapPlan, batch: Sequence[torch.Tensor], check: bool
    ) -> DonorRows | None:
        """Returns the donors as :func:`~torchrl_caiac._sampling.swap_batch` reads them.

        Args:
            plan (SwapPlan): the plan of a batch.
            batch (sequence of torch.Tensor): its leaves, in the order of the plan's.
            check (bool): whether fingerprints are compared, see :meth:`verified`.

        Returns:
            DonorRows, optional: ``None`` if donors are drawn and read by :meth:`draw`,
            :meth:`verified` and :meth:`apply`.

        Raises:
            KeyError: the donors lack scores or a leaf of the batch.
            ValueError: the donors have another layout.
        """
        index, trajectories, data = self.index()
        is_in_order = trajectories is None or trajectories.is_storage_order
        if not is_in_order or not isinstance(index, DonorIndex):
            return None
        known, entries = self._rows, self._entries(data, plan)
        if (
            known is None
            or known[0] is not plan
            or known[1] is not index
            or known[2] != check
            or not _are(known[3], entries)
        ):
            found = self._native_rows(index, data, plan, batch, check)
            self._rows = known = plan, index, check, entries, found
        return known[4]

    def _entries(self, data: TensorDictBase, plan: SwapPlan) -> list[Any]:
        """Returns what is read of the donors, which may be replaced by assignment."""
        layout = self.layout
        keys = [leaf.key for leaf in plan.leaves]
        keys += [key for own in layout.in_keys for key in (own, layout.next(own))]
        return [leaf_of(data, key) for key in (*keys, fingerprint_key(self.score_key))]

    def _native_rows(
        self,
        index: DonorIndex,
        data: TensorDictBase,
        plan: SwapPlan,
        batch: Sequence[torch.Tensor],
        check: bool,
    ) -> DonorRows | None:
        layout, sources = self.layout, self._sources(data, plan, batch)
        known = data.get(fingerprint_key(self.score_key), None) if check else None
        states: Sequence[tuple[torch.Tensor, torch.Tensor]] | None = []
        if known is not None:
            known = plain_tensor(known)
            after = [layout.next(key) for key in layout.in_keys]
            states = hashed_leaves(data, layout.in_keys, after, len(known))
        if (
            states is None
            or (known is not None and (known.dtype, known.ndim) != (torch.int64, 1))
            or not is_native_index(index, len(layout))
            or not is_native(
                sources=[
                    *index,
                    *sources,
                    *([] if known is None else [known]),
                    *(leaf for leaf, _ in states),
                ]
            )
        ):
            return None
        upper = upper_half(tuple(layout.names))
        return DonorRows(*index, sources, known, states, upper)

    def refresh(self) -> None:
        """Drops the index: needed only after writing to the storage's raw tensors."""
        self._built = self._read = self._rows = None
        if self.lookahead is not None:
            self.lookahead.refresh()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_built": None, "_read": None, "_rows": None}
