"""Local Minari datasets: where they lie, and how they are written whole or not at all.

Shared by the dataset creators of :mod:`torchrl_caiac.envs`.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.data.load_transitions import load_transitions

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer
    from tensordict import TensorDict

__all__ = [
    "dataset_path",
    "free_dataset_path",
    "index_tree",
    "open_minari",
    "publish_dataset",
    "stack_trees",
    "whole_folder",
    "work_folder",
    "write_rows",
]

_PARTIAL = ".partial-"


def dataset_path(dataset_id: str, root: str | os.PathLike[str] | None = None) -> Path:
    """Return the folder of a Minari dataset.

    Args:
        dataset_id: Minari's name of the dataset.
        root: folder of Minari datasets; `MINARI_DATASETS_PATH` or Minari's own where
            None.

    Returns:
        the folder, which need not exist.

    Example:
        >>> dataset_path("kitchen/play-v0", "/data").as_posix()
        '/data/kitchen/play-v0'
    """
    if root is not None:
        # Minari loses its way from a relative one.
        return Path(root).absolute() / dataset_id
    from minari.storage import get_dataset_path

    return Path(get_dataset_path(dataset_id)).absolute()


def free_dataset_path(
    dataset_id: str, root: str | os.PathLike[str] | None, overwrite: bool
) -> Path:
    """Return the folder of a dataset that is to be written.

    Args:
        dataset_id: Minari's name of the dataset.
        root: see :func:`dataset_path`.
        overwrite: whether there may be one already.

    Returns:
        the folder.

    Raises:
        FileExistsError: there is a dataset of that name and `overwrite` is False.
    """
    target = dataset_path(dataset_id, root)
    if target.exists() and not overwrite:
        raise FileExistsError(
            f"there is a dataset {dataset_id!r} at {target}; pass overwrite=True to "
            "replace it"
        )
    return target


def open_minari(
    dataset_id: str,
    root: str | os.PathLike[str] | None = None,
    *,
    download: bool = False,
) -> MinariDataset:
    """Open a Minari dataset.

    Args:
        dataset_id: Minari's name of the dataset.
        root: see :func:`dataset_path`.

    Keyword Args:
        download: fetch a dataset that is not there, to where it is looked for.

    Returns:
        the dataset.

    Raises:
        FileNotFoundError: there is none of that name.
    """
    import minari

    data = dataset_path(dataset_id, root) / "data"
    if not data.exists() and download:
        with _datasets_in(root):
            minari.download_dataset(dataset_id)
    if not data.exists():
        raise FileNotFoundError(
            f"no Minari dataset {dataset_id!r} at {data.parent}; collect it first, "
            "pass download=True where there is a network, or say where it is with "
            "root= or MINARI_DATASETS_PATH"
        )
    return minari.MinariDataset(data)


@contextlib.contextmanager
def _datasets_in(root: str | os.PathLike[str] | None) -> Iterator[None]:
    """Let Minari's own functions work in a folder; where they do anyway for None."""
    previous = os.environ.get("MINARI_DATASETS_PATH")
    if root is not None:
        os.environ["MINARI_DATASETS_PATH"] = str(Path(root).absolute())
    try:
        yield
    finally:
        if previous is None:
            os.environ.pop("MINARI_DATASETS_PATH", None)
        else:
            os.environ["MINARI_DATASETS_PATH"] = previous


@contextlib.contextmanager
def work_folder(work: str | os.PathLike[str] | None, dataset_id: str) -> Iterator[Path]:
    """Give a folder for the episodes of a collection, temporary where None is named.

    Args:
        work: where several collections keep theirs.
        dataset_id: Minari's name of the dataset that is collected.

    Yields:
        the collection's own folder.
    """
    if work is not None:
        yield Path(work) / dataset_id.replace("/", "-")
        return
    with tempfile.TemporaryDirectory(prefix="collection-") as folder:
        yield Path(folder)


