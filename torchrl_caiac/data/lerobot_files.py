"""Reads the files of LeRobot datasets: descriptions, tasks and frames."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_caiac._extras import extra
from torchrl_caiac._files import UnreadableFileError, read_json

__all__ = ["LeRobotDescription", "describe_lerobot", "lerobot_episodes"]

_AGAIN = "download or record the dataset again"
_ROWS = 4096  # that are read at a time
# Frames of cameras, which are not numbers or lie in other files, and texts.
_NO_NUMBERS = ("image", "string", "video")


class LeRobotDescription(NamedTuple):
    """What the files under ``meta`` say.

    Attributes:
        root (Path): the folder of the dataset.
        version (str): the version of the format, such as ``"v2.1"``.
        shapes (dict of str to tuple): the shape of one frame of each feature of
            numbers.
        others (list of str): the features that are images, videos or texts.
        tasks (dict of int to str): the texts of the tasks.
        lengths (dict of int to int): the number of frames of each episode.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_caiac.data.lerobot_files import LeRobotDescription
        >>> shapes = {"observation.state": (3,), "action": (2,)}
        >>> LeRobotDescription(Path("push"), "v2.1", shapes, [], {0: "Push."}, {0: 5})
        LeRobotDescription(root=..., lengths={0: 5})
    """

    root: Path
    version: str
    shapes: dict[str, tuple[int, ...]]
    others: list[str]
    tasks: dict[int, str]
    lengths: dict[int, int]


def describe_lerobot(root: Path) -> LeRobotDescription:
    """Reads the description of a LeRobot dataset.

    Args:
        root (Path): the folder of the dataset, with ``meta/info.json``.

    Returns:
        LeRobotDescription: the description.

    Raises:
        FileNotFoundError: a file is missing.
        ImportError: the package ``pyarrow`` is missing.
        UnreadableFileError: a file is damaged.
        ValueError: the format has another version than 2 or 3.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchrl_caiac.data.lerobot_files import describe_lerobot
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     describe_lerobot(Path(folder))
        Traceback (most recent call last):
        ...
        FileNotFoundError: ... has no meta/info.json: ...
    """
    file = root / "meta" / "info.json"
    if not file.exists():
        raise FileNotFoundError(
            f"{root} has no meta/info.json: give the folder of a LeRobot dataset"
        )
    info = read_json(file, "description of a LeRobot dataset", _AGAIN)
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not isinstance(version, str) or not version.startswith(("v2.", "v3.")):
        raise ValueError(
            f"{file} has the codebase_version {version!r}, expected v2.x or v3.x: "
            "convert the dataset with LeRobot"
        )
    shapes, others = _features(info, file)
    if version.startswith("v2."):
        tasks = _lines(root / "meta" / "tasks.jsonl")
        episodes = _lines(root / "meta" / "episodes.jsonl")
    else:
        tasks = _table(root / "meta" / "tasks.parquet", "task_index", *_TASK_NAMES)
        episodes = [
            row
            for part in _sorted(root / "meta" / "episodes")
            for row in _table(part, "episode_index", "length")
        ]
    try:
        texts = {int(row["task_index"]): _task(row) for row in tasks}
        lengths = {int(row["episode_index"]): int(row["length"]) for row in episodes}
        if len(lengths) != len(episodes):
            raise ValueError("an episode is there twice")
    except (KeyError, TypeError, ValueError) as error:
        raise UnreadableFileError(
            f"the tasks or episodes in {root / 'meta'} cannot be read ({error!r}): "
            f"{_AGAIN}"
        ) from error
    return LeRobotDescription(root, version, shapes, others, texts, lengths)


# pandas names the index of a table so.
_TASK_NAMES = ("task", "__index_level_0__")


def _task(row: Mapping[str, Any]) -> str:
    for name in _TASK_NAMES:
        if isinstance(row.get(name), str):
            return str(row[name])
    raise KeyError("task")


def _features(
    info: Mapping[str, Any], file: Path
) -> tuple[dict[str, tuple[int, ...]], list[str]]:
    shapes, others = {}, []
    try:
        for name, feature in info["features"].items():
            dtype, shape = feature["dtype"], feature["shape"]
            if dtype in _NO_NUMBERS:
                others.append(name)
            else:
                if not all(type(size) is int and size >= 0 for size in shape):
                    raise ValueError(f"the shape of {name!r} is {shape!r}")
                shapes[name] = tuple(shape) or (1,)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UnreadableFileError(
            f"{file} has unreadable features ({error!r}): {_AGAIN}"
        ) from error
    return shapes, others


def _lines(file: Path) -> list[dict[str, Any]]:
    """Reads a file with one JSON object a line."""
    if not file.exists():
        raise FileNotFoundError(f"there is no {file}: {_AGAIN}")
    try:
        text = file.read_text(encoding="utf-8")
        rows = [json.loads(line) for line in text.splitlines() if line.strip()]
        if not all(isinstance(row, dict) for row in rows):
            raise ValueError("a line is not an object")
    except (ValueError, RecursionError) as error:
        raise UnreadableFileError(
            f"{file} is not a readable list of JSON objects, it may be truncated or "
            f"damaged ({error}): {_AGAIN}"
        ) from error
    return rows


def _table(file: Path, *names: str) -> list[dict[str, Any]]:
    """Reads those columns of a Parquet file that are there."""
    if not file.exists():
        raise FileNotFoundError(f"there is no {file}: {_AGAIN}")
    stored = _opened(file)
    with stored:
        columns = [name for name in names if name in stored.schema_arrow.names]
        try:
            rows: list[dict[str, Any]] = stored.read(columns).to_pylist()
        except Exception as error:  # pyarrow raises many kinds for damaged files
            raise _unreadable(file, error) from error
    return rows


def _opened(file: Path) -> Any:
    with extra("lerobot", f"{file}, of a LeRobot dataset,"):
        import pyarrow.parquet as parquet
    try:
        return parquet.ParquetFile(file)
    except Exception as error:  # pyarrow raises many kinds for damaged files
        raise _unreadable(file, error) from error


def _unreadable(file: Path, error: Exception) -> UnreadableFileError:
    return UnreadableFileError(
        f"{file} is not a readable Parquet file, it may be truncated or damaged "
        f"({error}): {_AGAIN}"
    )


def _sorted(folder: Path) -> list[Path]:
    """Returns the Parquet files of a folder in the order of their numbers."""
    files = list(folder.rglob("*.parquet"))
    if not files:
        raise FileNotFoundError(f"there is no Parquet file in {folder}: {_AGAIN}")

    def numbers(file: Path) -> list[int]:
        name = file.relative_to(folder).as_posix()
        return [int(number) for number in re.findall(r"\d+", name)]

    return sorted(files, key=numbers)


def lerobot_episodes(
    description: LeRobotDescription, names: Sequence[str]
) -> Iterator[tuple[int, str, dict[str, NDArray[Any]]]]:
    """Reads the frames of a LeRobot dataset, one episode after the other.

    An episode may begin in one file and end in the next one.

    Args:
        description (LeRobotDescription): the description of the dataset.
        names (sequence of str): the features to read.

    Yields:
        tuple of int, str and dict of str to numpy.ndarray: the index of the episode,
        the name of its last file, and ``[L, *shape]`` by the names of the features.

    Raises:
        KeyError: a file lacks a feature.
        UnreadableFileError: a file is damaged; an episode is not whole.
        ValueError: a feature has missing values, other widths than described, or
            something other than numbers.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_caiac.data.lerobot_files import (
        ...     describe_lerobot, lerobot_episodes
        ... )
        >>> description = describe_lerobot(Path("tests/data/lerobot/v3.0"))
        >>> for number, _, frames in lerobot_episodes(description, ["action"]):
        ...     number, frames["action"].shape
        (0, (6, 2))
        (1, (4, 2))
        (2, (7, 2))
        (3, (5, 2))
    """
    seen: set[int] = set()
    pieces: list[dict[str, NDArray[Any]]] = []
    current, last = -1, Path()
    for file in _sorted(description.root / "data"):
        for frames in _batches(file, description, {"frame_index", *names}):
            numbers = frames["episode_index"].reshape(-1)
            cuts = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
            for start, stop in pairwise(cuts):
                if start == stop:
                    continue
                if numbers[start] != current and pieces:
                    yield _whole(description, current, last, pieces, seen, names)
                    pieces = []
                current, last = int(numbers[start]), file
                pieces.append(
                    {name: array[start:stop] for name, array in frames.items()}
                )
    if pieces:
        yield _whole(description, current, last, pieces, seen, names)
    missing = sorted(set(description.lengths) - seen)
    if missing or not seen:
        raise UnreadableFileError(
            f"{description.root / 'data'} lacks the episodes {missing}, which "
            f"{description.root / 'meta'} lists: {_AGAIN}"
        )


def _whole(
    description: LeRobotDescription,
    number: int,
    file: Path,
    pieces: Sequence[Mapping[str, NDArray[Any]]],
    seen: set[int],
    names: Sequence[str],
) -> tuple[int, str, dict[str, NDArray[Any]]]:
    """Joins the pieces of an episode, after checking that it is whole."""
    index = np.concatenate([piece["frame_index"] for piece in pieces]).reshape(-1)
    expected = description.lengths.get(number)
    if number in seen or len(index) != expected:
        reason = "is there twice" if number in seen else f"has {len(index)} frames"
        raise UnreadableFileError(
            f"episode {number} of {file} {reason}, but "
            f"{description.root / 'meta'} says {expected}: {_AGAIN}"
        )
    if not np.array_equal(index, np.arange(len(index))):
        raise UnreadableFileError(
            f"'frame_index' of episode {number} in {file} is not 0 to "
            f"{len(index) - 1}, so frames are missing or in another order: {_AGAIN}"
        )
    seen.add(number)
    frames = {name: np.concatenate([piece[name] for piece in pieces]) for name in names}
    return number, str(file), frames


def _batches(
    file: Path, description: LeRobotDescription, names: set[str]
) -> Iterator[dict[str, NDArray[Any]]]:
    wanted = sorted({"episode_index", *names})
    stored = _opened(file)
    with stored:
        there = stored.schema_arrow.names
        missing = [name for name in wanted if name not in there]
        if missing:
            raise KeyError(f"{file} lacks {missing}, it has {there}: {_AGAIN}")
        batches = stored.iter_batches(_ROWS, columns=wanted)
        while True:
            try:
                batch = next(batches, None)
            except Exception as error:  # pyarrow raises many kinds for damaged files
                raise _unreadable(file, error) from error
            if batch is None:
                return
            yield {
                name: _array(batch[name], name, description.shapes.get(name, ()), file)
                for name in wanted
            }


def _array(column: Any, name: str, shape: tuple[int, ...], file: Path) -> NDArray[Any]:
    """Converts a column, in which every frame may be a nested list, to an array."""
    import pyarrow as pa

    rows, sizes = len(column), list[int]()
    while True:
        if isinstance(column, pa.ExtensionArray):
            column = column.storage
        if column.null_count:
            raise ValueError(
                f"{name!r} of {file} has {column.null_count} missing values: remove "
                "the episodes, or record them again"
            )
        is_list = isinstance(
            column, (pa.ListArray, pa.LargeListArray, pa.FixedSizeListArray)
        )
        if not is_list:
            break
        widths = set(column.value_lengths().to_pylist() if rows else ())
        if len(widths) > 1:
            raise ValueError(
                f"{name!r} of {file} has frames of different widths, {sorted(widths)}, "
                f"expected shape {list(shape)}: remove those episodes"
            )
        sizes += widths
        column = column.flatten()
    if rows and math.prod(sizes) != math.prod(shape):
        raise ValueError(
            f"{name!r} of {file} has frames of shape {sizes}, but meta/info.json says "
            f"{list(shape)}: convert the file or the description"
        )
    checks = (pa.types.is_floating, pa.types.is_integer, pa.types.is_boolean)
    if not any(check(column.type) for check in checks):
        raise ValueError(
            f"{name!r} of {file} has {column.type}, expected numbers: leave it out"
        )
    array: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return array.reshape(rows, *shape)
