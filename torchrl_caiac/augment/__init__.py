"""Augmented datasets as files, for people who train with other libraries."""

from __future__ import annotations

from torchrl_caiac.augment.dataset import augment_dataset, needs_reward
from torchrl_caiac.augment.export import export_hdf5, export_npz
from torchrl_caiac.augment.rewards import SparseReward, find_sparse_reward

__all__ = [
    "SparseReward",
    "augment_dataset",
    "export_hdf5",
    "export_npz",
    "find_sparse_reward",
    "needs_reward",
]
