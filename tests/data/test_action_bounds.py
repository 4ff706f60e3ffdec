"""The bounds of the action space beside the transitions."""

from __future__ import annotations

import json

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_caiac.data import UnreadableFileError, action_bounds, load_transitions
from torchrl_caiac.data.action_bounds import write_action_bounds
from torchrl_caiac.data.write_transitions import write_transitions

FILE = "action_space.json"


@pytest.mark.parametrize("storage_kind", ["memory"], indirect=True)
class TestWithTransitions:
    def test_folder_and_opened_rows_have_them(self, flat_data, tmp_path):
        bounds = torch.tensor([-1.0, 0.1]), torch.tensor([1.0, 0.2])
        rows = write_transitions(flat_data, tmp_path / "data", action_bounds=bounds)
        for source in (rows, tmp_path / "data", load_transitions(tmp_path / "data")):
            found = action_bounds(source)
            assert all(map(torch.equal, found, bounds))
            assert found[0].dtype == torch.float32

    def test_none_where_they_are_unknown(self, flat_data, tmp_path):
        rows = write_transitions(flat_data, tmp_path / "data")
        assert action_bounds(rows) is action_bounds(flat_data) is None

    def test_bounds_of_other_actions_are_refused(self, flat_data, tmp_path):
        with pytest.raises(ValueError, match=r"\[3\].*'action' has shape \[33, 2\]"):
            write_transitions(
                flat_data, tmp_path / "data", action_bounds=([0] * 3, [1] * 3)
            )
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([0.0], [float("inf")]),
        ([float("nan")], [0.0]),
        ([1.0], [0.0]),
        ([0.0, 0.0], [1.0]),
        (0.0, 1.0),
    ],
)
def test_what_is_no_bound_is_refused(low, high, tmp_path):
    with pytest.raises(ValueError, match="the lowest action"):
        write_action_bounds(tmp_path, low, high)
    assert not list(tmp_path.iterdir())
    (tmp_path / FILE).write_text(json.dumps({"low": low, "high": high}))
    with pytest.raises(UnreadableFileError, match=FILE):
        action_bounds(tmp_path)


def test_a_missing_folder_is_not_one_without_bounds(tmp_path):
    with pytest.raises(FileNotFoundError, match="missing"):
        action_bounds(tmp_path / "missing")


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@given(
    st.binary()
    | JSON.map(json.dumps).map(str.encode)
    | st.fixed_dictionaries({"low": JSON, "high": JSON}).map(json.dumps).map(str.encode)
)
def test_any_file_is_bounds_or_one_error(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("any")
    (folder / FILE).write_bytes(content)
    try:
        low, high = action_bounds(folder)
    except UnreadableFileError as error:
        assert FILE in str(error)
    else:
        assert (low <= high).all()
