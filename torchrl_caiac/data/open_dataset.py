"""Opens a dataset of any known format."""

from __future__ import annotations

import inspect
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from tensordict import TensorDict

from torchrl_caiac._extras import extra
from torchrl_caiac.data.hdf5_files import open_hdf5, reading_hdf5
from torchrl_caiac.data.load_array_file import load_array_file
from torchrl_caiac.data.load_lerobot import load_lerobot
from torchrl_caiac.data.load_minari import load_minari
from torchrl_caiac.data.load_ogbench import load_ogbench
from torchrl_caiac.data.load_robomimic import load_robomimic
from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.minari_files import dataset_path, open_minari
from torchrl_caiac.data.npz_streams import NpzStreams

__all__ = ["FORMATS", "DatasetFormat", "open_dataset", "recognise_format"]

_logger = logging.getLogger("torchrl_caiac.data.open_dataset")

_AGAIN = "download or create the dataset again"
_HDF5 = (".hdf5", ".h5")
_ARRAYS = {"observations", "actions"}
# What OGBench's files and functions have.
_OGBENCH = {"observations", "actions", "terminals"}
_OGBENCH_MORE = {"next_observations", "valids", "rewards", "masks", "oracle_reps"}
_OGBENCH_OWN = {"valids", "masks", "oracle_reps", "qpos", "qvel", "button_states"}
_OGBENCH_MORE |= _OGBENCH_OWN
# How the names of its datasets begin, some of whose files have nothing else.
_OGBENCH_NAMES: tuple[str, ...] = (
    "antmaze-",
    "antsoccer-",
    "humanoidmaze-",
    "pointmaze-",
)
_OGBENCH_NAMES += ("cube-", "scene-", "puzzle-", "powderworld-", "visual-")


class DatasetFormat(NamedTuple):
    """A format that :func:`open_dataset` knows.

    Attributes:
        name (str): its name.
        looks (str): how it is recognised, for people.
        matches (callable): returns whether a path that exists has this format. It may
            raise :class:`~torchrl_caiac.data.UnreadableFileError`.
        load (callable): the loader, called with the source, the path to write, and
            keyword arguments.
        scheme (str, optional): the beginning of sources that are names, as ``minari``
            of ``minari://push/play-v0``.
        options (callable, optional): the function whose keyword arguments are those of
            ``load``. Defaults to ``None``: ``load`` itself.

    Examples:
        >>> from torchrl_caiac.data.open_dataset import FORMATS
        >>> [known.name for known in FORMATS]
        ['transitions', 'minari', 'lerobot', 'ogbench', 'npz', 'robomimic', 'hdf5']
    """

    name: str
    looks: str
    matches: Callable[[Path], bool]
    load: Callable[..., TensorDict]
    scheme: str | None = None
    options: Callable[..., TensorDict] | None = None


def open_dataset(
    source: str | os.PathLike[str],
    path: str | Path,
    *,
    format: str | None = None,
    overwrite: bool = False,
    progress: bool = True,
    **options: Any,
) -> TensorDict:
    """Converts a dataset of any known format to transitions, and opens them.

    The formats, and what reads them:

    - ``transitions``: a folder of transitions, which is opened where it is;
    - ``minari``: the id of a Minari dataset on this machine, ``minari://ID``, or its
      folder: :func:`~torchrl_caiac.data.load_minari`;
    - ``lerobot``: a LeRobot folder, or ``lerobot://REPO``:
      :func:`~torchrl_caiac.data.load_lerobot`;
    - ``ogbench``: OGBench's ``.npz``, or ``ogbench://NAME``:
      :func:`~torchrl_caiac.data.load_ogbench`;
    - ``npz``: another ``.npz`` with arrays named as the arguments of
      :func:`~torchrl_caiac.data.from_arrays`;
    - ``robomimic``: HDF5 with ``data/demo_*``:
      :func:`~torchrl_caiac.data.load_robomimic`;
    - ``hdf5``: another HDF5 with such arrays, as those of D4RL.

    Names with ``://`` are downloaded if they are not on this machine.

    Args:
        source (str or path): the dataset.
        path (str or Path): the folder to write. A folder of transitions is opened where
            it is, and nothing is written.

    Keyword Args:
        format (str, optional): the name of the format. Defaults to ``None``: it is
            recognised.
        overwrite (bool): whether to replace ``path`` if it exists. Defaults to
            ``False``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.
        **options: further arguments of the loader, such as ``columns=``.

    Returns:
        TensorDict: the memory-mapped transitions, ``[T]``.

    Raises:
        FileNotFoundError: there is no such dataset.
        TypeError: the loader has no such option; the message lists those it has.
        UnreadableFileError: a file is damaged.
        ValueError: the format is unknown; the message lists the known ones. Or what
            the loader raises.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.data import open_dataset
        >>> folder = tempfile.TemporaryDirectory()
        >>> data = open_dataset(
        ...     "tests/data/lerobot/v2.1",
        ...     f"{folder.name}/data",
        ...     progress=False,
        ...     keys=["observation.state"],
        ... )
        >>> data["observation"].shape
        torch.Size([18, 3])
        >>> open_dataset(f"{folder.name}/data", f"{folder.name}/more").batch_size
        torch.Size([18])
        >>> folder.cleanup()
    """
    source = os.fspath(source)
    _, sign, name = source.partition("://")
    known = recognise_format(source, format)
    if known.name != "transitions":
        options = {"overwrite": overwrite, "progress": progress, **options}
    if sign:
        options = {"download": True, **options}
    _check_options(known, options)
    _logger.info(
        "%s is read as %s%s; name another format with format= (--format)",
        source,
        known.name,
        # What differs from "npz", whose terminals say that a task ended.
        ", whose terminals end episodes as truncated"
        if known.name == "ogbench"
        else "",
    )
    return known.load(name if sign else source, path, **options)


