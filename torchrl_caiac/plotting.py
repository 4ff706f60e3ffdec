"""The paper's figures: frames (Fig. 1), success (Figs. 3, 4), influence (Fig. 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

__all__ = [
    "bootstrap_interval",
    "plot_comparison",
    "plot_frames",
    "plot_influence",
    "plot_learning_curves",
    "plot_success",
]

# Okabe and Ito's colours, told apart by colour-blind readers too; yellow left out.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#333333")
_QUIET = "#BBBBBB"


def _figure(width: float, height: float, pad: float = 0.04) -> Figure:
    # Not pyplot: no global state, no display, nothing to close.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=pad, h_pad=pad, wspace=0.01, hspace=0.02)
    figure = Figure(figsize=(width, height), dpi=150, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_axisbelow(True)


def _label(name: str) -> str:
    return name.replace("_", " ")


def bootstrap_interval(
    values: ArrayLike, *, confidence: float = 0.95, resamples: int = 9999, seed: int = 0
) -> tuple[float, float]:
    """Return the percentile-bootstrap confidence interval of a mean.

    Args:
        values: ``[R]`` results of independent runs (seeds, or episodes).

    Keyword Args:
        confidence: level, in (0, 1).
        resamples: how many.
        seed: of the resampling.

    Returns:
        lower and upper end; both the mean where all values are equal, and for a single
        value.

    Example:
        >>> bootstrap_interval([1.0, 1.0, 1.0])
        (1.0, 1.0)
        >>> low, high = bootstrap_interval([0.0, 1.0, 1.0, 1.0])
        >>> 0 <= low < 0.75 < high <= 1
        True
    """
    from scipy.stats import bootstrap

    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or not len(array) or not np.isfinite(array).all():
        raise ValueError(
            f"values have shape {array.shape}, wanted [R] with at least one value, all "
            "finite"
        )
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, wanted between 0 and 1")
    if np.ptp(array) == 0:
        return float(array[0]), float(array[0])
    interval = bootstrap(
        (array,),
        np.mean,
        confidence_level=confidence,
        n_resamples=resamples,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def plot_influence(
    scores: ArrayLike,
    names: Sequence[str],
    *,
    truth: ArrayLike | None = None,
    threshold: float | None = None,
    exclude: Sequence[str] = (),
    step_seconds: float | None = None,
    title: str = "",
) -> Figure:
    """Draw the influence of the action on every entity along a demonstration (Fig. 6).

    An entity is drawn in colour if its score passes the threshold somewhere, or if the
    truth has contact with it; the others are one grey bundle. True contacts are shaded
    in the entity's colour, with bars under the curves.

    Args:
        scores: ``[L, N]``, rows in time order; NaN leaves a gap.
        names: the ``N`` entities.

    Keyword Args:
        truth: bool ``[L, N]``, of
            :func:`~torchrl_caiac.influence.truth.true_influence`.
        threshold: θ, drawn as a dashed line. Without it the highlighted entities are
            those above a tenth of the highest score.
        exclude: entities left out, the robot say.
        step_seconds: seconds a row, for a time axis in seconds instead of steps.
        title: of the figure.

    Returns:
        the figure; ``figure.savefig(path)`` writes it.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> figure = plot_influence(
        ...     rng.random((40, 2)), ["kettle", "microwave"], threshold=0.3
        ... )
        >>> len(figure.axes)
        1
    """
    values = np.asarray(scores, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != len(names) or not len(values):
        raise ValueError(
            f"scores have shape {values.shape}, wanted [L, {len(names)}] with a row at "
            "least"
        )
    contact: NDArray[np.bool_] | None = None
    if truth is not None:
        contact = np.asarray(truth)
        if contact.shape != values.shape or contact.dtype != np.bool_:
            raise ValueError(
                f"truth has shape {contact.shape} and dtype {contact.dtype}, wanted "
                f"bool {values.shape}"
            )
    unknown = sorted(set(exclude) - set(names))
    if unknown:
        raise ValueError(f"exclude names {unknown}, wanted among {tuple(names)}")
    kept = [i for i, name in enumerate(names) if name not in exclude]
    if not kept:
        raise ValueError("exclude leaves no entity to draw")
    drawn = np.where(np.isfinite(values[:, kept]), values[:, kept], 0.0)
    top = max(float(drawn.max()), 0.0 if threshold is None else float(threshold))
    bar = 0.1 * top if threshold is None else threshold
    loud = [
        i
        for i in kept
        if (np.nan_to_num(values[:, i], nan=-np.inf) > bar).any()
        or (contact is not None and contact[:, i].any())
    ]
    time = np.arange(len(values)) * (1.0 if step_seconds is None else step_seconds)
    pitch = time[1] if len(time) > 1 else 1.0

    bars = 0 if contact is None else len(loud)
    figure = _figure(7.0, 3.1 + 0.22 * bars)
    grid = figure.add_gridspec(
        2 if bars else 1, 1, height_ratios=(3.1, 0.22 * bars) if bars else (1,)
    )
    axes = figure.add_subplot(grid[0])
    colours = {i: _COLOURS[n % len(_COLOURS)] for n, i in enumerate(loud)}
    for i in loud:
        axes.plot(
            time,
            values[:, i],
            color=colours[i],
            # More entities than colours: the second round is dashed.
            linestyle="-" if loud.index(i) < len(_COLOURS) else "--",
            linewidth=1.8,
            label=_label(names[i]),
            zorder=3,
        )
        for a, b in [] if contact is None else _runs(contact[:, i]):
            axes.axvspan(
                time[a] - pitch / 2,
                time[a] + (b - a - 0.5) * pitch,
                color=colours[i],
                alpha=0.1,
                linewidth=0,
                zorder=0,
            )
    quiet = [i for i in kept if i not in loud]
    for n, i in enumerate(quiet):
        label = (
            f"{len(quiet)} {'others' if loud else 'entities'}"
            if n == 0 and len(quiet) > 1
            else _label(names[i])
        )
        axes.plot(
            time,
            values[:, i],
            color=_QUIET,
            linewidth=1,
            label=label if n == 0 else "_",
            zorder=1,
        )
    if threshold is not None:
        axes.axhline(
            threshold,
            color="black",
            linestyle=(0, (4, 3)),
            linewidth=1,
            label=f"θ = {threshold:g}",
            zorder=2,
        )
    _plain(axes)
    axes.set_ylabel("influence score")
    axes.set_xlim(time[0], max(time[-1], pitch))
    axes.set_ylim(min(0.0, float(drawn.min())), 1.05 * top if top > 0 else 1.0)
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    if title:
        axes.set_title(title, fontsize=11, loc="left")
    last = axes
    if bars and contact is not None:
        axes.tick_params(labelbottom=False)
        strip = figure.add_subplot(grid[1], sharex=axes)
        for row, i in enumerate(loud):
            strip.broken_barh(
                [
                    (time[a] - pitch / 2, (b - a) * pitch)
                    for a, b in _runs(contact[:, i])
                ],
                (row + 0.12, 0.76),
                facecolors=colours[i],
            )
        strip.set_ylim(len(loud), 0)
        strip.set_yticks(
            np.arange(len(loud)) + 0.5, [_label(names[i]) for i in loud], fontsize=8
        )
        strip.tick_params(left=False)
        strip.spines[["top", "right", "left"]].set_visible(False)
        strip.set_title("true contact", fontsize=8, loc="left", pad=2)
        last = strip
    last.set_xlabel("step" if step_seconds is None else "time (s)")
    return figure


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the half-open ranges in which a mask is true."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False].astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


# Title, column (or columns to add up) and axis of each panel of plot_comparison.
_PANELS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("AUC of the action's influence", ("auc",), "share"),
    ("links above θ", ("density",), "share"),
    ("counterfactual rows with a swap", ("rows_swapped",), "share"),
    ("infeasible swaps", ("infeasible",), "share"),
    ("seconds to fit and to score", ("fit_seconds", "score_seconds"), "log"),
)


def plot_comparison(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw how influence estimators compare, one panel a measure.

    Args:
        rows: of :func:`~torchrl_caiac.evaluation.compare_influence`, with the name of
            the ``"experiment"`` in each; as numbers, or as strings of a CSV file. Only
            those over all entities are drawn; what is empty is left out.

    Returns:
        the figure.

    Raises:
        ValueError: there is no row over all entities.

    Example:
        >>> row = {"experiment": "push", "estimator": "caiac", "entity": "all"}
        >>> figure = plot_comparison([{**row, "auc": "0.9", "rows_swapped": 0.5}])
        >>> [len(axes.patches) for axes in figure.axes]
        [1, 0, 1, 0, 0]
    """
    shown = [row for row in rows if row["entity"] == "all"]
    if not shown:
        raise ValueError("rows hold none over all entities: there is nothing to draw")
    experiments = list(dict.fromkeys(row["experiment"] for row in shown))
    estimators = list(dict.fromkeys(row["estimator"] for row in shown))
    width = 0.8 / len(estimators)
    figure = _figure(10.0, 5.0)
    grid = figure.subplots(2, 3).ravel()
    grid[-1].remove()
    for axes, (title, columns, kind) in zip(grid, _PANELS, strict=False):
        for row in shown:
            values = [row.get(c) for c in columns]
            known = [float(v) for v in values if v not in (None, "")]
            height = sum(v for v in known if np.isfinite(v))
            if not known or (kind == "log" and not height > 0):
                continue
            n = estimators.index(row["estimator"])
            place = experiments.index(row["experiment"])
            axes.bar(
                place + (n - (len(estimators) - 1) / 2) * width,
                height,
                0.9 * width,
                color=_COLOURS[n % len(_COLOURS)],
            )
        axes.set_title(title, fontsize=9)
        labels = [_label(e) for e in experiments]
        axes.set_xticks(range(len(experiments)), labels, fontsize=8)
        if kind == "log" and axes.patches:
            axes.set_yscale("log")
        elif kind == "share":
            axes.set_ylim(0, 1.02)
        _plain(axes)
    from matplotlib.patches import Patch

    figure.legend(
        handles=[
            Patch(color=_COLOURS[n % len(_COLOURS)], label=_label(name))
            for n, name in enumerate(estimators)
        ],
        loc="lower right",
        frameon=False,
    )
    return figure


