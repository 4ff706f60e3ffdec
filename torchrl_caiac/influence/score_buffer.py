"""Scores every stored state once and stores the scores next to the data."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer
from tqdm.auto import tqdm

from torchrl_caiac._checks import check_int, check_local
from torchrl_caiac._files import claim_folder
from torchrl_caiac._keys import as_key
from torchrl_caiac._torchrl import (
    add_revision,
    drop_prefetched,
    forget_leaves,
    storage_data,
    storage_rows,
)
from torchrl_caiac.check import check_before_use
from torchrl_caiac.data.add_leaf import store_leaves
from torchrl_caiac.influence.estimator_digest import estimator_digest
from torchrl_caiac.influence.score_leaf import find_leaves, new_leaves
from torchrl_caiac.influence.score_parts import refuse_members
from torchrl_caiac.influence.score_pass import (
    ScorePass,
    chunk_scores,
    existing_scores,
    forget_rows,
    rows_to_score,
    stale_and_moved,
    steps_to_next,
    write_rows,
)
from torchrl_caiac.influence.score_record import score_settings, settings_digest
from torchrl_caiac.influence.score_spread import warn_of_one_side
from torchrl_caiac.influence.scorer import Scorer, layout_of, reads_state
from torchrl_caiac.influence.shards import (
    check_shard,
    has_parts,
    score_shard,
    settle_parts,
)
from torchrl_caiac.trajectories import trajectory_index

__all__ = ["score_buffer"]

_logger = logging.getLogger("torchrl_caiac.influence.score_buffer")
# Passes over a buffer that others write to, before rows are left unscored.
_MOST_PASSES = 10


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
    shard: tuple[int, int] | None = None,
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
    gets the score of that one. The last state of a trajectory is the next state of its
    last row, if the data have next states.

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
    up to rounding. The record also has what computed linear layers
    (:func:`~torchrl_caiac.modules.linear_kernel`), which later calls and all processes
    use. The digest is of the estimator's ``state_dict``, ``repr`` and
    attributes. An estimator whose attributes change while it scores, such as a counter,
    needs a ``__repr__`` (a module: an ``extra_repr``) that names its settings: then
    other attributes than models and tensors are left out.

    One process at a time may score a folder, or several together, with ``shard``. Open
    data in a folder with :func:`torchrl_caiac.data.load_transitions`, which detects
    truncated files.

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
            :func:`~torchrl_caiac.check_dataset`. Defaults to ``True``. Data of which
            the estimator reads no states of its layout, as simulators do, are not
            checked.
        progress (bool): show a progress bar. Defaults to ``True``.
        shard (tuple of int, optional): ``(i, n)``, if ``n`` processes, on one machine
            or several, score a folder together, of which this one is number ``i``,
            counted from 0. Each makes the same call but for ``i``. They divide the rows
            among themselves, and take over those of a process that has ended, so that
            ``n`` may differ from the number that are at work. The call returns when all
            rows are scored, and the scores are those that one process would have
            written, to the bit on processors of one kind. Rows that are written
            meanwhile are left to the next call. With ``overwrite=True``, only scores of
            other settings are replaced. Defaults to ``None``: this process scores all
            rows alone.

    Raises:
        TypeError: ``rb`` is not a replay buffer, its storage contains no tensordict, or
            the estimator has no layout.
        ValueError: the buffer is empty; an observation or a score is not finite; the
            estimator's output has another shape; the leaf or the score file has another
            origin, or the scores have other settings; ``every`` is above 1 and old rows
            were overwritten; ``lookahead`` is below the steps to the next states;
            ``shard`` is not ``(i, n)`` with ``0 <= i < n``, the storage has no folder,
            or the processes that score it together have different settings.
        RuntimeError: another process is scoring the folder, and not by parts.
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
    if shard is not None:
        check_shard(shard)
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
        # The layout of a simulator has the columns of what it computes.
        if check and not number and reads_state(estimator, layout):
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
        steps = steps_to_next(data, index.length, lookahead)
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
        own = ScorePass(storage, data, index, scorer, layout, key, settings, steps)
        if shard is not None:
            # The process that joins the scores also looks at them.
            number = int(
                score_shard(own, shard, overwrite=overwrite, progress=progress)
            )
            break
        is_done = _one_pass(own, overwrite=overwrite and not number, progress=progress)
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


def _one_pass(own: ScorePass, *, overwrite: bool, progress: bool) -> bool:
    """Scores all rows without a valid score; returns whether there were none."""
    index, scorer = own.index, own.scorer
    if has_parts(own):  # else nothing is locked, so that a folder may be read-only
        with _claimed(own):
            settle_parts(own, overwrite=overwrite)
    before = None if overwrite else own.read_record()
    found = None if overwrite else existing_scores(own)
    if found is None:
        own.keep_kernels(before)
        # Score the first block before anything is written: an estimator or data that
        # do not fit leave the storage unchanged.
        feature_shape = tuple(scorer.block(0).state.shape[1:])
        stale = torch.ones(index.length, dtype=torch.bool)
        moved, is_first = ~stale, True
    else:
        leaves, states, is_first = found
        if bool((states.valid & ~states.moved).all()):
            return True
        own.keep_kernels(before)
        scorer.feature_shape = feature_shape = tuple(leaves.scores.shape[1:])
        stale, moved = stale_and_moved(own, states)
    with _claimed(own):
        if not overwrite and own.read_record() != before:
            return False  # another process has scored: look again in the next pass
        if found is None:
            own.write_record("new")
            leaves = new_leaves(own.storage, own.key, feature_shape)
        own.write_record("scoring")
        todo = rows_to_score(own, stale, moved, is_first=is_first)
        forget_rows(own, leaves, todo)
        left = sum(int(is_near.sum()) for _, is_near in todo)
        with tqdm(
            total=index.length,
            initial=index.length - left,
            desc="scoring",
            unit="row",
            disable=not progress or not todo,
        ) as bar:
            for c, is_near in todo:
                rows, scores, fingerprints = chunk_scores(own, c, is_near)
                write_rows(leaves, rows, scores, fingerprints)
                bar.update(len(rows))
        own.write_record("scored")
    add_revision(own.storage)
    return False


@contextmanager
def _claimed(own: ScorePass) -> Iterator[None]:
    """Locks the folder of memory-mapped data, so that this process scores it alone."""
    if own.folder is None:
        yield
        return
    with claim_folder(own.folder):
        refuse_members(own.folder)
        yield