def recognise_format(source: str, format: str | None = None) -> DatasetFormat:
    """Returns the format of a dataset, without reading it.

    Args:
        source (str): the dataset, as for :func:`open_dataset`.
        format (str, optional): the name of the format. Defaults to ``None``: it is
            recognised.

    Returns:
        DatasetFormat: the format.

    Raises:
        FileNotFoundError: there is no such file.
        UnreadableFileError: the file is damaged.
        ValueError: the format is unknown, or a file lacks arrays; the message lists
            those that it has.

    Examples:
        >>> from torchrl_caiac.data.open_dataset import recognise_format
        >>> recognise_format("tests/data/lerobot/v2.1").name
        'lerobot'
    """
    scheme, sign, _ = source.partition("://")
    if format is not None:
        known = _by_name(format, source)
        if sign and known.scheme != scheme:
            raise ValueError(
                f"{source} does not have the format {format!r}: leave out format=, or "
                f"give {'a path' if known.scheme is None else f'{known.scheme}://NAME'}"
            )
        return known
    return _by_scheme(scheme, source) if sign else _recognise(source)


def _by_name(name: str, source: str) -> DatasetFormat:
    for known in FORMATS:
        if known.name == name:
            return known
    raise _unknown(f"the format {name!r} of {source} is unknown")


def _by_scheme(scheme: str, source: str) -> DatasetFormat:
    for known in FORMATS:
        if known.scheme == scheme:
            return known
    raise _unknown(f"{source} begins with an unknown {scheme}://")


def _recognise(source: str) -> DatasetFormat:
    path = Path(source)
    if path.exists():
        for known in FORMATS:
            if known.matches(path):
                return known
        if path.suffix in (".npz", *_HDF5):
            raise _lacking(source, _names_in_npz(path) | _names_in_hdf5(path))
        raise _unknown(f"{source} has no known format{_contents(path)}")
    if path.suffix in (".npz", *_HDF5):
        raise FileNotFoundError(f"there is no file {source}: give another one")
    if _is_minari_id(source):
        return _by_name("minari", source)
    raise _unknown(f"there is nothing at {source}, and it is no Minari dataset here")


def _contents(path: Path) -> str:
    if not path.is_dir():
        return ""
    names = sorted(item.name for item in path.iterdir())
    return f" (the folder has {names[:10]}{' and more' if len(names) > 10 else ''})"


def _lacking(source: str, names: set[str]) -> ValueError:
    found = sorted(names)
    other = (
        " (a file of robomimic has data/demo_*)" if Path(source).suffix in _HDF5 else ""
    )
    return ValueError(
        f"{source} lacks {sorted(_ARRAYS - names)}, it has {found[:20]}"
        f"{' and more' if len(found) > 20 else ''}{other}: rename its arrays to "
        "observations, actions and, for the ends of episodes, timeouts or terminals "
        "(dones beside them), episode_lengths or episode_ids; or convert them with "
        "from_arrays"
    )


