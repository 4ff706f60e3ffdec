"""What experiments share: files that appear whole, resuming, processes side by side.

It needs no extra: settings are plain mappings, Hydra's among them.
"""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_caiac._files import claim_folder, plain, whole_file, write_json
from torchrl_caiac._processes import bar_position
from torchrl_caiac._processes import run_in_processes as run_side_by_side

__all__ = [
    "bar_position",
    "claim_folder",
    "keep_settings",
    "quick_settings",
    "run_side_by_side",
    "update_csv",
    "whole_file",
    "write_json",
]


def update_csv(
    path: str | os.PathLike[str],
    rows: Sequence[Mapping[str, Any]],
    columns: Sequence[str],
    *,
    experiment: str,
) -> list[dict[str, str]]:
    """Writes the rows of one experiment into a table that several share.

    Args:
        path (path): the CSV file, made where it is missing.
        rows (sequence of mapping): by the names of columns; what is missing, or NaN, is
            left empty.
        columns (sequence of str): the columns after the first, ``"experiment"``.

    Keyword Args:
        experiment (str): whose rows these are; they take the place of earlier ones.

    Returns:
        list of dict: all rows of the file, as strings.

    Raises:
        ValueError: the file has other columns.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.experiments import update_csv
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
                    f"{path} has the columns {reader.fieldnames}, wanted {names}: "
                    "delete it, or give another file"
                )
            for row in reader:
                table.setdefault(row["experiment"], []).append(row)
    table[experiment] = [
        {"experiment": experiment, **{name: _cell(row.get(name)) for name in columns}}
        for row in rows
    ]
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


def quick_settings(cfg: Any) -> Any:
    """The settings that a Hydra script runs with, those of a smoke run if asked for.

    Args:
        cfg (DictConfig): with ``quick``, and in ``quick_settings`` what a smoke run has
            other.

    Returns:
        DictConfig: ``cfg``; where ``cfg.quick``, with the quick settings over it, and
        what the command line gave over both.

    Examples:
        >>> from types import SimpleNamespace
        >>> from torchrl_caiac.experiments import quick_settings
        >>> cfg = SimpleNamespace(quick=False)
        >>> quick_settings(cfg) is cfg
        True
    """
    if not cfg.quick:
        return cfg
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    hydra = HydraConfig.get()
    given = [
        text
        for text in hydra.overrides.task
        if text.split("=")[0] not in hydra.runtime.choices
    ]
    return OmegaConf.merge(cfg, cfg.quick_settings, OmegaConf.from_dotlist(given))


def keep_settings(settings: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Keeps the results of a folder to one set of settings.

    The first call writes the settings, a later one compares.

    Args:
        settings (Mapping): what the results depend on, of a ``DictConfig`` say.
        path (path): a JSON file beside the results.

    Raises:
        ValueError: the results were made with other settings.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.experiments import keep_settings
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     keep_settings({"lr": 0.1}, f"{folder}/train.json")
        ...     keep_settings({"lr": 0.1}, f"{folder}/train.json")
    """
    path = Path(path)
    if not path.exists():
        write_json(path, settings)
        return
    try:
        kept = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(
            f"{path} holds no settings ({error}): delete the folder, or give another "
            "one with out=..."
        ) from error
    # Through JSON, so that tuples and lists are the same.
    wanted = json.loads(json.dumps(plain(settings)))
    if kept != wanted:
        differ: Any = "all"
        if isinstance(kept, dict):
            same = {k for k in kept.keys() & wanted if kept[k] == wanted[k]}
            differ = sorted((kept.keys() | wanted) - same)
        raise ValueError(
            f"{path.parent} holds results of other settings, see {path} ({differ} "
            "differ): delete the folder, or give another one with out=..."
        )
