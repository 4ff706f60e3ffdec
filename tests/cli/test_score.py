"""``caiac score``: what it writes, what it refuses, and how it resumes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from tests.cli.conftest import Caiac
from tests.killing import run_killed
from tests.pushes import LAYOUT, push_transitions
from torchrl_caiac import EntityLayout
from torchrl_caiac.cli import main
from torchrl_caiac.data import load_transitions, offline_buffer, write_transitions
from torchrl_caiac.influence import (
    MotionInfluence,
    ResidualInfluence,
    score_buffer,
    suggest_thresholds,
)
from torchrl_caiac.scored import open_scored

SCORE = ("score", "pushes", "--layout", "layout.json", "--out", "scored")


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and not file.name.startswith(".lock")
    }


def test_scores_and_thresholds_are_those_of_the_library(
    caiac: Caiac, pushes: Path
) -> None:
    before = contents(pushes)
    result = caiac(*SCORE, "--lookahead", "3", "--json")
    assert result.code == 0, result.err
    rb = offline_buffer(push_transitions())
    score_buffer(rb, MotionInfluence(LAYOUT), lookahead=3, check=False, progress=False)
    found = suggest_thresholds(rb, LAYOUT)
    scored = open_scored("scored")
    assert torch.equal(scored.scores, rb.storage[:]["caiac", "score"])
    assert scored.thresholds == found.thresholds
    assert scored.estimator == "motion" and scored.layout == LAYOUT
    assert scored.settings == {"tolerance": "auto", "lookahead": 3, "smoothing": 1}
    for name in ("thresholds", "confidence", "reasons", "free"):
        assert result.document[name] == getattr(found, name)
    assert contents(pushes) == before  # the dataset itself is not changed


def test_a_second_call_changes_nothing(caiac: Caiac, scored: Path) -> None:
    before = contents(scored)
    first = caiac(*SCORE, "--json").document
    assert contents(scored) == before
    assert first["estimator"] == "motion"


def test_scores_of_a_scored_folder_are_not_taken_over(
    caiac: Caiac, scored: Path
) -> None:
    result = caiac("score", scored, "--layout", "layout.json", "--out", "again")
    assert result.code == 0, result.err
    assert torch.equal(open_scored("again").scores, open_scored(scored).scores)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--lookahead", "5"], "lookahead was 1, is 5"),
        (["--estimator", "distance", "--distance", "0.1"], "estimator was motion, is"),
    ],
)
def test_other_settings_need_overwrite(
    caiac: Caiac, scored: Path, arguments: list[str], message: str
) -> None:
    before = contents(scored)
    result = caiac(*SCORE, *arguments)
    assert result.code == 2 and message in result.error
    assert contents(scored) == before
    assert caiac(*SCORE, *arguments, "--overwrite").code == 0
    replaced = open_scored(scored)
    shutil.rmtree(scored)
    assert caiac(*SCORE, *arguments).code == 0
    fresh = open_scored(scored)
    assert torch.equal(replaced.scores, fresh.scores)
    assert replaced.settings == fresh.settings
    assert replaced.thresholds == fresh.thresholds


def test_another_layout_needs_overwrite(caiac: Caiac, scored: Path) -> None:
    EntityLayout({"hand": [0, 1], "cup": [2, 3]}, fixed=["hand"]).save("layout.json")
    result = caiac(*SCORE)
    assert result.code == 2 and "the layout was another" in result.error
    assert caiac(*SCORE, "--overwrite").code == 0
    assert open_scored(scored).layout.names == ("hand", "cup")


def test_other_data_need_overwrite(caiac: Caiac, scored: Path) -> None:
    write_transitions(push_transitions(seed=1), "others")
    arguments = ("score", "others", *SCORE[2:])
    result = caiac(*arguments)
    assert result.code == 2 and "others" in result.error
    assert caiac(*arguments, "--overwrite").code == 0
    other = push_transitions(seed=1)["observation"]
    assert torch.equal(open_scored(scored).data["observation"], other)


def test_data_that_have_changed_need_overwrite(caiac: Caiac, scored: Path) -> None:
    write_transitions(push_transitions(seed=1), "pushes", overwrite=True)
    result = caiac(*SCORE)
    assert result.code == 2 and "before it changed" in result.error


def killed_while_scoring(folder: Path) -> Iterator[None]:
    """Scores in the folder, and stops before the thresholds are written."""
    import torchrl_caiac.cli.score as command

    seen = 0
    original = MotionInfluence.forward

    def counted(self: MotionInfluence, td: object) -> object:
        nonlocal seen
        seen += 1
        if seen > 2:
            raise _Stop
        return original(self, td)

    class _Stop(BaseException):
        pass

    def in_small_chunks(*args: object, **kwargs: object) -> None:
        score_buffer(*args, batch_size=32, **kwargs)

    command.score_buffer = in_small_chunks
    MotionInfluence.forward = counted
    try:
        main(list(SCORE))
    except _Stop:
        yield


def test_a_killed_call_resumes(caiac: Caiac, pushes: Path) -> None:
    run_killed(killed_while_scoring, Path("scored"))
    assert not Path("scored/scores.json").exists()
    state = json.loads(Path("scored/data/caiac.score.json").read_text())["state"]
    assert state == "scoring"
    report = caiac("report", "scored")
    assert report.code == 1 and "has not finished" in report.error
    assert caiac(*SCORE).code == 0
    resumed = open_scored("scored")
    shutil.rmtree("scored")
    assert caiac(*SCORE).code == 0
    assert torch.equal(resumed.scores, open_scored("scored").scores)
    assert resumed.thresholds == open_scored("scored").thresholds


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "9"], "--steps is an option of --estimator cai and attention"),
        (["--more-data", "pushes"], "--more-data is an option of --estimator"),
        (["--distance", "1"], "--distance is an option of --estimator distance"),
        (["--estimator", "distance"], "needs --distance"),
        (
            ["--estimator", "cai", "--world-model", "x", "--seed", "1"],
            "--seed is for the fit of a world model",
        ),
        (
            ["--estimator", "cai", "--num-actions", "1"],
            "--num-actions is 1, expected at least 2",
        ),
        (["--lookahead", "-1"], "--lookahead must be at least 0"),
        (["--smoothing", "0"], "--smoothing must be at least 1"),
        (["--option", "x"], "expected NAME=VALUE"),
        (["--option", "a=1", "--option", "a=2"], "given twice"),
    ],
)
def test_options_that_make_no_sense(
    caiac: Caiac, pushes: Path, arguments: list[str], message: str
) -> None:
    result = caiac(*SCORE, *arguments)
    assert result.code == 2 and message in result.error
    assert not Path("scored").exists()


def test_distance_needs_positions(caiac: Caiac, pushes: Path) -> None:
    EntityLayout(LAYOUT.columns, fixed=["hand"]).save("layout.json")
    result = caiac(*SCORE, "--estimator", "distance", "--distance", "0.1")
    assert result.code == 2 and "needs the positions" in result.error


def test_a_folder_of_something_else_is_left_alone(caiac: Caiac, pushes: Path) -> None:
    Path("scored").mkdir()
    Path("scored/mine.txt").write_text("a")
    result = caiac(*SCORE, "--overwrite")
    assert result.code == 2 and "not empty" in result.error
    assert sorted(contents(Path("scored"))) == ["mine.txt"]


def test_errors_in_the_data_end_it_before_scoring(caiac: Caiac, pushes: Path) -> None:
    data = push_transitions()
    data["next", "observation"][100] = 0.0
    write_transitions(data, "pushes", overwrite=True)
    result = caiac(*SCORE)
    assert result.code == 1
    assert "next_not_following" in result.error and "caiac check" in result.error
    assert ("caiac", "score") not in load_transitions("scored/data").keys(True)


def test_residual_is_that_of_the_library(
    caiac: Caiac, pushes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = ResidualInfluence.fit
    monkeypatch.setattr(
        ResidualInfluence, "fit", lambda *args, **kwargs: fit(*args, steps=50, **kwargs)
    )
    arguments = ("--estimator", "residual", "--far", "0.1", "--seed", "3")
    result = caiac(*SCORE, *arguments)
    assert result.code == 0, result.err
    estimator = ResidualInfluence(LAYOUT, far=0.1)
    estimator.fit(load_transitions("pushes"), seed=3, progress=False)
    rb = offline_buffer(push_transitions())
    score_buffer(rb, estimator, check=False, progress=False)
    assert torch.equal(open_scored("scored").scores, rb.storage[:]["caiac", "score"])


def test_cai_fits_resumes_and_lends_its_model(caiac: Caiac, pushes: Path) -> None:
    fit = ("--estimator", "cai", "--steps", "30", "--num-actions", "4")
    assert caiac(*SCORE, *fit).code == 0
    first = open_scored("scored")
    assert first.settings["steps"] == 30 and first.scores.isfinite().all()
    Path("scored/scores.json").unlink()
    assert caiac(*SCORE, *fit).code == 0
    assert torch.equal(open_scored("scored").scores, first.scores)
    lent = ("--estimator", "cai", "--world-model", "scored", "--num-actions", "4")
    result = caiac(*SCORE[:-1], "lent", *lent)
    assert result.code == 0, result.err
    assert torch.equal(open_scored("lent").scores, first.scores)


def test_attention_scores_each_entity(caiac: Caiac, pushes: Path) -> None:
    result = caiac(*SCORE, "--estimator", "attention", "--steps", "3")
    assert result.code == 0, result.err
    assert open_scored("scored").scores.shape == (240, 3)


def test_more_data_are_fitted_to(caiac: Caiac, pushes: Path) -> None:
    write_transitions(push_transitions(seed=2), "random", action_bounds=([-1], [1]))
    fit = ("--estimator", "cai", "--steps", "30", "--num-actions", "4")
    assert caiac(*SCORE, *fit).code == 0
    alone = open_scored("scored").scores.clone()
    more = (*fit, "--more-data", "random", "--overwrite")
    result = caiac(*SCORE, *more)
    assert result.code == 0, result.err
    assert not torch.equal(open_scored("scored").scores, alone)


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda: None, "model.json is missing"),
        (lambda: Path("other/world_model/model.json").write_text("{"), "readable"),
        (lambda: Path("other/world_model/model.json").write_text("{}"), "readable"),
    ],
)
def test_a_world_model_that_cannot_be_used(
    caiac: Caiac, pushes: Path, prepare: object, message: str
) -> None:
    Path("other/world_model").mkdir(parents=True)
    prepare()
    result = caiac(*SCORE, "--estimator", "cai", "--world-model", "other")
    assert result.code in (1, 2) and message in result.error


def test_a_world_model_of_another_layout(caiac: Caiac, pushes: Path) -> None:
    fit = ("--estimator", "cai", "--steps", "2", "--num-actions", "4")
    assert caiac(*SCORE, *fit).code == 0
    EntityLayout({"hand": [0, 1], "cup": [2, 3]}, fixed=["hand"]).save("layout.json")
    lent = ("--estimator", "cai", "--world-model", "scored")
    result = caiac(*SCORE[:-1], "lent", *lent)
    assert result.code == 2 and "another layout" in result.error


def test_thresholds_are_suggested_not_warned_of(caiac: Caiac, pushes: Path) -> None:
    # These are distances in metres: all above the default threshold of CAI, or below.
    result = caiac(*SCORE, "--estimator", "distance", "--distance", "1e-4")
    assert result.code == 0, result.err
    assert "default threshold" not in result.err


def test_the_reason_of_an_unclear_threshold_is_shown(
    caiac: Caiac, pushes: Path
) -> None:
    still = push_transitions()[:20]
    write_transitions(still, "few")
    result = caiac("score", "few", "--layout", "layout.json", "--out", "scored")
    scored = open_scored("scored")
    unclear = [n for n, found in scored.confidence.items() if found == "unclear"]
    assert unclear
    for name in unclear:
        assert f"{name} is unclear: {scored.reasons[name]}" in result.out


def test_the_output_is_a_folder_by_name(caiac: Caiac, pushes: Path) -> None:
    result = caiac(*SCORE[:-1], "scored.npz")
    assert result.code == 2 and "scored.npz has the name of a file" in result.error
    assert not Path("scored.npz").exists()


def test_the_layout_of_a_scored_folder(caiac: Caiac, scored: Path) -> None:
    result = caiac("score", "pushes", "--layout", scored, "--out", "again")
    assert result.code == 0, result.err
    assert open_scored("again").layout == LAYOUT
