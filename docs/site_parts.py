"""Parts of the site that Sphinx has no setting for."""

from __future__ import annotations

import importlib
import pkgutil
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util import logging

import torchrl_caiac

# The path under which the reference has each public class.
_PUBLIC = {
    value: f"torchrl_caiac.{module.name}.{name}"
    for module in pkgutil.iter_modules(torchrl_caiac.__path__)
    if not module.name.startswith("_")
    for name in importlib.import_module(f"torchrl_caiac.{module.name}").__all__
    if isinstance(value := getattr(torchrl_caiac, module.name).__dict__[name], type)
} | {torchrl_caiac.EntityLayout: "torchrl_caiac.EntityLayout"}

_logger = logging.getLogger(__name__)


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers mathematics without scripts, and the bases of classes."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    app.connect("autodoc-process-bases", _public_bases)
    app.connect("autodoc-process-docstring", _describe_constant)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


# --- mathematics: browsers draw MathML, so no script and no font is loaded ------------


def _mathml(node: nodes.Node, display: bool) -> str:
    # Browsers choose the size of brackets.
    text = re.sub(r"\\(middle|[bB]ig)(?![a-z])", "", node.astext())
    try:
        return tex2mathml(text.replace(r"\dots", r"\ldots"), as_block=display)
    except MathError as error:
        _logger.warning("%s in %r", error, node.astext(), location=node)
        raise nodes.SkipNode from error


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(_mathml(node, False))
    raise nodes.SkipNode


def _display(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="math">{_mathml(node, True)}</div>\n')
    raise nodes.SkipNode


# --- the reference: constants, whose comments are where they are defined --------------


def _comments() -> dict[str, list[str]]:
    found = {}
    for path in Path(torchrl_caiac.__file__).parent.rglob("*.py"):
        module = ModuleAnalyzer.for_string(path.read_text(encoding="utf-8"), path.stem)
        for (_, name), lines in module.find_attr_docs().items():
            if name.isupper():
                found[name] = lines
    return found


_COMMENTS = _comments()


def _describe_constant(
    app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Replaces the docstring of a constant, which is that of its type."""
    if what == "data":
        lines[:] = _COMMENTS.get(name.rsplit(".", 1)[-1], [])


# --- the reference: bases that readers can look up -----------------------------------


def _public_bases(
    app: Sphinx, name: str, cls: type, options: Any, bases: list[Any]
) -> None:
    """Replaces private bases by theirs, and others by the names that are documented."""
    bases[:] = dict.fromkeys(
        f":class:`~{_documented(b)}`" for b in _without_private(bases)
    )


def _without_private(bases: list[type]) -> list[type]:
    found: list[type] = []
    for base in bases:
        if base.__module__.startswith("torchrl_caiac") and base not in _PUBLIC:
            found += _without_private(list(base.__bases__))
        elif base.__module__ != "abc":
            found.append(base)
    useful = [base for base in found if base is not object]
    return useful or [object]


def _documented(base: type) -> str:
    if base in _PUBLIC:
        return _PUBLIC[base]
    # Other projects document a class where it is imported from.
    first, *between = base.__module__.split(".")
    for end in range(min(2, len(between) + 1)):
        module = ".".join([first, *between[:end]])
        if getattr(importlib.import_module(module), base.__name__, None) is base:
            return f"{module}.{base.__name__}".removeprefix("builtins.")
    return f"{base.__module__}.{base.__qualname__}"
