"""Scores every stored state once and stores the scores next to the data."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage
from tqdm.auto import tqdm

from torchrl_caiac._checks import check_int, check_local
from torchrl_caiac._files import claim_folder
from torchrl_caiac._keys import as_key
from torchrl_caiac._torchrl import (
    add_revision,
    drop_prefetched,
    forget_leaves,
    memmap_folder,
    storage_data,
    storage_rows,
)
from torchrl_caiac.check import check_before_use
from torchrl_caiac.data.add_leaf import store_leaves
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.estimator_digest import estimator_digest
from torchrl_caiac.influence.score_leaf import (
    RowStates,
    ScoreLeaves,
    check_shape,
    find_leaves,
    new_leaves,
    row_states,
)
from torchrl_caiac.influence.score_record import (
    read_record,
    score_settings,
    settings_digest,
    settings_that_differ,
    write_record,
)
from torchrl_caiac.influence.score_spread import warn_of_one_side
from torchrl_caiac.influence.scorer import Scorer, layout_of
from torchrl_caiac.trajectories import STEPS_KEY, TrajectoryIndex, trajectory_index

__all__ = ["score_buffer"]

_logger = logging.getLogger("torchrl_caiac.influence.score_buffer")
# Passes over a buffer that others write to, before rows are left unscored.
_MOST_PASSES = 10
# The score of a row whose transition passes through states that are not stored: it
# counts as influenced.
_UNKNOWN = 1e30


@torch.no_grad()
def score_buffer(
    rb: ReplayBuffer,
    estimator: Callable[[TensorDictBase], torch.Tensor],
    batch_size: int = 4096,
    smoothing: int = 1,
    *,
    key: NestedKey = ("caiac", "score"),
    lookahead: int = 1,
    every: int = 1,
    trajectory_key: NestedKey | None = "episode",
    done_key: NestedKey | None = ("next", "done"),
    overwrite: bool = False,
    check: bool = True,
    progress: bool = True,
) -> None:
    r"""Computes the influence scores of all stored states and adds them to the storage.

    A trajectory of ``n`` stored rows has ``n + 1`` states: those of its rows, and the
    next state of its last row. With the estimator's scores :math:`r_0, \dots, r_n`, a
    window of :math:`w` states (``smoothing``) and :math:`L` (``lookahead``), row ``t``
    gets, for each entity,

    .. math:: \max_{t \le k \le \min(t + L, n)} \; \operatorname{mean} \big\{ r_m :
        k - \lfloor w / 2 \rfloor \le m \le k + \lfloor (w - 1) / 2 \rfloor, \;
        0 \le m \le n \big\}

    So smoothing is a centered box filter (an even width has its longer side in the
    past). At the ends of a trajectory the mean is over the states that exist. The state
    after the last row is treated like any other state. No window crosses from one
    trajectory into another. ``lookahead=0`` gives the score of the row's own state, the
    paper's :math:`\mathcal{U}_s` (section 3.3). With ``lookahead=1``, a row below the
    threshold is uninfluenced in its state and in its next state.

    An estimator whose ``in_keys`` contain more than the state (attention reads the
    action) cannot score the state after the last row; :math:`r_n` is then left out.

    Rows of :class:`~torchrl.envs.MultiStepTransform`, whose next states are several
    steps later, count as influenced if a state in between is not stored yet.

    For a slow estimator, ``every`` reduces the number of states that are scored: only
    :math:`r_0, r_e, r_{2e}, \dots` of each trajectory are computed. A state in between
    gets the larger of the two scores around it, and a state after the last scored one
    gets the score of that one.

    The leaf is float32 ``[T, N]`` (``[T, N + 1, N]`` for graphs), NaN where a row is
    not scored. Beside it, in ``("caiac", "score_fingerprint")`` for the default key,
    each row has a fingerprint of its state, its next state and the settings, int64
    ``[T]``. So a score is used only for the state that it was computed from, whichever
    process writes to the buffer: the transforms compare the
    fingerprints of every batch, and the next call of this function scores the rows
    whose states have changed, the rows whose windows contain these states, and rows
    that have lost or gained rows of their trajectory around them.
    Rows that are written while this function runs are scored in another pass.

    The rows are scored in chunks of ``batch_size``. An interrupted call resumes where
    it stopped when it is repeated, and a first call ends with the same bytes as an
    uninterrupted one. Time is linear in the number of rows. Apart from the index of
    trajectories and a few bytes for each row, memory does not grow with the number of
    rows or the length of trajectories.

    Both leaves are saved and loaded with the buffer, by ``dumps``, ``state_dict`` or
    TorchRL's checkpoints. A record of how the scores were computed (a digest of the
    estimator, its layout, ``smoothing``, ``lookahead``, ``every`` and the keys) is kept
    on the storage object, or, for a memory-mapped storage with a folder, in the file
    that :func:`~torchrl_caiac.influence.score_file` names. Scores with different
    settings are never mixed. ``batch_size`` may change between calls; scores then agree
    up to rounding. The digest is of the estimator's ``state_dict``, ``repr`` and
    attributes. An estimator whose attributes change while it scores, such as a counter,
    needs a ``__repr__`` (a module: an ``extra_repr``) that names its settings: then
    other attributes than models and tensors are left out.

    One process at a time may score a folder. Open data in a folder with
    :func:`torchrl_caiac.data.load_transitions`, which detects truncated files.

    A warning names entities of which all scores lie on one side of the default
    threshold of :class:`~torchrl_caiac.CAIACTransform`, so that they would be swapped
    in no row, or in all of them; see
    :func:`~torchrl_caiac.influence.suggest_thresholds`.

    Args:
        rb (ReplayBuffer): a buffer with a storage of tensordicts, ``[T]`` or
            ``[T, *B]``, full or not. See
            :func:`~torchrl_caiac.trajectories.trajectory_index` for its trajectories.
        estimator (callable): maps states, a tensordict ``[n]``, to scores ``[n, N]``
            (or ``[n, N + 1, N]``), each row independently. It, or its ``model``, has
            the ``layout`` (:class:`EntityLayout`) that the scores follow. It gets the
            keys in its ``in_keys``, or those of the layout if it has no ``in_keys``. If
            it has a method ``prepare(states, num_states, smoothing=...)``, that is
            called first, with up to 4,096 states spread over the buffer and the number
            of rows.
        batch_size (int): the number of states scored at once. Defaults to 4096.
        smoothing (int): the width of the box filter in states. Defaults to 1: no
            smoothing.

    Keyword Args:
        key (NestedKey): the leaf to write. Defaults to ``("caiac", "score")``.
        lookahead (int): the number of later states in the maximum of a row, at least
            the ``steps_to_next_obs`` of :class:`~torchrl.envs.MultiStepTransform`.
            Defaults to 1.
        every (int): score only every ``every``-th state of a trajectory. Defaults to 1:
            all states.
        trajectory_key (NestedKey, optional): the trajectory ids, see
            :func:`~torchrl_caiac.trajectories.trajectory_index`; ``None`` to rely on
            ``done_key`` alone. Defaults to ``"episode"``.
        done_key (NestedKey, optional): the end flags; ``None`` to rely on
            ``trajectory_key`` alone. Defaults to ``("next", "done")``.
        overwrite (bool): recompute all scores, whatever the leaf contains. Defaults to
            ``False``.
        check (bool): check a sample of the data first, see
            :func:`~torchrl_caiac.check_dataset`. Defaults to ``True``.
        progress (bool): show a progress bar. Defaults to ``True``.

    Raises:
        TypeError: ``rb`` is not a replay buffer, its storage contains no tensordict, or
            the estimator has no layout.
        ValueError: the buffer is empty; an observation or a score is not finite; the
            estimator's output has another shape; the leaf or the score file has another
            origin, or the scores have other settings; ``every`` is above 1 and old rows
            were overwritten; ``lookahead`` is below the steps to the next states.
        RuntimeError: another process is scoring the folder.
        DatasetError: the check found errors.
        KeyError: the storage lacks a key.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence.score_buffer import score_buffer
        >>> class Height:
        ...     layout = EntityLayout({"arm": [0], "cup": [1]})
        ...     def __call__(self, td):
        ...         return td["observation"]
        >>> states = torch.tensor([[0.0, 5.0], [1.0, 4.0], [2.0, 3.0], [3.0, 2.0]])
        >>> rows = TensorDict(
        ...     {
        ...         "observation": states[:3],
        ...         "episode": torch.zeros(3, dtype=torch.int64),
        ...         "next": {
        ...             "observation": states[1:],
        ...             "done": torch.tensor([[False], [False], [True]]),
        ...         },
        ...     },
        ...     [3],
        ... )
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=2)
        >>> _ = rb.extend(rows)
        >>> score_buffer(rb, Height(), progress=False)
        >>> rb[:]["caiac", "score"]
        tensor([[1., 5.],
                [2., 4.],
                [3., 3.]])
    """
    check_int("batch_size", batch_size, 1)
    check_int("smoothing", smoothing, 1)
    check_int("lookahead", lookahead, 0)
    check_int("every", every, 1)
    check_local("rb", rb)
    if not isinstance(rb, ReplayBuffer):
        raise TypeError(f"score_buffer scores a ReplayBuffer, got {type(rb).__name__}")
    key, storage = as_key(key), rb.storage
    if store_leaves(storage_data(storage)):
        forget_leaves(storage)
    layout = layout_of(estimator)
    settings = score_settings(
        estimator_digest(estimator),
        layout,
        smoothing=smoothing,
        lookahead=lookahead,
        every=every,
        trajectory_key=trajectory_key,
        done_key=done_key,
    )
    is_prepared = False
    for number in range(_MOST_PASSES):
        index = trajectory_index(rb, trajectory_key=trajectory_key, done_key=done_key)
        if check and not number:
            check_before_use(
                rb,
                layout,
                action_key=None,
                reward_key=None,
                trajectory_key=trajectory_key,
                done_key=done_key,
                read_next=smoothing > 1 or lookahead > 0,
            )
        if every > 1 and index.oldest:
            raise ValueError(
                f"every is {every}, but the oldest rows of the buffer were "
                "overwritten, so that trajectories lack their first states: use "
                "every=1"
            )
        data = storage_rows(storage)
        steps = _steps(data, index.length, lookahead)
        scorer = Scorer(
            data,
            estimator,
            layout,
            index,
            batch_size=batch_size,
            smoothing=smoothing,
            lookahead=lookahead,
            every=every,
            settings=settings_digest(settings),
            is_prepared=is_prepared,
        )
        is_done = _one_pass(
            storage,
            data,
            index,
            scorer,
            layout,
            key,
            settings,
            steps,
            overwrite=overwrite and not number,
            progress=progress,
        )
        if is_done:
            break
        is_prepared = scorer.is_prepared
    else:
        _logger.warning(
            "the buffer was written to during all of %d passes, so that some rows are "
            "not scored: call score_buffer again, or sample with unscored='keep'",
            _MOST_PASSES,
        )
    # Prefetched batches lack the leaf, or have it unscored.
    drop_prefetched(rb)
    leaves = find_leaves(storage, key)
    if number and leaves is not None and leaves.scores.ndim == 2:
        warn_of_one_side(leaves.scores[: len(storage)], layout)


def _one_pass(
    storage: TensorStorage,
    data: TensorDictBase,
    index: TrajectoryIndex,
    scorer: Scorer,
    layout: EntityLayout,
    key: NestedKey,
    settings: dict[str, Any],
    steps: torch.Tensor | None,
    *,
    overwrite: bool,
    progress: bool,
) -> bool:
    """Scores all rows without a valid score; returns whether there were none."""
    before = None if overwrite else read_record(storage, data, key)
    found = None
    if not overwrite:
        found = _existing(storage, data, scorer, index.length, layout, key, settings)
    if found is None:
        # Score the first block before anything is written: an estimator or data that
        # do not fit leave the storage unchanged.
        feature_shape = tuple(scorer.block(0).state.shape[1:])
        stale = torch.ones(index.length, dtype=torch.bool)
        moved, is_first = ~stale, True
    else:
        leaves, states, is_first = found
        if bool((states.valid & ~states.moved).all()):
            return True
        scorer.feature_shape = feature_shape = tuple(leaves.scores.shape[1:])
        position = torch.arange(index.length, device=index.device)
        rows = index.rows(position).cpu()
        stale, moved = ~states.valid[rows], states.moved[rows]
    with _claimed(data):
        if not overwrite and read_record(storage, data, key) != before:
            return False  # another process has scored: look again in the next pass
        if found is None:
            write_record(storage, data, key, settings, layout, "new")
            leaves = new_leaves(storage, key, feature_shape)
        write_record(storage, data, key, settings, layout, "scoring")
        _score(
            scorer,
            index,
            leaves,
            stale,
            moved,
            steps,
            is_first=is_first,
            progress=progress,
        )
        write_record(storage, data, key, settings, layout, "scored")
    add_revision(storage)
    return False


def _existing(
    storage: TensorStorage,
    data: TensorDictBase,
    scorer: Scorer,
    length: int,
    layout: EntityLayout,
    key: NestedKey,
    settings: dict[str, Any],
) -> tuple[ScoreLeaves, RowStates, bool] | None:
    """Returns leaves to keep, the states of rows, and whether a pass was interrupted.

    Raises:
        ValueError: the scores are of another origin or have other settings.
    """
    leaves = find_leaves(storage, key)
    record = read_record(storage, data, key)
    if record is not None and record["state"] == "new":
        return None  # interrupted before the leaves were initialized
    if leaves is None:
        folder = memmap_folder(data) if data.is_memmap() else None
        if folder is not None and record is not None:
            raise ValueError(
                f"scores in {key!r} were added to {folder} after these data were "
                "opened: open them again with load_transitions, call "
                "score_buffer(..., overwrite=True) to replace them, or give another "
                "key"
            )
        return None
    check_shape(leaves, key, layout)
    # Leaves without scores may have been created with the first write to the buffer.
    if leaves.fingerprints is None:
        if leaves.all_nan(length):
            return None
        raise ValueError(
            f"the storage has scores in {key!r} without fingerprints of their states "
            "(by another program, or an earlier version): call "
            "score_buffer(..., overwrite=True) to replace them, or give another key"
        )
    digest = settings_digest(settings)
    states = row_states(data, leaves, layout, length, digest, scorer.surroundings)
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


def _score(
    scorer: Scorer,
    index: TrajectoryIndex,
    leaves: ScoreLeaves,
    stale: torch.Tensor,
    moved: torch.Tensor,
    steps: torch.Tensor | None,
    *,
    is_first: bool,
    progress: bool,
) -> None:
    """Scores stale rows, and the rows whose scores depend on them.

    Args:
        scorer (Scorer): computes the scores.
        index (TrajectoryIndex): the trajectories.
        leaves (ScoreLeaves): where they are written.
        stale (torch.Tensor): bool ``[T]`` by position.
        moved (torch.Tensor): bool ``[T]`` by position, rows that are scored too, but on
            which no others depend.
        steps (torch.Tensor, optional): ``[T]``, the steps to the next states.

    Keyword Args:
        is_first (bool): whether chunks are scored as a whole, so that an interrupted
            first pass ends with the same bytes as an uninterrupted one.
        progress (bool): show a progress bar.
    """
    scores, known = leaves
    assert known is not None
    before, after = scorer.reach
    # In a ring, the oldest row has lost the row before it to the newest one.
    is_ring = index.order is None and index.length == len(scores)
    todo = []
    left = 0
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
        rows = scorer.rows(c)[is_near]
        # A row whose neighbors changed counts as unscored, so that it is found again
        # if this call is interrupted.
        known[rows.to(known.device)] = 0
        todo.append((c, is_near))
        left += len(rows)
    with tqdm(
        total=index.length,
        initial=index.length - left,
        desc="scoring",
        unit="row",
        disable=not progress or not todo,
    ) as bar:
        for c, is_near in todo:
            rows = scorer.rows(c)[is_near]
            if bool(is_near.all()):
                found, fingerprints = scorer.chunk(c)
            else:
                chosen = is_near.nonzero()[:, 0] + scorer.span(c).start
                found, fingerprints = scorer.some(chosen)
            if steps is not None:
                found[_is_cut(index, rows, steps)] = _UNKNOWN
            rows = rows.to(scores.device)
            # The fingerprints last: without them the scores do not count.
            scores[rows] = found.to(scores.device)
            known[rows] = fingerprints.to(known.device)
            bar.update(len(rows))


def _steps(data: TensorDictBase, length: int, lookahead: int) -> torch.Tensor | None:
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


def _claimed(data: TensorDictBase) -> AbstractContextManager[None]:
    """Locks the folder of memory-mapped data, so that one process scores it."""
    folder = memmap_folder(data) if data.is_memmap() else None
    return nullcontext() if folder is None else claim_folder(folder)
