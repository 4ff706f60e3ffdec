"""The table of results of a study: one row for each evaluation, task and measure."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock

from shared.studies import Run
from torchrl_caiac._files import whole_file

__all__ = [
    "COLUMNS",
    "add_rows",
    "read_rows",
    "remove_runs",
    "run_key",
    "state_of",
    "unlisted",
]

COLUMNS = (
    *("setting", "learner", "method", "seed", "step", "split", "task", "measure"),
    *("episodes", "value", "train_seconds", "evaluate_seconds", "commit", "settings"),
)
_KEY = COLUMNS[:8]  # no two rows have the same
_NUMBERS = ("seed", "step", "episodes", "value", "train_seconds", "evaluate_seconds")

Row = dict[str, str]
State = Literal["missing", "stale", "done"]


def read_rows(path: str | os.PathLike[str]) -> list[Row]:
    """Returns the rows of a table of results, none if there is no file.

    Raises:
        ValueError: the file has other columns, or a row is damaged.
    """
    path = Path(path)
    if not path.exists():
        return []
    remedy = "restore it from the repository, or delete it to repeat the runs"
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(
                f"{path} has the columns {reader.fieldnames}, expected "
                f"{list(COLUMNS)}: {remedy}"
            )
        rows = list(reader)
    seen: set[tuple[str, ...]] = set()
    for number, row in enumerate(rows, 2):
        if None in row or None in row.values() or not _has_numbers(row):
            raise ValueError(f"{path}, line {number}, is damaged ({row}): {remedy}")
        key = tuple(row[name] for name in _KEY)
        if key in seen:
            raise ValueError(f"{path}, line {number}, repeats an evaluation: {remedy}")
        seen.add(key)
    return rows


def _has_numbers(row: Mapping[str, str]) -> bool:
    try:
        return all(math.isfinite(float(row[name])) for name in _NUMBERS)
    except ValueError:
        return False


def add_rows(path: str | os.PathLike[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Adds rows to a table of results, which several processes may do at once.

    The file is replaced as a whole: a process that is killed leaves the old or the new
    one. A row of the same evaluation, task and measure is replaced.

    Raises:
        ValueError: a value is not a finite number; nothing is written.
    """
    new = {}
    for row in ({name: _cell(row[name]) for name in COLUMNS} for row in rows):
        if not _has_numbers(row):
            raise ValueError(f"a result has no finite number in {_NUMBERS}: {row}")
        new[tuple(row[name] for name in _KEY)] = row
    with _changed(path) as kept:
        kept[:] = [r for r in kept if tuple(r[name] for name in _KEY) not in new]
        kept += new.values()


def remove_runs(path: str | os.PathLike[str], keys: Iterable[Sequence[str]]) -> None:
    """Removes all rows of some runs from a table of results."""
    gone = set(map(tuple, keys))
    with _changed(path) as kept:
        kept[:] = [row for row in kept if run_key(row) not in gone]


@contextmanager
def _changed(path: str | os.PathLike[str]) -> Iterator[list[Row]]:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock")):
        rows = read_rows(path)
        yield rows
        with whole_file(path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def run_key(row: Mapping[str, str]) -> tuple[str, ...]:
    """Returns the cells that identify the run of a row, as :attr:`Run.key`."""
    return tuple(row[name] for name in COLUMNS[:4])


def state_of(run: Run, rows: Iterable[Mapping[str, str]]) -> State:
    """Returns what a table has of a run.

    ``"done"``: its test; ``"stale"``: something that was made with other settings;
    ``"missing"``: less than the test.
    """
    mine = [row for row in rows if run_key(row) == run.key]
    if any(row["settings"] != run.digest for row in mine):
        return "stale"
    return "done" if any(row["split"] == "test" for row in mine) else "missing"


def unlisted(
    runs: Iterable[Run], rows: Iterable[Mapping[str, str]]
) -> list[tuple[str, ...]]:
    """Returns the keys of runs that a table has but the study has not."""
    known = {run.key for run in runs}
    return sorted({run_key(row) for row in rows} - known)


def _cell(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
