"""The record of how scores were computed, which is kept next to them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import TensorStorage

from torchrl_caiac._files import UnreadableFileError, read_json, write_json
from torchrl_caiac._fingerprints import (
    fingerprint_key,
    is_fingerprint_of,
    settings_of,
    state_hash,
)
from torchrl_caiac._kernels import check_kernels
from torchrl_caiac._keys import jsonable, path
from torchrl_caiac._torchrl import leaf_of, memmap_folder
from torchrl_caiac.entities import EntityLayout

__all__ = [
    "check_owners",
    "check_scored_layout",
    "layout_digest",
    "read_record",
    "score_file",
    "score_settings",
    "settings_digest",
    "settings_that_differ",
    "write_record",
]

_FORMAT = "torchrl_caiac.scores"
_VERSION = 2
_STATES = ("new", "scoring", "scored")
_ROWS = 1 << 16  # that are read together


def score_file(folder: str | Path, key: NestedKey = ("caiac", "score")) -> Path:
    """Returns the path of the file that records how scores were computed.

    Args:
        folder (str or Path): the folder of the memory-mapped tensordict.
        key (NestedKey): the score leaf. Defaults to ``("caiac", "score")``.

    Returns:
        Path: the file, whether it exists or not.

    Examples:
        >>> from torchrl_caiac.influence.score_record import score_file
        >>> score_file("data").name
        'caiac.score.json'
    """
    return Path(folder) / f"{'.'.join(path(key))}.json"


def read_record(
    storage: TensorStorage, data: TensorDictBase, key: NestedKey
) -> dict[str, Any] | None:
    """Returns the record of some scores.

    Args:
        storage (TensorStorage): the storage, which stores the record of data without a
            folder.
        data (TensorDictBase): its rows.
        key (NestedKey): the score leaf.

    Returns:
        dict, optional: ``"state"`` (``"new"`` until the leaf is initialized,
        ``"scoring"`` until all rows are scored, then ``"scored"``), ``"settings"`` and
        others; ``None`` where there is no record.

    Raises:
        UnreadableFileError: the file is damaged, or is not a score file of this
            version.
    """
    folder = _folder(data)
    if folder is None:
        return getattr(storage, "caiac_scores", {}).get(key)
    file = score_file(folder, key)
    if not file.exists():
        return None
    remedy = (
        "call score_buffer(..., overwrite=True) to recompute the scores, or delete the "
        "file together with the scores"
    )
    record = read_json(file, "score file", remedy)
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        raise UnreadableFileError(
            f"{file} is not a score file of torchrl_caiac: {remedy}"
        )
    if record.get("version") != _VERSION:
        raise UnreadableFileError(
            f"the score file {file} has version {record.get('version')!r}, this "
            f"package reads {_VERSION}: update torchrl_caiac, or {remedy}"
        )
    pairs = record.get("features", [])  # earlier files have none
    if (
        record.get("state") not in _STATES
        or not isinstance(record.get("settings"), dict)
        or not isinstance(pairs, list)
        or not all(isinstance(p, list) and len(p) == 2 for p in pairs)
    ):
        raise UnreadableFileError(f"the score file {file} is incomplete: {remedy}")
    try:
        if record.get("linear_kernels") is not None:  # earlier files have none
            check_kernels(record["linear_kernels"])
    except ValueError as error:
        raise UnreadableFileError(f"in {file} {error}: {remedy}") from error
    return record


def write_record(
    storage: TensorStorage,
    data: TensorDictBase,
    key: NestedKey,
    settings: dict[str, Any],
    layout: EntityLayout,
    state: str,
    kernels: dict[str, Any] | None = None,
) -> None:
    """Writes the record of some scores, which :func:`read_record` returns.

    Args:
        storage (TensorStorage): the storage.
        data (TensorDictBase): its rows.
        key (NestedKey): the score leaf.
        settings (dict): what the scores depend on.
        layout (EntityLayout): the entities.
        state (str): ``"new"``, ``"scoring"`` or ``"scored"``.
        kernels (dict, optional): what computes linear layers.
    """
    record = {
        "format": _FORMAT,
        "version": _VERSION,
        "state": state,
        "key": jsonable(key),
        "entities": list(layout.names),
        "features": layout.to_dict()["entities"],
        "fingerprint": _sha(json.dumps(settings, sort_keys=True)),
        "settings": settings,
        "linear_kernels": kernels,
    }
    folder = _folder(data)
    if folder is None:
        records = getattr(storage, "caiac_scores", {})
        storage.caiac_scores = {**records, key: record}
    else:
        write_json(score_file(folder, key), record)


def check_scored_layout(
    storage: TensorStorage, data: TensorDictBase, key: NestedKey, layout: EntityLayout
) -> None:
    """Raises if rows have scores of a layout with other owners, by their record.

    A record of scores that no row has any more says nothing.

    Args:
        storage (TensorStorage): the storage.
        data (TensorDictBase): its rows.
        key (NestedKey): the score leaf.
        layout (EntityLayout): the entities of those who use the scores.

    Raises:
        ValueError: see :func:`check_owners`.
    """
    record = read_record(storage, data, key)
    if record is None:
        return
    try:
        check_owners(record, layout, key)
    except ValueError:
        if not _is_outdated(record, data, key, layout):
            raise


def _is_outdated(
    record: dict[str, Any], data: TensorDictBase, key: NestedKey, layout: EntityLayout
) -> bool:
    """Returns whether rows have scores, and none of them are those of a record."""
    fingerprints = leaf_of(data, fingerprint_key(key))
    if fingerprints is None:
        return False
    keys = list(layout.in_keys)
    next_keys = [layout.next(name) for name in keys]
    states = data.select(*keys, *next_keys, strict=False)
    wanted = settings_digest(record["settings"])
    has_scores = False
    for part, known in zip(states.split(_ROWS), fingerprints.split(_ROWS), strict=True):
        state, after = state_hash(part, keys), state_hash(part, next_keys)
        if state is None:
            return False
        is_scored = is_fingerprint_of(known, state, after, layout.names)
        differs = settings_of(known, state, after) ^ wanted
        # The lower 16 bits are the surroundings of a row.
        if (is_scored & (differs >> 16 == 0)).any():
            return False
        has_scores = has_scores or bool(is_scored.any())
    return has_scores


def check_owners(record: dict[str, Any], layout: EntityLayout, key: NestedKey) -> None:
    """Raises if scores are those of a layout that gives a feature to another entity.

    Args:
        record (dict): the record of the scores.
        layout (EntityLayout): the entities of those who use them.
        key (NestedKey): the score leaf, for the error.

    Raises:
        ValueError: they are.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence.score_record import check_owners
        >>> record = {"features": [["cup", [0]], ["jug", [1]]]}
        >>> check_owners(record, EntityLayout({"cup": [1], "jug": [0]}), "score")
        Traceback (most recent call last):
        ...
        ValueError: 'score' was computed with a layout in which column 1 is of 'jug'...
    """
    then = _owners(record.get("features", []))
    for feature, name in _owners(layout.to_dict()["entities"]).items():
        before = then.get(feature, name)
        if before != name:
            raise ValueError(
                f"{key!r} was computed with a layout in which {feature} is of "
                f"{before!r}, but the layout here says {name!r}: score again with it, "
                "score_buffer(..., overwrite=True), or use the layout of the estimator"
            )


def _owners(entities: list[Any]) -> dict[str, str]:
    """Returns the entity of each column, or of each key."""
    return {
        f"column {one}" if isinstance(one, int) else repr(one): name
        for name, features in entities
        for one in _features(features)
    }


def _features(value: Any) -> list[Any]:
    is_columns = isinstance(value, list) and all(isinstance(x, int) for x in value)
    return value if is_columns else [value]


def settings_that_differ(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Returns the differences between two settings, for an error message.

    Args:
        before (dict): the settings of the record.
        now (dict): the settings of this call.

    Returns:
        str: such as ``"smoothing was 1, is 3"``.

    Examples:
        >>> from torchrl_caiac.influence.score_record import settings_that_differ
        >>> settings_that_differ({"smoothing": 1}, {"smoothing": 3})
        'smoothing was 1, is 3'
    """
    return ", ".join(
        f"{name} was {_short(before.get(name))}, is {_short(now.get(name))}"
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    )


