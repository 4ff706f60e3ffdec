"""LeRobot datasets that LeRobot itself wrote, see ``lerobot/make.py``."""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import shutil
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from torchrl_caiac.data import UnreadableFileError, lerobot_tasks, load_lerobot
from torchrl_caiac.data.digests import data_source

HERE = Path(__file__).parent / "lerobot"
VERSIONS = ("v2.1", "v3.0")
FRAMES = {"v2.1": "data/chunk-000/episode_000001.parquet"}
FRAMES["v3.0"] = "data/chunk-000/file-000.parquet"


def _make() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make", HERE / "make.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


make = _make()
EPISODES = [make.episode(number) for number in range(len(make.LENGTHS))]


def joined(name, rows=slice(0, -1)):
    return np.concatenate([episode[name][rows] for episode in EPISODES])


@pytest.fixture(params=VERSIONS)
def folder(request, tmp_path):
    return Path(shutil.copytree(HERE / request.param, tmp_path / "push"))


def load(folder, **options):
    return load_lerobot(folder, folder.with_name("rows"), progress=False, **options)


def frames_of(folder):
    """The file with the frames of episode 1."""
    for name in FRAMES.values():
        if (folder / name).exists():
            return folder / name
    raise AssertionError


def rewrite(file, edit):
    """Changes a Parquet file, as a dictionary of columns."""
    table = pq.read_table(file)
    columns = {name: table[name] for name in table.column_names}
    edit(columns)
    pq.write_table(pa.table(columns), file)


@pytest.mark.parametrize("version", VERSIONS)
def test_all_features_of_numbers_are_read(tmp_path, version, caplog):
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        data = load_lerobot(HERE / version, tmp_path / "rows", progress=False)
    for name in ("state", "environment_state"):
        for rows, leaf in ((slice(0, -1), data), (slice(1, None), data["next"])):
            expected = joined(f"observation.{name}", rows)
            assert np.array_equal(leaf["observation", name], expected)
    assert np.array_equal(data["action"], joined("action"))
    assert np.array_equal(data["next", "reward"], joined("next.reward"))
    assert np.array_equal(data["next", "success"], joined("next.success"))
    lengths = [length - 1 for length in make.LENGTHS]
    assert data["episode"].tolist() == np.repeat(range(4), lengths).tolist()
    done = np.zeros((sum(lengths), 1), bool)
    done[np.cumsum(lengths) - 1] = True
    assert np.array_equal(data["next", "done"], done)
    assert np.array_equal(data["next", "truncated"], done)
    assert not data["next", "terminated"].any()
    assert "the last frame of each episode is left out" in caplog.text


def test_every_frame_has_its_task(folder):
    data = load(folder)
    texts = lerobot_tasks(folder.with_name("rows"))
    assert texts == dict(enumerate(make.TASKS))
    expected = [
        make.task(number, t)
        for number, length in enumerate(make.LENGTHS)
        for t in range(length - 1)
    ]
    assert data["task"].tolist() == expected
    assert {0, 1} == set(data["task"][data["episode"] == 3].tolist())


def test_keys_join_features_to_a_flat_observation(folder, caplog):
    keys = ["observation.environment_state", "observation.state"]
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        data = load(folder, keys=keys)
    expected = np.concatenate([joined(key) for key in keys], 1)
    assert np.array_equal(data["observation"], expected)
    columns = data_source(folder.with_name("rows"))["columns"]
    assert columns == {keys[0]: [0, 4], keys[1]: [4, 7]}
    assert "observation.environment_state 0 to 3, observation.state 4 to 6" in (
        caplog.text
    )


def test_features_are_left_out_and_kept_by_name(folder):
    data = load(
        folder,
        exclude=["observation.state", "next.success"],
        infos=["timestamp", "episode_index"],
    )
    assert set(data["observation"].keys()) == {"environment_state"}
    assert "success" not in set(data["next"].keys())
    assert data["info", "episode_index"].squeeze(1).tolist() == data["episode"].tolist()
    assert data["info", "timestamp"][:5].squeeze(1).tolist() == pytest.approx(
        [0, 0.1, 0.2, 0.3, 0.4]
    )


