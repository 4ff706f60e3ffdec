"""``caiac check``."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Caiac
from tests.pushes import LAYOUT, push_transitions
from torchrl_caiac import EntityLayout, check_dataset
from torchrl_caiac.data import load_transitions, write_transitions
from torchrl_caiac.layouts import layout_notes


def test_data_without_errors(caiac: Caiac, pushes: Path) -> None:
    result = caiac("check", pushes, "--layout", "layout.json", "--json")
    expected = check_dataset(
        load_transitions(pushes),
        LAYOUT,
        action_spec=([-1.0], [1.0]),
        variance_floor=1e-3,
    )
    assert result.code == 0
    assert result.document == expected.to_dict()
    assert result.document["ok"]


def test_findings_are_exit_code_1(caiac: Caiac, pushes: Path) -> None:
    data = push_transitions()
    data["next", "observation"][100] = 0.0
    write_transitions(data, "wrong")
    result = caiac("check", "wrong", "--layout", "layout.json")
    assert result.code == 1
    assert "next_not_following" in result.out and "100" in result.out
    assert "error: " not in result.err


@pytest.mark.parametrize("name", ["layout.jsn", "./layout.yml", "missing.json"])
def test_a_layout_that_is_not_there(caiac: Caiac, pushes: Path, name: str) -> None:
    result = caiac("check", pushes, "--layout", name)
    assert result.code == 2
    assert name in result.error


def test_a_name_that_is_nearly_one_of_a_ready_layout(
    caiac: Caiac, pushes: Path
) -> None:
    result = caiac("check", pushes, "--layout", "fetch/pusch")
    assert result.code == 2
    assert "did you mean fetch/push" in result.error and "adroit/door" in result.error


def test_a_layout_that_does_not_fit(caiac: Caiac, pushes: Path) -> None:
    EntityLayout({"hand": [0, 1], "cup": [2, 9]}, fixed=["hand"]).save("wide.json")
    result = caiac("check", pushes, "--layout", "wide.json")
    assert result.code == 1
    assert "wrong_shape" in result.out and "'observation' ha" in result.out


def test_a_layout_that_is_cut_short(caiac: Caiac, pushes: Path) -> None:
    Path("layout.json").write_text(Path("layout.json").read_text()[:40])
    result = caiac("check", pushes, "--layout", "layout.json")
    assert result.code == 1
    assert "layout.json is not a readable layout" in result.error


def test_the_notes_of_a_ready_layout_are_shown(caiac: Caiac, pushes: Path) -> None:
    result = caiac("check", pushes, "--layout", "fetch/push")
    note = f"layout fetch/push: {layout_notes('fetch/push')}"
    assert note in result.err and "belong to no entity" in note
