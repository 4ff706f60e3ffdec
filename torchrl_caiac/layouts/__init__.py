"""Ready layouts of well-known benchmarks."""

from __future__ import annotations

from torchrl_caiac.layouts.matching import matching_layouts
from torchrl_caiac.layouts.ready import layout_names, layout_notes, ready_layout

__all__ = ["layout_names", "layout_notes", "matching_layouts", "ready_layout"]
