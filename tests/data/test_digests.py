"""Digests of stored transitions."""

from __future__ import annotations

import hashlib
import json

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.mutations import mutate_json
from torchrl_caiac.data import UnreadableFileError, load_transitions
from torchrl_caiac.data.digests import (
    content_digests,
    data_digest,
    data_source,
    file_digest,
    has_digests,
    verify_digests,
    write_digests,
)
from torchrl_caiac.data.write_transitions import write_transitions


def stored(folder, fill=1.0):
    rows = {"action": torch.full((3, 2), fill), "next": {"x": torch.ones(3)}}
    TensorDict(rows, [3]).memmap(folder)
    return folder


def test_a_file_of_several_chunks(tmp_path):
    content = bytes(range(256)) * 10_000
    (tmp_path / "a").write_bytes(content)
    assert file_digest(tmp_path / "a") == hashlib.sha256(content).hexdigest()


def test_one_digest_of_the_data(tmp_path):
    for name, fill in (("one", 1.0), ("same", 1.0), ("other", 2.0)):
        folder = stored(tmp_path / name, fill)
        assert not has_digests(folder)
        write_digests(folder, source={"name": name})
        assert has_digests(folder) and data_source(folder) == {"name": name}
    digests = {data_digest(tmp_path / name) for name in ("one", "same")}
    assert len(digests) == 1 and data_digest(tmp_path / "other") not in digests


@pytest.mark.parametrize("change", [b"", b"x" * 12, None])
def test_changed_and_missing_leaves_are_named(change, tmp_path):
    write_digests(stored(tmp_path))
    file = tmp_path / "next" / "x.memmap"
    file.unlink() if change is None else file.write_bytes(change)
    with pytest.raises(UnreadableFileError) as error:
        verify_digests(tmp_path)
    assert str(file) in str(error.value) and "action" not in str(error.value)


def test_without_digests(tmp_path):
    stored(tmp_path)
    for read in (verify_digests, data_digest, data_source):
        with pytest.raises(FileNotFoundError, match=r"no digests\.json"):
            read(tmp_path)


def test_names_do_not_lead_out_of_the_folder(tmp_path):
    write_digests(stored(tmp_path))
    content = json.loads((tmp_path / "digests.json").read_text())
    for name in ("../x.memmap", "/etc/x.memmap", "meta.json"):
        content["sha256"] = {name: "0"}
        (tmp_path / "digests.json").write_text(json.dumps(content))
        with pytest.raises(UnreadableFileError, match="not a file of digests"):
            verify_digests(tmp_path)


@settings(max_examples=200)
@given(st.randoms(use_true_random=False))
def test_damaged_digests_are_refused_by_name(tmp_path_factory, rng):
    folder = stored(tmp_path_factory.mktemp("damaged") / "data")
    write_digests(folder)
    file = folder / "digests.json"
    file.write_text(json.dumps(mutate_json(json.loads(file.read_text()), rng)))
    try:
        verify_digests(folder)
    except UnreadableFileError as error:
        assert str(folder) in str(error)


class TestContentDigests:
    def test_only_original_leaves_and_named_scores_enter(self, tmp_path):
        write_digests(stored(tmp_path))
        rows = load_transitions(tmp_path, keys=["action"])
        before = content_digests(rows)
        assert before.keys() == {"action", "next.x"}
        for key in (("caiac", "score"), ("oracle", "score")):
            rows.make_memmap(key, shape=torch.Size([3, 2])).fill_(1.0)
        assert content_digests(rows, ("coda", "graph"), None) == before
        scored = content_digests(rows, ("caiac", "score"))
        assert scored.keys() == {*before, "caiac.score"}
        rows["oracle", "score"].fill_(2.0)
        assert content_digests(rows, ("caiac", "score")) == scored
        rows["caiac", "score"][1, 1] = 2.0
        changed = content_digests(rows, ("caiac", "score"))
        assert {key for key in scored if changed[key] != scored[key]} == {"caiac.score"}

    def test_all_leaves_of_other_transitions_enter(self, tmp_path):
        data = TensorDict({"action": torch.ones(3, 2), "x": torch.ones(3)}, [3])
        one = content_digests(data)
        assert one == content_digests(data.memmap(tmp_path))
        assert one.keys() == {"action", "x"}

    @pytest.mark.parametrize(
        "change",
        [
            lambda x: x.double(),
            lambda x: x.view(200_000, 1),
            lambda x: x.view(-1)[:-1],
            lambda x: torch.cat([x.view(-1)[:-1], torch.zeros(1)]).view_as(x),
        ],
    )
    def test_dtype_shape_and_every_number_count(self, change):
        tensor = torch.arange(200_000.0).view(100_000, 2)
        digests = [
            content_digests(TensorDict({"a": value}))
            for value in (tensor, tensor.clone(), change(tensor))
        ]
        assert digests[0] == digests[1] != digests[2]


def test_contents_of_a_relative_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = TensorDict(
        {
            "action": torch.ones(3, 2),
            "episode": torch.zeros(3, dtype=torch.int64),
            "next": {"done": torch.ones(3, 1, dtype=torch.bool)},
        },
        [3],
    )
    stored = write_transitions(rows, "here")
    assert content_digests(stored) == content_digests(load_transitions("here"))
    assert content_digests(stored) == content_digests(
        load_transitions(tmp_path / "here")
    )
