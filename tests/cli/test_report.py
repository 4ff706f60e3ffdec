"""``caiac report``."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Caiac
from torchrl_caiac.scored import ScoredDataset


def test_the_page_is_written_and_replaced(caiac: Caiac, scored: Path) -> None:
    (scored / "report.html").write_text("an old one")
    result = caiac("report", scored, "--json")
    assert result.code == 0, result.err
    assert result.document == {"written": str(scored / "report.html")}
    page = (scored / "report.html").read_text()
    assert page.startswith("<!") and "cup" in page and "an old one" not in page


def test_another_file(
    caiac: Caiac, scored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(scored: ScoredDataset, path: Path, **options: object) -> Path:
        path.write_text(f"{scored.estimator} {options['title']}")
        return path

    monkeypatch.setattr("torchrl_caiac.report.write_report", write)
    arguments = ("report", scored, "--out", "page.html", "--title", "Pushing cups")
    assert caiac(*arguments).code == 0
    assert Path("page.html").read_text() == "motion Pushing cups"
    result = caiac(*arguments)
    assert result.code == 2 and "page.html exists" in result.error
    assert caiac(*arguments, "--overwrite").code == 0


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["missing"], 2, "missing does not exist"),
        (["pushes"], 1, "not the folder of a scored dataset"),
        (["scored", "--out", "scored"], 2, "is a folder"),
    ],
)
def test_folders_without_a_report(
    caiac: Caiac, scored: Path, arguments: list[str], code: int, message: str
) -> None:
    result = caiac("report", *arguments)
    assert result.code == code and message in result.error


def test_a_file_is_no_scored_folder(caiac: Caiac, pushes: Path) -> None:
    result = caiac("report", "layout.json")
    assert result.code == 2
    assert (
        "layout.json is a file, not a folder that `caiac score` wrote" in result.error
    )
