"""The folder of a scored dataset, and what opening it refuses."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac import EntityLayout
from torchrl_caiac.data import (
    UnreadableFileError,
    load_transitions,
    offline_buffer,
    write_transitions,
)
from torchrl_caiac.influence import DistanceInfluence, score_buffer
from torchrl_caiac.scored import open_scored, write_scored

LAYOUT = EntityLayout({"arm": [0], "cup": [1], "box": [2]}, fixed=["arm"])
POSITIONS = {"arm": [0], "cup": [1], "box": [2]}
SETTINGS = {"smoothing": 1, "lookahead": 1, "distance": 0.3}


@dataclass
class Chosen:
    """Thresholds as `suggest_thresholds` returns them."""

    thresholds: dict[str, float]
    confidence: dict[str, str]
    reasons: dict[str, str]
    free: dict[str, float]


def chosen(**changes: Any) -> Chosen:
    names = ("cup", "box")
    tables = {
        "thresholds": dict.fromkeys(names, 0.5),
        "confidence": dict.fromkeys(names, "two clear modes"),
        "reasons": dict.fromkeys(names, "it is seen"),
        "free": dict.fromkeys(names, 0.25),
    }
    return Chosen(**{**tables, **changes})


def rows(seed: int = 0) -> TensorDict:
    walk = torch.rand(41, 3, generator=torch.Generator().manual_seed(seed))
    done = torch.zeros(40, 1, dtype=torch.bool)
    done[[19, 39]] = True
    return TensorDict(
        {
            "observation": walk[:-1],
            "action": walk[:-1, :1].clone(),
            "episode": torch.arange(40) // 20,
            "next": {"observation": walk[1:].clone(), "done": done},
        },
        [40],
    )


def scored_data(folder: Path, seed: int = 0, distance: float = 0.3) -> TensorDict:
    data = write_transitions(rows(seed), folder / "data", overwrite=True)
    rule = DistanceInfluence(LAYOUT, POSITIONS, distance=distance, action_only=True)
    score_buffer(offline_buffer(data), rule, check=False, progress=False)
    return data


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    scored_data(tmp_path)
    write_scored(
        tmp_path,
        LAYOUT,
        chosen(),
        estimator="distance",
        settings=SETTINGS,
        source={"dataset": "a.npz"},
        warnings=["few episodes"],
        coverage={"share": 0.5},
    )
    return tmp_path


def test_what_is_written_comes_back(folder: Path) -> None:
    scored = open_scored(folder)
    assert scored.layout == LAYOUT
    assert (scored.estimator, scored.settings) == ("distance", SETTINGS)
    assert scored.source == {"dataset": "a.npz"}
    assert scored.warnings == ("few episodes",)
    assert scored.coverage == {"share": 0.5}
    assert scored.confidence == dict.fromkeys(("cup", "box"), "two clear modes")
    assert (scored.data["observation"] == rows()["observation"]).all()
    near = (rows()["observation"] - rows()["observation"][:, :1]).abs() <= 0.3
    assert (scored.is_free[:, 0] == 0).all()
    # A row is free where it is so in its state; the lookahead only adds influence.
    assert not (scored.is_free & near).any()


def test_scores_of_the_data_are_those_of_the_record(folder: Path) -> None:
    scored = open_scored(folder)
    assert (scored.scores == load_transitions(folder / "data")["caiac", "score"]).all()


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="missing does not exist"):
        open_scored(tmp_path / "missing")


def test_a_folder_of_something_else(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"scores\.json is missing"):
        open_scored(tmp_path)


def test_a_folder_whose_scoring_has_not_finished(folder: Path) -> None:
    (folder / "scores.json").unlink()
    with pytest.raises(FileNotFoundError, match="has not finished"):
        open_scored(folder)


def edit(file: Path, **changes: Any) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "other"}, "not the description"),
        ({"version": 2}, "version 2"),
        ({"estimator": 3}, "no readable estimator"),
        ({"warnings": [1]}, "no readable warnings"),
        ({"free": None}, "no readable free"),
        ({"thresholds": {"cup": 0.5}}, "thresholds lacks"),
        ({"thresholds": {"cup": 0.5, "box": "low"}}, "'low', expected a number"),
        ({"thresholds": {"cup": 0.5, "box": True}}, "True, expected a number"),
        ({"thresholds": {"cup": 0.5, "box": float("inf")}}, "not finite"),
        ({"reasons": {"cup": "a", "box": "b", "jar": "c"}}, "'jar'"),
        ({"score_key": []}, "no readable score_key"),
        ({"layout_digest": "0"}, "not the layout"),
        ({"data_digest": "0"}, "other transitions"),
        ({"score_digests": {}}, "have changed"),
    ],
)
def test_a_description_that_was_changed(
    folder: Path, changes: dict[str, Any], message: str
) -> None:
    edit(folder / "scores.json", **changes)
    with pytest.raises(UnreadableFileError, match=message):
        open_scored(folder)


@pytest.mark.parametrize("name", ["scores.json", "layout.json"])
def test_files_that_were_cut_short(folder: Path, name: str) -> None:
    file = folder / name
    file.write_bytes(file.read_bytes()[:50])
    with pytest.raises(UnreadableFileError, match=name):
        open_scored(folder)


def test_a_layout_that_is_missing(folder: Path) -> None:
    (folder / "layout.json").unlink()
    with pytest.raises(UnreadableFileError, match=r"layout\.json is missing"):
        open_scored(folder)


def test_another_layout(folder: Path) -> None:
    EntityLayout(LAYOUT.columns, fixed=["cup"]).save(folder / "layout.json")
    with pytest.raises(UnreadableFileError, match="not the layout"):
        open_scored(folder)


def test_transitions_that_are_missing(folder: Path) -> None:
    shutil.rmtree(folder / "data")
    with pytest.raises(FileNotFoundError, match="data is missing"):
        open_scored(folder)


def test_other_transitions_with_scores_of_their_own(folder: Path) -> None:
    scored_data(folder, seed=1)
    with pytest.raises(UnreadableFileError, match="other transitions"):
        open_scored(folder)


def test_a_value_that_was_changed(folder: Path) -> None:
    load_transitions(folder / "data")["observation"][3] += 1
    with pytest.raises(UnreadableFileError, match=r"observation\.memmap changed"):
        open_scored(folder)
    assert len(open_scored(folder, verify=False).data) == 40


def test_scores_of_other_settings(folder: Path) -> None:
    rule = DistanceInfluence(LAYOUT, POSITIONS, distance=0.1, action_only=True)
    rb = offline_buffer(load_transitions(folder / "data"))
    score_buffer(rb, rule, overwrite=True, check=False, progress=False)
    with pytest.raises(UnreadableFileError, match="have changed"):
        open_scored(folder)


def test_scores_that_are_not_complete(folder: Path) -> None:
    edit(folder / "data" / "caiac.score.json", state="scoring")
    with pytest.raises(UnreadableFileError, match="not complete"):
        open_scored(folder)


def test_a_score_that_was_changed(folder: Path) -> None:
    load_transitions(folder / "data")["caiac", "score"][0, 1] = 7.0
    with pytest.raises(UnreadableFileError, match="have changed"):
        open_scored(folder)


def write(folder: Path, suggestions: Chosen, layout: EntityLayout = LAYOUT) -> None:
    write_scored(folder, layout, suggestions, estimator="distance", settings={})


def test_writing_without_scores(tmp_path: Path) -> None:
    write_transitions(rows(), tmp_path / "data")
    with pytest.raises(ValueError, match="has no scores"):
        write(tmp_path, chosen())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["data"]


def test_writing_with_another_layout(tmp_path: Path) -> None:
    scored_data(tmp_path)
    with pytest.raises(ValueError, match="not those of this layout"):
        write(tmp_path, chosen(), EntityLayout(LAYOUT.columns, fixed=["cup"]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"thresholds": {"cup": 0.5}}, "thresholds lacks"),
        ({"free": {"cup": 0.5, "box": 0.5, "lid": 0.1}}, "'lid'"),
        ({"confidence": {"cup": 0.5, "box": 0.5}}, "expected a text"),
    ],
)
def test_writing_tables_that_do_not_fit(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    scored_data(tmp_path)
    with pytest.raises(ValueError, match=message):
        write(tmp_path, chosen(**changes))
    assert not (tmp_path / "scores.json").exists()


def test_writing_without_transitions(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="data is missing"):
        write(tmp_path, chosen())