def plot_success(
    results: Mapping[str, Mapping[str, ArrayLike]],
    *,
    confidence: float = 0.95,
    labels: Mapping[str, str] | None = None,
    ylabel: str = "success rate",
    title: str = "",
) -> Figure:
    """Draw success per task and arm, with bootstrap confidence intervals (Fig. 3).

    Args:
        results: arm to task to the results ``[R]`` of independent runs (one success
            rate a seed, or one success an episode).

    Keyword Args:
        confidence: level of the intervals.
        labels: what to write for an arm or a task instead of its name.
        ylabel: of the vertical axis.
        title: of the figure.

    Returns:
        the figure.

    Example:
        >>> figure = plot_success(
        ...     {
        ...         "none": {"kettle": [1.0, 0.9], "microwave": [0.0, 0.05]},
        ...         "caiac": {"kettle": [1.0, 1.0], "microwave": [0.9, 1.0]},
        ...     }
        ... )
        >>> [round(float(bar.get_height()), 3) for bar in figure.axes[0].containers[0]]
        [0.95, 0.025]
    """
    labels = labels or {}
    arms = list(results)
    tasks = list(dict.fromkeys(task for arm in arms for task in results[arm]))
    if not arms or not tasks:
        raise ValueError("results are empty, wanted {arm: {task: [R] results}}")
    for arm in arms:
        missing = sorted(set(tasks) - set(results[arm]))
        if missing:
            raise ValueError(f"the results of arm {arm!r} lack the tasks {missing}")

    def label(name: str) -> str:
        return labels.get(name, _label(name))

    width = 0.8 / len(arms)
    figure = _figure(max(3.6, 1.2 + 0.62 * len(tasks) * len(arms) * 0.9 + 0.8), 3.2)
    axes = figure.add_subplot()
    for n, arm in enumerate(arms):
        means, low, high = [], [], []
        for task in tasks:
            runs = np.asarray(results[arm][task], dtype=np.float64)
            bottom, top = bootstrap_interval(runs, confidence=confidence)
            means.append(float(runs.mean()))
            low.append(means[-1] - bottom)
            high.append(top - means[-1])
        centre = np.arange(len(tasks)) + (n - (len(arms) - 1) / 2) * width
        bars = axes.bar(
            centre,
            means,
            0.9 * width,
            color=_COLOURS[n % len(_COLOURS)],
            label=label(arm),
        )
        axes.errorbar(
            centre,
            means,
            # Rounding may leave -1e-17, which errorbar refuses.
            yerr=np.maximum([low, high], 0),
            fmt="none",
            ecolor="#222222",
            elinewidth=1.2,
            capsize=3,
        )
        for bar, mean, above in zip(bars, means, high, strict=True):
            axes.annotate(
                f"{mean:.2f}",
                (bar.get_x() + bar.get_width() / 2, mean + above),
                xytext=(0, 3),
                textcoords="offset points",
                ha="center",
                fontsize=8,
            )
    _plain(axes)
    axes.set_xticks(np.arange(len(tasks)), [label(task) for task in tasks])
    axes.tick_params(axis="x", length=0)
    axes.set_ylabel(ylabel)
    axes.set_ylim(0, 1.1)
    axes.set_yticks(np.linspace(0, 1, 5))
    axes.grid(axis="y", color="#E5E5E5", linewidth=0.8)
    figure.legend(
        loc="outside lower center", ncols=min(len(arms), 4), frameon=False, fontsize=9
    )
    if title:
        axes.set_title(title, fontsize=11, loc="left")
    return figure


