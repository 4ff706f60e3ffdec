"""The goals and rewards of CAIAC's counterfactuals, without any swap."""

from __future__ import annotations

from typing import Any

from torchrl.envs import Transform

from methods.caiac import CAIAC
from torchrl_caiac import EntityLayout

__all__ = ["RelabelOnly"]


class RelabelOnly(CAIAC):
    """Separates the effect of the swap from that of relabelling."""

    label = "relabelling alone"

    def transform(
        self, layout: EntityLayout, counterfactual_ratio: float = 0.5, **options: Any
    ) -> Transform | None:
        """Returns CAIAC's transform, which flags transitions and swaps nothing."""
        options["swap_prob"] = 0.0
        return super().transform(layout, counterfactual_ratio, **options)
