"""What one pass over a buffer scores, and how its rows are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import TensorStorage

from torchrl_caiac._kernels import kernel_mode
from torchrl_caiac._torchrl import memmap_folder
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.score_leaf import (
    RowStates,
    ScoreLeaves,
    check_shape,
    find_leaves,
    row_states,
)
from torchrl_caiac.influence.score_record import (
    read_record,
    settings_digest,
    settings_that_differ,
    write_record,
)
from torchrl_caiac.influence.scorer import Scorer
from torchrl_caiac.trajectories import STEPS_KEY, TrajectoryIndex

__all__ = [
    "ScorePass",
    "chunk_scores",
    "existing_scores",
    "forget_rows",
    "rows_to_score",
    "stale_and_moved",
    "steps_to_next",
    "write_rows",
]

# The score of a row whose transition passes through states that are not stored: it
# counts as influenced.
_UNKNOWN = 1e30


@dataclass(frozen=True)
class ScorePass:
    """One pass over a buffer.

    Args:
        storage (TensorStorage): the storage.
        data (TensorDictBase): its rows, ``[capacity]``.
        index (TrajectoryIndex): the trajectories.
        scorer (Scorer): computes the scores.
        layout (EntityLayout): the entities.
        key (NestedKey): the score leaf.
        settings (dict): what the scores depend on.
        steps (torch.Tensor, optional): ``[T]``, the steps to the next states.
    """

    storage: TensorStorage
    data: TensorDictBase
    index: TrajectoryIndex
    scorer: Scorer
    layout: EntityLayout
    key: NestedKey
    settings: dict[str, Any]
    steps: torch.Tensor | None

    @property
    def folder(self) -> str | None:
        """The folder of memory-mapped data."""
        return memmap_folder(self.data) if self.data.is_memmap() else None

    def read_record(self) -> dict[str, Any] | None:
        """Returns the record of the scores."""
        return read_record(self.storage, self.data, self.key)

    def write_record(self, state: str) -> None:
        """Writes the record of the scores."""
        write_record(
            self.storage,
            self.data,
            self.key,
            self.settings,
            self.layout,
            state,
            self.scorer.kernels,
        )

    def keep_kernels(self, record: dict[str, Any] | None) -> None:
        """Uses the kernels of earlier scores, if they are recorded.

        Args:
            record (dict, optional): that of the earlier scores.

        Raises:
            ValueError: another :func:`~torchrl_caiac.modules.linear_kernel` is set.
        """
        kernels = None if record is None else record.get("linear_kernels")
        if kernels is None:
            return
        own = kernel_mode()
        if own not in ("auto", kernels["kernel"]):
            raise ValueError(
                f"the scores in {self.key!r} were computed with linear_kernel "
                f"{kernels['kernel']!r}, and {own!r} is set: score with that one, or "
                "call score_buffer(..., overwrite=True) to recompute them"
            )
        self.scorer.kernels = kernels


def existing_scores(
    own: ScorePass,
) -> tuple[ScoreLeaves, RowStates, bool] | None:
    """Returns leaves to keep, the states of rows, and whether a pass was interrupted.

    Raises:
        ValueError: the scores are of another origin or have other settings.
    """
    data, index, scorer = own.data, own.index, own.scorer
    layout, key, settings = own.layout, own.key, own.settings
    leaves = find_leaves(own.storage, key)
    record = own.read_record()
    if record is not None and record["state"] == "new":
        return None  # interrupted before the leaves were initialized
    if leaves is None:
        if own.folder is not None and record is not None:
            raise ValueError(
                f"scores in {key!r} were added to {own.folder} after these data were "
                "opened: open them again with load_transitions, call "
                "score_buffer(..., overwrite=True) to replace them, or give another "
                "key"
            )
        return None
    check_shape(leaves, key, layout)
    # Leaves without scores may have been created with the first write to the buffer.
    if leaves.fingerprints is None:
        if leaves.all_nan(index.length):
            return None
        raise ValueError(
            f"the storage has scores in {key!r} without fingerprints of their states "
            "(by another program, or an earlier version): call "
            "score_buffer(..., overwrite=True) to replace them, or give another key"
        )
    digest = settings_digest(settings)
    states = row_states(data, leaves, layout, index.length, digest, scorer.surroundings)
    has_others = states.has_others
    if record is not None and record.get("entities") != list(layout.names):
        has_others = True  # whose fingerprints are not those of these entities
    if has_others:
        differences = "see the settings of the earlier call"
        if record is not None:
            differences = settings_that_differ(record["settings"], settings)
        raise ValueError(
            f"the scores in {key!r} have other settings: {differences}. Call "
            "score_buffer(..., overwrite=True) to recompute them, or give another key"
        )
    return leaves, states, record is not None and record["state"] == "scoring"


def stale_and_moved(
    own: ScorePass, states: RowStates
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns which rows have no valid score, and which others around them.

    Returns:
        tuple of torch.Tensor: bool ``[T]``, by position.
    """
    index = own.index
    position = torch.arange(index.length, device=index.device)
    rows = index.rows(position).cpu()
    return ~states.valid[rows], states.moved[rows]


