"""Figures of torchrl_caiac.plotting in the tutorials: pyplot does not know of them."""

from __future__ import annotations

import weakref
from typing import Any

from matplotlib import pyplot
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

_SEEN: weakref.WeakSet[Figure] = weakref.WeakSet()


def save_figures(
    block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]
) -> str:
    """Saves what a block has made, for sphinx-gallery to show (an image scraper)."""
    # Pyplot's own figures are left to the scraper of sphinx-gallery.
    _SEEN.update(pyplot.figure(number) for number in pyplot.get_fignums())
    paths = []
    for value in block_vars["example_globals"].values():
        if isinstance(value, Figure) and value not in _SEEN:
            _SEEN.add(value)
            paths.append(next(block_vars["image_path_iterator"]))
            value.savefig(paths[-1], dpi=110)
    return figure_rst(paths, gallery_conf["src_dir"])