def test_both_versions_and_a_split_episode_give_the_same(tmp_path):
    copy = shutil.copytree(HERE / "v3.0", tmp_path / "push")
    second = copy / "data/chunk-000/file-001.parquet"
    table = pq.read_table(second)
    pq.write_table(table.slice(0, 3), second)
    pq.write_table(table.slice(3), copy / "data/chunk-000/file-002.parquet")
    parts = [
        load_lerobot(path, tmp_path / str(number), progress=False)
        for number, path in enumerate((HERE / "v2.1", HERE / "v3.0", copy))
    ]
    assert (parts[0] == parts[1]).all() and (parts[0] == parts[2]).all()


def test_lists_of_variable_length_are_read_too(folder):
    def edit(columns):
        values = columns["action"].to_pylist()
        columns["action"] = pa.array(values, pa.list_(pa.float64()))

    rewrite(frames_of(folder), edit)
    assert np.array_equal(load(folder)["action"], joined("action"))


def test_a_second_call_opens_what_the_first_one_wrote(folder):
    first = load(folder)
    (folder.with_name("rows") / "note").touch()
    assert (load(folder) == first).all()
    assert (folder.with_name("rows") / "note").exists()
    with pytest.raises(FileExistsError, match=r"columns, features differ"):
        load(folder, keys=["observation.state"])


def test_an_end_inside_an_episode_is_said(folder, caplog):
    def edit(columns):
        columns["next.done"] = pa.array([True] * len(columns["next.done"]))

    rewrite(frames_of(folder), edit)
    load(folder)
    assert "['next.done'] of episode " in caplog.text
    assert caplog.text.count("is taken as one trajectory") == 1


def test_datasets_of_the_hub_are_downloaded(folder, monkeypatch, tmp_path):
    hub, asked = ModuleType("huggingface_hub"), []

    def snapshot_download(name, **options):
        asked.append((name, options))
        if name != "someone/push":
            raise ValueError("404")
        return str(folder)

    hub.snapshot_download = snapshot_download
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    options = {"download": True, "progress": False}
    data = load_lerobot("someone/push", tmp_path / "hub", revision="main", **options)
    assert (data == load(folder)).all()
    ((name, passed),) = asked
    assert name == "someone/push" and passed["repo_type"] == "dataset"
    assert passed["revision"] == "main"
    assert not any(pattern.startswith("video") for pattern in passed["allow_patterns"])
    assert data_source(tmp_path / "hub")["dataset"] == "someone/push"
    with pytest.raises(OSError, match=r"'someone/cup' could not be downloaded .404"):
        load_lerobot("someone/cup", tmp_path / "cup", **options)
    with pytest.raises(
        FileNotFoundError, match=r"no folder someone/cup.*download=True"
    ):
        load_lerobot("someone/cup", tmp_path / "cup")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match=r"package huggingface_hub"):
        load_lerobot("someone/cup", tmp_path / "cup", **options)


def test_without_pyarrow_the_package_is_named(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(ImportError, match=r"torchrl-caiac\[lerobot\]"):
        load(folder)


def drop(name):
    return lambda columns: columns.pop(name)


def put(name, value):
    def edit(columns):
        columns[name] = pa.array([value] * len(columns[name]))

    return edit


def mixed(columns):
    values = columns["action"].to_pylist()
    # As many numbers as before.
    values[0], values[1] = values[0] + values[1][:1], values[1][1:]
    columns["action"] = pa.array(values, pa.list_(pa.float32()))


def shuffled(columns):
    order = columns["frame_index"].to_pylist()
    columns["frame_index"] = pa.array([order[1], order[0], *order[2:]])


@pytest.mark.parametrize(
    ("edit", "error", "message"),
    [
        (drop("action"), KeyError, r"parquet lacks \['action'\], it has \['observati"),
        (put("action", None), ValueError, "'action' of .*parquet has .* missing"),
        (put("action", [1.0, None]), ValueError, "'action' of .*missing"),
        (put("action", [1.0]), ValueError, r"'action' of .*\[1\], but .*\[2\]"),
        (put("action", "left"), ValueError, r"'action' of .*\[\], but|has string"),
        (mixed, ValueError, r"'action' of .*parquet .*different widths, \[1, 2, 3\]"),
        (put("next.reward", np.nan), ValueError, "'reward' in episode . of .*NaN"),
        (put("task_index", 7), ValueError, r"'task_index' of episode . of .*\[7\]"),
        (
            shuffled,
            UnreadableFileError,
            "'frame_index' of episode . in .*parquet is not",
        ),
        (put("episode_index", 0), UnreadableFileError, r"episode 0 of .* has 10 fr"),
    ],
)
def test_errors_of_frames_name_file_and_key_and_leave_nothing(
    folder, edit, error, message
):
    rewrite(frames_of(folder), edit)
    with pytest.raises(error, match=message):
        load(folder)
    assert os.listdir(folder.parent) == [folder.name]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"keys": ["observation.cup"]}, KeyError, r"\['observation.cup'\] .*keys="),
        ({"keys": []}, ValueError, "keys is empty"),
        ({"keys": ["action", "action"]}, ValueError, "a feature twice"),
        ({"action": "actions"}, KeyError, "'actions'.*'action'.*correct action="),
        ({"infos": ["cup"]}, KeyError, "correct infos="),
        ({"exclude": ["cup"]}, KeyError, "correct exclude="),
        (
            {"exclude": ["observation.state", "observation.environment_state"]},
            KeyError,
            r"no feature observation.\* of numbers",
        ),
    ],
)
def test_wrong_options_list_what_is_there(folder, options, error, message):
    with pytest.raises(error, match=message):
        load(folder, **options)


