from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from torchrl_caiac._figures import new_figure
from torchrl_caiac.report.figures import (
    draw_influence,
    draw_lengths,
    draw_marks,
    draw_plan,
    draw_scores,
)
from torchrl_caiac.report.svg import RECORDED, drawing, short_label, svg_text

HOSTILE = (
    "<script>alert(1)</script>",
    "$\\frac{a}{",
    '"><img src=x onerror=alert(1)>',
    "_hidden",
    "two\nlines\x00and\x1b[31m",
    "杯子 🫖",
    "a" * 300,
    " ",
    "&amp;",
)


def parsed(svg: str) -> ElementTree.Element:
    """An SVG element, which is also well-formed XML."""
    return ElementTree.fromstring(svg)


def texts(svg: str) -> str:
    return "".join(parsed(svg).itertext())


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names(name: str) -> None:
    scores = np.random.default_rng(0).random((30, 1))
    at = np.zeros(3)
    figures = [
        draw_influence(scores, scores > 0.5, [name], [0.5], name="a", description=name),
        draw_plan(
            {name: (at, at + 1, True)},
            {name: scores[:, [0, 0, 0]]},
            name="a",
            description=name,
        ),
        draw_marks(
            {name: (at[0], at[1], False)},
            {name: scores[:, 0]},
            name="a",
            description=name,
        ),
    ]
    for svg in figures:
        root = parsed(svg)
        assert {e.tag for e in root.iter()} <= {
            "svg",
            "g",
            "path",
            "defs",
            "style",
            "use",
            "text",
            "clipPath",
            "rect",
        }
        assert short_label(name, 8)[:4].strip() in texts(svg)
        assert root.get("aria-label") == name.replace("\n", " ").replace(
            "\x00", "\N{REPLACEMENT CHARACTER}"
        ).replace("\x1b", "\N{REPLACEMENT CHARACTER}")


def test_colours_and_ids_of_the_page() -> None:
    def draw(name: str) -> str:
        with drawing():
            figure = new_figure(3.0, 2.0)
            axes = figure.add_subplot()
            axes.plot([0, 1], [0, 1], "o", color=RECORDED)
            axes.set_xlabel("0.000123")
            return svg_text(figure, name, "a line")

    one, two = draw("one"), draw("two")
    assert "var(--recorded)" in one and RECORDED not in one
    assert "0.000123" in texts(one)  # only geometry is rounded
    ids = [
        {e.get("id") for e in parsed(svg).iter() if e.get("id")} for svg in (one, two)
    ]
    assert ids[0] and all(i.startswith("one-") for i in ids[0])
    assert not ids[0] & ids[1]
    for svg, own in zip((one, two), ids, strict=True):
        used = {e.get("href", "#").lstrip("#") for e in parsed(svg).iter()} - {""}
        assert used and used <= own
    assert "font-family" not in one
    assert draw("one") == one


@pytest.mark.parametrize(
    "scores, threshold",
    [
        ([0.0] * 20, 0.5),
        ([0.0, 0.0, 3.0, 9.0], 0.5),
        ([-2.0, -1.0, 0.0, 1.0, 40.0], -0.5),
        ([1e-9, 1e-3, 2.0, 1e6], 1e-2),
        ([0.3], 0.3),
        ([0.2, 0.3], -1.0),
        ([5.0], 0.0),
    ],
)
def test_scores_of_all_kinds(scores: list[float], threshold: float) -> None:
    values = np.array(scores, dtype=np.float32)
    svg = draw_scores(values, threshold, name="a", description="scores")
    free = int((values <= np.float32(threshold)).sum())
    # Both colours only where there are both kinds of scores.
    assert ("var(--recorded)" in svg) == (free > 0)
    assert ("var(--influenced)" in svg) == (free < len(values))
    assert ("≤ 0" in texts(svg)) == bool((values <= 0).any())


def test_long_and_short_trajectories() -> None:
    for length in (1, 2, 100_000):
        scores = np.linspace(0, 3, length)[:, None]
        svg = draw_influence(
            scores, scores > 1, ["cup"], [1.0], name="a", description="one"
        )
        assert len(svg) < 40_000
    # A single peak among many steps is drawn.
    scores = np.zeros((100_000, 1))
    flat = draw_influence(
        scores, scores > 1, ["cup"], [1.0], name="a", description="one"
    )
    scores[51_234] = 9.0
    peak = draw_influence(
        scores, scores > 1, ["cup"], [1.0], name="a", description="one"
    )
    assert flat != peak and "var(--influenced)" in peak


def test_lengths() -> None:
    svg = draw_lengths(np.array([3, 3, 900, 41]), name="a", description="lengths")
    assert "trajectories" in texts(svg)


@pytest.mark.parametrize("most", [6, 7, 20])
def test_short_labels(most: int) -> None:
    assert len(short_label("x" * 50, most)) == most
    assert short_label("abc", most) == "abc"
    assert short_label("a\nb\tc", most) == "a b c"
