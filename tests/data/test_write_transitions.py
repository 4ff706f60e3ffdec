from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac.data.load_transitions import load_transitions
from torchrl_caiac.data.write_transitions import check_free, write_transitions


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