def cut(file):
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])


def test_files_cut_short_are_refused_by_name(folder):
    files = [p for p in sorted(folder.rglob("*")) if p.suffix in (".parquet", ".json")]
    for file in files:
        if file.name == "stats.json":
            continue
        whole = file.read_bytes()
        cut(file)
        with pytest.raises(
            UnreadableFileError, match=rf"{file.name} is not a readable"
        ):
            load(folder)
        file.write_bytes(whole)
    assert os.listdir(folder.parent) == [folder.name]


def test_missing_files_are_named(folder):
    for name in ("meta/info.json", "meta/tasks.*", "meta/episodes*", "data"):
        for path in folder.glob(name):
            if path.name == "episodes_stats.jsonl":
                continue
            path.rename(folder.with_name("aside"))
            with pytest.raises(FileNotFoundError, match=path.name):
                load(folder)
            folder.with_name("aside").rename(path)
    frames_of(folder).unlink()
    with pytest.raises(UnreadableFileError, match=r"lacks the episodes \[(0, )?1\]"):
        load(folder)


def test_an_episode_cut_short_is_refused(folder):
    file = frames_of(folder)
    table = pq.read_table(file)
    pq.write_table(table.slice(0, len(table) - 1), file)
    with pytest.raises(UnreadableFileError, match=r"episode 1 of .* has 3 frames, but"):
        load(folder)


def test_an_episode_of_one_frame_is_refused(tmp_path):
    folder = Path(shutil.copytree(HERE / "v2.1", tmp_path / "push"))
    pq.write_table(pq.read_table(frames_of(folder)).slice(0, 1), frames_of(folder))
    meta = folder / "meta/episodes.jsonl"
    meta.write_text(meta.read_text().replace('"length": 4', '"length": 1'))
    with pytest.raises(ValueError, match=r"episode 1 of .*parquet has one frame only"):
        load(folder)
    assert os.listdir(tmp_path) == ["push"]


def edit_info(folder, **changes):
    file = folder / "meta/info.json"
    info = json.loads(file.read_text())
    info.update(changes)
    file.write_text(json.dumps(info))


def test_other_versions_are_refused(folder):
    edit_info(folder, codebase_version="v1.6")
    with pytest.raises(ValueError, match=r"'v1.6', expected v2.x or v3.x"):
        load(folder)


def test_cameras_are_left_out_and_said(folder, caplog):
    info = json.loads((folder / "meta/info.json").read_text())
    camera = {"dtype": "video", "shape": [3, 8, 8], "names": None}
    info["features"]["observation.images.top"] = camera
    edit_info(folder, features=info["features"])
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        load(folder)
    assert "the features ['observation.images.top'] are left out" in caplog.text
    info["features"]["action"] = {"dtype": "float32"}
    edit_info(folder, features=info["features"])
    with pytest.raises(UnreadableFileError, match=r"info.json has unreadable features"):
        load(folder, overwrite=True)


def test_other_roles_of_the_same_features_are_other_data(folder, tmp_path):
    path = tmp_path / "roles"
    first = load_lerobot(folder, path, progress=False)
    assert ("info", "action") not in first.keys(True, True)
    with pytest.raises(FileExistsError):
        load_lerobot(folder, path, infos=["action"], progress=False)
