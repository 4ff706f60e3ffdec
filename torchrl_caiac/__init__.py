"""Causal data augmentation for offline robot learning with TorchRL."""

from __future__ import annotations

from torchrl_caiac.entities import EntityLayout

__all__ = ["EntityLayout"]
