"""OGBench's files, compared with what OGBench itself reads from them."""

from __future__ import annotations

import io
import logging
import os
import sys
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_caiac.data import UnreadableFileError, action_bounds, load_ogbench
from torchrl_caiac.data.digests import data_source


def arrays(lengths=(4, 2, 6), *, seed=0, width=3, button=True):
    """The arrays of a file, with the types that OGBench's generator saves."""
    random, rows = np.random.default_rng(seed), sum(lengths)
    ends = np.zeros(rows, bool)
    ends[np.cumsum(lengths) - 1] = True
    result = {
        "observations": random.normal(size=(rows, width)).astype(np.float32),
        "actions": random.uniform(-1, 1, (rows, 5)).astype(np.float32),
        "terminals": ends,
        "qpos": random.normal(size=(rows, 4)).astype(np.float32),
        "qvel": random.normal(size=(rows, 3)).astype(np.float32),
    }
    if button:
        result["button_states"] = random.integers(0, 2, (rows, 2))
    return result


def write(path, content=None, **changes):
    content = {**(arrays() if content is None else content), **changes}
    kept = {key: value for key, value in content.items() if value is not None}
    np.savez_compressed(path, **kept)
    return path


@pytest.fixture
def file(tmp_path):
    return write(tmp_path / "point-play-v0.npz")


def load(file, **options):
    return load_ogbench(
        file, os.path.join(os.path.dirname(file), "rows"), progress=False, **options
    )


def check_same(data, expected):
    """Compares transitions with the arrays that OGBench returns."""
    assert np.array_equal(data["observation"], expected["observations"])
    assert np.array_equal(data["next", "observation"], expected["next_observations"])
    assert np.array_equal(data["action"], expected["actions"])
    done = data["next", "done"].squeeze(1)
    assert np.array_equal(done, expected["terminals"] > 0)
    assert np.array_equal(data["next", "truncated"].squeeze(1), done)
    assert not data["next", "terminated"].any()
    starts = np.concatenate([[0], np.cumsum(done)[:-1]])
    assert np.array_equal(data["episode"], starts)
    for key in ("qpos", "qvel", "button_states"):
        assert np.array_equal(data["info", key], expected[key])


@given(
    lengths=st.lists(st.integers(2, 6), min_size=1, max_size=5),
    seed=st.integers(0, 100),
)
@settings(max_examples=20, deadline=None)
def test_the_result_is_what_ogbench_reads(tmp_path_factory, lengths, seed):
    from ogbench.utils import load_dataset

    folder = tmp_path_factory.mktemp("ogbench")
    compact = write(folder / "a-v0.npz", arrays(lengths, seed=seed))
    expected = load_dataset(compact, add_info=True)
    check_same(load_ogbench(compact, folder / "a", progress=False), expected)
    # What OGBench returns can be saved and loaded too, in both of its forms.
    regular = write(folder / "b-v0.npz", expected)
    check_same(load_ogbench(regular, folder / "b", progress=False), expected)
    both = load_dataset(compact, add_info=True, compact_dataset=True)
    valid = write(folder / "c-v0.npz", both)
    check_same(load_ogbench(valid, folder / "c", progress=False), expected)


def test_uncompressed_and_transposed_arrays_are_read(tmp_path):
    content = arrays()
    content["observations"] = np.asfortranarray(content["observations"])
    np.savez(tmp_path / "a-v0.npz", **content)
    data = load(tmp_path / "a-v0.npz")
    ends = content["terminals"]
    assert np.array_equal(data["observation"], content["observations"][~ends])


def test_images_stay_integers(tmp_path):
    random = np.random.default_rng(0)
    images = random.integers(0, 255, (12, 8, 8, 3), dtype=np.uint8)
    file = write(tmp_path / "visual-point-v0.npz", observations=images)
    ends = arrays()["terminals"]
    assert np.array_equal(load(file)["observation"], images[~ends])


def test_rewards_are_kept_and_masks_are_infos(tmp_path):
    rewards, masks = np.arange(12) - 20.0, np.arange(12) % 2.0
    file = write(tmp_path / "a-v0.npz", rewards=rewards, masks=masks)
    data, ends = load(file), arrays()["terminals"]
    assert np.array_equal(data["next", "reward"].squeeze(1), rewards[~ends])
    assert np.array_equal(data["info", "masks"], masks[~ends])


