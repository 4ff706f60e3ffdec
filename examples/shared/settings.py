"""What results were made with, settings and digests of data, stored next to them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_caiac._files import plain, write_json

__all__ = ["check_settings", "keep_settings"]


def keep_settings(
    folder: str | os.PathLike[str], step: str, settings: Mapping[str, Any]
) -> None:
    """Ties the results of a step in a folder to one set of settings.

    The first call writes the settings to ``<folder>/<step>.json``, later calls compare.

    Args:
        folder (path): the folder with the results.
        step (str): the name of the step.
        settings (Mapping): what the results depend on, for example a ``DictConfig``,
            and digests of the data.

    Raises:
        ValueError: the results were made with other settings.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     keep_settings(folder, "train", {"lr": 0.1})
        ...     keep_settings(folder, "train", {"lr": 0.1})
    """
    path = Path(folder) / f"{step}.json"
    if path.exists():
        check_settings(folder, step, settings)
    else:
        write_json(path, settings)


def check_settings(
    folder: str | os.PathLike[str], step: str, settings: Mapping[str, Any]
) -> None:
    """Compares settings with those that :func:`keep_settings` wrote.

    Args:
        folder (path): the folder with the results.
        step (str): the name of the step.
        settings (Mapping): what the results depend on.

    Raises:
        FileNotFoundError: the step was not begun in this folder.
        ValueError: the results were made with other settings.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     keep_settings(folder, "train", {"lr": 0.1})
        ...     check_settings(folder, "train", {"lr": 0.1})
    """
    path = Path(folder) / f"{step}.json"
    if not path.exists():
        raise FileNotFoundError(
            f"there is no {path}: run the step {step!r} first, or set the folder of "
            "the results with out=..."
        )
    try:
        kept = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(
            f"{path} contains no settings ({error}): delete the folder, or set another "
            "one with out=..."
        ) from error
    # Through JSON, so that tuples and lists are the same.
    given = json.loads(json.dumps(plain(settings)))
    if kept != given:
        differ = "all" if not isinstance(kept, dict) else _differences(kept, given)
        raise ValueError(
            f"{path.parent} contains results of other settings, see {path} ({differ} "
            "differ): delete the folder, or set another one with out=..."
        )


def _differences(one: Any, other: Any, prefix: str = "") -> list[str]:
    """Returns the dotted names under which two mappings differ."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return [] if one == other else [prefix]
    names: list[str] = []
    for name in sorted(one.keys() | other.keys()):
        dotted = f"{prefix}.{name}" if prefix else name
        if name in one and name in other:
            names += _differences(one[name], other[name], dotted)
        else:
            names.append(dotted)
    return names
