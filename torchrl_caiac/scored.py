"""A folder with a scored dataset: transitions, scores, layout and thresholds."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._files import UnreadableFileError, plain, read_json, write_json
from torchrl_caiac._fingerprints import fingerprint_key
from torchrl_caiac._keys import as_key, jsonable, key_from_json
from torchrl_caiac.data import load_transitions, offline_buffer, verify_digests
from torchrl_caiac.data.digests import data_digest, file_digest
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.score_record import layout_digest, read_record

__all__ = [
    "DATA_FOLDER",
    "LAYOUT_FILE",
    "MODEL_FOLDER",
    "SCORES_FILE",
    "ScoredDataset",
    "Suggestions",
    "open_scored",
    "write_scored",
]

#: The names inside of the folder of a scored dataset.
DATA_FOLDER, LAYOUT_FILE, SCORES_FILE = "data", "layout.json", "scores.json"
MODEL_FOLDER = "world_model"

_FORMAT = "torchrl_caiac.scored"
_VERSION = 1
_AGAIN = "score the dataset again, with `caiac score`"
_TABLES: dict[str, tuple[type, ...]] = {
    "thresholds": (int, float),
    "confidence": (str,),
    "reasons": (str,),
    "free": (int, float),
}


class Suggestions(Protocol):
    """Thresholds with their reasons, such as those of ``suggest_thresholds``.

    Each is a dict from the names of entities: ``thresholds`` (float), ``confidence``
    and ``reasons`` (str), ``free`` (float, the share of rows that would be swapped).
    """

    @property
    def thresholds(self) -> Mapping[str, float]:
        """The thresholds."""

    @property
    def confidence(self) -> Mapping[str, str]:
        """How clear each of them is."""

    @property
    def reasons(self) -> Mapping[str, str]:
        """Why."""

    @property
    def free(self) -> Mapping[str, float]:
        """The share of rows in which each entity is uninfluenced."""


@dataclass(frozen=True)
class ScoredDataset:
    """A dataset with scores, as ``caiac score`` wrote it.

    Args:
        path (Path): the folder.
        data (TensorDict): the memory-mapped transitions, ``[T]``, with the scores.
        layout (EntityLayout): the entities.
        estimator (str): the name of the estimator, such as ``"motion"``.
        settings (dict): how the scores were computed: ``"smoothing"``, ``"lookahead"``
            and those of the estimator, JSON values.
        thresholds (dict of str to float): the suggested threshold of each entity that
            is not fixed.
        confidence (dict of str to str): how clear each threshold is.
        reasons (dict of str to str): why.
        free (dict of str to float): the share of rows in which each entity is
            uninfluenced.
        source (dict): what the transitions were made from, JSON values. Defaults to
            ``{}``.
        warnings (tuple of str): warnings for users of the scores. Defaults to ``()``.
        coverage (dict, optional): how many different actions the data have, see
            :func:`~torchrl_caiac.influence.action_coverage`. Defaults to ``None``: not
            computed.
        score_key (NestedKey): the scores, ``[T, N]``. Defaults to
            ``("caiac", "score")``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.scored import ScoredDataset
        >>> scored = ScoredDataset(
        ...     Path("out"),
        ...     TensorDict({"caiac": {"score": torch.tensor([[9.0, 0.0]])}}, [1]),
        ...     EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"]),
        ...     estimator="motion",
        ...     settings={"smoothing": 1, "lookahead": 1},
        ...     thresholds={"cup": 0.5},
        ...     confidence={"cup": "two clear modes"},
        ...     reasons={"cup": "the cup never moves by itself"},
        ...     free={"cup": 1.0},
        ... )
        >>> scored.scores
        tensor([[9., 0.]])
        >>> scored.is_free
        tensor([[False,  True]])
    """

    path: Path
    data: TensorDict
    layout: EntityLayout
    estimator: str
    settings: dict[str, Any]
    thresholds: dict[str, float]
    confidence: dict[str, str]
    reasons: dict[str, str]
    free: dict[str, float]
    source: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    coverage: dict[str, Any] | None = None
    score_key: NestedKey = ("caiac", "score")

    @property
    def scores(self) -> torch.Tensor:
        """The scores, float32 ``[T, N]``."""
        return self.data.get(self.score_key)

    @property
    def is_free(self) -> torch.Tensor:
        """Which entities are uninfluenced in each row, bool ``[T, N]``.

        Fixed entities, and those without a threshold, are not.
        """
        fixed = dict.fromkeys(self.layout.fixed, -math.inf)
        known = {**self.thresholds, **fixed}
        limits = [known.get(name, -math.inf) for name in self.layout.names]
        scores = self.scores.as_subclass(torch.Tensor)
        return scores <= torch.tensor(limits, dtype=scores.dtype)


def write_scored(
    path: str | os.PathLike[str],
    layout: EntityLayout,
    suggestions: Suggestions,
    *,
    estimator: str,
    settings: Mapping[str, Any],
    source: Mapping[str, Any] | None = None,
    warnings: Sequence[str] = (),
    coverage: Mapping[str, Any] | None = None,
    score_key: NestedKey = ("caiac", "score"),
) -> ScoredDataset:
    """Writes how a folder's transitions were scored, and opens the folder.

    The transitions are in the subfolder ``data``, scored by
    :func:`~torchrl_caiac.influence.score_buffer`. The files ``layout.json`` and
    ``scores.json`` are written, the latter last: a folder without it is not complete.
    They hold digests of the layout, transitions and scores, so that
    :func:`open_scored` refuses files that do not belong together.

    Args:
        path (path): the folder.
        layout (EntityLayout): the entities.
        suggestions (Suggestions): the thresholds, see
            :class:`~torchrl_caiac.scored.Suggestions`.

    Keyword Args:
        estimator (str): the name of the estimator.
        settings (mapping): how the scores were computed, JSON values.
        source (mapping, optional): what the transitions were made from, JSON values.
            Defaults to ``None``: unknown.
        warnings (sequence of str): warnings for users of the scores. Defaults to
            ``()``.
        coverage (mapping, optional): how many different actions the data have, JSON
            values. Defaults to ``None``: not computed.
        score_key (NestedKey): the scores. Defaults to ``("caiac", "score")``.

    Returns:
        ScoredDataset: the folder, opened.

    Raises:
        FileNotFoundError: the subfolder ``data`` is missing, or has no digests.
        ValueError: the transitions have no scores of this layout, or not all rows are
            scored; a name in ``suggestions`` is not an entity that may be swapped, or
            one of these lacks a threshold.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.data import offline_buffer, write_transitions
        >>> from torchrl_caiac.influence import DistanceInfluence, score_buffer
        >>> from torchrl_caiac.scored import ScoredDataset, open_scored, write_scored
        >>> rows = TensorDict(
        ...     {
        ...         "observation": torch.rand(4, 2),
        ...         "action": torch.rand(4, 1),
        ...         "episode": torch.zeros(4, dtype=torch.int64),
        ...         "next": {"observation": torch.rand(4, 2), "done": torch.ones(4, 1)},
        ...     },
        ...     [4],
        ... )
        >>> layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])
        >>> near = DistanceInfluence(
        ...     layout, {"arm": [0], "cup": [1]}, distance=0.1, action_only=True
        ... )
        >>> class Chosen:  # or what suggest_thresholds returns
        ...     thresholds, confidence = {"cup": 0.5}, {"cup": "chosen by hand"}
        ...     reasons, free = {"cup": "an example"}, {"cup": 0.25}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     data = write_transitions(rows, f"{folder}/data")
        ...     score_buffer(offline_buffer(data), near, check=False, progress=False)
        ...     _ = write_scored(
        ...         folder, layout, Chosen(), estimator="distance", settings={}
        ...     )
        ...     open_scored(folder).thresholds
        {'cup': 0.5}
    """
    folder, score_key = Path(path), as_key(score_key)
    data = _open_data(folder)
    digests = _score_digests(data, layout, score_key, folder)
    tables = {name: dict(getattr(suggestions, name)) for name in _TABLES}
    _check_tables(tables, layout)
    layout.save(folder / LAYOUT_FILE)
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "estimator": str(estimator),
        "settings": plain(settings),
        **tables,
        "source": plain(source or {}),
        "warnings": list(warnings),
        "coverage": None if coverage is None else plain(coverage),
        "score_key": jsonable(score_key),
        "layout_digest": layout_digest(layout),
        "data_digest": data_digest(folder / DATA_FOLDER),
        "score_digests": digests,
    }
    write_json(folder / SCORES_FILE, content)
    return open_scored(folder, verify=False)


def open_scored(path: str | os.PathLike[str], *, verify: bool = True) -> ScoredDataset:
    """Opens a scored dataset.

    Args:
        path (path): the folder that ``caiac score`` or :func:`write_scored` wrote.

    Keyword Args:
        verify (bool): whether to read all transitions and compare them with their
            digests. Digests of layout and scores are always compared. Defaults to
            ``True``.

    Returns:
        ScoredDataset: the dataset, its transitions memory-mapped.

    Raises:
        FileNotFoundError: the folder does not exist, or is not that of a scored
            dataset, or scoring has not finished.
        UnreadableFileError: a file is damaged; or layout, transitions or scores have
            changed since they were written.

    Examples:
        See :func:`write_scored`.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise FileNotFoundError(
            f"the folder {folder} does not exist: create it with `caiac score`"
        )
    file = folder / SCORES_FILE
    if not file.exists():
        if (folder / DATA_FOLDER).is_dir():
            raise FileNotFoundError(
                f"{file} is missing: scoring has not finished; repeat the same call "
                "of `caiac score`, which resumes"
            )
        raise FileNotFoundError(
            f"{folder} is not the folder of a scored dataset, {file} is missing: "
            "create one with `caiac score`"
        )
    content = read_json(file, "description of a scored dataset", _AGAIN)
    _check_content(content, file)
    layout = _open_layout(folder, content["layout_digest"])
    tables: dict[str, Any] = {name: content[name] for name in _TABLES}
    try:
        _check_tables(tables, layout)
    except ValueError as error:
        raise UnreadableFileError(f"{file} is damaged ({error}): {_AGAIN}") from error
    score_key = as_key(key_from_json(content["score_key"]))
    data = _open_data(folder)
    if data_digest(folder / DATA_FOLDER) != content["data_digest"]:
        raise UnreadableFileError(
            f"{folder / DATA_FOLDER} has other transitions than those that were "
            f"scored: {_AGAIN}"
        )
    if verify:
        verify_digests(folder / DATA_FOLDER)
    try:
        digests = _score_digests(data, layout, score_key, folder)
    except ValueError as error:
        raise UnreadableFileError(str(error)) from error
    if digests != content["score_digests"]:
        raise UnreadableFileError(
            f"the scores {score_key!r} in {folder / DATA_FOLDER} have changed since "
            f"{file.name} was written: {_AGAIN}"
        )
    return ScoredDataset(
        path=folder,
        data=data,
        layout=layout,
        estimator=content["estimator"],
        settings=content["settings"],
        source=content["source"],
        warnings=tuple(content["warnings"]),
        coverage=content["coverage"],
        score_key=score_key,
        **tables,
    )


