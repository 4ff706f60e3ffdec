"""Local Minari datasets: their folders, and writing them atomically."""

from __future__ import annotations

import contextlib
import inspect
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_caiac._extras import extra
from torchrl_caiac._files import UnreadableFileError, whole_folder
from torchrl_caiac.data.collect import collection_folder
from torchrl_caiac.data.minari_checks import check_metadata

if TYPE_CHECKING:
    from gymnasium import Space
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer

__all__ = [
    "dataset_path",
    "free_dataset_path",
    "open_minari",
    "publish_dataset",
    "work_folder",
]


def dataset_path(dataset_id: str, root: str | os.PathLike[str] | None = None) -> Path:
    """Returns the folder of a Minari dataset.

    Args:
        dataset_id (str): the id of the dataset.
        root (path, optional): the folder of all Minari datasets. Defaults to ``None``:
            ``MINARI_DATASETS_PATH``, or the default of Minari.

    Returns:
        Path: the folder, which need not exist.

    Examples:
        >>> from torchrl_caiac.data.minari_files import dataset_path
        >>> dataset_path("push/play-v0", "/data").as_posix()
        '/data/push/play-v0'
    """
    if root is not None:
        # Minari does not support relative paths.
        return Path(root).absolute() / dataset_id
    with extra("envs", dataset_id):
        from minari.storage import get_dataset_path

    return Path(get_dataset_path(dataset_id)).absolute()


