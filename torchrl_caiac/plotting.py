"""The figures of the paper: frames (Fig. 1), success (Figs. 3, 4), influence (Fig. 6).

All functions return a :class:`matplotlib.figure.Figure` without pyplot, so no display
is needed and no figure has to be closed. Matplotlib and SciPy are imported on use.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac._extras import extra
from torchrl_caiac._figures import (
    GREY,
    NUM_COLOURS,
    colour,
    finish_results,
    name_label,
    new_figure,
    remove_frame,
    true_ranges,
)

if TYPE_CHECKING:
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


def bootstrap_interval(
    values: ArrayLike, *, confidence: float = 0.95, resamples: int = 9999, seed: int = 0
) -> tuple[float, float]:
    """Returns the percentile-bootstrap confidence interval of a mean.

    Args:
        values (array-like): ``[R]``, the results of independent runs, such as seeds or
            episodes.

    Keyword Args:
        confidence (float): the confidence level, in (0, 1). Defaults to ``0.95``.
        resamples (int): the number of bootstrap samples. Defaults to ``9999``.
        seed (int): the seed of the resampling. Defaults to ``0``.

    Returns:
        tuple of float and float: the lower and the upper end; both are the mean if all
        values are equal.

    Raises:
        ValueError: there are no values, a value is not finite, or ``confidence`` is out
            of range.

    Examples:
        >>> from torchrl_caiac.plotting import bootstrap_interval
        >>> bootstrap_interval([1.0, 1.0, 1.0])
        (1.0, 1.0)
        >>> low, high = bootstrap_interval([0.0, 1.0, 1.0, 1.0])
        >>> 0 <= low < 0.75 < high <= 1
        True
    """
    with extra("report", "bootstrap_interval"):
        from scipy.stats import bootstrap

    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or not len(array) or not np.isfinite(array).all():
        raise ValueError(
            f"values have shape {array.shape}, expected [R] with at least one value, "
            "all finite"
        )
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, expected above 0 and below 1")
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
    ground_truth: ArrayLike | None = None,
    threshold: float | None = None,
    exclude: Sequence[str] = (),
    step_seconds: float | None = None,
    title: str = "",
) -> Figure:
    """Plots the influence of the action on each entity along a demonstration.

    An entity gets a colour if its score exceeds the threshold in some row, or if it is
    in contact in some row of the ground truth. All others are grey. Rows with contact
    are shaded in the entity's colour, and shown as bars below the curves.

    Args:
        scores (array-like): ``[L, N]``, rows in the order of time. NaN leaves a gap.
        names (sequence of str): the ``N`` entities.

    Keyword Args:
        ground_truth (array-like, optional): bool ``[L, N]``, the contacts, as returned
            by :func:`~torchrl_caiac.influence.truth.true_influence`. Defaults to
            ``None``: not drawn.
        threshold (float, optional): the threshold θ, drawn as a dashed line. Defaults
            to ``None``: entities above a tenth of the highest score get a colour.
        exclude (sequence of str): entities to leave out, such as the robot. Defaults to
            ``()``.
        step_seconds (float, optional): the duration of a row, for a time axis in
            seconds. Defaults to ``None``: the axis counts steps.
        title (str): the title of the figure. Defaults to ``""``.

    Returns:
        matplotlib.figure.Figure: the figure.

    Raises:
        ValueError: a shape or a type is wrong, or ``exclude`` names an unknown entity
            or all of them.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.plotting import plot_influence
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
            f"scores have shape {values.shape}, expected [L, {len(names)}] with at "
            "least one row"
        )
    contact: NDArray[np.bool_] | None = None
    if ground_truth is not None:
        contact = np.asarray(ground_truth)
        if contact.shape != values.shape or contact.dtype != np.bool_:
            raise ValueError(
                f"ground_truth has shape {contact.shape} and dtype {contact.dtype}, "
                f"expected bool {values.shape}"
            )
    unknown = sorted(set(exclude) - set(names))
    if unknown:
        raise ValueError(f"exclude names {unknown}, expected some of {tuple(names)}")
    kept = [i for i, name in enumerate(names) if name not in exclude]
    if not kept:
        raise ValueError("exclude leaves no entity to draw")
    drawn = np.where(np.isfinite(values[:, kept]), values[:, kept], 0.0)
    top = max(float(drawn.max()), 0.0 if threshold is None else float(threshold))
    bar = 0.1 * top if threshold is None else threshold
    coloured = [
        i
        for i in kept
        if (np.nan_to_num(values[:, i], nan=-np.inf) > bar).any()
        or (contact is not None and contact[:, i].any())
    ]
    time = np.arange(len(values)) * (1.0 if step_seconds is None else step_seconds)
    pitch = time[1] if len(time) > 1 else 1.0

    bars = 0 if contact is None else len(coloured)
    figure = new_figure(7.0, 3.1 + 0.22 * bars)
    grid = figure.add_gridspec(
        2 if bars else 1, 1, height_ratios=(3.1, 0.22 * bars) if bars else (1,)
    )
    axes = figure.add_subplot(grid[0])
    colours = {i: colour(n) for n, i in enumerate(coloured)}
    for i in coloured:
        axes.plot(
            time,
            values[:, i],
            color=colours[i],
            # With more entities than colours, the second round is dashed.
            linestyle="-" if coloured.index(i) < NUM_COLOURS else "--",
            linewidth=1.8,
            label=name_label(names[i]),
            zorder=3,
        )
        for a, b in [] if contact is None else true_ranges(contact[:, i]):
            axes.axvspan(
                time[a] - pitch / 2,
                time[a] + (b - a - 0.5) * pitch,
                color=colours[i],
                alpha=0.1,
                linewidth=0,
                zorder=0,
            )
    grey = [i for i in kept if i not in coloured]
    for n, i in enumerate(grey):
        label = (
            f"{len(grey)} {'others' if coloured else 'entities'}"
            if n == 0 and len(grey) > 1
            else name_label(names[i])
        )
        axes.plot(
            time,
            values[:, i],
            color=GREY,
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
    remove_frame(axes)
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
        for row, i in enumerate(coloured):
            strip.broken_barh(
                [
                    (time[a] - pitch / 2, (b - a) * pitch)
                    for a, b in true_ranges(contact[:, i])
                ],
                (row + 0.12, 0.76),
                facecolors=colours[i],
            )
        strip.set_ylim(len(coloured), 0)
        strip.set_yticks(
            np.arange(len(coloured)) + 0.5,
            [name_label(names[i]) for i in coloured],
            fontsize=8,
        )
        strip.tick_params(left=False)
        strip.spines[["top", "right", "left"]].set_visible(False)
        strip.set_title("contact (ground truth)", fontsize=8, loc="left", pad=2)
        last = strip
    last.set_xlabel("step" if step_seconds is None else "time (s)")
    return figure


# The title, the columns (which are summed) and the axis of each panel.
_PANELS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("AUC of the influence", ("auc",), "share"),
    ("scores above θ", ("density",), "share"),
    ("counterfactual rows with a swap", ("rows_swapped",), "share"),
    ("infeasible swaps", ("infeasible",), "share"),
    ("seconds to fit and to score", ("fit_seconds", "score_seconds"), "log"),
)


