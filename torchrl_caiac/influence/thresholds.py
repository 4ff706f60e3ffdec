"""Suggests a threshold for each entity, from the scores and what moves."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac._checks import check_int, check_local
from torchrl_caiac._fingerprints import fingerprint_key, matches
from torchrl_caiac._keys import as_key
from torchrl_caiac._torchrl import storage_rows
from torchrl_caiac._whole_files import whole_file
from torchrl_caiac.data.offline_buffer import offline_buffer
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.score_record import read_record
from torchrl_caiac.influence.score_spread import UNKNOWN, score_limits
from torchrl_caiac.influence.threshold_motion import (
    SampledRows,
    doubt_of_zeros,
    motion_of_rows,
    position_tolerances,
    sample_blocks,
    without_near_rests,
)
from torchrl_caiac.influence.threshold_rule import (
    DEFAULT_THRESHOLD,
    MOVES,
    Confidence,
    Split,
    split_scores,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

__all__ = ["ThresholdSuggestions", "suggest_thresholds"]

_CHUNK = 1 << 20
_BINS = 60
# The share of the rows about which two scores must agree.
_AGREEMENT = 0.95


class _Histogram(NamedTuple):
    """How many rows have a score in each bin: all, and those in which it moves."""

    edges: NDArray[np.float64]
    rows: NDArray[np.int64]
    moving: NDArray[np.int64]


@dataclass(frozen=True)
class ThresholdSuggestions:
    """The thresholds of entities, and how clear they are.

    Every mapping has the entities that are not fixed, in layout order.

    Args:
        thresholds (dict of str to float): for ``CAIACTransform(threshold=...)``. Below
            all scores where nothing of the entity may be swapped: if it is always
            influenced, or if no clear threshold was found. If it is never influenced:
            twice the highest score that was looked at, or 0.05 if no score is above 0.
        confidence (dict of str to str): ``"two clear modes"``; ``"one mode: never
            influenced"``, so that all rows are free; ``"one mode: always influenced"``
            or ``"unclear"``, so that none is.
        reasons (dict of str to str): why.
        free (dict of str to float): the share of the scored rows in which the entity is
            free to be swapped with this threshold.
        splits (dict of str to float): the best split of the scores, also where it is
            not clear; without entities whose scores are all equal or at most 0.
        rows (int): the number of rows from which the splits were computed.
    """

    thresholds: dict[str, float]
    confidence: dict[str, Confidence]
    reasons: dict[str, str]
    free: dict[str, float]
    splits: dict[str, float]
    rows: int
    _histograms: dict[str, _Histogram] = field(
        default_factory=dict, repr=False, compare=False
    )

    def to_dict(self) -> dict[str, Any]:
        """Returns all of it but the figure, as JSON values.

        Returns:
            dict: by the names of the attributes.
        """
        return {
            "thresholds": dict(self.thresholds),
            "confidence": dict(self.confidence),
            "reasons": dict(self.reasons),
            "free": dict(self.free),
            "splits": dict(self.splits),
            "rows": self.rows,
        }

    def __str__(self) -> str:
        width = max(len("entity"), *map(len, self.thresholds))
        lines = [f"{'entity':<{width}}  threshold  free rows  confidence"]
        for name, threshold in self.thresholds.items():
            lines += [
                f"{name:<{width}}  {threshold:>9.3g}  {100 * self.free[name]:>7.1f} %  "
                f"{self.confidence[name]}",
                f"{'':<{width}}    {self.reasons[name]}",
            ]
        return "\n".join(lines)

    def figure(self) -> Figure:
        """Draws the distribution of each entity's scores, with its threshold.

        Returns:
            matplotlib.figure.Figure: one panel for each entity. The dashed line is the
            threshold; a dotted one is a split that is not clear.

        Raises:
            ImportError: matplotlib is not installed.
            ValueError: there are no distributions, as in a copy made of
                :meth:`to_dict`.
        """
        from torchrl_caiac._figures import (
            GREY,
            colour,
            name_label,
            new_figure,
            remove_frame,
        )

        if not self._histograms:
            raise ValueError(
                "the distributions of the scores are not known: call "
                "suggest_thresholds(...) and plot what it returns"
            )
        figure = new_figure(7.0, 1.7 * len(self._histograms) + 0.4)
        axes = figure.subplots(len(self._histograms), 1, squeeze=False)[:, 0]
        for panel, (name, found) in zip(axes, self._histograms.items(), strict=True):
            width = np.diff(found.edges)
            others = found.rows - found.moving
            panel.bar(
                found.edges[:-1], others, width, align="edge", color=GREY, label="rows"
            )
            if found.moving.any():
                panel.bar(
                    found.edges[:-1],
                    found.moving,
                    width,
                    bottom=others,
                    align="edge",
                    color=colour(0),
                    label="rows in which it moves",
                )
            is_clear = self.confidence[name] != "unclear"
            lines = self.thresholds if is_clear else self.splits
            line = lines.get(name, 0.0)
            if found.edges[0] <= line <= found.edges[-1]:
                panel.axvline(
                    line,
                    color="black",
                    linestyle="--" if is_clear else ":",
                    label=f"{'threshold' if is_clear else 'split'} {line:.3g}",
                )
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.set_ylim(bottom=0.5)
            panel.set_title(
                f"{name_label(name)}: {self.confidence[name]}", fontsize=9, loc="left"
            )
            panel.set_ylabel("rows", fontsize=8)
            panel.tick_params(labelsize=8)
            remove_frame(panel)
            panel.legend(frameon=False, fontsize=7, loc="upper right")
        axes[-1].set_xlabel("score", fontsize=8)
        return figure

    def plot(self, path: str | os.PathLike[str]) -> Path:
        """Writes the figure to a file.

        Args:
            path (path): its suffix says the format, such as ``.png`` or ``.svg``.

        Returns:
            Path: the file.

        Raises:
            ImportError: matplotlib is not installed.
        """
        path = Path(path)
        figure = self.figure()
        with whole_file(path) as partial:
            figure.savefig(partial, format=path.suffix.lstrip(".") or "png")
        return path


def suggest_thresholds(
    source: ReplayBuffer | TensorStorage | TensorDictBase,
    layout: EntityLayout | None = None,
    *,
    score_key: NestedKey = ("caiac", "score"),
    second_key: NestedKey | None = None,
    lookahead: int | None = None,
    tolerance: float | Mapping[str, float] | None = None,
    max_rows: int = 200_000,
) -> ThresholdSuggestions:
    """Suggests the largest score of an uninfluenced row, for each entity.

    The scores of an entity are split where their logarithms fall into two groups
    (Otsu). If the layout has ``positions``, the split is compared with what moves in
    the recorded transitions: rows in which the entity moves must score above rows in
    which it rests (apart from those just before and after motion, in which the agent
    may be able to move it). The split is kept if it separates both kinds of rows almost
    as well as the best threshold. Otherwise it is moved to the nearest threshold that
    does. An entity that never moves counts as never influenced, unless its scores have
    two modes far apart: the agent may have been able to move it in the upper one. If no
    threshold separates them, for example because the estimator misses influence or the
    entity moves by itself, the entity is never swapped.

    Without positions, the scores must have two modes far apart, or all be 0 while the
    state of the entity never changes.

    Args:
        source (ReplayBuffer, TensorStorage or TensorDictBase): transitions with scores,
            as :func:`~torchrl_caiac.influence.score_buffer` writes them.
        layout (EntityLayout, optional): the entities. Defaults to that of a transform
            of the buffer.

    Keyword Args:
        score_key (NestedKey): the scores, ``[T, N]``. Defaults to
            ``("caiac", "score")``.
        second_key (NestedKey, optional): scores of the same rows by another estimator,
            for example by a world model that was fitted to other trajectories. A
            threshold is clear only if both agree about 95 % of the rows. Defaults to
            ``None``.
        lookahead (int, optional): the number of later states that a score covers.
            Defaults to what ``score_buffer`` recorded, else 0.
        tolerance (float or mapping of str to float, optional): the change of a
            position that is noise, in the units of the data. Defaults to the layout's
            ``variance_floor``, else to :func:`~torchrl_caiac.noise.resting_noise`.
        max_rows (int): about how many rows are read, of larger datasets always the
            same ones. Defaults to 200,000.

    Returns:
        ThresholdSuggestions: the thresholds, how clear they are, and why.

    Raises:
        TypeError: ``source`` or ``layout`` has the wrong type.
        KeyError: there are no scores.
        ValueError: no layout is known; the scores have another shape, are infinite, or
            are all missing or those of other states.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence import suggest_thresholds
        >>> layout = EntityLayout(
        ...     {"arm": [0], "cup": [1]}, fixed=["arm"], positions={"cup": [1]},
        ...     variance_floor=0.01)
        >>> is_pushed = torch.arange(400) % 4 == 0
        >>> state = torch.zeros(400, 2)
        >>> score = torch.where(is_pushed, 0.5, 0.001) * torch.linspace(1, 2, 400)
        >>> data = TensorDict({
        ...     "observation": state,
        ...     "next": {"observation": state + 0.1 * is_pushed.unsqueeze(-1)},
        ...     "caiac": {"score": torch.stack([torch.ones(400), score], -1)}}, [400])
        >>> found = suggest_thresholds(data, layout)
        >>> found.confidence, found.free
        ({'cup': 'two clear modes'}, {'cup': 0.75})
    """
    check_int("max_rows", max_rows, 1)
    score_key = as_key(score_key)
    layout = _layout(source, layout)
    storage = _storage(source)
    data = storage_rows(storage)
    length = len(storage)
    names = [name for name in layout.names if name not in layout.fixed]
    if not names:
        raise ValueError(
            "all entities of the layout are fixed: none is swapped, or has a threshold"
        )
    scores = _scores(data, score_key, layout, length)
    record = read_record(storage, data, score_key)
    settings = {} if record is None else record["settings"]
    if lookahead is None:
        lookahead = int(settings.get("lookahead", 0))
    check_int("lookahead", lookahead, 0)
    sampled = sample_blocks(
        data,
        length,
        lookahead=lookahead if layout.positions else 0,
        max_rows=max_rows,
        trajectory_key=_key(settings, "trajectory_key", "episode"),
        done_key=_key(settings, "done_key", ("next", "done")),
    )
    used = _usable(data, scores, sampled, score_key, layout)
    motion: dict[str, torch.Tensor] = {}
    if layout.positions:
        tolerances = position_tolerances(data[:length], layout, tolerance)
        moving = {n: t for n, t in tolerances.items() if n in names}
        motion = _motion(data, layout, sampled, moving, lookahead)
    rows = sampled.rows.reshape(-1)[used]
    own = _picked(scores, rows)
    second = None
    if second_key is not None:
        other = _scores(data, as_key(second_key), layout, length)
        second = _picked(other, rows)
    lowest, _, _ = score_limits(scores)
    confidence: dict[str, Confidence] = {}
    thresholds, splits, reasons, histograms = {}, {}, {}, {}
    for name in names:
        place = layout.index(name)
        values = own[:, place]
        known = values < UNKNOWN
        moves = motion[name][used].numpy() if name in motion else None
        doubt = None
        if moves is None and values[known].max(initial=0) <= 0:
            doubt = doubt_of_zeros(data, layout, rows, name)
        split = split_scores(
            values[known], None if moves is None else moves[known], doubt=doubt
        )
        if second is not None:
            split = _compared(split, values, second[:, place], moves)
        confidence[name], reasons[name] = split.confidence, split.reason
        if not np.isnan(split.threshold):
            splits[name] = split.threshold
        highest = float(values[known].max(initial=-np.inf))
        thresholds[name] = _threshold(split, lowest[place], highest)
        histograms[name] = _histogram(values[known], moves, known)
    free = _free_shares(scores, [layout.index(n) for n in names], thresholds)
    return ThresholdSuggestions(
        thresholds, confidence, reasons, free, splits, len(rows), histograms
    )


def _motion(
    data: TensorDictBase,
    layout: EntityLayout,
    sampled: SampledRows,
    tolerances: dict[str, torch.Tensor],
    lookahead: int,
) -> dict[str, torch.Tensor]:
    """Returns how each entity moves in the sampled rows, ``[K * B]``."""
    found = motion_of_rows(data, layout, sampled, tolerances, lookahead=lookahead)
    return {
        name: without_near_rests(motion.view(sampled.rows.shape)).flatten()
        for name, motion in found.items()
    }


# --- arguments -----------------------------------------------------------------------


def _layout(source: Any, layout: EntityLayout | None) -> EntityLayout:
    check_local("source", source)
    if layout is None and isinstance(source, ReplayBuffer):
        found = (getattr(transform, "layout", None) for transform in source.transform)
        layout = next((x for x in found if isinstance(x, EntityLayout)), None)
    if layout is None:
        raise ValueError(
            "no layout is known, since no transform of a buffer has one: pass layout"
        )
    if not isinstance(layout, EntityLayout):
        raise TypeError(f"layout must be an EntityLayout, got {type(layout).__name__}")
    return layout


def _storage(source: Any) -> TensorStorage:
    if isinstance(source, TensorDictBase):
        source = offline_buffer(source, batch_size=1)
    if isinstance(source, ReplayBuffer):
        source = source.storage
    if not isinstance(source, TensorStorage):
        raise TypeError(
            "source must be a ReplayBuffer with a storage of tensordicts, its storage, "
            f"or a tensordict; got {type(source).__name__}"
        )
    return source


def _key(settings: dict[str, Any], name: str, default: NestedKey) -> NestedKey | None:
    """Returns a key of the record, in which nested ones are lists."""
    value = settings.get(name, default)
    return tuple(value) if isinstance(value, list) else value


def _scores(
    data: TensorDictBase, key: NestedKey, layout: EntityLayout, length: int
) -> torch.Tensor:
    scores = data.get(key, None)
    if scores is None:
        raise KeyError(
            f"there are no scores in {key!r}: call score_buffer first, or name their "
            "key with score_key"
        )
    if scores.ndim != 2 or scores.shape[-1] != len(layout):
        raise ValueError(
            f"{key!r} has shape {list(scores.shape)}, expected [T, {len(layout)}], one "
            f"score for each of the entities {list(layout.names)}; graphs have one "
            "threshold for all links"
        )
    return scores.as_subclass(torch.Tensor)[:length]


def _usable(
    data: TensorDictBase,
    scores: torch.Tensor,
    sampled: SampledRows,
    key: NestedKey,
    layout: EntityLayout,
) -> torch.Tensor:
    """Returns which of the sampled rows have valid scores, bool ``[K * B]``."""
    rows = sampled.rows.reshape(-1).to(scores.device)
    own = scores[rows]
    if bool(own.isinf().any()):
        raise ValueError(
            f"{key!r} has infinite scores: check the estimator, then call "
            "score_buffer(..., overwrite=True)"
        )
    used = ~own.isnan().any(-1)
    known = data.get(fingerprint_key(key), None)
    if known is not None:
        used &= matches(
            data,
            known.as_subclass(torch.Tensor).reshape(-1),
            layout.in_keys,
            [layout.next(entry) for entry in layout.in_keys],
            layout.names,
            rows,
        )
    if not bool(used.any()):
        raise ValueError(
            f"none of {len(rows)} rows has a score in {key!r} of its own state and of "
            f"the entities {list(layout.names)}: call score_buffer with the estimator "
            "of this layout"
        )
    return used.cpu()


# --- values --------------------------------------------------------------------------


def _picked(scores: torch.Tensor, rows: torch.Tensor) -> NDArray[np.float64]:
    picked: NDArray[np.float64] = scores[rows.to(scores.device)].double().cpu().numpy()
    return picked


def _threshold(split: Split, lowest: float, highest: float) -> float:
    if split.confidence == "two clear modes":
        return split.threshold
    if split.confidence == "one mode: never influenced":
        # Above the scores of the rows that were looked at, and of similar ones; a row
        # that scores much more than these is not known to be uninfluenced.
        return 2 * highest if highest > 0 else DEFAULT_THRESHOLD
    return min(-1.0, 2 * lowest)  # below all scores


def _compared(
    split: Split,
    values: NDArray[np.float64],
    second: NDArray[np.float64],
    moves: NDArray[np.int8] | None,
) -> Split:
    """Compares a split with that of other scores of the same rows."""
    if split.confidence != "two clear modes":
        return split
    known = (values < UNKNOWN) & (second < UNKNOWN)
    other = split_scores(second[known], None if moves is None else moves[known])
    if other.confidence != "two clear modes":
        reason = f"the second scores: {other.reason}"
        return split._replace(confidence="unclear", reason=reason)
    same = (values > split.threshold) == (second > other.threshold)
    agreement = float(same[known].mean())
    reason = f"{split.reason}; the second scores agree about {100 * agreement:.1f} %"
    if agreement < _AGREEMENT:
        return split._replace(confidence="unclear", reason=reason)
    return split._replace(reason=reason)


def _histogram(
    values: NDArray[np.float64], moves: NDArray[np.int8] | None, known: NDArray[np.bool]
) -> _Histogram:
    positive = values[values > 0]
    low, high = (positive.min(), positive.max()) if len(positive) else (0.01, 1.0)
    low = max(low, 1e-6 * high)
    edges = np.geomspace(low / 1.1, high * 1.1, _BINS + 1)
    clipped = np.clip(values, low, high)
    counts = np.histogram(clipped, edges)[0]
    moving = np.zeros_like(counts)
    if moves is not None:
        moving = np.histogram(clipped[moves[known] == MOVES], edges)[0]
    return _Histogram(edges, counts, moving)


def _free_shares(
    scores: torch.Tensor, places: list[int], thresholds: dict[str, float]
) -> dict[str, float]:
    """Returns the shares of the scored rows with scores up to the thresholds."""
    where = torch.tensor(places, device=scores.device)
    limit = torch.tensor(list(thresholds.values()), device=scores.device)
    limit = limit.to(scores.dtype)
    free = torch.zeros(len(places), dtype=torch.int64, device=scores.device)
    rows = torch.zeros_like(free)
    for part in scores.split(_CHUNK):
        own = part[:, where]
        free += (own <= limit).sum(0)
        rows += (~own.isnan()).sum(0)
    shares = (free.double() / rows.clamp_min(1)).tolist()
    return dict(zip(thresholds, shares, strict=True))
