"""``caiac inspect``."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.cli.conftest import Caiac
from tests.pushes import LAYOUT, push_transitions
from torchrl_caiac import EntityLayout
from torchrl_caiac.data import write_transitions
from torchrl_caiac.inspection import inspect_dataset
from torchrl_caiac.layouts import matching_layouts


def test_the_result_is_that_of_the_library(caiac: Caiac, pushes: Path) -> None:
    result = caiac("inspect", pushes, "--json")
    found = inspect_dataset(push_transitions()).to_dict()
    document = result.document
    assert result.code == 0
    assert document.pop("format") == "transitions"
    assert document.pop("action_bounds") == [[-1.0], [1.0]]
    assert document.pop("notes")[0].startswith("the positions of entity0, entity1")
    found.pop("action_bounds"), found.pop("notes")
    assert document == found


def test_a_person_sees_what_the_document_has(caiac: Caiac, pushes: Path) -> None:
    text = caiac("inspect", pushes).out
    for part in (
        "format: transitions",
        "240 transitions, 6 episodes of 30 to 50",
        "next.observation",
        "action bounds: [-1.0] to [1.0]",
        "moves with the action",
        "proposed layout",
    ):
        assert part in text


@pytest.mark.parametrize("name", ["proposal.json", "proposal.yaml"])
def test_the_proposal_is_a_layout_for_the_next_call(
    caiac: Caiac, pushes: Path, name: str
) -> None:
    result = caiac("inspect", pushes, "--write-layout", name)
    assert result.code == 0 and f"written to {name}" in result.out
    proposal = EntityLayout.load(name)
    assert proposal.columns.keys() == {"robot", "entity0", "entity1"}
    assert list(proposal.columns.values()) == list(LAYOUT.columns.values())
    assert proposal.fixed == ("robot",)
    checked = caiac("check", pushes, "--layout", name)
    assert checked.code == 0, checked.out
    again = caiac("inspect", pushes, "--write-layout", name)
    assert again.code == 2 and f"{name} exists" in again.error


def test_a_proposal_of_another_format(caiac: Caiac, pushes: Path) -> None:
    result = caiac("inspect", pushes, "--write-layout", "proposal.txt")
    assert result.code == 2 and "expected a .json or .yaml file" in result.error


def test_nothing_to_propose(caiac: Caiac, pushes: Path) -> None:
    data = push_transitions()
    for key in ("observation", ("next", "observation")):
        data[key] = data[key][:, :2].clone()
    write_transitions(data, "hand")
    result = caiac("inspect", "hand", "--write-layout", "proposal.json")
    assert result.code == 0
    assert "nothing is written to proposal.json" in result.err
    assert not Path("proposal.json").exists()
    assert "no layout is proposed" in result.out


def test_ready_layouts_that_fit(caiac: Caiac, pushes: Path) -> None:
    data = push_transitions()
    for key in ("observation", ("next", "observation")):
        wide = 1 + torch.rand(len(data), 25)
        wide[:, 6:9] = wide[:, 3:6] - wide[:, 0:3]  # as in Gymnasium's Fetch
        data[key] = wide
    write_transitions(data, "fetch")
    expected = matching_layouts(data)
    assert "fetch/push" in expected
    assert caiac("inspect", "fetch", "--json").document["layouts"] == expected
    assert ", ".join(expected) in caiac("inspect", "fetch").out