def plot_comparison(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Plots a comparison of influence estimators, one panel for each measure.

    Args:
        rows (sequence of mapping): the results of
            :func:`~torchrl_caiac.evaluation.compare_influence`, with the name of the
            ``"experiment"`` in each; numbers, or the strings of a CSV file. Only the
            rows over all entities are plotted, and empty values are left out.

    Returns:
        matplotlib.figure.Figure: the figure.

    Raises:
        ValueError: there is no row over all entities.

    Examples:
        >>> from torchrl_caiac.plotting import plot_comparison
        >>> row = {"experiment": "push", "estimator": "caiac", "entity": "all"}
        >>> figure = plot_comparison([{**row, "auc": "0.9", "rows_swapped": 0.5}])
        >>> [len(axes.patches) for axes in figure.axes]
        [1, 0, 1, 0, 0]
    """
    shown = [row for row in rows if row["entity"] == "all"]
    if not shown:
        raise ValueError(
            "no row has the entity 'all': pass all rows of compare_influence"
        )
    experiments = list(dict.fromkeys(row["experiment"] for row in shown))
    estimators = list(dict.fromkeys(row["estimator"] for row in shown))
    width = 0.8 / len(estimators)
    figure = new_figure(max(10.0, 2.0 * len(experiments)), 5.0)
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
                **_fill(n),
            )
        axes.set_title(title, fontsize=9)
        labels = [textwrap.fill(name_label(e), 8) for e in experiments]
        axes.set_xticks(range(len(experiments)), labels, fontsize=8)
        if kind == "log" and axes.patches:
            axes.set_yscale("log")
        elif kind == "share":
            axes.set_ylim(0, 1.02)
        remove_frame(axes)
    from matplotlib.patches import Patch

    figure.legend(
        handles=[
            Patch(**_fill(n), label=name_label(name))
            for n, name in enumerate(estimators)
        ],
        loc="lower right",
        frameon=False,
    )
    return figure


def _fill(number: int) -> dict[str, Any]:
    """Returns the look of a bar; hatched where the colours repeat."""
    if number < NUM_COLOURS:
        return {"color": colour(number)}
    return {"facecolor": colour(number), "edgecolor": "white", "hatch": "////"}


def plot_success(
    results: Mapping[str, Mapping[str, ArrayLike]],
    *,
    confidence: float = 0.95,
    labels: Mapping[str, str] | None = None,
    ylabel: str = "success rate",
    title: str = "",
) -> Figure:
    """Plots success by task and method, with bootstrap confidence intervals.

    Args:
        results (mapping of str to mapping of str to array-like): for each method and
            task, the results ``[R]`` of independent runs: one success rate for each
            seed, or one success for each episode.

    Keyword Args:
        confidence (float): the confidence level of the intervals. Defaults to ``0.95``.
        labels (mapping of str to str, optional): labels of methods and tasks. Defaults
            to ``None``: their names.
        ylabel (str): the label of the vertical axis. Defaults to ``"success rate"``.
        title (str): the title of the figure. Defaults to ``""``.

    Returns:
        matplotlib.figure.Figure: the figure.

    Raises:
        ValueError: there are no results, or a method lacks a task.

    Examples:
        >>> from torchrl_caiac.plotting import plot_success
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
    methods = list(results)
    tasks = list(dict.fromkeys(task for method in methods for task in results[method]))
    if not methods or not tasks:
        raise ValueError("results are empty, expected {method: {task: [R] results}}")
    for method in methods:
        missing = sorted(set(tasks) - set(results[method]))
        if missing:
            raise ValueError(
                f"the results of method {method!r} lack the tasks {missing}: add them"
            )

    def label(name: str) -> str:
        return labels.get(name, name_label(name))

    width = 0.8 / len(methods)
    figure = new_figure(
        max(3.6, 1.2 + 0.62 * len(tasks) * len(methods) * 0.9 + 0.8), 3.2
    )
    axes = figure.add_subplot()
    for n, method in enumerate(methods):
        means, low, high = [], [], []
        for task in tasks:
            runs = np.asarray(results[method][task], dtype=np.float64)
            bottom, top = bootstrap_interval(runs, confidence=confidence)
            means.append(float(runs.mean()))
            low.append(means[-1] - bottom)
            high.append(top - means[-1])
        centre = np.arange(len(tasks)) + (n - (len(methods) - 1) / 2) * width
        bars = axes.bar(
            centre,
            means,
            0.9 * width,
            color=colour(n),
            label=label(method),
        )
        axes.errorbar(
            centre,
            means,
            # Rounding may leave -1e-17, which errorbar rejects.
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
    axes.set_xticks(np.arange(len(tasks)), [label(task) for task in tasks])
    axes.tick_params(axis="x", length=0)
    axes.set_ylim(0, 1.1)
    axes.set_yticks(np.linspace(0, 1, 5))
    return finish_results(
        figure, axes, methods=len(methods), ylabel=ylabel, title=title
    )


def plot_learning_curves(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    confidence: float = 0.95,
    labels: Mapping[str, str] | None = None,
    xlabel: str = "gradient steps",
    ylabel: str = "success rate",
    title: str = "",
) -> Figure:
    """Plots the mean of each method during training, with bootstrap confidence bands.

    Args:
        curves (mapping of str to tuple of array-likes): for each method, the steps
            ``[P]`` of its evaluations and their results ``[R, P]`` in independent runs.

    Keyword Args:
        confidence (float): the confidence level of the bands. Defaults to ``0.95``.
        labels (mapping of str to str, optional): labels of methods. Defaults to
            ``None``: their names.
        xlabel (str): the label of the horizontal axis. Defaults to
            ``"gradient steps"``.
        ylabel (str): the label of the vertical axis. Defaults to ``"success rate"``.
        title (str): the title of the figure. Defaults to ``""``.

    Returns:
        matplotlib.figure.Figure: the figure.

    Raises:
        ValueError: there are no curves, or a shape is wrong.

    Examples:
        >>> from torchrl_caiac.plotting import plot_learning_curves
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
        raise ValueError(
            "curves are empty, expected {method: (steps [P], values [R, P])}"
        )
    labels = labels or {}
    figure = new_figure(5.2, 3.4)
    axes = figure.add_subplot()
    for n, (method, (at, values)) in enumerate(curves.items()):
        steps = np.asarray(at, dtype=np.float64)
        runs = np.asarray(values, dtype=np.float64)
        if steps.ndim != 1 or runs.ndim != 2 or runs.shape[1:] != steps.shape:
            raise ValueError(
                f"method {method!r} has steps of shape {steps.shape} and values of "
                f"shape {runs.shape}, expected [P] and [R, P]"
            )
        bands = [bootstrap_interval(run, confidence=confidence) for run in runs.T]
        axes.plot(
            steps,
            runs.mean(0),
            color=colour(n),
            linewidth=1.8,
            marker="o",
            markersize=3,
            label=labels.get(method, name_label(method)),
            zorder=3,
        )
        low, high = np.reshape(bands, (-1, 2)).T
        axes.fill_between(steps, low, high, color=colour(n), alpha=0.15, linewidth=0)
    axes.set_xlabel(xlabel)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    return finish_results(figure, axes, methods=len(curves), ylabel=ylabel, title=title)


def plot_frames(
    frames: ArrayLike | Sequence[Any],
    titles: Sequence[str] | None = None,
    *,
    columns: int | None = None,
    title: str = "",
) -> Figure:
    """Plots frames next to each other, such as a demonstration and counterfactuals.

    Args:
        frames (array-like): RGB images ``[F, H, W, 3]``, uint8, or floats in [0, 1].
        titles (sequence of str, optional): the title of each frame. Defaults to
            ``None``: no titles.

    Keyword Args:
        columns (int, optional): the number of frames in a row. Defaults to ``None``:
            all in one row.
        title (str): the title of the figure. Defaults to ``""``.

    Returns:
        matplotlib.figure.Figure: the figure.

    Raises:
        ValueError: there are no frames, or a shape or a number is wrong.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.plotting import plot_frames
        >>> figure = plot_frames(np.zeros((3, 24, 32, 3), np.uint8), ["a", "b", "c"])
        >>> [axes.get_title() for axes in figure.axes]
        ['a', 'b', 'c']
    """
    images = [np.asarray(frame) for frame in frames]  # type: ignore[union-attr]
    if not images:
        raise ValueError("frames are empty, expected at least one image")
    for i, image in enumerate(images):
        if image.ndim != 3 or image.shape[-1] != 3:
            raise ValueError(f"frame {i} has shape {image.shape}, expected [H, W, 3]")
    if titles is not None and len(titles) != len(images):
        raise ValueError(f"{len(titles)} titles for {len(images)} frames")
    if columns is not None and columns < 1:
        raise ValueError(f"columns is {columns}, expected at least 1")
    columns = min(columns or len(images), len(images))
    rows = -(-len(images) // columns)
    height, width = images[0].shape[:2]
    scale = 2.3 if columns > 2 else 3.2  # inches for each frame
    head = 0.22 if titles is not None else 0.0
    figure = new_figure(
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
