"""The data and layouts that are named on the command line."""

from __future__ import annotations

import argparse
import difflib
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tensordict import TensorDict

from torchrl_caiac._files import (
    UnreadableFileError,
    claim_folder,
    plain,
    read_json,
    write_json,
)
from torchrl_caiac.cli.console import Console
from torchrl_caiac.cli.errors import UsageError
from torchrl_caiac.data import (
    FORMATS,
    action_bounds,
    load_transitions,
    open_dataset,
    verify_digests,
    write_transitions,
)
from torchrl_caiac.data.digests import data_digest, file_digest, has_digests
from torchrl_caiac.data.open_dataset import recognise_format
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.scored import DATA_FOLDER, LAYOUT_FILE, MODEL_FOLDER, SCORES_FILE

__all__ = [
    "SETTINGS_FILE",
    "SOURCE_FILE",
    "add_data",
    "add_layout",
    "convert",
    "describe_source",
    "format_name",
    "loader_options",
    "open_data",
    "open_named",
    "own_folder",
    "read_layout",
    "remove_scores",
    "scored_folder",
]

#: What the transitions in a folder were made from, beside them; and how their scores
#: are computed, from the start of scoring on.
SOURCE_FILE, SETTINGS_FILE = "source.json", "settings.json"

_META = "meta.json"
_VIDEOS = {".mp4", ".png", ".jpg", ".jpeg", ".avi", ".webm", ".mkv"}
_OF_SCORES = (SCORES_FILE, LAYOUT_FILE, MODEL_FOLDER)
_DATA_HELP = (
    "the dataset: a folder of transitions, an .npz or .hdf5 file, the folder of a "
    "LeRobot dataset, a Minari id, minari://ID, ogbench://NAME, lerobot://REPO, or a "
    "folder that `caiac score` wrote"
)


# --- arguments ---------------------------------------------------------------------


def add_data(parser: argparse.ArgumentParser, *, cache: bool = True) -> None:
    """Adds the argument DATA, and the options that say how it is read.

    Args:
        parser (ArgumentParser): the parser of a command.

    Keyword Args:
        cache (bool): whether converted data go to a cache folder. Defaults to ``True``.
    """
    parser.add_argument("data", metavar="DATA", help=_DATA_HELP)
    group = parser.add_argument_group("reading the data")
    group.add_argument(
        "--format",
        choices=[known.name for known in FORMATS],
        help="the format (default: it is recognised)",
    )
    group.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="an option of the format's loader, such as columns=[0,1,2]; VALUE is JSON "
        "or a text; may be repeated",
    )
    if cache:
        group.add_argument(
            "--cache",
            metavar="DIR",
            help="where converted data are kept, in `caiac score` those of "
            "--more-data; default: torchrl_caiac in $XDG_CACHE_HOME or ~/.cache",
        )


def add_layout(parser: argparse.ArgumentParser) -> None:
    """Adds the option ``--layout``."""
    parser.add_argument(
        "--layout",
        required=True,
        metavar="L",
        help="which columns belong to which entity: the name of a ready layout, such "
        "as ogbench/cube-double, a .json or .yaml file, or a folder that `caiac score` "
        "wrote",
    )


def read_layout(name: str, console: Console) -> EntityLayout:
    """Returns the layout that an argument names.

    Args:
        name (str): a file, a folder that ``caiac score`` wrote, or the name of a ready
            layout, whose notes are shown.
        console (Console): where they are shown.

    Returns:
        EntityLayout: the layout.

    Raises:
        UsageError: it is neither.
        UnreadableFileError: the file is not that of a layout.
    """
    if (Path(name) / LAYOUT_FILE).is_file():  # the folder of a scored dataset
        return EntityLayout.load(Path(name) / LAYOUT_FILE)
    is_file = Path(name).suffix.lower() in (".json", ".yaml", ".yml")
    if is_file or Path(name).is_file():
        if not Path(name).exists():
            raise UsageError(
                f"the layout file {name} does not exist: `caiac inspect DATA "
                "--write-layout FILE` writes a proposal"
            )
        return EntityLayout.load(name)
    from torchrl_caiac.layouts import layout_names, layout_notes, ready_layout

    names = layout_names()
    if name not in names:
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.4)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise UsageError(
            f"there is no layout {name!r}: {hint}The ready layouts are "
            f"{', '.join(names)}; or give a .json or .yaml file"
        )
    if layout_notes(name):
        console.note(f"layout {name}: {layout_notes(name)}")
    return ready_layout(name)


