"""Figures as SVG that takes colours, fonts and width from the page around it."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "ADDED",
    "GRID",
    "INFLUENCED",
    "INK",
    "MUTED",
    "RECORDED",
    "drawing",
    "printable",
    "short_label",
    "svg_text",
]

# Colours that stand for variables of the page's style sheet, which differ in the light
# and the dark scheme. No figure uses them for anything else.
INK, MUTED, GRID = "#010203", "#020304", "#030405"
RECORDED, INFLUENCED, ADDED = "#040506", "#050607", "#060708"
_VARIABLES = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--line)",
    RECORDED: "var(--recorded)",
    INFLUENCED: "var(--influenced)",
    ADDED: "var(--added)",
}
_SVG, _XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_GEOMETRY = {"d", "x", "y", "width", "height", "transform", "points"}
_RC: Any = {
    "svg.fonttype": "none",  # text stays text: searchable, and in the page's font
    "svg.hashsalt": "torchrl-caiac",
    "text.parse_math": False,  # names may contain dollar signs
    "axes.unicode_minus": False,
    "path.simplify": True,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.titlecolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "font.size": 10.0,
    "axes.labelsize": 10.0,
    "axes.titlesize": 10.0,
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
    "axes.linewidth": 0.8,
}


@contextmanager
def drawing() -> Iterator[None]:
    """Context manager in which figures are drawn and written.

    Examples:
        >>> from torchrl_caiac._figures import new_figure
        >>> from torchrl_caiac.report.svg import drawing, svg_text
        >>> with drawing():
        ...     figure = new_figure(2.0, 1.0)
        ...     text = svg_text(figure, "one", "an empty figure")
        >>> text.startswith("<svg") and "an empty figure" in text
        True
    """
    import matplotlib

    with matplotlib.rc_context(_RC), warnings.catch_warnings():
        # The browser has glyphs that matplotlib's font has not.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def short_label(name: str, most: int = 34) -> str:
    """Returns a name that fits into a figure.

    Args:
        name (str): the name.
        most (int): the number of characters to keep. Defaults to 34.

    Returns:
        str: the name on one line, shortened in the middle if necessary.

    Examples:
        >>> from torchrl_caiac.report.svg import short_label
        >>> short_label("left_gripper_finger", 10)
        'left_…nger'
    """
    text = " ".join(printable(name).split()) or " "
    if len(text) <= most:
        return text
    tail = (most - 1) // 2
    return text[: most - 1 - tail] + "…" + text[-tail:]


def printable(text: str) -> str:
    r"""Returns text without control characters, which XML does not allow.

    Args:
        text (str): the text.

    Returns:
        str: the text, with spaces for line breaks and tabs.

    Examples:
        >>> from torchrl_caiac.report.svg import printable
        >>> printable("two\nlines")
        'two lines'
    """
    return "".join(
        c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}"
        for c in text
    )


def svg_text(figure: Figure, name: str, description: str) -> str:
    """Returns a figure as an ``<svg>`` element for the body of a page.

    Args:
        figure (matplotlib.figure.Figure): a figure drawn in :func:`drawing`.
        name (str): the prefix of the ids, different for each figure of a page.
        description (str): what screen readers say.

    Returns:
        str: the element.

    Examples:
        See :func:`drawing`.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    ElementTree.register_namespace("", _SVG)
    root = ElementTree.fromstring(buffer.getvalue())
    for parent in list(root.iter()):
        for child in list(parent):
            # A style sheet in the page would be one for the whole page.
            if child.tag in (f"{{{_SVG}}}metadata", f"{{{_SVG}}}style"):
                parent.remove(child)
    used = _references(root)
    for element in root.iter():
        link = element.attrib.pop(f"{{{_XLINK}}}href", None)
        if link is not None:
            element.set("href", f"#{name}-{link[1:]}" if link[0] == "#" else link)
        element.tail = None  # white space
        if not (element.text or "").strip():
            element.text = None
        own = element.attrib.pop("id", None)
        if own in used:
            element.set("id", f"{name}-{own}")
        for key in ("clip-path", "style"):
            if key in element.attrib:
                element.set(key, _adapted(element.attrib[key], name))
        for key in _GEOMETRY & set(element.attrib):
            short = re.sub(r"(\d\.\d{2})\d+", r"\1", element.attrib[key])
            element.set(key, " ".join(short.split()))
    width, height = root.attrib.pop("width"), root.attrib.pop("height")
    root.attrib.pop("version", None)
    root.set("viewBox", f"0 0 {width.rstrip('pt')} {height.rstrip('pt')}")
    root.set("role", "img")
    root.set("aria-label", printable(description))
    root.set("style", "stroke-linejoin: round")
    text = ElementTree.tostring(root, encoding="unicode", short_empty_elements=True)
    text = text.replace(f' xmlns="{_SVG}"', "")  # HTML knows it
    return text.strip()


def _references(root: ElementTree.Element) -> set[str]:
    found = set()
    for element in root.iter():
        found |= set(re.findall(r"url\(#([^)]+)\)", element.get("clip-path", "")))
        link = element.get(f"{{{_XLINK}}}href", "")
        if link.startswith("#"):
            found.add(link[1:])
    return found


def _adapted(text: str, name: str) -> str:
    """Returns style with variables for colours, the page's font, and own ids."""
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, variable)
    text = re.sub(r"font: (?:\w+ )*?([\d.]+)px [^;]*", r"font-size: \1px", text)
    text = re.sub(r"font-family: [^;]*;? ?", "", text)
    return text.replace("url(#", f"url(#{name}-")
