"""Tests of reports: their text, their JSON form, and their errors."""

from __future__ import annotations

import json
import pickle
from dataclasses import FrozenInstanceError

import pytest
import torch

from torchrl_caiac.check import DatasetError, DatasetReport, Finding
from torchrl_caiac.check.kinds import KINDS, finding

REPORT = DatasetReport(
    (
        finding(
            "not_finite",
            "('next', 'observation') is nan in row 3, " + ", ".join(["cup"] * 40),
            key=("next", "observation"),
            columns=["cup (column 1)"],
            rows=torch.arange(3, 12),
        ),
        finding("jump", "'cup' jumps in 1 checked rows", rows=torch.tensor([7])),
    ),
    1_000_000,
    20_000,
    5_000,
)


def test_text() -> None:
    lines = str(REPORT).splitlines()
    assert all(len(line) <= 80 for line in lines)
    assert lines[:2] == [
        "checked 20000 of 1000000 transitions, 5000 trajectories: 1 error, 1 warning",
        "error    not_finite",
    ]
    assert lines[2].startswith("         ('next', 'observation') is nan in row 3, cup,")
    assert "         Rows: 3, 4, 5, 6, 7 and 4 more." in lines
    assert "         Rows: 7." in lines
    text = " ".join(str(REPORT).split())
    for code in ("not_finite", "jump"):
        assert KINDS[code].effect in text and KINDS[code].remedy in text


def test_json() -> None:
    content = json.loads(json.dumps(REPORT.to_dict()))
    assert not content["ok"] and content["num_checked"] == 20_000
    first, second = content["findings"]
    assert first["key"] == ["next", "observation"] and first["count"] == 9
    assert first["rows"] == [3, 4, 5, 6, 7] and first["columns"] == ["cup (column 1)"]
    assert second["severity"] == "warning" and second["key"] is None


def test_errors_raise_and_warnings_do_not() -> None:
    assert [f.code for f in REPORT.errors] == ["not_finite"]
    assert [f.code for f in REPORT.warnings] == ["jump"]
    with pytest.raises(DatasetError, match="not_finite") as caught:
        REPORT.raise_if_errors()
    assert caught.value.report is REPORT and isinstance(caught.value, ValueError)
    assert pickle.loads(pickle.dumps(caught.value)).report == REPORT
    harmless = DatasetReport(REPORT.warnings, 5, 5, 1)
    harmless.raise_if_errors()
    assert harmless.ok


def test_reports_cannot_be_changed() -> None:
    with pytest.raises(FrozenInstanceError):
        REPORT.num_checked = 5  # type: ignore[misc]
    with pytest.raises(FrozenInstanceError):
        Finding("jump", "error", "", "", "").count = 5  # type: ignore[misc]


@pytest.mark.parametrize("code", KINDS)
def test_kinds_say_what_happens_and_what_to_do(code: str) -> None:
    kind = KINDS[code]
    assert kind.severity in ("error", "warning")
    for text in (kind.effect, kind.remedy):
        assert text and not text.endswith(".")