def loader_options(texts: list[str]) -> dict[str, Any]:
    """Returns the options of a loader.

    Raises:
        UsageError: an option has no name or value, or appears twice.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not sign or not name.isidentifier():
            raise UsageError(f"--option {text}: expected NAME=VALUE")
        if name in found:
            raise UsageError(f"--option {name} is given twice: give it once")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
    return found


# --- what a source is --------------------------------------------------------------


def describe_source(
    source: str, format: str | None = None, options: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Returns what a source is, so that it is recognised again.

    Args:
        source (str): the argument DATA.
        format (str, optional): its format. Defaults to ``None``.
        options (mapping, optional): those of the loader. Defaults to ``None``.

    Returns:
        dict: JSON values: the source, and digests of its files. Of videos and images,
        which no loader reads, the size.

    Raises:
        UsageError: a path does not exist.
        UnreadableFileError: transitions have changed since they were written.
        ValueError: a path has no known format.
    """
    path = _local(source)
    name = source if path is None else str(path.resolve())
    if path is not None:
        recognise_format(str(path), format)  # refuses a folder before it is read
    files: dict[str, Any] = {}
    root = path if path is not None else _minari_folder(source)
    if root is not None and root.is_dir() and has_digests(root):
        try:
            verify_digests(root)
        except UnreadableFileError as error:
            raise UnreadableFileError(
                f"{error}; if the change is meant, write the opened transitions to a "
                "new folder with write_transitions, and give that folder as DATA"
            ) from error
        files = {".": data_digest(root)}
    elif root is not None:
        found = sorted(root.rglob("*")) if root.is_dir() else [root]
        for file in found:
            if file.is_file() and not file.name.startswith(".lock"):
                size = file.suffix.lower() in _VIDEOS
                files[file.relative_to(root).as_posix()] = (
                    file.stat().st_size if size else file_digest(file)
                )
    return {
        "source": name,
        "format": format,
        "options": plain(options or {}),
        "files": files,
    }


def _local(source: str) -> Path | None:
    """Returns the path that a source names; ``None`` for an id or an address.

    Raises:
        UsageError: it looks like a path, but nothing is there.
    """
    _, sign, _ = source.partition("://")
    if sign:
        return None
    path = Path(source).expanduser()
    if path.exists():
        # The folder of a scored dataset has its transitions in a subfolder.
        is_scored = (path / SOURCE_FILE).exists() or (path / SCORES_FILE).exists()
        return path / DATA_FOLDER if is_scored else path
    if path.suffix or path.is_absolute() or source.startswith((".", "~")):
        raise UsageError(f"{source} does not exist: give the path of a dataset")
    return None


def _minari_folder(source: str) -> Path | None:
    scheme, sign, name = source.partition("://")
    if sign and scheme != "minari":
        return None
    from torchrl_caiac.data.minari_files import dataset_path

    try:
        folder = dataset_path(name if sign else source)
    except ImportError:  # of Minari, which says where datasets are
        return None
    return folder if folder.is_dir() else None


def format_name(source: str, format: str | None = None) -> str:
    """Returns the name of the format of a source, which is there.

    Args:
        source (str): the argument DATA.
        format (str, optional): that of ``--format``. Defaults to ``None``.

    Returns:
        str: the name.
    """
    path = _local(source)
    if path is not None and (path / _META).exists():
        return "transitions"
    return recognise_format(source if path is None else str(path), format).name


# --- opening -----------------------------------------------------------------------


def open_data(args: argparse.Namespace, console: Console) -> TensorDict:
    """Opens the data of a command that writes nothing to them.

    Folders of transitions are opened where they are. Others are converted, into a
    folder of the cache that only the same files use.

    Args:
        args (Namespace): with those of :func:`add_data`.
        console (Console): shows progress.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        UsageError: there is no such file, or the format is unknown.
    """
    options = loader_options(args.option)
    return open_named(args.data, args.cache, console, args.format, options)


def open_named(
    source: str,
    cache: str | None,
    console: Console,
    format: str | None = None,
    options: Mapping[str, Any] | None = None,
) -> TensorDict:
    """Opens a source, as :func:`open_data` does.

    Args:
        source (str): such as the argument DATA.
        cache (str, optional): the folder for converted data; ``None`` for the default.
        console (Console): shows progress.
        format (str, optional): its format. Defaults to ``None``.
        options (mapping, optional): those of the loader. Defaults to ``None``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.
    """
    path = _local(source)
    if path is not None and (path / _META).exists():
        return load_transitions(path)
    described = describe_source(source, format, options)
    text = json.dumps(described, sort_keys=True)
    root = Path(cache) if cache else _cache_root()
    folder = root / hashlib.sha256(text.encode()).hexdigest()[:16]
    with own_folder(folder):
        return convert(source, folder, described, console)


def _cache_root() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(base) / "torchrl_caiac"