def plot_learning_curves(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    confidence: float = 0.95,
    labels: Mapping[str, str] | None = None,
    xlabel: str = "gradient steps",
    ylabel: str = "success rate",
    title: str = "",
) -> Figure:
    """Draw each arm's mean along training, with bootstrap confidence bands.

    Args:
        curves: arm to the steps ``[P]`` of its measurements and their values
            ``[R, P]`` in independent runs.

    Keyword Args:
        confidence: level of the bands.
        labels: what to write for an arm instead of its name.
        xlabel: of the horizontal axis.
        ylabel: of the vertical axis.
        title: of the figure.

    Returns:
        the figure.

    Example:
        >>> figure = plot_learning_curves(
        ...     {
        ...         "none": ([1000, 2000], [[0.0, 0.1], [0.0, 0.2]]),
        ...         "caiac": ([1000, 2000], [[0.1, 0.4], [0.2, 0.5]]),
        ...     }
        ... )
        >>> figure.axes[0].lines[1].get_ydata().round(3).tolist()
        [0.15, 0.45]
    """
    if not curves:
        raise ValueError("curves are empty, wanted {arm: (steps [P], values [R, P])}")
    labels = labels or {}
    figure = _figure(5.2, 3.4)
    axes = figure.add_subplot()
    for n, (arm, (at, values)) in enumerate(curves.items()):
        steps = np.asarray(at, dtype=np.float64)
        runs = np.asarray(values, dtype=np.float64)
        if steps.ndim != 1 or runs.ndim != 2 or runs.shape[1:] != steps.shape:
            raise ValueError(
                f"arm {arm!r} has steps of shape {steps.shape} and values of shape "
                f"{runs.shape}, wanted [P] and [R, P]"
            )
        bands = [bootstrap_interval(run, confidence=confidence) for run in runs.T]
        colour = _COLOURS[n % len(_COLOURS)]
        axes.plot(
            steps,
            runs.mean(0),
            color=colour,
            linewidth=1.8,
            marker="o",
            markersize=3,
            label=labels.get(arm, _label(arm)),
            zorder=3,
        )
        low, high = np.reshape(bands, (-1, 2)).T
        axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
    _plain(axes)
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.grid(axis="y", color="#E5E5E5", linewidth=0.8)
    figure.legend(
        loc="outside lower center", ncols=min(len(curves), 4), frameon=False, fontsize=9
    )
    if title:
        axes.set_title(title, fontsize=11, loc="left")
    return figure


