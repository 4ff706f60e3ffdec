"""Causal data augmentation for offline robot learning with TorchRL."""

from __future__ import annotations

import importlib.metadata

from torchrl_caiac.check import check_dataset
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms import CAIACTransform, CoDATransform

__all__ = ["CAIACTransform", "CoDATransform", "EntityLayout", "check_dataset"]

try:
    __version__ = importlib.metadata.version("torchrl-caiac")
except importlib.metadata.PackageNotFoundError:  # imported from a folder
    __version__ = "0+unknown"