def convert(
    source: str,
    folder: Path,
    described: dict[str, Any],
    console: Console,
    *,
    overwrite: bool = False,
) -> TensorDict:
    """Converts a source to the subfolder ``data`` of a folder, unless it is there.

    Args:
        source (str): the argument DATA.
        folder (Path): the folder. It is empty, or from an earlier call.
        described (dict): from :func:`describe_source`.
        console (Console): shows progress.

    Keyword Args:
        overwrite (bool): whether to replace what an earlier call with another source
            left in the folder. Defaults to ``False``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        UsageError: the folder has other content, or transitions of another source.
    """
    file, data = folder / SOURCE_FILE, folder / DATA_FOLDER
    others = [p.name for p in folder.iterdir()] if folder.is_dir() else []
    others = [name for name in others if not name.startswith(".lock")]
    if others and not file.exists():
        raise UsageError(
            f"{folder} is not empty, and not from `caiac`: give another folder"
        )
    if file.exists() and data.is_dir():
        before = read_json(file, "description of a source", f"delete {folder}")
        if before != described and not overwrite:
            raise UsageError(
                f"{folder} has transitions of {_differences(before, described)}: give "
                "another folder, or pass --overwrite to replace them"
            )
        if before != described:
            _remove(folder, (*_OF_SCORES, SETTINGS_FILE, DATA_FOLDER, SOURCE_FILE))
    if not data.is_dir():
        write_json(file, described)
        try:
            with console.step(f"reading {source}"):
                _convert(source, data, described, console)
        except BaseException:
            file.unlink()
            raise
    stored = load_transitions(data)
    _warn_of_counterfactuals(source, stored, console)
    return stored


@contextmanager
def own_folder(folder: Path) -> Iterator[None]:
    """Context manager that locks a folder, and removes it if it was and stays empty."""
    is_new = not folder.exists()
    try:
        with claim_folder(folder):
            yield
    finally:
        left = list(folder.iterdir()) if is_new and folder.is_dir() else []
        if left and all(path.name.startswith(".lock") for path in left):
            shutil.rmtree(folder, ignore_errors=True)


def remove_scores(folder: Path) -> None:
    """Removes what depends on scores from a folder; the transitions stay."""
    _remove(folder, _OF_SCORES)


def _remove(folder: Path, names: Iterable[str]) -> None:
    for name in names:
        path = folder / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _differences(before: Any, now: dict[str, Any]) -> str:
    if not isinstance(before, dict) or before.get("source") != now["source"]:
        found = before.get("source") if isinstance(before, dict) else before
        return f"{found}, not of {now['source']}"
    if before.get("files") != now["files"]:
        return f"{now['source']} as it was before it changed"
    return f"{now['source']} that were read with other options"


def _convert(
    source: str, data: Path, described: dict[str, Any], console: Console
) -> None:
    path = _local(source)
    if path is not None and (path / _META).exists():
        rows = load_transitions(path)
        # Scores of an earlier call belong to the folder that they were written to.
        write_transitions(
            rows.exclude("caiac"), data, action_bounds=action_bounds(rows)
        )
        return
    is_there = path is not None or "://" in source or _minari_folder(source) is not None
    try:
        open_dataset(
            source,
            data,
            format=described["format"],
            progress=console.progress,
            **described["options"],
        )
    except TypeError as error:
        if not described["options"]:
            raise
        raise UsageError(f"--option: {error}") from error
    except (OSError, ValueError, KeyError, ImportError) as error:
        text = str(error.args[0]) if isinstance(error, KeyError) else str(error)
        if not is_there:
            raise UsageError(text) from error
        if Path(source).name in text:
            raise
        raise ValueError(f"{source}: {text}") from error


def _warn_of_counterfactuals(source: str, data: TensorDict, console: Console) -> None:
    """Warns of transitions that are not recordings: they would count as originals."""
    path = _local(source)
    if path is not None and (path / _META).exists():
        data = load_transitions(path)
    for key in (("caiac", "counterfactual"), ("info", "counterfactual")):
        flags = data.get(key, None)
        count = 0 if flags is None else int((flags != 0).sum())
        if count:
            console.warn(
                f"{count} of {len(data)} transitions of {source} are counterfactual "
                f"({key!r}): they are scored as if they had been recorded, and `caiac "
                "augment` would count them as originals; score the dataset that they "
                "were made from instead"
            )


def scored_folder(name: str) -> Path:
    """Returns the folder of a scored dataset.

    Args:
        name (str): the argument DIR.

    Returns:
        Path: the folder.

    Raises:
        UsageError: it does not exist.
    """
    folder = Path(name)
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file, not a folder that `caiac score` wrote")
    if not folder.is_dir():
        raise UsageError(
            f"the folder {folder} does not exist: create it with `caiac score`"
        )
    return folder