def rows_to_score(
    own: ScorePass, stale: torch.Tensor, moved: torch.Tensor, *, is_first: bool
) -> list[tuple[int, torch.Tensor]]:
    """Returns stale rows, and the rows whose scores depend on them.

    Args:
        own (ScorePass): the pass.
        stale (torch.Tensor): bool ``[T]`` by position.
        moved (torch.Tensor): bool ``[T]`` by position, rows that are scored too, but on
            which no others depend.

    Keyword Args:
        is_first (bool): whether chunks are scored as a whole, so that an interrupted
            first pass ends with the same bytes as an uninterrupted one.

    Returns:
        list of tuple: chunks, and which of their rows to score, bool ``[n]``.
    """
    scorer, index = own.scorer, own.index
    before, after = scorer.reach
    # In a ring, the oldest row has lost the row before it to the newest one.
    is_ring = index.order is None and index.length == len(own.data)
    todo = []
    for c in range(scorer.num_chunks):
        span = scorer.span(c)
        near = torch.arange(span.start - before, span.stop + after)
        near = near % index.length if is_ring else near.clamp(0, index.length - 1)
        # Whether there is a stale row around each one.
        counts = stale[near].long().cumsum(0)
        counts = torch.cat([counts.new_zeros(1), counts])
        size = before + after + 1
        is_near = (counts[size:] > counts[:-size]) | moved[span]
        if not bool(is_near.any()):
            continue
        if is_first:
            is_near[:] = True
        todo.append((c, is_near))
    return todo


def forget_rows(
    own: ScorePass, leaves: ScoreLeaves, todo: list[tuple[int, torch.Tensor]]
) -> None:
    """Removes the fingerprints of rows that will be scored.

    A row whose neighbors changed counts as unscored, so that it is found again if the
    call is interrupted.
    """
    known = leaves.fingerprints
    assert known is not None
    for c, is_near in todo:
        known[own.scorer.rows(c)[is_near].to(known.device)] = 0


def chunk_scores(
    own: ScorePass, c: int, is_near: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns the scores of some rows of a chunk.

    Args:
        own (ScorePass): the pass.
        c (int): the chunk.
        is_near (torch.Tensor): bool ``[n]``, which of its rows.

    Returns:
        tuple of torch.Tensor: the rows, int64 ``[m]``, the scores, float32
        ``[m, *feature_shape]``, and fingerprints, int64 ``[m]``.
    """
    scorer, steps = own.scorer, own.steps
    rows = scorer.rows(c)[is_near]
    if bool(is_near.all()):
        found, fingerprints = scorer.chunk(c)
    else:
        chosen = is_near.nonzero()[:, 0] + scorer.span(c).start
        found, fingerprints = scorer.some(chosen)
    if steps is not None:
        found[_is_cut(own.index, rows, steps)] = _UNKNOWN
    return rows, found, fingerprints


def write_rows(
    leaves: ScoreLeaves,
    rows: torch.Tensor,
    found: torch.Tensor,
    fingerprints: torch.Tensor,
) -> None:
    """Writes scores and their fingerprints into the leaves."""
    scores, known = leaves
    assert known is not None
    rows = rows.to(scores.device)
    # The fingerprints last: without them the scores do not count.
    scores[rows] = found.to(scores.device)
    known[rows] = fingerprints.to(known.device)


def steps_to_next(
    data: TensorDictBase, length: int, lookahead: int
) -> torch.Tensor | None:
    """Returns the steps from states to next states, ``[T]``, where they are stored.

    Raises:
        ValueError: they are more than the lookahead.
    """
    leaf = data.get(STEPS_KEY, None)
    if leaf is None:
        return None
    steps = leaf.as_subclass(torch.Tensor)[:length].reshape(length)
    most = int(steps.max())
    if most > lookahead:
        raise ValueError(
            f"the next states are up to {most} steps later, see {STEPS_KEY!r}, but "
            f"lookahead is {lookahead}: an entity that is influenced in between would "
            f"count as uninfluenced. Use lookahead={most} or more"
        )
    return steps


def _is_cut(
    index: TrajectoryIndex, rows: torch.Tensor, steps: torch.Tensor
) -> torch.Tensor:
    """Returns the rows for which a state up to the next one is not stored."""
    left = index.remaining(rows)
    end = index.later(rows.to(index.device), left)
    # The last row has one more state, if that is the one right after it.
    known = left + (steps[end.to(steps.device)] == 1).to(left.device)
    return (steps[rows.to(steps.device)].to(left.device) > known).cpu()
