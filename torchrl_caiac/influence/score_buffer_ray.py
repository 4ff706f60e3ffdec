"""Scores a folder with the workers of a Ray cluster."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensordict.utils import NestedKey
from torch import nn
from tqdm.auto import tqdm

from torchrl_caiac._checks import check_int
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence.score_buffer import score_buffer
from torchrl_caiac.influence.shards import scoring_progress

__all__ = ["score_buffer_ray"]

_SECONDS = 1.0  # between two looks at the progress


def score_buffer_ray(
    folder: str | os.PathLike[str],
    estimator: Any,
    *,
    num_workers: int,
    resources: Mapping[str, Any] | None = None,
    max_retries: int = 3,
    key: NestedKey = ("caiac", "score"),
    progress: bool = True,
    **kwargs: Any,
) -> None:
    """Scores the transitions of a folder with tasks of Ray.

    Each task takes part in :func:`~torchrl_caiac.influence.score_buffer` with
    ``shard=(i, num_workers)``. All nodes of the cluster need the folder under the same
    path. A task that is killed is started again; the others take over its rows
    meanwhile. A task whose call raises ends all of them, and the error is raised here;
    what is scored by then is kept, and the next call goes on from there. The scores are
    those of one process, to the bit on processors of one kind.

    A cluster that is already connected is used. Otherwise Ray starts one on this
    machine, or connects to that of ``RAY_ADDRESS``.

    Args:
        folder (path): the folder of the transitions, see
            :func:`~torchrl_caiac.data.load_transitions`.
        estimator (callable): see :func:`~torchrl_caiac.influence.score_buffer`. It has
            to be picklable.

    Keyword Args:
        num_workers (int): the number of tasks, at least 1.
        resources (mapping, optional): what each task occupies, as in ``ray.remote``,
            such as ``{"num_cpus": 1, "num_gpus": 0.5}``. A task that has a GPU moves
            an estimator that is a module there. A warning says so if no node has them.
            Defaults to ``None``: one CPU.
        max_retries (int): how often a killed task is started again. Defaults to 3.
        key (NestedKey): the leaf to write. Defaults to ``("caiac", "score")``.
        progress (bool): show a progress bar of all tasks. Defaults to ``True``.
        **kwargs (Any): further arguments of
            :func:`~torchrl_caiac.influence.score_buffer`.

    Raises:
        ImportError: Ray is not installed.
        TypeError: ``shard`` is given.
        ValueError: ``num_workers`` or ``max_retries`` is out of range.

    Examples:
        >>> from torchrl_caiac.influence.score_buffer_ray import score_buffer_ray
        >>> score_buffer_ray("data", estimator, num_workers=8)  # doctest: +SKIP
    """
    check_int("num_workers", num_workers, 1)
    check_int("max_retries", max_retries, 0)
    if "shard" in kwargs:
        raise TypeError("score_buffer_ray numbers the tasks itself: leave out shard")
    try:
        import ray
    except ImportError as error:
        raise ImportError(
            "score_buffer_ray needs Ray: pip install 'torchrl-caiac[ray]'"
        ) from error
    path = Path(folder).absolute()
    load_transitions(path)  # raises here what each task would
    if not ray.is_initialized():
        ray.init(include_dashboard=False)
    options = {"num_cpus": 1, **(resources or {}), "max_retries": max_retries}
    task = ray.remote(**options)(_score_shard)
    _warn_if_too_large(options)
    # Once for all tasks.
    settings = ray.put((estimator, {**kwargs, "key": key}))
    waiting = [
        task.remote(path, settings, (i, num_workers)) for i in range(num_workers)
    ]
    with tqdm(unit=" rows", disable=not progress, desc="scores") as bar:
        try:
            while waiting:
                done, waiting = ray.wait(waiting, timeout=_SECONDS)
                ray.get(done)
                found = scoring_progress(path, key)
                if found is not None:
                    bar.total = found.total
                    bar.update(found.done - bar.n)
            if bar.total is not None:
                bar.update(bar.total - bar.n)
        finally:
            for reference in waiting:
                ray.cancel(reference, force=True)


def _warn_if_too_large(options: Mapping[str, Any]) -> None:
    """Warns if no node of the cluster has what a task occupies."""
    import ray

    names = {"num_cpus": "CPU", "num_gpus": "GPU", "memory": "memory"}
    needed = {new: options[old] for old, new in names.items() if options.get(old)}
    needed |= options.get("resources") or {}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(n, 0) >= needed[n] for n in needed) for node in nodes):
        found = [{name: node.get(name, 0) for name in needed} for node in nodes]
        warnings.warn(
            f"each task needs {needed}, and no node of the cluster has that, they have "
            f"{found}: the tasks wait until such a node joins. Interrupt this call, "
            "and give other resources=, unless the cluster adds nodes by itself",
            stacklevel=3,
        )


def _score_shard(
    path: Path, settings: tuple[Any, dict[str, Any]], shard: tuple[int, int]
) -> None:
    """Runs in a task of Ray."""
    import ray

    estimator, kwargs = settings
    gpus = ray.get_runtime_context().get_accelerator_ids().get("GPU")
    if gpus and isinstance(estimator, nn.Module):
        estimator = estimator.to("cuda")
    rb = offline_buffer(load_transitions(path))
    score_buffer(rb, estimator, progress=False, shard=shard, **kwargs)
