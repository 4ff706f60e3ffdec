"""Scores every stored state once and stores the scores next to the data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer
from tqdm.auto import tqdm

from torchrl_caiac._keys import as_key, jsonable
from torchrl_caiac._torchrl import (
    add_revision,
    drop_prefetched,
    known_to_be_memmap,
    storage_data,
)
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.mark_unscored import mark_later_rows
from torchrl_caiac.influence.score_leaf import (
    all_nan,
    check_leaf,
    find_leaf,
    new_leaf,
)
from torchrl_caiac.influence.score_record import (
    estimator_digest,
    layout_digest,
    read_record,
    settings_that_differ,
    write_record,
)
from torchrl_caiac.influence.scorer import Scorer
from torchrl_caiac.trajectories import trajectory_index

__all__ = ["score_buffer"]


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

    For a slow estimator, ``every`` reduces the number of states that are scored: only
    :math:`r_0, r_e, r_{2e}, \dots` of each trajectory are computed. A state in between
    gets the larger of the two scores around it, and a state after the last scored one
    gets the score of that one.

    The leaf is float32 ``[T, N]`` (``[T, N + 1, N]`` for graphs), NaN where a row is
    not scored. The rows are scored in chunks of ``batch_size``. An interrupted call
    resumes where it stopped when it is repeated, and ends with the same bytes as an
    uninterrupted one. This function appends a
    :class:`~torchrl_caiac.influence.MarkUnscored` to the buffer, which marks rows that
    are written later as not scored. The next call scores them, and the rows around them
    whose windows they are in. Time is linear in the number of rows. The index of
    trajectories takes 4 bytes of memory for each row; the rest does not grow with the
    number of rows or the length of trajectories.

    A record of how the scores were computed (a digest of the estimator's state, its
    ``repr`` and its layout, ``smoothing``, ``lookahead``, ``every`` and the keys) is
    kept on the storage object, or, for a memory-mapped storage with a folder, in the
    file that :func:`~torchrl_caiac.influence.score_file` names. Scores
    with different settings are never mixed. ``batch_size`` may change between calls;
    scores then agree up to rounding. ``rb.dumps`` saves the scores without the file.

    Nothing may be sampled or written while this function runs. Open data in a folder
    with :func:`torchrl_caiac.data.load_transitions`, which detects truncated files.

    Args:
        rb (ReplayBuffer): a buffer with a one-dimensional storage of tensordicts, full
            or not. The rows of a trajectory are next to each other, in the order of
            time.
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
        lookahead (int): the number of later states in the maximum of a row. Defaults to
            1.
        every (int): score only every ``every``-th state of a trajectory. Defaults to 1:
            all states.
        trajectory_key (NestedKey, optional): the trajectory ids, see
            :func:`~torchrl_caiac.trajectories.trajectory_index`; ``None`` to rely on
            ``done_key`` alone. Defaults to ``"episode"``.
        done_key (NestedKey, optional): the end flags; ``None`` to rely on
            ``trajectory_key`` alone. Defaults to ``("next", "done")``.
        overwrite (bool): recompute all scores, whatever the leaf contains. Defaults to
            ``False``.
        progress (bool): show a progress bar. Defaults to ``True``.

    Raises:
        TypeError: ``rb`` is not a replay buffer, its storage contains no tensordict, or
            the estimator has no layout.
        ValueError: the buffer is empty or its storage has several dimensions; an
            observation or a score is not finite; the estimator's output has another
            shape; the leaf or the score file has another origin, or the scores have
            other settings; ``every`` is above 1 and old rows were overwritten.
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
    _check_int("batch_size", batch_size, 1)
    _check_int("smoothing", smoothing, 1)
    _check_int("lookahead", lookahead, 0)
    _check_int("every", every, 1)
    if not isinstance(rb, ReplayBuffer):
        raise TypeError(f"score_buffer scores a ReplayBuffer, got {type(rb).__name__}")
    key, storage = as_key(key), rb.storage
    index = trajectory_index(rb, trajectory_key=trajectory_key, done_key=done_key)
    data = storage_data(storage)
    known_to_be_memmap(data)
    layout = _layout_of(estimator)
    if every > 1 and index.oldest:
        raise ValueError(
            f"every is {every}, but the oldest rows of the buffer were overwritten, so "
            "that trajectories lack their first states: use every=1"
        )
    scorer = Scorer(
        data,
        estimator,
        layout,
        index,
        batch_size=batch_size,
        smoothing=smoothing,
        lookahead=lookahead,
        every=every,
    )
    settings = {
        "estimator": estimator_digest(estimator),
        "layout": layout_digest(layout),
        "smoothing": smoothing,
        "lookahead": lookahead,
        "trajectory_key": jsonable(trajectory_key),
        "done_key": jsonable(done_key),
    }
    if every > 1:  # not in records of earlier versions
        settings["every"] = every
    leaf = find_leaf(data, key)
    record = None if overwrite else read_record(storage, data, key)
    if not overwrite and leaf is not None:
        # Rows that have not been written do not matter.
        written = leaf[: index.length]
        if record is not None and record["state"] == "new":
            overwrite = True  # interrupted before the leaf was filled with NaN
        else:
            check_leaf(leaf, key, data, layout)
            overwrite = not _can_keep(written, record, settings, key, batch_size)
    if leaf is None or overwrite:
        # Score the first block before anything is written: an estimator or data that
        # do not fit leave the storage unchanged.
        feature_shape = tuple(scorer.block(0)[0].shape[1:])
        write_record(storage, data, key, settings, layout, "new")
        leaf = new_leaf(storage, data, key, feature_shape)
        todo = list(range(scorer.num_chunks))
    else:
        feature_shape = scorer.feature_shape = tuple(leaf.shape[1:])
        todo = [c for c in range(scorer.num_chunks) if scorer.is_stale(c, leaf)]
        for c in todo:
            # A row whose neighbors changed counts as unscored, so that it is found
            # again if this call is interrupted.
            leaf[scorer.span(c)] = torch.nan
    write_record(storage, data, key, settings, layout, "scored")
    mark_later_rows(rb, key, feature_shape)
    spans = [scorer.span(c) for c in todo]
    left = sum(span.stop - span.start for span in spans)
    with tqdm(
        total=index.length,
        initial=index.length - left,
        desc="scoring",
        unit="row",
        disable=not progress or not todo,
    ) as bar:
        for c, span in zip(todo, spans, strict=True):
            scores = scorer.chunk(c)
            leaf[span] = scores.to(leaf.device)
            bar.update(len(scores))
    add_revision(storage)
    # Prefetched batches lack the leaf, or have it unscored.
    drop_prefetched(rb)


def _layout_of(estimator: Any) -> EntityLayout:
    layout = getattr(estimator, "layout", None)
    if layout is None:
        layout = getattr(getattr(estimator, "model", None), "layout", None)
    if not isinstance(layout, EntityLayout):
        raise TypeError(
            f"the estimator, a {type(estimator).__name__}, has no `layout`: give it "
            "the EntityLayout that its scores follow"
        )
    return layout


def _can_keep(
    written: torch.Tensor,
    record: dict[str, Any] | None,
    settings: dict[str, Any],
    key: NestedKey,
    batch_size: int,
) -> bool:
    """Returns whether existing scores have these settings; raises otherwise."""
    if record is not None and record["settings"] == settings:
        return True
    # A leaf without scores may come from a transform that was there at the first write.
    if all_nan(written, batch_size):
        return False
    if record is None:
        raise ValueError(
            f"the storage has scores in {key!r} without a record of how they were "
            "computed (by another program, or loaded from another folder): call "
            "score_buffer(..., overwrite=True), or give another key"
        )
    raise ValueError(
        f"the scores in {key!r} have other settings: "
        f"{settings_that_differ(record['settings'], settings)}. Call "
        "score_buffer(..., overwrite=True) to recompute them, or give another key"
    )


def _check_int(name: str, value: int, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be an int of at least {least}, got {value!r}")