def free_dataset_path(
    dataset_id: str,
    root: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> Path:
    """Returns the folder of a Minari dataset to write, after checking that it is free.

    Args:
        dataset_id (str): the id of the dataset.
        root (path, optional): as in :func:`dataset_path`. Defaults to ``None``.
        overwrite (bool): whether the dataset may exist. Defaults to ``False``.

    Returns:
        Path: the folder.

    Raises:
        FileExistsError: the dataset exists and ``overwrite`` is ``False``.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.data.minari_files import free_dataset_path
        >>> with tempfile.TemporaryDirectory() as root:
        ...     free_dataset_path("push/play-v0", root).name
        'play-v0'
    """
    target = dataset_path(dataset_id, root)
    if target.exists() and not overwrite:
        raise FileExistsError(
            f"the dataset {dataset_id!r} exists at {target}: give another id, or pass "
            "overwrite=True to replace it"
        )
    return target


def open_minari(
    dataset_id: str,
    root: str | os.PathLike[str] | None = None,
    *,
    download: bool = False,
) -> MinariDataset:
    """Opens a Minari dataset.

    Args:
        dataset_id (str): the id of the dataset.
        root (path, optional): as in :func:`dataset_path`. Defaults to ``None``.

    Keyword Args:
        download (bool): whether to download a missing dataset, into ``root``. Defaults
            to ``False``.

    Returns:
        MinariDataset: the dataset.

    Raises:
        FileNotFoundError: the dataset does not exist.
        UnreadableFileError: its metadata are damaged, or would run code.

    Examples:
        >>> import tempfile
        >>> from torchrl_caiac.data.minari_files import open_minari
        >>> with tempfile.TemporaryDirectory() as root:
        ...     open_minari("push/play-v0", root)
        Traceback (most recent call last):
        ...
        FileNotFoundError: no Minari dataset 'push/play-v0' in ...
    """
    with extra("envs", dataset_id):
        import minari

    data = dataset_path(dataset_id, root) / "data"
    if not data.exists() and download:
        with _datasets_in(root):
            minari.download_dataset(dataset_id)
    if not data.exists():
        raise FileNotFoundError(
            f"no Minari dataset {dataset_id!r} in {data.parent}: collect it first, "
            "pass download=True, or give its folder with root= or MINARI_DATASETS_PATH"
        )
    check_metadata(data)
    try:
        return minari.MinariDataset(data)
    except Exception as error:  # gymnasium and Minari raise many kinds
        raise UnreadableFileError(
            f"Minari cannot open {data} ({type(error).__name__}: {error}): download or "
            "collect the dataset again"
        ) from error


@contextlib.contextmanager
def _datasets_in(root: str | os.PathLike[str] | None) -> Iterator[None]:
    """Sets the folder that Minari's functions use; ``None`` changes nothing."""
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
    """Context manager that provides a folder for the episodes of a collection.

    Args:
        work (path, optional): the folder of several collections, to resume an
            interrupted one. ``None``: a temporary folder.
        dataset_id (str): the id of the dataset to collect.

    Yields:
        Path: the folder of this collection.

    Examples:
        >>> from torchrl_caiac.data.minari_files import work_folder
        >>> with work_folder("/work", "push/play-v0") as folder:
        ...     folder.as_posix()
        '/work/push-play-v0'
    """
    own = None if work is None else Path(work) / dataset_id.replace("/", "-")
    with collection_folder(own) as folder:
        yield folder


def publish_dataset(
    dataset_id: str,
    buffers: Iterable[EpisodeBuffer],
    target: Path,
    make_env: Callable[[], Any] | None,
    *,
    code: str,
    requirements: Sequence[str],
    progress: bool,
    description: str,
    algorithm_name: str,
    spaces: tuple[Space[Any], Space[Any]] | None = None,
) -> MinariDataset:
    """Writes a Minari dataset, atomically.

    Args:
        dataset_id (str): the id of the dataset.
        buffers (iterable of EpisodeBuffer): the episodes.
        target (Path): the folder, as returned by :func:`free_dataset_path`. It is
            replaced if it exists.
        make_env (callable, optional): creates the environment, whose specification
            Minari stores. ``None``: it is unknown, and ``spaces`` are given.

    Keyword Args:
        code (str): the file that collected the dataset.
        requirements (sequence of str): the packages that the environment needs, as in a
            requirements file.
        progress (bool): whether to show a progress bar.
        description (str): the content of the dataset.
        algorithm_name (str): the policy that acted.
        spaces (tuple of gymnasium.Space, optional): the spaces of the observations and
            of the actions. Images are then stored without loss. Defaults to ``None``:
            those of the environment.

    Returns:
        MinariDataset: the dataset.

    Examples:
        >>> import tempfile
        >>> import gymnasium
        >>> import numpy as np
        >>> from minari.data_collector import EpisodeBuffer
        >>> from torchrl_caiac.data import minari_files
        >>> episode = EpisodeBuffer(
        ...     observations=np.zeros((3, 4), np.float32),
        ...     actions=np.zeros(2, int),
        ...     rewards=np.zeros(2),
        ...     terminations=np.zeros(2, bool),
        ...     truncations=np.array([False, True]),
        ... )
        >>> with tempfile.TemporaryDirectory() as root:
        ...     dataset = minari_files.publish_dataset(
        ...         "pole/rest-v0",
        ...         [episode],
        ...         minari_files.free_dataset_path("pole/rest-v0", root),
        ...         lambda: gymnasium.make("CartPole-v1"),
        ...         code="examples/collect.py",
        ...         requirements=["gymnasium>=1"],
        ...         progress=False,
        ...         description="A pole at rest.",
        ...         algorithm_name="none",
        ...     )
        ...     dataset.total_steps
        2
    """
    import minari
    from minari import MinariDataset
    from tqdm import tqdm

    env = None if make_env is None else make_env()
    options: dict[str, Any] = {}
    if spaces is not None:
        options["observation_space"], options["action_space"] = spaces
        # Minari compresses images as JPEG, from 0.5.4 on.
        create = minari.create_dataset_from_buffers
        if "jpeg_encoding" in inspect.signature(create).parameters:
            options["jpeg_encoding"] = False
    try:
        with whole_folder(target) as made:
            partial = made.parent / "minari"
            partial.mkdir()
            bar = tqdm(buffers, desc=f"writing {dataset_id}", disable=not progress)
            with _datasets_in(partial), warnings.catch_warnings():
                if env is None:  # which is what it warns of
                    warnings.filterwarnings("ignore", module="minari")
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
                    requirements=list(requirements),
                    **options,
                )
            built = partial / dataset_id
            # Minari stores the description of a namespace in a separate file.
            for extra in built.parent.iterdir():
                if extra.is_file() and not (target.parent / extra.name).exists():
                    os.replace(extra, target.parent / extra.name)
            os.replace(built, made)
    finally:
        if env is not None:
            env.close()
    return MinariDataset(target / "data")
