"""Datasets of all formats as DATA, and what is refused."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from tests.cli.conftest import Caiac
from tests.pushes import push_arrays, push_transitions
from torchrl_caiac.data import load_transitions, to_minari, write_transitions
from torchrl_caiac.scored import open_scored

LEROBOT = Path(__file__).parents[1] / "data" / "lerobot"


def write_npz(path: str = "pushes.npz", **changes: np.ndarray) -> None:
    np.savez(path, **{**push_arrays(), **changes})


def write_hdf5(path: str = "pushes.hdf5") -> None:
    with h5py.File(path, "w") as file:
        for name, array in push_arrays().items():
            file[name] = array


def write_robomimic(path: str = "demos.hdf5") -> None:
    arrays = push_arrays()
    ends = np.flatnonzero(arrays["timeouts"]) + 1
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["total"] = len(arrays["actions"])
        begin = 0
        for number, end in enumerate(ends):
            demo = file["data"].create_group(f"demo_{number}")
            demo.attrs["num_samples"] = end - begin
            demo["obs/state"] = arrays["observations"][begin:end]
            demo["next_obs/state"] = arrays["next_observations"][begin:end]
            demo["actions"] = arrays["actions"][begin:end]
            demo["dones"] = np.arange(begin, end) == end - 1
            demo["rewards"] = np.zeros(end - begin)
            begin = end


@pytest.fixture
def work(caiac: Caiac) -> Path:
    return Path.cwd()


def test_npz(caiac: Caiac, work: Path) -> None:
    write_npz()
    found = caiac("inspect", "pushes.npz", "--json").document
    assert found["episodes"] == {
        "count": 6,
        "shortest": 30,
        "median": 40,
        "longest": 50,
    }


def test_hdf5(caiac: Caiac, work: Path) -> None:
    write_hdf5()
    assert caiac("inspect", "pushes.hdf5", "--json").document["num_transitions"] == 240


def test_robomimic(caiac: Caiac, work: Path) -> None:
    write_robomimic()
    found = caiac("inspect", "demos.hdf5", "--json")
    assert found.code == 0, found.err
    assert found.document["episodes"]["count"] == 6


def test_lerobot(caiac: Caiac, work: Path) -> None:
    version = sorted(path.parent for path in LEROBOT.glob("*/meta"))[0]
    keys = '--option=keys=["observation.state"]'
    found = caiac("inspect", version, keys, "--json")
    assert found.code == 0, found.err
    assert found.document["num_transitions"] == 18


@pytest.mark.parametrize("name", ["pushes/play-v0", "minari://pushes/play-v0"])
def test_minari(caiac: Caiac, pushes: Path, name: str) -> None:
    to_minari(push_transitions(), "pushes/play-v0", progress=False)
    found = caiac("inspect", name, "--json")
    assert found.code == 0, found.err
    assert found.document["episodes"]["count"] == 6


def test_options_reach_the_loader(caiac: Caiac, pushes: Path) -> None:
    to_minari(push_transitions(), "pushes/play-v0", progress=False)
    columns = "--option=columns=[0,2]"
    found = caiac("inspect", "pushes/play-v0", columns, "--json").document
    assert [
        leaf["shape"] for leaf in found["leaves"] if leaf["key"] == "observation"
    ] == [[2]]
    result = caiac("inspect", "pushes/play-v0", "--option", "colour=1")
    assert result.code == 2 and "has no options ['colour']" in result.error


def test_a_scored_folder(caiac: Caiac, scored: Path) -> None:
    assert caiac("inspect", scored, "--json").document["num_transitions"] == 240


def test_converted_data_are_used_again(
    caiac: Caiac, work: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_npz()
    first = caiac("inspect", "pushes.npz", "--json")
    assert "reading pushes.npz" in first.err
    second = caiac("inspect", "pushes.npz", "--json")
    assert "reading" not in second.err and second.document == first.document
    elsewhere = caiac("inspect", "pushes.npz", "--json", "--cache", "mine")
    assert "reading" in elsewhere.err and list(Path("mine").iterdir())
    write_npz(observations=push_arrays(seed=1)["observations"])
    changed = caiac("inspect", "pushes.npz", "--json")
    assert "reading" in changed.err and changed.document != first.document
    assert sorted(p.name for p in work.iterdir()) == ["mine", "pushes.npz"]


def test_scoring_a_file_converts_it_once(caiac: Caiac, pushes: Path) -> None:
    write_npz()
    score = ("score", "pushes.npz", "--layout", "layout.json", "--out", "scored")
    assert "reading" in caiac(*score).err
    assert "reading" not in caiac(*score).err
    assert torch.equal(
        open_scored("scored").data["observation"], push_transitions()["observation"]
    )


def cut(path: str) -> Callable[[], str]:
    def write() -> str:
        (write_npz if path.endswith("npz") else write_hdf5)(path)
        content = Path(path).read_bytes()
        Path(path).write_bytes(content[: len(content) // 2])
        return path

    return write


def unknown() -> str:
    Path("notes.txt").write_text("hello")
    return "notes.txt"


def other_keys() -> str:
    with h5py.File("other.hdf5", "w") as file:
        file["states"], file["controls"] = np.zeros((5, 2)), np.zeros((5, 1))
    return "other.hdf5"


def other_names() -> str:
    np.savez("other.npz", states=np.zeros((5, 2)))
    return "other.npz"


def no_actions() -> str:
    shutil.copytree(LEROBOT / "v2.1", "robot")
    for file in Path("robot").rglob("*.parquet"):
        file.write_bytes(b"PAR1 nothing")
    return "robot"


def empty_file() -> str:
    Path("empty.npz").touch()
    return "empty.npz"


def not_finite() -> str:
    arrays = push_arrays()
    arrays["observations"][17, 3] = np.nan
    write_npz("nan.npz", observations=arrays["observations"])
    return "nan.npz"


def mixed_widths() -> str:
    write_robomimic("mixed.hdf5")
    with h5py.File("mixed.hdf5", "a") as file:
        for group in ("obs", "next_obs"):
            old = file[f"data/demo_2/{group}/state"][:, :4]
            del file[f"data/demo_2/{group}/state"]
            file[f"data/demo_2/{group}/state"] = old
    return "mixed.hdf5"


def short_actions() -> str:
    write_npz("short.npz", actions=push_arrays()["actions"][:-1])
    return "short.npz"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (unknown, ["notes.txt has no known format", "lerobot", "robomimic", "minari"]),
        (cut("cut.npz"), ["cut.npz"]),
        (cut("cut.hdf5"), ["cut.hdf5", "truncated"]),
        (other_keys, ["other.hdf5", "robomimic"]),
        (other_names, ["other.npz"]),
        (no_actions, ["parquet"]),
        (empty_file, ["empty.npz"]),
        (not_finite, ["nan.npz", "NaN"]),
        (mixed_widths, ["mixed.hdf5", "demo_2"]),
        (short_actions, ["short.npz", "timeouts have shape [240]"]),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
@pytest.mark.parametrize("command", ["inspect", "score"])
def test_data_that_cannot_be_read(
    caiac: Caiac, pushes: Path, make: Callable[[], str], words: list[str], command: str
) -> None:
    name = make()
    before = set(Path.cwd().rglob("*"))
    more = ["--layout", "layout.json", "--out", "scored"] if command == "score" else []
    result = caiac(command, name, *more)
    assert result.code == 1
    for word in words:
        assert word in result.error
    assert set(Path.cwd().rglob("*")) == before  # nothing half-written stays


def test_a_folder_is_free_for_other_data_after_an_error(
    caiac: Caiac, pushes: Path
) -> None:
    Path("scored").mkdir()
    to = ("--layout", "layout.json", "--out", "scored")
    assert caiac("score", not_finite(), *to).code == 1
    assert caiac("score", pushes, *to).code == 0


def test_episodes_of_one_row(caiac: Caiac, pushes: Path) -> None:
    ends = np.ones(240, dtype=bool)
    write_npz("ones.npz", timeouts=ends)
    result = caiac("check", "ones.npz", "--layout", "layout.json", "--json")
    assert result.code in (0, 1), result.err
    assert result.document["num_trajectories"] == 240


@pytest.mark.parametrize("name", ["nothing/there-v0", "minari://nothing/there-v0"])
def test_a_minari_dataset_that_is_not_there(
    caiac: Caiac, work: Path, name: str
) -> None:
    result = caiac("inspect", name)
    assert result.code in (1, 2) and "nothing/there-v0" in result.error


def test_without_minari_a_name_is_unknown(
    caiac: Caiac, work: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "minari.storage", None)
    result = caiac("inspect", "nothing/there-v0")
    assert result.code == 2 and "nothing at nothing/there-v0" in result.error


def test_an_unknown_format_by_name(caiac: Caiac, work: Path) -> None:
    write_npz()
    result = caiac("inspect", "pushes.npz", "--format", "csv")
    assert result.code == 2 and "'lerobot'" in result.err


def test_an_unknown_address(caiac: Caiac, work: Path) -> None:
    result = caiac("inspect", "s3://bucket/data")
    assert result.code in (1, 2) and "unknown s3://" in result.error


def test_a_folder_of_transitions_is_opened_where_it_is(
    caiac: Caiac, pushes: Path, tmp_path: Path
) -> None:
    before = {p: p.stat().st_mtime_ns for p in pushes.rglob("*")}
    assert caiac("inspect", pushes).code == 0
    assert {p: p.stat().st_mtime_ns for p in pushes.rglob("*")} == before
    assert not (tmp_path / "cache").exists()
    assert len(load_transitions(pushes)) == 240


@pytest.mark.parametrize("out", ["scored", "fresh"])
def test_a_folder_that_was_changed_in_place(
    caiac: Caiac, scored: Path, out: str
) -> None:
    load_transitions("pushes")["action"][7] *= 0.5
    score = ("--layout", "layout.json", "--out", out)
    result = caiac("score", "pushes", *score)
    assert result.code == 1 and "action.memmap changed" in result.error
    assert "with write_transitions" in result.error
    assert not Path("fresh").exists()
    write_transitions(load_transitions("pushes"), "again")
    assert caiac("score", "again", "--layout", "layout.json", "--out", "b").code == 0


def test_data_that_are_counterfactual_already(caiac: Caiac, scored: Path) -> None:
    out = "minari://pushes/more-v0"
    assert caiac("augment", scored, "--out", "more").code == 0
    assert caiac("augment", scored, "--out", out).code == 0
    infos = '--option=infos=["counterfactual"]'
    for number, source in enumerate((["more"], [out, infos])):
        score = ("score", *source, "--layout", "layout.json", "--out", f"s{number}")
        for _ in range(2):  # a repeated call, that resumes, warns too
            result = caiac(*score)
            assert result.code == 0, result.err
            assert "240 of 480 transitions of" in result.err
    assert "are counterfactual" not in caiac("inspect", scored).err


def test_arrays_with_other_names_are_named(caiac: Caiac, work: Path) -> None:
    np.savez("mine.npz", obs=np.zeros((4, 2)), act=np.zeros((4, 1)), done=np.ones(4))
    with h5py.File("mine.hdf5", "w") as file:
        file["observations"], file["act"] = np.zeros((4, 2)), np.zeros((4, 1))
    error = caiac("inspect", "mine.npz").error
    assert "mine.npz lacks ['actions', 'observations'], it has ['act', 'done'" in error
    assert "lerobot" not in error
    error = caiac("inspect", "mine.hdf5").error
    assert "mine.hdf5 lacks ['actions'], it has ['act', 'observations']" in error


def test_a_folder_without_a_format_is_refused_before_it_is_read(
    caiac: Caiac, work: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path) -> str:
        raise AssertionError(f"{path} is read")

    monkeypatch.setattr("torchrl_caiac.cli.sources.file_digest", fail)
    Path("notes").mkdir()
    Path("notes/text.txt").write_text("nothing")
    result = caiac("inspect", "notes")
    assert result.code == 1 and "notes has no known format" in result.error
    result = caiac("score", "notes", "--layout", "fetch/push", "--out", "scored")
    assert "notes has no known format" in result.error
    assert not Path("scored").exists()