def score_settings(
    digest: str,
    layout: EntityLayout,
    *,
    smoothing: int,
    lookahead: int,
    every: int,
    trajectory_key: NestedKey | None,
    done_key: NestedKey | None,
) -> dict[str, Any]:
    """Returns what scores depend on, apart from the data.

    Args:
        digest (str): that of the estimator.
        layout (EntityLayout): its entities.

    Keyword Args:
        smoothing (int): see :func:`~torchrl_caiac.influence.score_buffer`.
        lookahead (int): the same.
        every (int): the same.
        trajectory_key (NestedKey, optional): the same.
        done_key (NestedKey, optional): the same.

    Returns:
        dict: JSON-compatible settings.
    """
    return {
        "estimator": digest,
        "layout": layout_digest(layout),
        "smoothing": smoothing,
        "lookahead": lookahead,
        "every": every,
        "trajectory_key": jsonable(trajectory_key),
        "done_key": jsonable(done_key),
    }


def settings_digest(settings: dict[str, Any]) -> int:
    """Returns a digest of settings, 32 bits.

    Args:
        settings (dict): what the scores depend on.

    Returns:
        int: at least 0, below ``2**32``.
    """
    return int(_sha(json.dumps(settings, sort_keys=True))[:8], 16)


def layout_digest(layout: EntityLayout) -> str:
    """Returns a digest of a layout.

    Args:
        layout (EntityLayout): the layout.

    Returns:
        str: hexadecimal SHA-256.
    """
    return _sha(json.dumps(layout.to_dict(), sort_keys=True))


def _folder(data: TensorDictBase) -> str | None:
    return memmap_folder(data) if data.is_memmap() else None


def _sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return f"{text[:8]}..." if len(text) == 64 else text
