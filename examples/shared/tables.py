"""Tables that several experiments share."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_caiac._files import whole_file
from torchrl_caiac.evaluation import COLUMNS
from torchrl_caiac.plotting import plot_comparison

__all__ = ["publish_comparison", "update_csv"]


def update_csv(
    path: str | os.PathLike[str],
    rows: Sequence[Mapping[str, Any]],
    columns: Sequence[str],
    *,
    experiment: str,
    kept: str | None = None,
) -> list[dict[str, str]]:
    """Writes the rows of one experiment into a table that several share.

    Args:
        path (path): the CSV file, created if it is missing.
        rows (sequence of mapping): by the names of columns; missing values and NaN are
            left empty.
        columns (sequence of str): the columns after the first, ``"experiment"``.

    Keyword Args:
        experiment (str): the experiment of the rows, which replace its earlier ones.
        kept (str, optional): a column. Earlier rows of the experiment whose value in
            it the new rows do not have are kept. Defaults to ``None``: none are kept.

    Returns:
        list of dict: all rows of the file, as strings.

    Raises:
        ValueError: the file has other columns.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = f"{folder}/table.csv"
        ...     for name, auc in (("push", 0.5), ("kitchen", 0.8), ("push", 0.9)):
        ...         found = update_csv(path, [{"auc": auc}], ["auc"], experiment=name)
        >>> [(row["experiment"], row["auc"]) for row in found]
        [('push', '0.9'), ('kitchen', '0.8')]
    """
    path, names = Path(path), ["experiment", *columns]
    table: dict[str, list[dict[str, str]]] = {}
    if path.exists():
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            if list(reader.fieldnames or []) != names:
                raise ValueError(
                    f"{path} has the columns {reader.fieldnames}, expected {names}: "
                    "delete it, or give another file"
                )
            for row in reader:
                table.setdefault(row["experiment"], []).append(row)
    new = [
        {"experiment": experiment, **{name: _cell(row.get(name)) for name in columns}}
        for row in rows
    ]
    replaced = {row[kept] for row in new} if kept else set()
    old = table.get(experiment, []) if kept else []
    table[experiment] = [row for row in old if row[kept] not in replaced] + new
    written = [row for part in table.values() for row in part]
    with whole_file(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(written)
    return written


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def publish_comparison(
    folder: str | os.PathLike[str],
    rows: Sequence[Mapping[str, Any]],
    *,
    experiment: str,
) -> None:
    """Writes a comparison to ``influence.csv``, and draws ``influence.png``.

    ``influence.txt`` has the rows over all entities in a table to read. Several
    experiments share the files: each call replaces the rows of its own experiment
    and estimators.

    Args:
        folder (path): the folder of the files.
        rows (sequence of dict): of ``compare_influence``.

    Keyword Args:
        experiment (str): the name of the data, the table's first column.
    """
    table = update_csv(
        Path(folder) / "influence.csv",
        rows,
        COLUMNS,
        experiment=experiment,
        kept="estimator",
    )
    with whole_file(Path(folder) / "influence.txt") as partial:
        partial.write_text(_table(table))
    with whole_file(Path(folder) / "influence.png") as partial:
        plot_comparison(table).savefig(partial, dpi=150)


# The columns of the table to read, and their heads.
_READ = {
    "threshold": "θ",
    "auc": "AUC",
    "true_positive_rate": "TPR",
    "false_positive_rate": "FPR",
    "density": "links > θ",
    "rows_swapped": "rows swapped",
    "infeasible": "infeasible",
    "fit_seconds": "fit, s",
    "score_seconds": "score, s",
}


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    """Returns the rows over all entities, one experiment after another."""
    lines: list[str] = []
    experiment = None
    for row in rows:
        if row["entity"] != "all":
            continue
        if row["experiment"] != experiment:
            experiment = row["experiment"]
            heads = "".join(f"{head:>14}" for head in _READ.values())
            lines += ["", experiment, f"  {'':<16}{heads}"]
        values = (float(row[name]) if row[name] else None for name in _READ)
        cells = "".join(f"{_number(value):>14}" for value in values)
        lines.append(f"  {row['estimator']:<16}{cells}")
    return "\n".join(lines[1:]) + "\n"


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"
