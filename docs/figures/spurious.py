"""The figure of the concept page: which combinations the demonstrations show.

``python docs/figures/spurious.py docs/images/spurious_correlation.png``
"""

from __future__ import annotations

import sys

from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

BLUE, ORANGE = "#0072B2", "#D55E00"  # Okabe and Ito


def draw() -> Figure:
    figure = Figure(figsize=(8, 3.6), dpi=200)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, 8), ylim=(0, 3.6))
    axes.set_axis_off()
    columns = {"cabinet open": 2.0, "cabinet closed": 5.1}
    rows = {"open the\nmicrowave": 1.85, "push the\nkettle": 0.3}
    for text, x in columns.items():
        axes.text(x + 1.35, 3.3, text, ha="center", va="center", size=13)
    for text, y in rows.items():
        axes.text(0.95, y + 0.6, text, ha="center", va="center", size=13)
    recorded = {
        ("cabinet open", "open the\nmicrowave"),
        ("cabinet closed", "push the\nkettle"),
    }
    for column, x in columns.items():
        for row, y in rows.items():
            shown = (column, row) in recorded
            colour = BLUE if shown else ORANGE
            axes.add_patch(
                FancyBboxPatch(
                    (x, y),
                    2.7,
                    1.2,
                    boxstyle="round,pad=0,rounding_size=0.1",
                    facecolor=f"{colour}22",
                    edgecolor=colour,
                    linewidth=2,
                    linestyle="-" if shown else (0, (4, 2)),
                )
            )
            text = "recorded" if shown else "counterfactual:\ncabinet swapped"
            axes.text(
                x + 1.35, y + 0.6, text, ha="center", va="center", size=13, color=colour
            )
    for (x0, x1), y in (((4.7, 5.1), 2.45), ((5.1, 4.7), 0.9)):
        axes.add_patch(
            FancyArrowPatch(
                (x0, y), (x1, y), arrowstyle="-|>", mutation_scale=18, color="#333"
            )
        )
    return figure


if __name__ == "__main__":
    draw().savefig(sys.argv[1])
