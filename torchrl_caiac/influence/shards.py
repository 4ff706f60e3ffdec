"""Scores a folder together with other processes."""

from __future__ import annotations

import hashlib
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict.utils import NestedKey
from tqdm.auto import tqdm

from torchrl_caiac._fingerprints import fingerprint_key
from torchrl_caiac._torchrl import add_revision, forget_leaves, storage_data
from torchrl_caiac.data.add_leaf import open_leaf
from torchrl_caiac.influence.score_leaf import (
    RowStates,
    ScoreLeaves,
    find_leaves,
    new_leaves,
)
from torchrl_caiac.influence.score_parts import Plan, ScoreParts, new_plan
from torchrl_caiac.influence.score_pass import (
    ScorePass,
    chunk_scores,
    existing_scores,
    forget_rows,
    rows_to_score,
    stale_and_moved,
    write_rows,
)
from torchrl_caiac.influence.score_record import settings_that_differ

__all__ = [
    "ScoringProgress",
    "check_shard",
    "has_parts",
    "score_shard",
    "scoring_progress",
    "settle_parts",
]

_logger = logging.getLogger("torchrl_caiac.influence.score_buffer")
_MOST_JOINS = 3
_LEAST_WAIT, _MOST_WAIT = 0.02, 1.0


class ScoringProgress(NamedTuple):
    """How far processes are that score a folder together.

    Attributes:
        done (int): the number of rows in finished ranges.
        total (int): the number of rows to score.
    """

    done: int
    total: int


def scoring_progress(
    folder: str | os.PathLike[str], key: NestedKey = ("caiac", "score")
) -> ScoringProgress | None:
    """Returns how far processes are that score a folder together.

    Args:
        folder (path): the folder of the data.
        key (NestedKey): the score leaf. Defaults to ``("caiac", "score")``.

    Returns:
        ScoringProgress, optional: ``None`` before they begin, and after all is done.

    Examples:
        >>> from torchrl_caiac.influence.shards import scoring_progress
        >>> scoring_progress("data")
    """
    parts = ScoreParts.of(folder, key)
    plan = parts.read()
    if plan is None:
        return None
    done = sum(plan.rows[r] for r in parts.finished(plan))
    return ScoringProgress(done, sum(plan.rows))


def check_shard(shard: Any) -> None:
    """Raises unless a value is ``(i, n)`` with ``0 <= i < n``."""
    is_pair = isinstance(shard, (tuple, list)) and len(shard) == 2
    if not is_pair or any(type(x) is not int for x in shard):
        raise ValueError(
            f"shard must be two ints (i, n), process i of n, got {shard!r}"
        )
    i, n = shard
    if not 0 <= i < n:
        raise ValueError(
            f"shard is ({i}, {n}), expected (i, n) with 0 <= i < n: the processes are "
            "counted from 0"
        )


def score_shard(
    own: ScorePass, shard: tuple[int, int], *, overwrite: bool, progress: bool
) -> bool:
    """Scores rows of a folder, until this and other processes have scored all.

    Args:
        own (ScorePass): what is scored.
        shard (tuple of int): the number of this process, and of all.

    Keyword Args:
        overwrite (bool): replace scores with other settings.
        progress (bool): show a progress bar, of all processes.

    Returns:
        bool: whether this process has joined the scores of all.

    Raises:
        ValueError: the storage has no folder, or scores or other processes have other
            settings.
        RuntimeError: a process scores the folder alone.
    """
    if own.folder is None:
        raise ValueError(
            "shard needs data in a folder, which other processes can open, and the "
            "storage has none: write the data with write_transitions and open them "
            "with offline_buffer(load_transitions(folder)), or leave out shard"
        )
    parts = ScoreParts.of(own.folder, own.key)
    if not parts.root.exists() and _is_scored(own):
        return False  # before anything is locked, as the folder may be read-only
    joined = False
    record = own.read_record()
    if record is None or record["state"] != "scored":
        own.scorer.block(0)  # all compile what they need at once, not within the lock
    with parts.taking_part():
        with parts.leading():
            plan = _begin(own, parts, shard[1], overwrite=overwrite)
            if plan is not None:
                parts.enter()
        if plan is not None:
            own.keep_kernels(own.read_record())
            own.scorer.feature_shape = tuple(plan.feature_shape)
            _work(own, parts, plan, shard, progress=progress)
            with parts.leading():
                for _ in range(_MOST_JOINS):
                    if joined or not parts.is_current(plan):
                        break
                    joined = _join(own, parts, plan)
                    if not joined:  # a file was damaged
                        _work(own, parts, plan, shard, progress=False)
                else:
                    raise RuntimeError(
                        f"scores were damaged again after {_MOST_JOINS} tries: delete "
                        f"{parts.root}, check the disk, and call score_buffer again"
                    )
    _open_leaves(own)
    record = own.read_record()
    if record is None or record["state"] != "scored":
        raise RuntimeError(
            f"another process has taken over the scoring of {own.folder}, or has "
            "removed what was scored: call score_buffer again"
        )
    return joined


