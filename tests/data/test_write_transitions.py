from __future__ import annotations

import os

import pytest
import torch
from tensordict import TensorDict

from tests.killing import run_killed
from torchrl_caiac._files import whole_folder
from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.write_transitions import (
    check_free,
    whole_transitions,
    write_transitions,
)


def transitions(value, length=3):
    return TensorDict(
        {
            "action": torch.full((length, 2), value),
            "episode": torch.zeros(length, dtype=torch.int64),
            "next": {"done": torch.ones(length, 1, dtype=torch.bool)},
        },
        [length],
    )


def test_writes_and_replaces_a_folder(tmp_path):
    path = tmp_path / "deep" / "data"
    for value in (1.0, 2.0):
        data = write_transitions(transitions(value), path, overwrite=value > 1)
        assert data.is_memmap()
        assert (data == transitions(value)).all()
    assert [entry.name for entry in path.parent.iterdir()] == ["data"]
    assert len(write_transitions(transitions(3.0, 5), f"{tmp_path}/other")) == 5


def test_replaces_nothing_without_permission(tmp_path):
    write_transitions(transitions(1.0), tmp_path / "data")
    with pytest.raises(FileExistsError, match=r"data exists.*overwrite=True"):
        write_transitions(transitions(2.0), tmp_path / "data")
    assert (load_transitions(tmp_path / "data") == transitions(1.0)).all()
    check_free(None)
    check_free(tmp_path / "other")


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: data.exclude("episode"), r"the data lacks \['episode'\].*add"),
        (lambda data: data.exclude(("next", "done")), r"lacks \[\('next', 'done'\)\]"),
        (lambda data: data.unsqueeze(0), r"the data has batch size \[1, 3\]"),
        (lambda data: data[:0], r"batch size \[0\], expected \[T\] with at least one"),
    ],
)
def test_what_is_not_transitions_replaces_nothing(exists, spoil, message, tmp_path):
    path = tmp_path / "data"
    if exists:
        write_transitions(transitions(1.0), path)
    with pytest.raises(ValueError, match=message):
        write_transitions(spoil(transitions(2.0)), path, overwrite=exists)
    if exists:
        assert (load_transitions(path, verify=True) == transitions(1.0)).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["data"] * exists
    write_transitions(transitions(3.0), path, overwrite=exists)


@pytest.mark.parametrize("damage", ["truncate", "keys"])
def test_a_folder_that_cannot_be_opened_replaces_nothing(damage, tmp_path):
    path = tmp_path / "data"
    write_transitions(transitions(1.0), path)
    keys = ["x"] if damage == "keys" else None
    match = r"data cannot be opened once.*data is unchanged: correct the data"
    with (
        pytest.raises(ValueError, match=match),
        whole_transitions(path, keys=keys) as folder,
    ):
        transitions(2.0).memmap(folder)
        if damage == "truncate":
            os.truncate(folder / "action.memmap", 3)
    assert (load_transitions(path, verify=True) == transitions(1.0)).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize("call", ["load", "write", "check"])
def test_a_kill_between_two_moves_loses_nothing(call, tmp_path, monkeypatch):
    path = tmp_path / "data"
    write_transitions(transitions(1.0), path)
    replace = os.replace

    def once(source, target):
        replace(source, target)
        os.kill(os.getpid(), 9)

    def replacing():
        with whole_folder(path) as folder:
            folder.mkdir()
        yield

    monkeypatch.setattr(os, "replace", once)
    run_killed(replacing)
    monkeypatch.undo()
    assert not path.exists()
    if call == "write":
        with pytest.raises(FileExistsError, match="overwrite=True"):
            write_transitions(transitions(2.0), path)
    elif call == "check":
        with pytest.raises(FileExistsError, match="overwrite=True"):
            check_free(path)
    assert (load_transitions(path, verify=True) == transitions(1.0)).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["data"]


def test_a_full_disk_is_an_error_and_leaves_nothing(small_disk):
    with pytest.raises(OSError, match=r"the disk is full: .*\.memmap needs \d+ bytes"):
        write_transitions(transitions(1.0, 500_000), small_disk / "data")
    assert not list(small_disk.iterdir())


def test_an_opened_folder_is_written_elsewhere(tmp_path):
    opened = write_transitions(transitions(1.0), tmp_path / "one")
    other = write_transitions(opened, tmp_path / "other")
    other["action"].fill_(2.0)
    assert (load_transitions(tmp_path / "one") == transitions(1.0)).all()


@pytest.mark.parametrize("key", ["shape", ("next", "device"), ("_type", "x")])
def test_names_that_would_be_lost_are_refused(key, tmp_path):
    data = transitions(1.0).set(key, torch.zeros(3))
    with pytest.raises(ValueError, match=r"\['_type', 'device', 'shape'\].*rename"):
        write_transitions(data, tmp_path / "data")
    assert not list(tmp_path.iterdir())


def test_what_is_not_a_tensor_is_refused_before_it_is_written(tmp_path):
    data = transitions(1.0)
    data.set_non_tensor(("next", "note"), "text")
    with pytest.raises(ValueError, match=r"'note'\) .* is a NonTensorData.*exclude"):
        write_transitions(data, tmp_path / "data")
    assert not list(tmp_path.iterdir())


def test_what_another_process_wrote_meanwhile_stays(tmp_path):
    rows = TensorDict({"action": torch.zeros(3, 2)}, [3])
    with (
        pytest.raises(FileExistsError, match="exists: open it"),
        whole_transitions(tmp_path / "a", keys=["action"], overwrite=False) as folder,
    ):
        rows.memmap(folder)
        (rows + 1).memmap(tmp_path / "a")
    assert load_transitions(tmp_path / "a", keys=["action"])["action"].eq(1).all()
