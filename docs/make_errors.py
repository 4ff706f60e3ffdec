"""Lists every error and warning of the package, from its source.

``conf.py`` writes the page at each build, so that the search of the site finds them.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "errors.md"
# The step in which a part of the package is used; parts that are not named: the last.
STEPS = {
    "Reading and writing data": ("data", "envs", "_files", "_whole_files", "augment"),
    "Entities and layouts": ("entities", "layouts", "_layout", "_columns", "_keys"),
    "Checking": ("check", "noise", "_checks", "_column_motion"),
    "Trajectories": ("trajectories",),
    "World models": ("modules", "fit", "_fit", "_torchrl", "checkpoint"),
    "Scores and thresholds": ("influence", "evaluation", "_fingerprints"),
    "Sampling": (
        *("transforms", "caiac_buffer", "_buffer_transform", "_random"),
        "_sampling",
    ),
    "Training": ("objectives",),
    "Command line and reports": (
        *("cli", "report", "scored", "inspection", "plotting"),
        *("_layout_proposal", "_moving_groups"),
    ),
    "Other": (),
}
HEAD = """\
# All error messages

Every error and warning of the package, by step, as its source has it: `…` stands for
names and numbers of your data. Search for the words of a message that do not change.
{doc}`/faq` explains those that many users meet.

"""


def text_of(node: ast.expr) -> str:
    """Returns the text of an expression, with ``…`` for what is not constant."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else "…"
    if isinstance(node, ast.JoinedStr):
        return "".join(map(text_of, node.values))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text_of(node.left) + text_of(node.right)
    if isinstance(node, ast.IfExp):
        return f"{text_of(node.body)} | {text_of(node.orelse)}"
    return "…"


def messages(path: Path) -> list[tuple[str, str]]:
    """Returns the kinds and messages of all errors and warnings of a module."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not (isinstance(node, ast.Call) and node.args):
            continue
        kind = ast.unparse(node.func).rsplit(".", 1)[-1]
        arguments = node.args
        if kind in ("warn", "warning"):
            kind, arguments = "Warning", node.args[:1]
        elif not re.fullmatch(r"[A-Z]\w*(Error|Unavailable)", kind):
            continue
        text = " ".join(" ".join(map(text_of, arguments)).split())
        text = re.sub(r"%[ds]|%\.?\d*f", "…", text)
        if len(re.findall(r"\w{3,}", text)) > 1:
            found.append((kind, text))
    return found


def step_of(part: str) -> str:
    """Returns the step that a subpackage or module of the package belongs to."""
    for step, parts in STEPS.items():
        # Private modules are named by how they begin.
        if part in parts or part.startswith(tuple(p for p in parts if p[:1] == "_")):
            return step
    return "Other"


def page() -> str:
    """Returns the page, in Markdown."""
    rows: dict[str, set[tuple[str, str]]] = {step: set() for step in STEPS}
    for path in sorted((ROOT / "torchrl_caiac").rglob("*.py")):
        part = path.relative_to(ROOT / "torchrl_caiac").with_suffix("").parts[0]
        rows[step_of(part)] |= set(messages(path))
    lines = [HEAD]
    for step, found in rows.items():
        lines.append(f"## {step}\n")
        for kind, text in sorted(found, key=lambda row: row[1].lower().lstrip("… '")):
            ticks = "``" if "`" in text else "`"
            lines.append(f"- {kind}: {ticks} {text} {ticks}")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