def _is_scored(own: ScorePass) -> bool:
    """Returns whether a finished call with the same settings has scored all rows."""
    record = own.read_record()
    if record is None or (record["state"], record["settings"]) != (
        "scored",
        own.settings,
    ):
        return False
    _open_leaves(own)
    found = existing_scores(own)
    return found is not None and _nothing_left(found[1])


def _nothing_left(states: RowStates) -> bool:
    return bool((states.valid & ~states.moved).all())


def has_parts(own: ScorePass) -> bool:
    """Returns whether processes that score together have left scores in the folder."""
    if own.folder is None:
        return False
    return ScoreParts.of(own.folder, own.key).root.exists()


def settle_parts(own: ScorePass, *, overwrite: bool) -> None:
    """Moves what processes have scored together into the leaf, to go on alone.

    Args:
        own (ScorePass): what is scored, in a folder. No other process is at work.

    Keyword Args:
        overwrite (bool): discard it instead.

    Raises:
        ValueError: it has other settings.
    """
    assert own.folder is not None
    parts = ScoreParts.of(own.folder, own.key)
    plan = None if overwrite else parts.read()
    if plan is not None:
        if plan.settings != own.settings:
            raise _other_settings(own, plan)
        if find_leaves(own.storage, own.key) is None:
            return  # opened before the leaves were added, which is refused next
        _move(own, parts, plan)
    if parts.root.exists():
        parts.discard()


def _begin(
    own: ScorePass, parts: ScoreParts, processes: int, *, overwrite: bool
) -> Plan | None:
    """Returns the plan of all processes, ``None`` if nothing is left to score."""
    geometry = _geometry(own)
    plan = parts.read()
    # Otherwise the data may have changed since, and with them the rows around a change.
    if plan is not None and parts.members():
        if (plan.settings, plan.geometry) == (own.settings, geometry):
            return plan
        raise ValueError(
            f"other processes are scoring {own.key!r} in {own.folder} with other "
            "settings: "
            + settings_that_differ(
                {**plan.settings, **plan.geometry}, {**own.settings, **geometry}
            )
            + ". Give all of them the same, or wait until the others have ended"
        )
    _open_leaves(own)
    if plan is not None:  # of processes that have ended
        if plan.settings == own.settings:
            _move(own, parts, plan)
        elif not overwrite:
            raise _other_settings(own, plan)
    parts.discard()
    try:
        found = existing_scores(own)
    except ValueError:
        if not overwrite:
            raise
        found = None
    needed = None
    if found is None:
        own.keep_kernels(None if overwrite else own.read_record())
        # Before anything is written, as in a call without shard.
        shape = tuple(own.scorer.block(0).state.shape[1:])
        own.write_record("new")
        new_leaves(own.storage, own.key, shape)
    else:
        leaves, states, is_first = found
        is_done = _nothing_left(states)
        if is_done and not is_first:
            return None
        own.keep_kernels(own.read_record())
        if is_done:
            own.write_record("scored")
            return None
        if own.scorer.kernels is None:  # not recorded
            own.scorer.block(0)
        shape = tuple(leaves.scores.shape[1:])
        own.scorer.feature_shape = shape
        todo = rows_to_score(own, *stale_and_moved(own, states), is_first=is_first)
        forget_rows(own, leaves, todo)
        needed = torch.zeros(own.index.length, dtype=torch.bool)
        for c, is_near in todo:
            needed[own.scorer.span(c)] = is_near
    own.write_record("scoring")
    plan = new_plan(own.settings, geometry, shape, needed, processes)
    parts.write(plan, needed)
    return plan


