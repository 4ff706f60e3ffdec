"""Damaged records of scores are refused by one error."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import TensorStorage

from tests.mutations import mutate_file
from torchrl_caiac import EntityLayout
from torchrl_caiac.data import UnreadableFileError, load_transitions
from torchrl_caiac.influence import score_file
from torchrl_caiac.influence.score_record import read_record, write_record

KEY = ("caiac", "score")


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scored")
    TensorDict({"action": torch.zeros(3, 2)}, [3]).memmap(folder)
    data = load_transitions(folder, keys=["action"])
    storage, layout = TensorStorage(data), EntityLayout({"arm": [0]})
    write_record(storage, data, KEY, {"smoothing": 1, "every": 2}, layout, "scored")
    return folder, storage, data, score_file(folder, KEY).read_bytes()


@settings(max_examples=300)
@given(st.randoms(use_true_random=False))
def test_a_damaged_record_is_read_or_refused_by_name(scored, rng):
    folder, storage, data, content = scored
    file = score_file(folder, KEY)
    if file.is_dir():
        file.rmdir()
    file.write_bytes(content)
    mutate_file(file, rng)
    try:
        record = read_record(storage, data, KEY)
    except UnreadableFileError as error:
        assert str(file) in str(error)
    else:
        assert record is None or isinstance(record["settings"], dict)