def test_arrays_can_be_left_out(file):
    data = load(file, exclude=["qvel", "button_states"])
    assert set(data["info"].keys()) == {"qpos"}
    assert data_source(file.with_name("rows"))["exclude"] == ["button_states", "qvel"]


def test_the_validation_data_are_beside(file):
    write(file.with_name("point-play-v0-val.npz"), arrays((3, 3), seed=1))
    assert len(load(file)) == 9
    assert len(load(file, split="val", overwrite=True)) == 4
    again = load(file.with_name("point-play-v0-val.npz"), split="val", overwrite=True)
    assert len(again) == 4
    with pytest.raises(ValueError, match=r"'test', expected 'train' or 'val'"):
        load(file, split="test")


def test_actions_of_the_robot_have_bounds(tmp_path, caplog):
    file = write(tmp_path / "cube-double-play-v0.npz")
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        load(file)
    low, high = action_bounds(tmp_path / "rows")
    assert low.tolist() == [-1] * 5 and high.tolist() == [1] * 5
    assert "the actions of this environment are in [-1, 1]" in caplog.text
    load(file, overwrite=True, action_bounds=([-2] * 5, [2] * 5))
    assert action_bounds(tmp_path / "rows")[1].tolist() == [2] * 5
    wide = write(tmp_path / "scene-play-v0.npz", actions=np.full((12, 5), 3.0))
    with pytest.raises(
        ValueError, match=r"'actions' of episode 0 of .*scene.* go to 3"
    ):
        load(wide, overwrite=True)


def test_other_actions_have_none(file):
    load(file)
    assert action_bounds(file.with_name("rows")) is None


def test_a_second_call_opens_what_the_first_one_wrote(file):
    first = load(file)
    times = {f: f.stat().st_mtime_ns for f in file.with_name("rows").rglob("*")}
    second = load(file)
    assert (first == second).all()
    assert times == {f: f.stat().st_mtime_ns for f in file.with_name("rows").rglob("*")}
    with pytest.raises(FileExistsError, match=r"exclude differ"):
        load(file, exclude=["qpos"])
    write(file, arrays(seed=5))
    with pytest.raises(FileExistsError, match=r"sha256 differ"):
        load(file)


class Response:
    """What ``urllib.request.urlopen`` returns."""

    def __init__(self, content):
        self.content, self.length = content, len(content)

    def __iter__(self):
        return iter(io.BytesIO(self.content))


@pytest.fixture
def server(tmp_path, monkeypatch):
    """Files by the end of their address, and the addresses that were asked for."""
    files, asked = {}, []

    def urlopen(url):
        asked.append(url)
        if url.rsplit("/", 1)[1] not in files:
            raise OSError("HTTP Error 404: Not Found")
        return Response(files[url.rsplit("/", 1)[1]])

    monkeypatch.setattr("urllib.request.urlopen", urlopen)
    return files, asked


def test_a_dataset_is_downloaded_by_name(tmp_path, server):
    files, asked = server
    for number, ending in enumerate(("", "-val")):
        path = write(tmp_path / "x.npz", arrays((4, 3), seed=number))
        files[f"point-play-v0{ending}.npz"] = path.read_bytes()
    root = tmp_path / "root"
    options = {"root": root, "progress": False}
    with pytest.raises(
        FileNotFoundError, match=r"'point-play-v0' is not at .*download="
    ):
        load_ogbench("point-play-v0", tmp_path / "a", **options)
    data = load_ogbench("point-play-v0", tmp_path / "a", download=True, **options)
    assert np.array_equal(data["action"][:3], arrays((4, 3))["actions"][:3])
    assert [url.rsplit("/", 1)[1] for url in asked] == sorted(files, reverse=True)
    asked.clear()
    # They are there now.
    load_ogbench("point-play-v0", tmp_path / "b", split="val", **options)
    assert not asked


def test_a_download_that_fails_says_what_to_do(tmp_path, server):
    with pytest.raises(OSError, match=r"'nothing-v0' could not be downloaded .*404"):
        load_ogbench("nothing-v0", tmp_path / "a", root=tmp_path, download=True)
    assert os.listdir(tmp_path) == []


def test_without_ogbench_the_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ogbench", None)
    with pytest.raises(ImportError, match=r"torchrl-caiac\[ogbench\]"):
        load_ogbench("point-play-v0", tmp_path / "a", root=tmp_path, download=True)