def publish_dataset(
    dataset_id: str,
    buffers: Iterable[EpisodeBuffer],
    target: Path,
    make_env: Callable[[], Any],
    *,
    code: str,
    progress: bool,
    description: str,
    algorithm_name: str,
) -> MinariDataset:
    """Write a dataset beside its place and move it there when it is whole.

    Args:
        dataset_id: Minari's name of the dataset.
        buffers: the episodes.
        target: of :func:`free_dataset_path`; what is there is replaced.
        make_env: makes the environment that Minari keeps the specification of.

    Keyword Args:
        code: the file that collected it.
        progress: show a progress bar.
        description: what the dataset holds.
        algorithm_name: what acted.

    Returns:
        the dataset.
    """
    import minari
    from minari import MinariDataset
    from tqdm import tqdm

    place = target
    for _ in Path(dataset_id).parts:
        place = place.parent
    place.mkdir(parents=True, exist_ok=True)
    env = make_env()
    partial = Path(tempfile.mkdtemp(dir=place, prefix=_PARTIAL))
    try:
        bar = tqdm(buffers, desc=f"writing {dataset_id}", disable=not progress)
        with _datasets_in(partial):
            minari.create_dataset_from_buffers(
                dataset_id,
                bar,
                env=env,
                eval_env=env,
                algorithm_name=algorithm_name,
                author="torchrl-caiac",
                author_email="none",
                code_permalink=code,
                description=description,
                requirements=["gymnasium-robotics>=1.4,<1.5", "mujoco>=3.1,<3.12"],
            )
        built = partial / dataset_id
        target.parent.mkdir(parents=True, exist_ok=True)
        # Minari describes a namespace in a file of its own.
        for extra in built.parent.iterdir():
            if extra.is_file() and not (target.parent / extra.name).exists():
                os.replace(extra, target.parent / extra.name)
        _swap(built, target, partial / "replaced")
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        env.close()
    return MinariDataset(target / "data")


@contextlib.contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a folder to make, which is moved to its place when the block ends well.

    Args:
        path: the place; what is there is replaced then.

    Yields:
        a folder beside it that does not exist yet.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=path.parent, prefix=_PARTIAL))
    try:
        yield partial / "rows"
        _swap(partial / "rows", path, partial / "replaced")
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _swap(made: Path, place: Path, replaced: Path) -> None:
    """Move what was made to its place, and what was there before out of the way."""
    there = place.exists()
    if there:
        os.replace(place, replaced)
    try:
        os.replace(made, place)
    except OSError:
        if there:
            os.replace(replaced, place)
        raise


def write_rows(rows: TensorDict, path: str | os.PathLike[str]) -> TensorDict:
    """Write rows to a folder, which appears whole or not at all, and open them.

    Args:
        rows: transitions `[T]`.
        path: the folder; what is there is replaced.

    Returns:
        the memory-mapped rows.
    """
    with whole_folder(path) as folder:
        rows.memmap(folder)
    return load_transitions(Path(path))


def stack_trees(trees: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Stack nested arrays of equal structure, `[*]` each, to `[M, *]`.

    Args:
        trees: `M` mappings of names to arrays or mappings.

    Returns:
        one such mapping.

    Example:
        >>> stack_trees([{"a": 1}, {"a": 2}])
        {'a': array([1, 2])}
    """
    return {
        key: stack_trees([tree[key] for tree in trees])
        if isinstance(value, Mapping)
        else np.stack([tree[key] for tree in trees])
        for key, value in trees[0].items()
    }


def index_tree(tree: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Return the entry of nested arrays at an index, what :func:`stack_trees` undid.

    Args:
        tree: mapping of names to arrays `[M, *]` or mappings.
        index: which of the `M`.

    Returns:
        the same mapping with arrays `[*]`.

    Example:
        >>> import numpy as np
        >>> index_tree({"a": np.array([1, 2])}, 1)["a"].item()
        2
    """
    return {
        key: index_tree(value, index) if isinstance(value, Mapping) else value[index]
        for key, value in tree.items()
    }
