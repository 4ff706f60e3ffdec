from __future__ import annotations

import importlib
import json
import os
import shutil

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from tests.killing import run_killed
from tests.mutations import mutate_file
from torchrl_caiac._files import safe_meta
from torchrl_caiac.data import UnreadableFileError
from torchrl_caiac.data.digests import write_digests
from torchrl_caiac.data.load_transitions import load_transitions

load_module = importlib.import_module("torchrl_caiac.data.load_transitions")


def rows(n=6):
    return TensorDict(
        {
            "observation": torch.randn(n, 3),
            "action": torch.randn(n, 2),
            "episode": torch.arange(n) // 3,
            "next": {"observation": torch.randn(n, 3), "done": torch.ones(n, 1) > 0},
            "odd/key": torch.randn(n),
        },
        [n],
    )


def test_what_was_written_is_read(tmp_path):
    data = rows()
    data.memmap(tmp_path / "data")
    loaded = load_transitions(tmp_path / "data")
    assert (loaded == data).all()
    assert loaded.is_memmap()
    # A leaf can be added, and is there the next time.
    loaded.make_memmap(("caiac", "score"), shape=[6, 2]).fill_(3.0)
    again = load_transitions(tmp_path / "data")
    assert (again["caiac", "score"] == 3).all()


def test_opening_writes_nothing(tmp_path):
    # Another process may be opening the same folder.
    rows().memmap(tmp_path / "data")
    before = {f: f.stat().st_mtime_ns for f in tmp_path.rglob("*")}
    loaded = load_transitions(tmp_path / "data")
    assert loaded["next"].is_memmap()
    assert loaded["next"].is_locked
    assert {f: f.stat().st_mtime_ns for f in tmp_path.rglob("*")} == before


@pytest.mark.parametrize("size", [6, 9])
def test_rows_that_a_saved_buffer_does_not_use_are_no_data(size, tmp_path):
    rb = ReplayBuffer(storage=LazyTensorStorage(size))
    rb.extend(rows())
    rb.dumps(tmp_path)
    if size == 6:
        assert (load_transitions(tmp_path / "storage") == rb.storage[:]).all()
    else:
        with pytest.raises(ValueError, match=r"uses 6 of its 9 rows.*rb\.loads"):
            load_transitions(tmp_path / "storage")


@pytest.mark.parametrize("name", ["observation", "next/observation", "odd%2Fkey"])
@pytest.mark.parametrize("size", [0, 7, 4000])
def test_a_truncated_file_is_noticed_and_left_as_it_is(name, size, tmp_path):
    rows().memmap(tmp_path / "data")
    file = tmp_path / "data" / f"{name}.memmap"
    file.write_bytes((file.read_bytes() * 200)[:size])
    with pytest.raises(ValueError, match=f"has {size} bytes, expected") as error:
        load_transitions(tmp_path / "data")
    assert "create the data again" in str(error.value)
    assert file.stat().st_size == size


@pytest.mark.parametrize("name", ["meta.json", "next/meta.json", "action.memmap"])
def test_a_missing_file(name, tmp_path):
    rows().memmap(tmp_path / "data")
    (tmp_path / "data" / name).unlink()
    with pytest.raises(ValueError, match="is missing"):
        load_transitions(tmp_path / "data")


@pytest.mark.parametrize(
    "text", ["", "{", "[1]", '{"a": 1}', '{"_type": 1, "shape": "x"}']
)
def test_a_foreign_meta_file(text, tmp_path):
    rows().memmap(tmp_path / "data")
    (tmp_path / "data/meta.json").write_text(text)
    with pytest.raises(ValueError, match=r"meta.json is .*truncated"):
        load_transitions(tmp_path / "data")


def test_another_batch_size(tmp_path):
    rows().reshape(2, 3).memmap(tmp_path / "data")
    with pytest.raises(ValueError, match=r"batch size \[2, 3\], expected \[T\]"):
        load_transitions(tmp_path / "data")


