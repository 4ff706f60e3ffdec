"""Exported files, read by the libraries of their formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.augment import export_hdf5, export_npz
from torchrl_caiac.data import open_dataset

NAMES = ("arm", "cup")


def read_npz(file: Path) -> tuple[dict[str, Any], list[str]]:
    with np.load(file, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return arrays, list(arrays.pop("entities", ()))


def read_hdf5(file: Path) -> tuple[dict[str, Any], list[str]]:
    arrays: dict[str, Any] = {}
    with h5py.File(file) as stored:
        stored.visititems(
            lambda name, item: (
                arrays.update({name: item[()]})
                if isinstance(item, h5py.Dataset)
                else None
            )
        )
        return arrays, list(stored.attrs.get("entities", ()))


FORMATS = [(export_npz, read_npz, "a.npz"), (export_hdf5, read_hdf5, "a.hdf5")]
Export = Callable[..., Path]
Read = Callable[[Path], tuple[dict[str, Any], list[str]]]


def flat_rows(length: int) -> TensorDict:
    done = torch.zeros(length, 1, dtype=torch.bool)
    done[-1] = True
    return TensorDict(
        {
            "observation": torch.randn(length, 4),
            "action": torch.randn(length, 2),
            "episode": torch.zeros(length, dtype=torch.int64),
            "info": {"step": torch.arange(length)},
            "caiac": {
                "counterfactual": torch.arange(length).unsqueeze(-1) % 2 == 0,
                "swapped": torch.rand(length, 2) > 0.5,
            },
            "next": {
                "observation": torch.randn(length, 4),
                "reward": torch.randn(length, 1),
                "terminated": torch.zeros_like(done),
                "truncated": done,
                "done": done,
            },
        },
        [length],
    )


@pytest.mark.parametrize(("export", "read", "name"), FORMATS)
# More rows than are copied at a time, and fewer.
@pytest.mark.parametrize("length", [5, (1 << 14) + 3])
def test_flat_transitions(
    tmp_path: Path, export: Export, read: Read, name: str, length: int
) -> None:
    rows = flat_rows(length)
    arrays, entities = read(export(rows, tmp_path / name, entities=NAMES))
    expected = {
        "observations": rows["observation"],
        "next_observations": rows["next", "observation"],
        "actions": rows["action"],
        "episodes": rows["episode"],
        "rewards": rows["next", "reward"][:, 0],
        "terminals": rows["next", "terminated"][:, 0],
        "timeouts": rows["next", "truncated"][:, 0],
        "dones": rows["next", "done"][:, 0],
        "counterfactual": rows["caiac", "counterfactual"][:, 0],
        "swapped": rows["caiac", "swapped"],
    }
    assert set(arrays) == set(expected) and entities == list(NAMES)
    for key, leaf in expected.items():
        assert arrays[key].dtype == leaf.numpy().dtype
        assert np.array_equal(arrays[key], leaf.numpy())
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(("export", "read", "name"), FORMATS)
def test_nested_states_and_goals(
    tmp_path: Path, export: Export, read: Read, name: str
) -> None:
    rows = TensorDict(
        {
            "observation": {"arm": torch.rand(3, 2), "cup": {"at": torch.rand(3, 1)}},
            "desired_goal": torch.rand(3, 1),
            "action": torch.rand(3, 1),
            "next": {
                "observation": {"arm": torch.rand(3, 2), "cup": {"at": torch.rand(3)}}
            },
        },
        [3],
    )
    arrays, _ = read(export(rows, tmp_path / name))
    assert set(arrays) == {
        "observations/arm",
        "observations/cup/at",
        "observations/desired_goal",
        "next_observations/arm",
        "next_observations/cup/at",
        "actions",
    }


@pytest.mark.parametrize(("export", "read", "name"), FORMATS)
def test_the_package_opens_what_it_wrote(
    tmp_path: Path, export: Export, read: Read, name: str
) -> None:
    rows = flat_rows(9)
    export(rows, tmp_path / name)
    data = open_dataset(str(tmp_path / name), tmp_path / "data", progress=False)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        assert torch.equal(data[key], rows[key])


@pytest.mark.parametrize(("export", "read", "name"), FORMATS)
def test_an_existing_file_is_kept(
    tmp_path: Path, export: Export, read: Read, name: str
) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(FileExistsError, match=name):
        export(flat_rows(3), tmp_path / name)
    assert (tmp_path / name).read_text() == "mine"
    export(flat_rows(3), tmp_path / name, overwrite=True)
    assert len(read(tmp_path / name)[0]["actions"]) == 3


@pytest.mark.parametrize(("export", "read", "name"), FORMATS)
def test_half_of_a_file_is_not_left(
    tmp_path: Path,
    export: Export,
    read: Read,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torchrl_caiac.augment.export._parts", full)
    with pytest.raises(OSError, match=f"disk is full: .*{name}"):
        export(flat_rows(3), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_brain_floats_are_written_as_floats(tmp_path: Path) -> None:
    rows = TensorDict({"observation": torch.ones(3, 2, dtype=torch.bfloat16)}, [3])
    arrays, _ = read_npz(export_npz(rows, tmp_path / "a.npz"))
    assert arrays["observations"].dtype == np.float32


def test_what_is_no_state_is_left_out(tmp_path: Path) -> None:
    """Such as the source of a mixture, and a success in the next state."""
    data = TensorDict(
        {
            "observation": torch.rand(4, 2),
            "action": torch.rand(4, 1),
            "episode": torch.zeros(4, dtype=torch.int64),
            "source": torch.zeros(4, dtype=torch.int64),
            "goal_index": torch.zeros(4, dtype=torch.int64),
            "done": torch.zeros(4, 1, dtype=torch.bool),
            "step_count": torch.zeros(4, 1),
            "next": {
                "observation": torch.rand(4, 2),
                "step_count": torch.ones(4, 1),
                "goal_reached": torch.zeros(4, 1, dtype=torch.bool),
                "success": torch.zeros(4, 1, dtype=torch.bool),
                "done": torch.tensor([[False]] * 3 + [[True]]),
                "terminated": torch.zeros(4, 1, dtype=torch.bool),
            },
        },
        [4],
    )
    export_npz(data, tmp_path / "a.npz")
    names = {"observations", "next_observations", "actions", "episodes"}
    assert {*np.load(tmp_path / "a.npz")} == names | {"dones", "terminals"}
    back = open_dataset(tmp_path / "a.npz", tmp_path / "back", progress=False)
    assert back["observation"].shape[-1] == 2


def test_states_without_next_ones_are_kept(tmp_path: Path) -> None:
    rows = TensorDict({"state": torch.rand(4, 2), "action": torch.rand(4, 1)}, [4])
    with np.load(export_npz(rows, tmp_path / "a.npz"), allow_pickle=False) as stored:
        assert sorted(stored) == ["actions", "observations/state"]


def test_nested_actions_and_goals_of_one_state_are_kept(tmp_path: Path) -> None:
    rows = TensorDict(
        {
            "observation": torch.rand(4, 2),
            "action": {"arm": torch.rand(4, 2), "hand": torch.rand(4, 1)},
            "desired_goal": torch.rand(4, 1),
            "priority": torch.rand(4, 1),
            "next": {
                "observation": torch.rand(4, 2),
                "achieved_goal": torch.rand(4, 1),
            },
        },
        [4],
    )
    rows["displacement", "score"] = torch.rand(4, 2)
    with np.load(export_npz(rows, tmp_path / "a.npz"), allow_pickle=False) as stored:
        assert sorted(stored) == [
            "actions/arm",
            "actions/hand",
            "next_observations/achieved_goal",
            "next_observations/observation",
            "observations/desired_goal",
            "observations/observation",
        ]