def _open_layout(folder: Path, digest: str) -> EntityLayout:
    file = folder / LAYOUT_FILE
    if not file.exists():
        raise UnreadableFileError(f"{file} is missing: {_AGAIN}")
    layout = EntityLayout.load(file)
    if layout_digest(layout) != digest:
        raise UnreadableFileError(
            f"{file} is not the layout that the scores were computed with: {_AGAIN}"
        )
    return layout


def _open_data(folder: Path) -> TensorDict:
    if not (folder / DATA_FOLDER).is_dir():
        raise FileNotFoundError(
            f"{folder / DATA_FOLDER} is missing, the transitions: {_AGAIN}"
        )
    return load_transitions(folder / DATA_FOLDER)


def _score_digests(
    data: TensorDictBase, layout: EntityLayout, key: NestedKey, folder: Path
) -> dict[str, str]:
    """Returns digests of complete scores and fingerprints.

    Raises:
        ValueError: rows are not scored, or by another layout.
    """
    where = f"{folder / DATA_FOLDER}"
    record = read_record(offline_buffer(data).storage, data, key)
    scores = data.get(key, None)
    prints = data.get(fingerprint_key(key), None)
    if record is None or scores is None or prints is None:
        raise ValueError(f"{where} has no scores {key!r}: {_AGAIN}")
    if record["state"] != "scored":
        raise ValueError(
            f"the scores {key!r} in {where} are not complete: repeat the same call of "
            "`caiac score`, which resumes"
        )
    expected = [len(data), len(layout)]
    if list(scores.shape) != expected or record["settings"].get(
        "layout"
    ) != layout_digest(layout):
        raise ValueError(
            f"the scores {key!r} in {where}, {list(scores.shape)}, are not those of "
            f"this layout, {expected}: {_AGAIN}"
        )
    return {
        "settings": str(record.get("fingerprint")),
        "scores": file_digest(scores.filename),
        "fingerprints": file_digest(prints.filename),
    }


