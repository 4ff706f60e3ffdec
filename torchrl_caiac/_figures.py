"""Sizes, colours, labels and legends of the package's figures."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from torchrl_caiac._extras import extra

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

__all__ = [
    "GREY",
    "NUM_COLOURS",
    "colour",
    "finish_results",
    "name_label",
    "new_figure",
    "remove_frame",
    "true_ranges",
]

# The palette of Okabe and Ito, safe for colour-blind readers, without its yellow.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#333333")
NUM_COLOURS = len(_COLOURS)
GREY = "#BBBBBB"


def colour(number: int) -> str:
    """Returns a colour of the palette, which repeats after ``NUM_COLOURS``.

    Args:
        number (int): the position of a method, an entity or an estimator.

    Returns:
        str: the colour.

    Examples:
        >>> from torchrl_caiac._figures import colour
        >>> colour(0), colour(7)
        ('#0072B2', '#0072B2')
    """
    return _COLOURS[number % NUM_COLOURS]


def new_figure(width: float, height: float, pad: float = 0.04) -> Figure:
    """Creates an empty figure without pyplot.

    Pyplot has global state and needs figures to be closed.

    Args:
        width (float): the width in inches.
        height (float): the height in inches.
        pad (float): the margin in inches. Defaults to ``0.04``.

    Returns:
        matplotlib.figure.Figure: the figure.

    Examples:
        >>> from torchrl_caiac._figures import new_figure
        >>> float(new_figure(4.0, 3.0).get_figwidth())
        4.0
    """
    with extra("report", "a figure"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=pad, h_pad=pad, wspace=0.01, hspace=0.02)
    figure = Figure(figsize=(width, height), dpi=150, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def remove_frame(axes: Axes) -> None:
    """Removes the upper and the right border of axes.

    Args:
        axes (matplotlib.axes.Axes): the axes.

    Examples:
        >>> from torchrl_caiac._figures import new_figure, remove_frame
        >>> remove_frame(new_figure(4.0, 3.0).add_subplot())
    """
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_axisbelow(True)


def name_label(name: str) -> str:
    """Returns a name as text for readers.

    Args:
        name (str): the name.

    Returns:
        str: the text.

    Examples:
        >>> from torchrl_caiac._figures import name_label
        >>> name_label("slide_cabinet")
        'slide cabinet'
    """
    return name.replace("_", " ")


def true_ranges(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Returns the half-open ranges in which a mask is true.

    Args:
        mask (numpy.ndarray): bool ``[L]``.

    Returns:
        list of tuple of int: the first place of each range and the one after its last.

    Examples:
        >>> import numpy as np

    from torchrl_caiac._extras import extra
        >>> from torchrl_caiac._figures import true_ranges
        >>> true_ranges(np.array([True, True, False, True]))
        [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False].astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def finish_results(
    figure: Figure, axes: Axes, *, methods: int, ylabel: str, title: str
) -> Figure:
    """Adds the grid, the legend and the title to a figure of results.

    Args:
        figure (matplotlib.figure.Figure): the figure.
        axes (matplotlib.axes.Axes): its axes.

    Keyword Args:
        methods (int): the number of methods in the legend.
        ylabel (str): the label of the vertical axis.
        title (str): the title, ``""`` for none.

    Returns:
        matplotlib.figure.Figure: the same figure.

    Examples:
        >>> from torchrl_caiac._figures import finish_results, new_figure
        >>> figure = new_figure(4.0, 3.0)
        >>> axes = figure.add_subplot()
        >>> _ = axes.plot([0.0, 1.0], label="caiac")
        >>> _ = finish_results(figure, axes, methods=1, ylabel="success", title="")
    """
    remove_frame(axes)
    axes.set_ylabel(ylabel)
    axes.grid(axis="y", color="#E5E5E5", linewidth=0.8)
    for columns in range(min(methods, 4), 0, -1):  # as many as the width allows
        legend = figure.legend(
            loc="outside lower center", ncols=columns, frameon=False, fontsize=9
        )
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()
    if title:
        letters = int(9 * figure.get_figwidth())  # that fit into a line
        axes.set_title(textwrap.fill(title, letters), fontsize=11, loc="left")
    return figure
