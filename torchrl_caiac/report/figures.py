"""The figures of a report, drawn narrow enough for a phone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac._figures import new_figure, remove_frame, true_ranges
from torchrl_caiac.report.svg import (
    ADDED,
    GRID,
    INFLUENCED,
    INK,
    MUTED,
    RECORDED,
    drawing,
    short_label,
    svg_text,
)
from torchrl_caiac.report.swaps import Cells, PairCoverage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.path import Path
    from numpy.typing import NDArray

__all__ = [
    "Marks",
    "draw_coverage",
    "draw_influence",
    "draw_lengths",
    "draw_marks",
    "draw_plan",
    "draw_scores",
]

# Inches. On a phone, a figure is about 340 pixels wide.
_WIDTH, _NARROW = 4.3, 3.9
_MOST_POINTS = 500  # of a curve
Marks = Mapping[str, "tuple[NDArray[Any], NDArray[Any], bool]"]


def draw_influence(
    scores: NDArray[Any],
    influenced: NDArray[Any],
    names: Sequence[str],
    thresholds: Sequence[float],
    *,
    name: str,
    description: str,
) -> str:
    """Draws the scores of entities along a trajectory, one strip for each.

    Scores are drawn linearly around zero and logarithmically above the threshold.

    Args:
        scores (numpy.ndarray): ``[L, N]``.
        influenced (numpy.ndarray): bool ``[L, N]``, where scores are above the
            thresholds.
        names (sequence of str): the ``N`` entities.
        thresholds (sequence of float): the threshold of each.

    Keyword Args:
        name (str): the prefix of the ids.
        description (str): what screen readers say.

    Returns:
        str: the ``<svg>`` element.
    """
    length = len(scores)
    step = -(-length // _MOST_POINTS)
    with drawing():
        figure = new_figure(_WIDTH, 0.45 + 0.68 * len(names))
        strips = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
        for i, (axes, entity) in enumerate(zip(strips, names, strict=True)):
            theta = thresholds[i]
            # The largest score of `step` rows, so that no peak disappears.
            starts = np.arange(0, length, step)
            values = np.maximum.reduceat(scores[:, i].astype(np.float64), starts)
            unit = abs(theta) or 1.0
            curve = _compressed(values, unit)
            line = float(_compressed(np.asarray(theta), unit))
            low, high = min(0.0, curve.min(), line), max(curve.max(), 1.8 * line, line)
            pad = 0.12 * ((high - low) or 1.0)
            bars = [(a - 0.5, b - a) for a, b in true_ranges(influenced[:, i])]
            axes.broken_barh(
                bars, (low - pad, high - low + 2 * pad), facecolor=INFLUENCED, alpha=0.3
            )
            axes.axhline(line, color=INK, linewidth=0.9, linestyle=(0, (4, 3)))
            axes.plot(starts, curve, color=INK, linewidth=1.3)
            axes.set_ylim(low - pad, high + pad)
            axes.set_yticks([line], ["θ"])
            axes.set_title(short_label(entity, 44), loc="left", pad=3)
            remove_frame(axes)
        strips[-1].set_xlim(-0.5, max(length - 0.5, 0.5))
        _whole_steps(strips[-1])
        strips[-1].set_xlabel("step of the trajectory")
        return svg_text(figure, name, description)


def draw_scores(
    scores: NDArray[Any], threshold: float, *, name: str, description: str
) -> str:
    """Draws the distribution of an entity's scores, on logarithmic axes.

    Args:
        scores (numpy.ndarray): ``[T]``.
        threshold (float): the threshold.

    Keyword Args:
        name (str): the prefix of the ids.
        description (str): what screen readers say.

    Returns:
        str: the ``<svg>`` element.
    """
    # As the transform compares them: in the dtype of the scores.
    threshold = float(np.asarray(threshold, dtype=scores.dtype))
    values = scores.astype(np.float64)
    positive = values[values > 0]
    rest = int((values <= 0).sum())
    free_rest = int((values <= min(threshold, 0)).sum())
    inside = [*positive, threshold] if threshold > 0 else positive
    low, high = (np.min(inside), np.max(inside)) if len(inside) else (0.1, 1.0)
    low, high = np.log10(low) - 0.1, np.log10(high) + 0.1
    edges = np.linspace(low, high, 37)
    width = edges[1] - edges[0]
    if threshold > 0:  # an edge at the threshold: no bar has both colours
        edges += (
            np.log10(threshold) - edges[np.abs(edges - np.log10(threshold)).argmin()]
        )
        edges = np.concatenate([[edges[0] - width], edges, [edges[-1] + width]])
    with drawing():
        figure = new_figure(_NARROW, 2.0)
        axes = figure.add_subplot()
        if len(positive):
            counts, _ = np.histogram(np.log10(positive), edges)
            # By the exact scores: what equals the threshold is not influenced.
            free, _ = np.histogram(np.log10(positive[positive <= threshold]), edges)
            for part, colour in ((free, RECORDED), (counts - free, INFLUENCED)):
                shown = part > 0
                axes.bar(
                    edges[:-1][shown],
                    part[shown],
                    0.9 * width,
                    align="edge",
                    color=colour,
                )
        left = edges[0] - 3.2 * width
        if rest:
            parts = [(free_rest, RECORDED), (rest - free_rest, INFLUENCED)]
            parts = [part for part in parts if part[0]]
            for place, (count, colour) in enumerate(parts):
                own = 2 * width / len(parts)
                axes.bar(left + place * own, count, own, align="edge", color=colour)
        if threshold > 0:
            axes.axvline(
                np.log10(threshold), color=INK, linewidth=1, linestyle=(0, (4, 3))
            )
        axes.set_yscale("log")
        axes.set_ylim(0.6, max(2.0, 1.6 * len(values)))
        axes.yaxis.set_major_locator(_powers())
        axes.yaxis.set_minor_locator(_nothing())
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        ticks = np.arange(np.ceil(edges[0]), np.floor(edges[-1]) + 1)
        ticks = ticks[:: max(1, -(-len(ticks) // 6))]
        labels = [f"{10.0**t:g}" for t in ticks]
        if rest:
            ticks, labels = np.append(left + width, ticks), ["≤ 0", *labels]
            near = np.abs(ticks[1:] - ticks[0]) < 4 * width
            keep = np.concatenate([[True], ~near])
            ticks = ticks[keep]
            labels = [label for label, ok in zip(labels, keep, strict=True) if ok]
        axes.set_xticks(ticks, labels)
        axes.set_xlim(left - width if rest else edges[0], edges[-1])
        axes.set_xlabel("score")
        axes.set_ylabel("transitions")
        remove_frame(axes)
        return svg_text(figure, name, description)


def draw_coverage(pair: PairCoverage, *, name: str, description: str) -> str:
    """Draws the combinations of the places of two entities, before and after.

    Args:
        pair (PairCoverage): the combinations.

    Keyword Args:
        name (str): the prefix of the ids.
        description (str): what screen readers say.

    Returns:
        str: the ``<svg>`` element.
    """
    from matplotlib.patches import PathPatch

    before, after = pair.before.numpy(), pair.after.numpy()
    with drawing():
        figure = new_figure(_NARROW, 3.1)
        axes = figure.add_subplot()
        edges = []
        for own, side in zip(pair.cells, (1, 0), strict=True):
            if own.edges is not None:
                edges.append(own.edges.numpy())
                continue
            # Cells of a plane have no order: those that were never recorded are left
            # out.
            visited = before.any(side)
            before, after = (x.compress(visited, 1 - side) for x in (before, after))
            edges.append(np.arange(int(visited.sum()) + 1.0))
        x, y = edges
        for cells, colour in ((before, RECORDED), (after & ~before, ADDED)):
            # With an edge, there are no seams between rows.
            look = {"facecolor": colour, "edgecolor": colour, "linewidth": 0.4}
            axes.add_patch(PathPatch(_rectangles(cells, x, y), **look))
        axes.set_xlim(x[0], x[-1])
        axes.set_ylim(y[0], y[-1])
        axes.locator_params(nbins=5)
        axes.set_xlabel(_cells_label(pair.cells[0], 40))
        axes.set_ylabel(_cells_label(pair.cells[1], 30))
        if pair.cells[0].edges is None:
            axes.set_xticks([])
        if pair.cells[1].edges is None:
            axes.set_yticks([])
        return svg_text(figure, name, description)


def draw_lengths(lengths: NDArray[Any], *, name: str, description: str) -> str:
    """Draws the distribution of the lengths of trajectories.

    Args:
        lengths (numpy.ndarray): ``[E]``, not all the same.

    Keyword Args:
        name (str): the prefix of the ids.
        description (str): what screen readers say.

    Returns:
        str: the ``<svg>`` element.
    """
    low, high = int(lengths.min()), int(lengths.max())
    step = max(1, -(-(high - low + 1) // 24))
    edges = np.arange(low, high + step + 1, step) - 0.5
    with drawing():
        figure = new_figure(_NARROW, 1.6)
        axes = figure.add_subplot()
        axes.hist(lengths, edges.tolist(), color=RECORDED, rwidth=0.9)
        axes.set_xlabel("length of a trajectory, transitions")
        axes.set_ylabel("trajectories")
        axes.locator_params(integer=True, nbins=5)
        remove_frame(axes)
        return svg_text(figure, name, description)


def draw_plan(
    marks: Marks, background: Mapping[str, NDArray[Any]], *, name: str, description: str
) -> str:
    """Draws a counterfactual as a plan, seen from above.

    Args:
        marks (mapping): for each entity its recorded and its counterfactual place,
            ``[3]`` each, and whether it was swapped.
        background (mapping of str to numpy.ndarray): places of each entity in the
            dataset, ``[P, 3]``.

    Keyword Args:
        name (str): the prefix of the ids.
        description (str): what screen readers say.

    Returns:
        str: the ``<svg>`` element.
    """
    points = np.concatenate([*background.values()])
    # The wider of the first two coordinates is horizontal.
    axis = [0, 1] if np.ptp(points[:, 0]) >= np.ptp(points[:, 1]) else [1, 0]
    with drawing():
        figure = new_figure(_WIDTH, 3.0)
        axes = figure.add_subplot()
        axes.plot(*points[:, axis].T, ".", color=MUTED, markersize=1.2, alpha=0.35)
        for number, (entity, (recorded, made, swapped)) in enumerate(marks.items()):
            before, after = recorded[axis], made[axis]
            if swapped:
                _arrow(axes, before, after)
            _dots(axes, before, after, swapped)
            axes.annotate(
                short_label(entity, 16),
                (after[0], after[1]),
                # On three sides in turn, as entities may be close.
                xytext=((0, 9), (0, -17), (10, -3))[number % 3],
                textcoords="offset points",
                ha="left" if number % 3 == 2 else "center",
                fontsize=9,
                zorder=6,
            )
        axes.set_xlabel(f"{('first', 'second')[axis[0]]} coordinate")
        axes.set_ylabel(f"{('first', 'second')[axis[1]]} coordinate")
        axes.margins(0.12)
        axes.set_aspect("equal", adjustable="datalim")
        axes.locator_params(nbins=5)
        remove_frame(axes)
        return svg_text(figure, name, description)


def draw_marks(
    marks: Marks,
    background: Mapping[str, NDArray[Any]],
    *,
    name: str,
    description: str,
) -> str:
    """Draws a counterfactual as one line for each entity, from low to high.

    Args:
        marks (mapping): for each entity its recorded and its counterfactual place,
            ``[]`` each, and whether it was swapped.
        background (mapping of str to numpy.ndarray): places of each entity in the
            dataset, ``[P]``.

    Keyword Args:
        name (str): the prefix of the ids.
        description (str): what screen readers say.

    Returns:
        str: the ``<svg>`` element.
    """
    with drawing():
        figure = new_figure(_WIDTH, 0.4 + 0.42 * len(marks))
        axes = figure.add_subplot()
        for row, (entity, (recorded, made, swapped)) in enumerate(marks.items()):
            low, high = background[entity].min(), background[entity].max()
            span = (high - low) or 1.0
            before, after = (recorded - low) / span, (made - low) / span
            axes.plot([0, 1], [row, row], color=GRID, linewidth=4, zorder=1)
            if swapped:
                axes.plot([before, after], [row, row], color=ADDED, linewidth=1.2)
            _dots(axes, (before, row), (after, row), swapped)
        axes.set_yticks(
            range(len(marks)), [short_label(entity, 18) for entity in marks]
        )
        axes.set_ylim(len(marks) - 0.5, -0.5)
        axes.set_xlim(-0.08, 1.08)
        axes.set_xticks([0, 1], ["lowest", "highest"])
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        return svg_text(figure, name, description)


def _rectangles(cells: NDArray[Any], x: NDArray[Any], y: NDArray[Any]) -> Path:
    """The outlines of cells ``[C0, C1]``, those next to each other as one."""
    from matplotlib.path import Path

    # The first entity is on the horizontal axis: a row of cells is a column here.
    corners = [
        [(x[a], y[j]), (x[b], y[j]), (x[b], y[j + 1]), (x[a], y[j + 1]), (x[a], y[j])]
        for j in range(cells.shape[1])
        for a, b in true_ranges(cells[:, j])
    ]
    codes = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    return Path(np.reshape(corners, (-1, 2)), codes * len(corners))


def _dots(axes: Axes, before: Any, after: Any, swapped: bool) -> None:
    if not swapped:
        axes.plot(*before, "o", color=RECORDED, markersize=8, zorder=3)
        return
    axes.plot(*before, "o", color=RECORDED, markersize=7, fillstyle="none", zorder=3)
    axes.plot(*after, "o", color=ADDED, markersize=8, zorder=4)
    axes.plot(*after, "o", color=INK, markersize=11, fillstyle="none", zorder=5)


def _arrow(axes: Axes, before: Any, after: Any) -> None:
    look = {
        "arrowstyle": "->",
        "color": ADDED,
        "shrinkA": 6,
        "shrinkB": 7,
        "linewidth": 1.2,
    }
    axes.annotate("", after, before, arrowprops=look)


def _compressed(values: NDArray[Any], unit: float) -> NDArray[Any]:
    return np.sign(values) * np.log1p(np.abs(values) / unit)


def _cells_label(cells: Cells, most: int) -> str:
    if cells.edges is None:
        return f"places of {short_label(cells.name, most - 10)}"
    return short_label(f"{short_label(cells.name, 18)}, {cells.labels[0]}", most)


def _whole_steps(axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))


def _powers() -> Any:
    from matplotlib.ticker import LogLocator

    return LogLocator(base=10, numticks=5)


def _nothing() -> Any:
    from matplotlib.ticker import NullLocator

    return NullLocator()