def _check_tables(tables: Mapping[str, Any], layout: EntityLayout) -> None:
    """Raises if there are not the same entries for all entities that may be swapped."""
    expected = {name for name in layout.names if name not in layout.fixed}
    for name, kinds in _TABLES.items():
        table: dict[str, Any] = tables[name]
        for entity, value in table.items():
            if entity not in layout.names:
                raise ValueError(
                    f"{name} has {entity!r}, which is not one of the layout's "
                    f"entities {list(layout.names)}"
                )
            if isinstance(value, bool) or not isinstance(value, kinds):
                raise ValueError(
                    f"{name} of {entity!r} is {value!r}, expected "
                    f"{'a text' if kinds == (str,) else 'a number'}"
                )
            if isinstance(value, (int, float)) and not math.isfinite(value):
                raise ValueError(f"{name} of {entity!r} is {value}, not finite")
        missing = expected - set(table)
        if missing:
            raise ValueError(f"{name} lacks {sorted(missing)}")


def _check_content(content: Any, file: Path) -> None:
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise UnreadableFileError(
            f"{file} is not the description of a scored dataset: {_AGAIN}"
        )
    if content.get("version") != _VERSION:
        raise UnreadableFileError(
            f"{file} has version {content.get('version')!r}, this package reads "
            f"{_VERSION}: update torchrl_caiac, or {_AGAIN}"
        )
    checks: dict[str, Callable[[Any], Any]] = {
        "estimator": lambda x: isinstance(x, str),
        "settings": lambda x: isinstance(x, dict),
        **{name: lambda x: isinstance(x, dict) for name in _TABLES},
        "source": lambda x: isinstance(x, dict),
        "warnings": lambda x: (
            isinstance(x, list) and all(isinstance(text, str) for text in x)
        ),
        "coverage": lambda x: x is None or isinstance(x, dict),
        "score_key": lambda x: (
            isinstance(x, str)
            or (isinstance(x, list) and x and all(isinstance(k, str) for k in x))
        ),
        "layout_digest": lambda x: isinstance(x, str),
        "data_digest": lambda x: isinstance(x, str),
        "score_digests": lambda x: isinstance(x, dict),
    }
    wrong = [
        name
        for name, check in checks.items()
        if name not in content or not check(content[name])
    ]
    if wrong:
        raise UnreadableFileError(
            f"{file} has no readable {', '.join(wrong)}, it may be damaged: {_AGAIN}"
        )
