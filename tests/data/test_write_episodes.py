from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_caiac.data import (
    UnreadableFileError,
    episode_transitions,
    load_transitions,
)
from torchrl_caiac.data.write_episodes import Part, write_episodes

SOURCE = {"file": "a.npz", "columns": (0, 1)}


def parts(count=2, value=0.0):
    for number in range(count):
        rows = episode_transitions(
            np.full((4, 2), value), np.full((3, 1), number), where="it"
        )
        yield Part(rows, f"episode {number}")


def never():
    raise AssertionError("the episodes are read")
    yield


def write(path, episodes, **given):
    return write_episodes(episodes, path, progress=False, **given)


def test_an_equal_source_is_opened_without_reading_it(tmp_path):
    first = write(tmp_path / "a", parts(), source=SOURCE)
    again = write(tmp_path / "a", never(), source={"columns": [0, 1], "file": "a.npz"})
    assert (first == again).all()
    with pytest.raises(
        FileExistsError, match=r"another source \(columns differ\).*over"
    ):
        write(tmp_path / "a", never(), source={**SOURCE, "columns": [0]})
    with pytest.raises(FileExistsError, match=r"\(exclude differ\)"):
        write(tmp_path / "a", never(), source={**SOURCE, "exclude": None})
    with pytest.raises(FileExistsError, match="other action_bounds"):
        write(tmp_path / "a", never(), source=SOURCE, action_bounds=([0], [2]))


def test_changed_leaves_of_an_equal_source_are_refused(tmp_path):
    write(tmp_path / "a", parts(), source=SOURCE)["observation"][0] = 1
    with pytest.raises(UnreadableFileError, match=r"observation\.memmap changed since"):
        write(tmp_path / "a", never(), source=SOURCE)
    write(tmp_path / "a", parts(), source=SOURCE, overwrite=True)
    write(tmp_path / "a", never(), source=SOURCE)


def test_replacing_another_source_is_logged(tmp_path, caplog):
    write(tmp_path / "a", parts(), source=SOURCE)
    write(tmp_path / "a", parts(), source=SOURCE, overwrite=True)
    assert not caplog.records
    data = write(tmp_path / "a", parts(3), source={"file": "b"}, overwrite=True)
    assert "a was written from other data" in caplog.text
    assert len(data) == 9


@pytest.mark.parametrize("content", ["[]", "", None])
def test_without_readable_digests_it_is_refused(content, tmp_path):
    write(tmp_path / "a", parts(), source=SOURCE)
    digests = tmp_path / "a" / "digests.json"
    digests.unlink() if content is None else digests.write_text(content)
    for given in ({"source": SOURCE}, {}):
        with pytest.raises((FileExistsError, UnreadableFileError), match="a"):
            write(tmp_path / "a", parts(), **given)
    write(tmp_path / "a", parts(), source=SOURCE, overwrite=True)


def test_rows_are_compared_without_a_source(tmp_path):
    first = write(tmp_path / "a", parts())
    assert (write(tmp_path / "a", parts()) == first).all()
    for other, match in (
        (parts(value=1.0), r"\['observation', .*\] of episode 0 differ"),
        (parts(1), "6 rows, now 3"),
        (parts(3), "of episode 2 differ"),
    ):
        with pytest.raises(FileExistsError, match=f"{match}.*overwrite=True"):
            write(tmp_path / "a", other)
    assert torch.equal(load_transitions(tmp_path / "a")["action"], first["action"])


def test_rows_without_numbers_are_compared(tmp_path):
    rows = next(parts())
    rows.rows["nothing"] = torch.zeros(3, 0)
    write(tmp_path / "a", [rows])
    assert write(tmp_path / "a", [rows])["nothing"].shape == (3, 0)
