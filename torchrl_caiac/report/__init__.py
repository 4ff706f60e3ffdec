"""A page that shows what the agent influences in a dataset, and what swaps add."""

from __future__ import annotations

from torchrl_caiac.report.pictures import RenderFn
from torchrl_caiac.report.write_report import write_report

__all__ = ["RenderFn", "write_report"]
