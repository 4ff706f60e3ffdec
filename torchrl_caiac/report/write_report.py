"""Writes a report."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from tensordict.utils import NestedKey

from torchrl_caiac._whole_files import whole_file
from torchrl_caiac.report.contents import collect_contents
from torchrl_caiac.report.page import page_text
from torchrl_caiac.report.pictures import RenderFn
from torchrl_caiac.report.settings import ReportSettings
from torchrl_caiac.scored import ScoredDataset

__all__ = ["write_report"]


def write_report(
    scored: ScoredDataset,
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
    date: str | None = None,
    windows: tuple[int, ...] = (10, 20),
    trajectories: int = 4,
    pairs: int = 6,
    examples: int = 4,
    samples: int = 20_480,
    counterfactual_ratio: float = 0.5,
    render: RenderFn | Literal["auto"] | None = "auto",
    seed: int = 0,
    trajectory_key: NestedKey | None = "episode",
    done_key: NestedKey | None = ("next", "done"),
    overwrite: bool = False,
) -> Path:
    """Writes a page that shows what can be swapped in a scored dataset.

    The page is one HTML file without scripts, which needs no network. It shows what the
    dataset is, warnings, the influence along some trajectories, the distribution of
    scores with the thresholds, how often each entity may be swapped, which combinations
    of places swaps add, examples, and the code to use it. The same dataset and
    arguments give the same file.

    Combinations and examples are samples of a replay buffer with a
    :class:`~torchrl_caiac.CAIACTransform`.

    Args:
        scored (ScoredDataset): the scored dataset, see
            :func:`~torchrl_caiac.scored.open_scored`.
        path (path): the file to write. It is written atomically.

    Keyword Args:
        title (str, optional): the heading. Defaults to ``None``: the folder's name.
        date (str, optional): a date below the heading. Defaults to ``None``: no date.
        windows (tuple of int): the lengths κ of windows for which the share that may be
            swapped is shown. Defaults to ``(10, 20)``.
        trajectories (int): the number of trajectories to show. Defaults to 4.
        pairs (int): the number of pairs of entities with a figure; the table has all.
            Defaults to 6.
        examples (int): the number of example counterfactuals. Defaults to 4.
        samples (int): the number of samples to draw. Defaults to 20,480.
        counterfactual_ratio (float): the share of them that are counterfactual.
            Defaults to 0.5.
        render (callable, "auto" or None): how examples are shown. A function from
            states, a tensordict ``[S]`` with ``layout.in_keys``, to RGB frames, uint8
            ``[S, height, width, 3]``; ``None`` for plots of positions. Defaults to
            ``"auto"``: pictures if the layout is that of an environment of this
            package, else plots.
        seed (int): the seed of the samples. Defaults to 0.
        trajectory_key (NestedKey, optional): the trajectory ids, as in
            :func:`~torchrl_caiac.trajectories.trajectory_index`. Defaults to
            ``"episode"``.
        done_key (NestedKey, optional): the end flags, as there. Defaults to
            ``("next", "done")``.
        overwrite (bool): replace an existing file. Defaults to ``False``.

    Returns:
        Path: the file.

    Raises:
        FileExistsError: the file exists, and ``overwrite`` is ``False``.
        ImportError: matplotlib or Jinja is not installed.
        ValueError: an argument is out of range, rows have no finite score, or no entity
            may be swapped.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.report import write_report
        >>> from torchrl_caiac.scored import ScoredDataset
        >>> walk = torch.randn(101, 2, generator=torch.Generator().manual_seed(0))
        >>> walk = walk.cumsum(0)
        >>> step = torch.arange(100)
        >>> data = TensorDict({
        ...     "observation": walk[:-1], "action": walk.diff(dim=0),
        ...     "episode": step // 50, "caiac": {"score": torch.rand(100, 2)},
        ...     "next": {"observation": walk[1:], "done": step[:, None] % 50 == 49}},
        ...     [100])
        >>> scored = ScoredDataset(
        ...     Path("walk"), data,
        ...     EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"]),
        ...     estimator="motion",
        ...     settings={}, thresholds={"cup": 0.5},
        ...     confidence={"cup": "unclear"}, reasons={"cup": "random scores"},
        ...     free={"cup": 0.5})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = write_report(scored, f"{folder}/report.html", samples=512)
        ...     "<title>Influence in walk</title>" in file.read_text(encoding="utf-8")
        True
    """
    file = Path(path)
    numbers = {
        "trajectories": trajectories,
        "pairs": pairs,
        "examples": examples,
        "samples": samples,
        **{f"windows[{i}]": window for i, window in enumerate(windows)},
    }
    for name, value in numbers.items():
        least = 0 if name in ("trajectories", "pairs", "examples") else 1
        if value < least:
            raise ValueError(f"{name} is {value}, expected at least {least}")
    if not 0 < counterfactual_ratio <= 1:
        raise ValueError(
            f"counterfactual_ratio is {counterfactual_ratio}, expected above 0 and at "
            "most 1"
        )
    if isinstance(render, str) and render != "auto":
        raise ValueError(f"render is {render!r}, expected a function, 'auto' or None")
    if file.is_dir():
        raise FileExistsError(
            f"{file} is a folder: name a file in it, such as report.html"
        )
    if file.exists() and not overwrite:
        raise FileExistsError(f"{file} exists: pass overwrite=True to replace it")
    _check_packages()
    settings = ReportSettings(
        windows=tuple(windows),
        trajectories=trajectories,
        pairs=pairs,
        examples=examples,
        samples=samples,
        ratio=counterfactual_ratio,
        seed=seed,
        trajectory_key=trajectory_key,
        done_key=done_key,
    )
    contents = collect_contents(scored, settings, render)
    text = page_text(
        contents,
        scored,
        settings,
        title=f"Influence in {scored.path.name}" if title is None else title,
        date=date,
    )
    with whole_file(file) as partial:
        partial.write_text(text, encoding="utf-8")
    return file


def _check_packages() -> None:
    try:
        import jinja2  # noqa: F401
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"a report needs {error.name}, which is not installed: pip install "
            "'torchrl-caiac[report]'"
        ) from error
