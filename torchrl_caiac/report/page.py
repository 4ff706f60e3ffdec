"""The page of a report: texts and tables around the figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torchrl_caiac
from torchrl_caiac.report.contents import ReportContents
from torchrl_caiac.report.settings import ReportSettings
from torchrl_caiac.report.svg import printable
from torchrl_caiac.report.swaps import CELLS, PLANE
from torchrl_caiac.scored import ScoredDataset

__all__ = ["page_text", "settings_rows", "share_text", "usage_code"]

# What the estimators of the command line do, for readers who do not know them.
_ESTIMATORS = {
    "motion": "it counts an entity as influenced where it moves in the recording, by "
    "more than its noise",
    "residual": "it counts an entity as influenced where a model of this entity alone "
    "does not predict its motion",
    "cai": "it asks a world model how much the next state of an entity depends on the "
    "choice of the action",
    "attention": "it reads the attention of a transformer world model from each entity "
    "to the action",
    "distance": "it counts an entity as influenced where the robot is near",
}
_FOLDER = Path(__file__).parent


def page_text(
    contents: ReportContents,
    scored: ScoredDataset,
    settings: ReportSettings,
    *,
    title: str,
    date: str | None,
) -> str:
    """Returns the page as HTML.

    Args:
        contents (ReportContents): what it says.
        scored (ScoredDataset): the scored dataset.
        settings (ReportSettings): how much it shows.

    Keyword Args:
        title (str): the heading.
        date (str, optional): the date below it.

    Returns:
        str: one self-contained page.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup, escape

    environment = Environment(
        loader=FileSystemLoader(_FOLDER),
        autoescape=True,  # names come from the dataset
        finalize=_finalized,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["percent"] = share_text
    template = environment.get_template("page.html.jinja")
    text = template.render(
        report=contents,
        scored=scored,
        settings=settings,
        title=title,
        date=date,
        version=torchrl_caiac.__version__,
        style=Markup((_FOLDER / "page.css").read_text(encoding="utf-8")),
        svg=Markup,  # what this package drew, already escaped
        estimator_text=_ESTIMATORS.get(scored.estimator, ""),
        cells=CELLS,
        plane=PLANE,
        code=escape(usage_code(scored)),
        source_rows=settings_rows(scored.source),
        setting_rows=settings_rows(scored.settings),
        coverage_rows=settings_rows(scored.coverage or {}),
    )
    return text.strip() + "\n"


def _finalized(value: Any) -> Any:
    # A Markup is a str, too; its texts are printable already, and it has line breaks.
    return printable(value) if type(value) is str else value


def share_text(share: float) -> str:
    r"""Returns a share in percent, never rounded to nothing or everything.

    Args:
        share (float): in [0, 1].

    Returns:
        str: the text.

    Examples:
        >>> from torchrl_caiac.report.page import share_text
        >>> for share in (0.0, 0.0001, 0.1234, 0.9999):
        ...     print(share_text(share).replace("\N{NO-BREAK SPACE}", " "))
        0 %
        < 0.1 %
        12.3 %
        > 99.9 %
    """
    if share in (0, 1):
        return f"{100 * share:.0f}\N{NO-BREAK SPACE}%"
    if share < 0.001:
        return "<\N{NO-BREAK SPACE}0.1\N{NO-BREAK SPACE}%"
    if share > 0.999:
        return ">\N{NO-BREAK SPACE}99.9\N{NO-BREAK SPACE}%"
    return f"{100 * share:.1f}\N{NO-BREAK SPACE}%"


def usage_code(scored: ScoredDataset) -> str:
    """Returns the code that samples counterfactuals of a scored dataset.

    Args:
        scored (ScoredDataset): the scored dataset.

    Returns:
        str: Python code; ``batch`` is the last name it defines.
    """
    key = ""
    if scored.score_key != ("caiac", "score"):
        key = f", score_key={scored.score_key!r}"
    return (
        "from torchrl_caiac import CAIACTransform\n"
        "from torchrl_caiac.data import offline_buffer\n"
        "from torchrl_caiac.scored import open_scored\n"
        "\n"
        f"scored = open_scored({str(scored.path)!r})\n"
        "rb = offline_buffer(scored.data, batch_size=256)\n"
        "rb.append_transform(\n"
        f"    CAIACTransform(scored.layout, scored.thresholds{key})\n"
        ")\n"
        "batch = rb.sample()\n"
    )


def settings_rows(content: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Returns nested settings as rows of a table.

    Args:
        content (dict): JSON values.
        prefix (str): what the names begin with. Defaults to ``""``.

    Returns:
        list of pairs of str: names, joined by dots, and values.

    Examples:
        >>> from torchrl_caiac.report.page import settings_rows
        >>> settings_rows({"cai": {"actions": 64}, "spread": [0.25, 1 / 3]})
        [('cai.actions', '64'), ('spread', '0.25, 0.3333')]
    """
    rows = []
    for key, value in content.items():
        if value is None:
            continue
        if isinstance(value, dict):
            rows += settings_rows(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", _value_text(value)))
    return rows


def _value_text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(map(_value_text, value))
    return json.dumps(value)
