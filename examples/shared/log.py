"""The log of a training run, which is the same if the run was interrupted."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.record.loggers import get_logger

from torchrl_caiac._files import whole_file

__all__ = ["ScalarLog"]


class ScalarLog:
    """Logs the mean of each scalar over some steps.

    It is a part of the run's checkpoint. After :meth:`resume`, the CSV files are those
    of a run that was not interrupted. Other loggers keep what they have; they show the
    repeated steps twice.

    Args:
        kind (str): the logger, ``"csv"``, ``"tensorboard"`` or ``"wandb"``.
        folder (path): of the run; the log is in ``<folder>/log``.
    """

    def __init__(self, kind: str, folder: str | os.PathLike[str]) -> None:
        self.kind = kind
        self.folder = Path(folder)
        self._sums: dict[str, torch.Tensor] = {}
        self._count = 0
        self._logger: Any = None

    def resume(self, step: int) -> None:
        """Removes what was logged after a step, to which the run has gone back."""
        for file in (self.folder / "log" / "scalars").rglob("*.csv"):
            with file.open(newline="") as stream:
                rows = list(csv.reader(stream))
            kept = [row for row in rows if _step(row) <= step]
            if len(kept) == len(rows):
                continue
            with whole_file(file) as partial, partial.open("w", newline="") as stream:
                csv.writer(stream, lineterminator="\n").writerows(kept)

    def add(self, scalars: Mapping[str, torch.Tensor]) -> None:
        """Adds the scalars of a step."""
        for name, value in scalars.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1

    def write(self, step: int) -> None:
        """Logs the means since the last call."""
        if self._logger is None:
            self._logger = get_logger(self.kind, str(self.folder), "log")
        for name, value in self._sums.items():
            self._logger.log_scalar(name, value.item() / self._count, step=step)
        self._sums, self._count = {}, 0

    def state_dict(self) -> dict[str, Any]:
        """Returns the sums since the last log."""
        return {"sums": dict(self._sums), "count": self._count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores the output of :meth:`state_dict`."""
        self._sums, self._count = dict(state["sums"]), state["count"]


def _step(row: list[str]) -> float:
    """Returns the step of a line, infinity for half a line of a killed run."""
    return int(row[0]) if len(row) == 2 and row[0].isdigit() else float("inf")
