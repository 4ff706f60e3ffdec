"""The order of the tutorials, and their figures that pyplot does not know."""

from __future__ import annotations

import weakref
from typing import Any

from matplotlib import pyplot
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

_ORDER = (
    "first_counterfactuals",
    "own_dataset",
    "thresholds",
    "kitchen_skills",
    "fetch_push_cloning",
    "own_parts",
    "online",
    "past_one_machine",
)
_SEEN: weakref.WeakSet[Figure] = weakref.WeakSet()


def tutorial_order(file: str) -> int:
    """Returns the place of a tutorial in the gallery."""
    return _ORDER.index(file.removeprefix("plot_").removesuffix(".py"))


def save_figures(
    block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]
) -> str:
    """Saves the new figures of a code block (an image scraper of sphinx-gallery)."""
    # The scraper of sphinx-gallery saves pyplot's own figures.
    _SEEN.update(pyplot.figure(number) for number in pyplot.get_fignums())
    paths = []
    for value in block_vars["example_globals"].values():
        if isinstance(value, Figure) and value not in _SEEN:
            _SEEN.add(value)
            paths.append(next(block_vars["image_path_iterator"]))
            value.savefig(paths[-1], dpi=110)
    return figure_rst(paths, gallery_conf["src_dir"])