def _unknown(what: str) -> ValueError:
    known = "; ".join(f"{entry.name}: {entry.looks}" for entry in FORMATS)
    return ValueError(
        f"{what}. The known formats are {known}. Give one of these, name it with "
        "format=, or convert your arrays with from_arrays"
    )


def _check_options(known: DatasetFormat, options: dict[str, Any]) -> None:
    parameters = inspect.signature(known.options or known.load).parameters.values()
    there = [p.name for p in parameters if p.kind == p.KEYWORD_ONLY]
    unknown = sorted(set(options) - set(there))
    if unknown:
        raise TypeError(
            f"the format {known.name!r} has no options {unknown}, it has {there}: "
            "correct them"
        )


# --- how formats are recognised ------------------------------------------------------


def _is_transitions(path: Path) -> bool:
    return (path / "meta.json").exists()


def _minari_root(path: Path) -> Path | None:
    """Returns the folder of a Minari dataset, given it or what is in it."""
    path = path.absolute()
    if path.name == "main_data.hdf5":
        path = path.parent
    folder = path.parent if path.name == "data" else path
    return folder if (folder / "data" / "metadata.json").exists() else None


def _is_minari_id(source: str) -> bool:
    try:
        return dataset_path(source).is_dir()
    except ImportError:  # of Minari, which says where datasets are
        return False


def _names_in_npz(path: Path) -> set[str]:
    if path.suffix != ".npz":
        return set()
    with NpzStreams(path, "file of arrays", _AGAIN) as arrays:
        # Arrays of a group are named "observations/arm".
        return {name.split("/")[0] for name in arrays.kinds}


def _is_ogbench(path: Path) -> bool:
    names = _names_in_npz(path)
    # OGBench has masks with its rewards. Others say with terminals that a task ended.
    has_own_rewards = "rewards" in names and "masks" not in names
    is_own = bool(names & _OGBENCH_OWN) or path.name.startswith(_OGBENCH_NAMES)
    fits = _OGBENCH <= names <= _OGBENCH | _OGBENCH_MORE
    return fits and is_own and not has_own_rewards


def _names_in_hdf5(path: Path) -> set[str]:
    if path.suffix not in _HDF5:
        return set()
    with open_hdf5(path) as stored, reading_hdf5(path):
        return {str(name) for name in stored}


def _is_arrays(names: set[str]) -> bool:
    return names >= _ARRAYS


# --- loaders with another form -------------------------------------------------------


def _open_transitions(source: str, path: str | Path, *, verify: bool = False) -> Any:
    return load_transitions(source, verify=verify)


def _load_minari(source: str, path: str | Path, **options: Any) -> TensorDict:
    with extra("envs", source):
        import minari  # noqa: F401
    root = _minari_root(Path(source))
    if root is None:
        return load_minari(source, path, **options)
    return load_minari(open_minari(root.name, root.parent), path, **options)


#: All formats, in the order in which they are tried.
FORMATS: tuple[DatasetFormat, ...] = (
    DatasetFormat(
        "transitions",
        "a folder with meta.json",
        _is_transitions,
        _open_transitions,
    ),
    DatasetFormat(
        "minari",
        "minari://ID, the id of a dataset on this machine, or its folder",
        lambda path: _minari_root(path) is not None,
        _load_minari,
        "minari",
        load_minari,
    ),
    DatasetFormat(
        "lerobot",
        "lerobot://REPO, or a folder with meta/info.json",
        lambda path: (path / "meta" / "info.json").exists(),
        load_lerobot,
        "lerobot",
    ),
    DatasetFormat(
        "ogbench",
        "ogbench://NAME, or a file .npz with observations, actions and terminals, and "
        "with qpos, valids or the name of one of its datasets",
        _is_ogbench,
        load_ogbench,
        "ogbench",
    ),
    DatasetFormat(
        "npz",
        "another file .npz with observations, actions and the ends of episodes",
        lambda path: _is_arrays(_names_in_npz(path)),
        load_array_file,
    ),
    DatasetFormat(
        "robomimic",
        "a file .hdf5 or .h5 with data/demo_*",
        lambda path: "data" in _names_in_hdf5(path),
        load_robomimic,
    ),
    DatasetFormat(
        "hdf5",
        "another file .hdf5 or .h5 with observations, actions and the ends of episodes",
        lambda path: _is_arrays(_names_in_hdf5(path)),
        load_array_file,
    ),
)