def _work(
    own: ScorePass,
    parts: ScoreParts,
    plan: Plan,
    shard: tuple[int, int],
    *,
    progress: bool,
) -> None:
    """Scores ranges until there are scores of all."""
    mask = parts.mask(plan)
    following = shard[0] * len(plan.rows) // shard[1]
    wait = _LEAST_WAIT
    total, length = sum(plan.rows), own.index.length
    with tqdm(total=length, desc="scoring", unit="row", disable=not progress) as bar:
        while parts.is_current(plan):
            left = parts.unfinished(plan)
            # Of all processes, and the rows that were scored before.
            bar.n = length - sum(plan.rows[r] for r in left)
            bar.refresh()
            if not left:
                return
            number = parts.claim(plan, following)
            if number is None:
                number = parts.take_over(plan)
            if number is None:  # the last ones are in work
                time.sleep(wait)
                wait = min(2 * wait, _MOST_WAIT)
                continue
            wait, following = _LEAST_WAIT, number + 1
            scores, fingerprints = [], []
            for c, needed in _chunks(own, plan, mask, number):
                rows, found, known = chunk_scores(own, c, needed)
                scores.append(found)
                fingerprints.append(known)
                bar.update(len(rows))
            parts.put(plan, number, torch.cat(scores), torch.cat(fingerprints))
        bar.n = bar.n if total else length


def _join(own: ScorePass, parts: ScoreParts, plan: Plan) -> bool:
    """Writes the scores of all processes into the leaf, unless one is damaged."""
    _open_leaves(own)
    if _move(own, parts, plan):
        return False
    own.write_record("scored")
    parts.discard()
    return True


def _move(own: ScorePass, parts: ScoreParts, plan: Plan) -> list[int]:
    """Moves finished scores into the leaf.

    Returns:
        list of int: the ranges without scores.
    """
    geometry = {**_geometry(own), "batch_size": plan.geometry["batch_size"]}
    if plan.geometry != geometry:
        _logger.warning(
            "%s was written to since a part of it was scored (%s): the part is "
            "discarded",
            own.folder,
            settings_that_differ(plan.geometry, geometry),
        )
        return list(range(len(plan.rows)))
    leaves = find_leaves(own.storage, own.key)
    assert leaves is not None  # they were added before the plan
    mask, missing = parts.mask(plan), []
    size = plan.chunks * plan.geometry["batch_size"]
    there = parts.finished(plan)
    for number, count in enumerate(plan.rows):
        if not count:
            continue
        part = parts.get(plan, number) if number in there else None
        if part is None:
            missing.append(number)
            continue
        start = number * size
        position = torch.arange(start, min(start + size, own.index.length))
        if mask is not None:
            position = position[mask[start : start + size]]
        rows = own.index.rows(position.to(own.index.device)).cpu()
        write_rows(leaves, rows, *part)
    _flush(own, leaves)
    return missing


def _chunks(
    own: ScorePass, plan: Plan, mask: torch.Tensor | None, number: int
) -> Iterator[tuple[int, torch.Tensor]]:
    """Yields the chunks of a range, and which of their rows are scored."""
    first = number * plan.chunks
    for c in range(first, min(first + plan.chunks, own.scorer.num_chunks)):
        span = own.scorer.span(c)
        if mask is None:
            yield c, torch.ones(span.stop - span.start, dtype=torch.bool)
        elif bool(mask[span].any()):
            yield c, mask[span]


def _geometry(own: ScorePass) -> dict[str, Any]:
    """Returns what processes must agree on to mean the same rows by a range."""
    ends = own.index.ends.cpu().numpy().tobytes()
    return {
        "batch_size": own.scorer.batch_size,
        "rows": own.index.length,
        "oldest row": own.index.oldest,
        "trajectories": hashlib.sha256(ends).hexdigest(),
    }


def _open_leaves(own: ScorePass) -> None:
    """Opens leaves that another process has added or written."""
    data = storage_data(own.storage)
    for key in (own.key, fingerprint_key(own.key)):
        open_leaf(data, key)
    forget_leaves(own.storage)
    add_revision(own.storage)


def _flush(own: ScorePass, leaves: ScoreLeaves) -> None:
    """Writes the leaves to the disk or server, before the record says so."""
    data = storage_data(own.storage)
    for key in (own.key, fingerprint_key(own.key)):
        descriptor = os.open(Path(data.get(key).filename), os.O_RDWR)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _other_settings(own: ScorePass, plan: Plan) -> ValueError:
    differences = settings_that_differ(plan.settings, own.settings)
    return ValueError(
        f"some scores in {own.key!r} of {own.folder} have other settings: "
        f"{differences}. Repeat the call that was interrupted, call "
        "score_buffer(..., overwrite=True) to replace them, or give another key"
    )
