"""``caiac augment``: files of every format, read by the library of the format."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest
import torch

from tests.augment.conftest import GOALS, with_goals
from tests.cli.conftest import Caiac
from tests.killing import run_killed
from tests.pushes import push_transitions
from torchrl_caiac.augment import augment_dataset
from torchrl_caiac.cli import main
from torchrl_caiac.data import load_transitions, to_minari, write_transitions
from torchrl_caiac.scored import open_scored


def names(folder: Path = Path()) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def expected(scored: Path, tmp_path: Path) -> dict[str, np.ndarray]:
    """What the library writes with the same settings."""
    data = augment_dataset(open_scored(scored), tmp_path / "expected", progress=False)
    return {
        "observations": data["observation"].numpy(),
        "next_observations": data["next", "observation"].numpy(),
        "actions": data["action"].numpy(),
        "counterfactual": data["caiac", "counterfactual"].numpy()[:, 0],
        "swapped": data["caiac", "swapped"].numpy(),
    }


def test_npz(caiac: Caiac, scored: Path, expected: dict[str, np.ndarray]) -> None:
    before = names()
    result = caiac("augment", scored, "--out", "a.npz", "--json")
    assert result.code == 0, result.err
    assert result.document["num_transitions"] == 480
    assert result.document["num_counterfactual"] == 240
    assert set(result.document["swapped"]) == {"cup", "box"}
    with np.load("a.npz") as stored:
        for name, array in expected.items():
            assert np.array_equal(stored[name], array)
    assert names() == before | {"a.npz"}


def test_hdf5(caiac: Caiac, scored: Path, expected: dict[str, np.ndarray]) -> None:
    before = names()
    assert caiac("augment", scored, "--out", "a.h5").code == 0
    with h5py.File("a.h5") as stored:
        for name, array in expected.items():
            assert np.array_equal(stored[name], array)
    assert names() == before | {"a.h5"}


def test_a_folder(caiac: Caiac, scored: Path, expected: dict[str, np.ndarray]) -> None:
    assert caiac("augment", scored, "--out", "more").code == 0
    data = load_transitions("more")
    assert np.array_equal(data["observation"].numpy(), expected["observations"])


@pytest.mark.parametrize("arguments", [[], ["--trajectories"]])
def test_minari(caiac: Caiac, scored: Path, arguments: list[str]) -> None:
    out = "minari://pushes/augmented-v0"
    result = caiac("augment", scored, "--out", out, *arguments, "--json")
    assert result.code == 0, result.err
    caiac("augment", scored, "--out", "more", *arguments)
    data = load_transitions("more")
    episodes = list(minari.load_dataset("pushes/augmented-v0").iterate_episodes())
    actions = np.concatenate([episode.actions for episode in episodes])
    assert np.array_equal(actions, data["action"].numpy())
    states = np.concatenate([episode.observations[:-1] for episode in episodes])
    assert np.array_equal(states, data["observation"].numpy())
    after = np.concatenate([episode.observations[1:] for episode in episodes])
    assert np.array_equal(after, data["next", "observation"].numpy())
    flags = np.concatenate([e.infos["counterfactual"][:-1] for e in episodes])
    assert np.array_equal(flags, data["caiac", "counterfactual"].numpy())
    again = caiac("augment", scored, "--out", out, *arguments)
    assert again.code == 2 and "exists" in again.error


def test_the_minari_dataset_that_was_scored(caiac: Caiac, pushes: Path) -> None:
    to_minari(push_transitions(), "pushes/play-v0", progress=False)
    score = ("score", "pushes/play-v0", "--layout", "layout.json", "--out", "scored")
    assert caiac(*score).code == 0
    out = ("--out", "minari://pushes/play-v0", "--overwrite")
    result = caiac("augment", "scored", *out)
    assert result.code == 2 and "is the data that were scored" in result.error
    assert minari.load_dataset("pushes/play-v0").total_steps == 240


def test_trajectories_alone(caiac: Caiac, scored: Path) -> None:
    arguments = ("--trajectories", "--no-originals", "--ratio", "0.25", "--seed", "3")
    assert caiac("augment", scored, "--out", "more", *arguments).code == 0
    data = load_transitions("more")
    assert data["caiac", "counterfactual"].all()
    assert int(data["episode"].max()) + 1 == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "a.csv"], "the format .csv is not known; known are .npz"),
        (["--out", "s3://a"], "only minari://ID can be written"),
        (["--out", "a.npz", "--ratio", "1"], "--ratio is 1.0, expected between"),
        (["--out", "a.npz", "--reward-tolerance", "1"], "option of --reward sparse"),
        (["--out", "scored/more"], "is inside of scored"),
        (["--out", "layout.json"], "the format .json is not known"),
        (["--out", "pushes"], "pushes exists"),
        (["--out", "pushes", "--overwrite"], "pushes is the data that were scored"),
        (["--out", "../work", "--overwrite"], "contains"),
    ],
)
def test_a_wrong_command_line(
    caiac: Caiac, scored: Path, arguments: list[str], message: str
) -> None:
    before = names()
    result = caiac("augment", scored, *arguments)
    assert result.code == 2 and message in result.error
    assert names() == before


def test_a_folder_that_is_not_there(caiac: Caiac) -> None:
    result = caiac("augment", "missing", "--out", "a.npz")
    assert result.code == 2 and "missing does not exist" in result.error


def test_a_folder_that_has_changed(caiac: Caiac, scored: Path) -> None:
    load_transitions(scored / "data")["action"][0] += 1
    before = names()
    result = caiac("augment", scored, "--out", "a.npz")
    assert result.code == 1 and "action.memmap changed" in result.error
    assert names() == before


def test_sparse_rewards(caiac: Caiac, pushes: Path) -> None:
    write_transitions(with_goals(push_transitions()), "goals")
    GOALS.save("goals.json")
    score = ("score", "goals", "--layout", "goals.json", "--out", "scored")
    assert caiac(*score).code == 0
    result = caiac("augment", "scored", "--out", "a.npz")
    assert result.code == 2 and "--reward sparse" in result.error
    wrong = ("--reward", "sparse", "--reward-tolerance", "0.01")
    result = caiac("augment", "scored", "--out", "a.npz", *wrong)
    assert result.code == 1 and "agrees with the stored rewards" in result.error
    assert not Path("a.npz").exists()
    result = caiac("augment", "scored", "--out", "more", "--reward", "sparse")
    assert result.code == 0, result.err
    data = load_transitions("more")
    gap = data["next", "achieved_goal"] - data["desired_goal"]
    near = (gap.abs() <= 0.1).all(-1, keepdim=True)
    assert torch.equal(data["next", "reward"], near.float() - 1)


def test_nothing_to_swap(caiac: Caiac, pushes: Path) -> None:
    write_transitions(push_transitions((40,)), "one")
    assert caiac("score", "one", "--layout", "layout.json", "--out", "few").code == 0
    before = names()
    result = caiac("augment", "few", "--out", "a.npz", "--trajectories")
    assert result.code == 1 and "no trajectory has" in result.error
    assert names() == before


@pytest.mark.parametrize("out", ["a.npz", "a.h5"])
def test_the_file_of_a_faster_call_stays(
    caiac: Caiac, scored: Path, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    import torchrl_caiac.cli.augment as command

    def slow(*args: object, **options: object) -> object:
        Path(out).write_text("other")
        return augment_dataset(*args, **options)

    monkeypatch.setattr(command, "augment_dataset", slow)
    before = names()
    result = caiac("augment", scored, "--out", out)
    assert result.code == 2 and f"{out} has appeared" in result.error
    assert Path(out).read_text() == "other" and names() == before | {out}


def killed_while_augmenting() -> Iterator[None]:
    """Stops after the transitions, before the file."""
    import torchrl_caiac.cli.augment as command

    class _Stop(BaseException):
        pass

    def stop(*args: object, **kwargs: object) -> None:
        raise _Stop

    command.export_npz = stop
    command.shutil.rmtree = lambda *args, **kwargs: None
    try:
        main(["augment", "scored", "--out", "a.npz"])
    except _Stop:
        yield


def test_what_a_killed_call_left_is_removed(caiac: Caiac, scored: Path) -> None:
    before = names()
    run_killed(killed_while_augmenting)
    assert names() > before and not Path("a.npz").exists()
    assert caiac("augment", scored, "--out", "a.npz").code == 0
    assert names() == before | {"a.npz"}
