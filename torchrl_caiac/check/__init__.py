"""Checks that a dataset fits its layout and the steps that read it."""

from __future__ import annotations

from torchrl_caiac.check.dataset import check_before_use, check_dataset
from torchrl_caiac.check.report import DatasetError, DatasetReport, Finding

__all__ = [
    "DatasetError",
    "DatasetReport",
    "Finding",
    "check_before_use",
    "check_dataset",
]