def plot_frames(
    frames: ArrayLike | Sequence[Any],
    titles: Sequence[str] | None = None,
    *,
    columns: int | None = None,
    title: str = "",
) -> Figure:
    """Draw frames side by side (Fig. 1: a demonstration beside its counterfactuals).

    Args:
        frames: RGB images ``[F, H, W, 3]``, uint8, or floats in [0, 1].
        titles: one a frame.

    Keyword Args:
        columns: frames a line; all in one line by default.
        title: of the figure.

    Returns:
        the figure.

    Example:
        >>> figure = plot_frames(np.zeros((3, 24, 32, 3), np.uint8), ["a", "b", "c"])
        >>> [axes.get_title() for axes in figure.axes]
        ['a', 'b', 'c']
    """
    images = [np.asarray(frame) for frame in frames]  # type: ignore[union-attr]
    if not images:
        raise ValueError("frames are empty")
    for i, image in enumerate(images):
        if image.ndim != 3 or image.shape[-1] != 3:
            raise ValueError(f"frame {i} has shape {image.shape}, wanted [H, W, 3]")
    if titles is not None and len(titles) != len(images):
        raise ValueError(f"{len(titles)} titles for {len(images)} frames")
    if columns is not None and columns < 1:
        raise ValueError(f"columns is {columns}, wanted at least 1")
    columns = min(columns or len(images), len(images))
    rows = -(-len(images) // columns)
    height, width = images[0].shape[:2]
    scale = 2.3 if columns > 2 else 3.2  # inches a frame
    head = 0.22 if titles is not None else 0.0
    figure = _figure(
        scale * columns,
        rows * (scale * height / width + head) + (0.25 if title else 0.0),
        pad=0.02,
    )
    for i, image in enumerate(images):
        axes = figure.add_subplot(rows, columns, i + 1)
        axes.imshow(image)
        axes.set_axis_off()
        if titles is not None:
            axes.set_title(titles[i], fontsize=9)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure
