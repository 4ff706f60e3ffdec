"""No augmentation."""

from __future__ import annotations

from typing import Any

from torchrl.envs import Transform

from methods.base import Method
from torchrl_caiac import EntityLayout

__all__ = ["NoAugmentation"]


class NoAugmentation(Method):
    """Learns from the data as they are."""

    label = "without counterfactuals"

    def transform(
        self, layout: EntityLayout, counterfactual_ratio: float = 0.5, **options: Any
    ) -> Transform | None:
        """Returns no transform."""
        return None