def test_single_tasks_have_the_rewards_of_ogbench(tmp_path, monkeypatch):
    import ogbench

    make, made = ogbench.make_env_and_datasets, []
    monkeypatch.setattr(
        ogbench,
        "make_env_and_datasets",
        lambda *args, **options: made.append(make(*args, **options)) or made[-1],
    )
    x, y = np.meshgrid(np.arange(0, 22, 0.25), np.arange(0, 22, 0.25))
    places = np.stack([x.ravel(), y.ravel()], 1)
    content = arrays((len(places) - 10, 10), button=False, width=2)
    content["qpos"] = places.astype(np.float32)
    for ending in ("", "-val"):
        write(tmp_path / f"pointmaze-medium-navigate-v0{ending}.npz", content)
    name = "pointmaze-medium-navigate-singletask-task2-v0"
    data = load_ogbench(name, tmp_path / "rows", root=tmp_path, progress=False)
    ((_, train, _),) = made
    assert set(train["rewards"].tolist()) == {-1, 0}
    assert np.array_equal(data["next", "reward"].squeeze(1), train["rewards"])
    assert np.array_equal(data["info", "masks"], train["masks"])
    assert np.array_equal(data["info", "qpos"], train["qpos"])


ENDS = arrays()["terminals"]


@pytest.mark.parametrize(
    ("changes", "options", "error", "message"),
    [
        (
            {"terminals": None},
            {},
            KeyError,
            r"a-v0.npz lacks \['terminals'\], it has \[",
        ),
        ({"terminals": ENDS * 2.0}, {}, ValueError, "'terminals' of .*0 or 1"),
        ({"terminals": ENDS[:, None]}, {}, ValueError, r"'terminals' .*\[12, 1\]"),
        (
            {"terminals": ENDS * 0},
            {},
            ValueError,
            "'terminals' .*does not end the last",
        ),
        (
            {"terminals": np.arange(12) > 9},
            {},
            ValueError,
            r"episode 1 of .*a-v0.npz has one row only \(row 11.*remove the episode",
        ),
        ({"qpos": np.zeros((5, 2))}, {}, ValueError, r"a-v0.npz .*'qpos': \[5, 2\]"),
        ({"version": np.array(1)}, {}, ValueError, r"'version': \[\].*exclude="),
        (
            {"actions": np.full((12, 5), np.nan)},
            {},
            ValueError,
            "'action' in episode 0",
        ),
        ({"names": np.full(12, "cube")}, {}, ValueError, "'names'.*text.*exclude="),
        ({}, {"exclude": ["cup"]}, KeyError, r"\['cup'\], expected some of .*'qpos'"),
        ({}, {"exclude": ["actions"]}, KeyError, r"\['actions'\], expected"),
        (
            {"qpos": np.array([{}] * 12, dtype=object)},
            {},
            UnreadableFileError,
            "a-v0.npz .*'qpos' has Python objects",
        ),
        (
            {"next_observations": np.zeros((12, 4))},
            {},
            ValueError,
            r"'observation' in episode 0 of .*\[12?, 3\]|has shape",
        ),
    ],
)
def test_errors_name_file_and_key_and_leave_nothing(
    tmp_path, changes, options, error, message
):
    file = write(tmp_path / "a-v0.npz", **changes)
    with pytest.raises(error, match=message):
        load(file, **options)
    assert os.listdir(tmp_path) == ["a-v0.npz"]


def test_a_file_cut_short_or_changed_is_refused(file):
    content = file.read_bytes()
    for size in (0, 10, len(content) // 2, len(content) - 1):
        file.write_bytes(content[:size])
        with pytest.raises(
            UnreadableFileError, match=r"point-play-v0.npz is not a rea"
        ):
            load(file)
    # A changed byte of an array is found by the checksum of the ZIP file.
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        part = archive.getinfo("actions.npy")
    place = part.header_offset + part.compress_size - 20
    file.write_bytes(content[:place] + b"\x55\xaa" + content[place + 2 :])
    with pytest.raises(
        UnreadableFileError, match=r"point-play-v0.npz is not a readable"
    ):
        load(file)
    assert os.listdir(file.parent) == [file.name]


def test_missing_files_and_wrong_names_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file .*a-v0.npz"):
        load(tmp_path / "a-v0.npz")
    with pytest.raises(ValueError, match=r"neither a file .npz nor the name"):
        load_ogbench(tmp_path, tmp_path / "rows")