def test_missing_folders_and_keys(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        load_transitions(tmp_path / "absent")
    with pytest.raises(ValueError, match="not a memory-mapped tensordict"):
        load_transitions(tmp_path)
    rows().exclude("episode").memmap(tmp_path / "data")
    with pytest.raises(ValueError, match=r"lacks \['episode'\]"):
        load_transitions(tmp_path / "data")
    assert len(load_transitions(tmp_path / "data", keys=["action"])) == 6


def test_leaves_without_elements_have_no_file(tmp_path):
    data = rows().set("nothing", torch.zeros(6, 0))
    data.memmap(tmp_path / "data")
    assert load_transitions(tmp_path / "data")["nothing"].shape == (6, 0)


def change_meta(folder, change):
    meta = folder / "meta.json"
    content = json.loads(meta.read_text())
    change(content)
    meta.write_text(json.dumps(content))


def test_a_file_must_fit_its_description(tmp_path):
    rows().memmap(tmp_path / "data")
    change_meta(tmp_path / "data", lambda meta: meta["action"].update(shape=[6, 3]))
    with pytest.raises(ValueError, match="expected 72"):
        load_transitions(tmp_path / "data")


@pytest.mark.parametrize(
    "entry",
    [
        {"shape": "[6, 2]"},
        {"shape": [6, -2]},
        {"shape": [6, True]},
        {"shape": [3, 4]},
        {"dtype": "torch.float23"},
        {"dtype": "torch.nn"},
        {"dtype": None},
        {"is_nested": True},
    ],
)
def test_a_damaged_description_is_refused(entry, tmp_path):
    """Nothing is allocated by a shape of text, no leaf is dropped without a word."""
    rows().memmap(tmp_path / "data")
    change_meta(tmp_path / "data", lambda meta: meta["action"].update(entry))
    with pytest.raises(ValueError, match=r"meta.json has an unreadable .*'action'"):
        load_transitions(tmp_path / "data")


class Payload:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


@pytest.mark.parametrize("below", [(), ("next",)])
def test_nothing_is_unpickled(below, tmp_path):
    data, ran = rows(), tmp_path / "ran"
    data.set_non_tensor((*below, "note"), Payload(ran))
    data.memmap(tmp_path / "data")
    with pytest.raises(
        ValueError, match=r"NonTensorData in 'note', expected only tensors"
    ):
        load_transitions(tmp_path / "data")
    assert not ran.exists()
    # The payload works: tensordict runs it if it is allowed to.
    TensorDict.load_memmap(tmp_path / "data", allow_pickle=True)
    assert ran.exists()


def test_another_class_is_refused(tmp_path):
    rows().memmap(tmp_path / "data")
    kind = "<class 'tensordict.tensorclass.NonTensorData'>"
    change_meta(tmp_path / "data/next", lambda meta: meta.update(_type=kind))
    with pytest.raises(ValueError, match=r"next.meta.json describes a .*NonTensorData"):
        load_transitions(tmp_path / "data")


@pytest.mark.parametrize(
    "change",
    [
        {"device": "cuda:0"},
        {"device": "meta"},
        {"action": "torch.float32"},
        {"action": None},
        {"device": None},
    ],
)
def test_no_entry_is_left_out_or_moved_without_a_word(change, tmp_path):
    rows().memmap(tmp_path / "data")
    change_meta(tmp_path / "data", lambda meta: meta.update(change))
    with pytest.raises(UnreadableFileError, match=r"meta\.json"):
        load_transitions(tmp_path / "data")


def test_an_inner_batch_size_must_begin_with_the_outer_one(tmp_path):
    rows().memmap(tmp_path / "data")
    change_meta(tmp_path / "data/next", lambda meta: meta.update(shape=[3]))
    with pytest.raises(UnreadableFileError, match=r"next/meta\.json.*batch size \[6\]"):
        load_transitions(tmp_path / "data")


def test_what_is_not_a_file_is_not_opened(tmp_path):
    rows().memmap(tmp_path / "data")
    file = tmp_path / "data" / "action.memmap"
    file.unlink()
    os.mkfifo(file)  # opening it would wait forever
    with pytest.raises(UnreadableFileError, match=r"action\.memmap"):
        load_transitions(tmp_path / "data")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "data"
    rows().memmap(folder)
    write_digests(folder)
    return folder


@settings(max_examples=300)
@given(st.randoms(use_true_random=False))
def test_a_damaged_folder_is_read_whole_or_refused_by_name(whole, rng):
    folder = whole.with_name("damaged")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(whole, folder)
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    mutate_file(rng.choice(files), rng)
    for verify in (False, True):
        try:
            loaded = load_transitions(folder, verify=verify)
        except (UnreadableFileError, FileNotFoundError) as error:
            assert str(folder) in str(error)
            continue
        except ValueError as error:  # readable, but not flat transitions
            assert str(folder) in str(error)
            assert "batch size" in str(error) or "lacks" in str(error)
            continue
        assert all(leaf.shape[0] == 6 for leaf in loaded.values(True, True))
        if verify:
            digests = json.loads((folder / "digests.json").read_text())["sha256"]
            expected = load_transitions(whole)
            for key in loaded.keys(True, True):
                if (
                    f"{'/'.join(key) if isinstance(key, tuple) else key}.memmap"
                    in digests
                ):
                    same = loaded[key].flatten().view(torch.uint8)
                    assert torch.equal(same, expected[key].flatten().view(torch.uint8))


class TestVerify:
    def test_one_flipped_bit_is_noticed(self, tmp_path):
        rows().memmap(tmp_path)
        write_digests(tmp_path)
        load_transitions(tmp_path, verify=True)
        file = tmp_path / "next" / "observation.memmap"
        content = bytearray(file.read_bytes())
        content[11] ^= 4
        file.write_bytes(content)
        load_transitions(tmp_path)
        with pytest.raises(
            UnreadableFileError, match=r"next/observation\.memmap chang"
        ):
            load_transitions(tmp_path, verify=True)

    def test_leaves_may_be_added(self, tmp_path):
        rows().memmap(tmp_path)
        write_digests(tmp_path)
        loaded = load_transitions(tmp_path)
        loaded.make_memmap(("caiac", "score"), shape=[6, 2]).fill_(3.0)
        assert ("caiac", "score") in load_transitions(tmp_path, verify=True).keys(True)

    def test_without_digests_there_is_nothing_to_verify(self, tmp_path):
        rows().memmap(tmp_path)
        with pytest.raises(FileNotFoundError, match=r"no digests\.json"):
            load_transitions(tmp_path, verify=True)


def test_a_killed_addition_of_a_leaf_is_undone(tmp_path, caplog):
    rows().memmap(tmp_path)

    def half():
        data = load_transitions(tmp_path)
        with safe_meta(tmp_path):
            data.make_memmap(("caiac", "score"), shape=[6, 2])
            (tmp_path / "caiac" / "meta.json").write_text("")
            yield

    run_killed(half)
    assert ("caiac", "score") not in load_transitions(tmp_path).keys(True)
    assert "without that leaf" in caplog.text
    # The file of that leaf is left, and taken over by the next one.
    loaded = load_transitions(tmp_path)
    loaded.make_memmap(("caiac", "score"), shape=[6, 2]).fill_(3.0)
    assert (load_transitions(tmp_path)["caiac", "score"] == 3).all()


def test_a_leaf_that_is_added_meanwhile_is_waited_for(tmp_path, monkeypatch):
    folder = tmp_path / "data"
    rows().memmap(folder)
    meta = folder / "meta.json"
    content = meta.read_text()
    written = iter(["", content[:40], content + " "])

    def recover_meta(path):  # the last moment before the folder is read
        meta.write_text(next(written))

    monkeypatch.setattr(load_module, "recover_meta", recover_meta)
    assert load_transitions(folder).shape == (6,)
    assert not [*written]


def test_a_read_only_folder_is_read(read_only, tmp_path):
    rows().memmap(tmp_path / "data")
    write_digests(tmp_path / "data")
    read_only(tmp_path / "data")
    with pytest.raises(OSError, match=r"(?i)read-only|denied"):
        (tmp_path / "data" / "new").touch()
    loaded = load_transitions(tmp_path / "data", verify=True)
    assert loaded["observation"].shape == (6, 3)
