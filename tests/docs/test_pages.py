"""Pages that quote the package, against it."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

DOCS = Path(__file__).parents[2] / "docs"


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_message_that_the_faq_explains_exists() -> None:
    page = script("make_errors").page()
    quoted = re.findall(r"^`([^`]+)`\n: ", (DOCS / "faq.md").read_text(), re.MULTILINE)
    assert len(quoted) > 10
    for text in filter(re.compile(r"\s").search, quoted):  # not the names of classes
        parts = [part.strip(" :") for part in text.split("…")]
        assert re.search(".*".join(map(re.escape, parts)), page), text


def test_messages_have_what_is_constant(tmp_path: Path) -> None:
    make_errors = script("make_errors")
    module = tmp_path / "module.py"
    module.write_text(
        "if a:\n"
        "    raise ValueError(f'rows {n} are ' + 'wrong: remove them') from error\n"
        "warnings.warn(f'{n} rows of %s are slow', stacklevel=2)\n"
        "raise\n"
        "raise error\n"
        "raise KeyError(name)\n"
    )
    assert sorted(make_errors.messages(module)) == [
        ("ValueError", "rows … are wrong: remove them"),
        ("Warning", "… rows of … are slow"),
    ]
    assert make_errors.step_of("_fit_ranks") == "World models"
    assert make_errors.step_of("transforms") == "Sampling"
