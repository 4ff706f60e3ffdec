"""Minari datasets are checked before Minari allocates, or runs anything."""

from __future__ import annotations

import json
import os
import shutil
import tracemalloc

import h5py
import minari
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict
from hypothesis import given, settings
from hypothesis import strategies as st
from minari.data_collector import EpisodeBuffer

from tests.mutations import mutate_file
from torchrl_caiac.data import UnreadableFileError, load_minari
from torchrl_caiac.data.minari_checks import check_hdf5_array
from torchrl_caiac.data.minari_files import open_minari

ID = "caiac/test-v0"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of all datasets, with one of three episodes."""
    root = tmp_path_factory.mktemp("minari")
    episodes = [
        EpisodeBuffer(
            observations={"arm": np.ones((n + 1, 2)), "cup": np.ones((n + 1, 1))},
            actions=np.ones((n, 2)),
            rewards=np.ones(n),
            terminations=np.zeros(n, bool),
            truncations=np.zeros(n, bool),
            infos={"clock": np.arange(n + 1.0)},
        )
        for n in (3, 1, 4)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        minari.create_dataset_from_buffers(
            ID,
            buffer=episodes,
            observation_space=Dict({"arm": Box(0, 1, (2,)), "cup": Box(0, 1, (1,))}),
            action_space=Box(-1, 1, (2,)),
        )
    return root


@pytest.fixture
def root(whole, tmp_path, monkeypatch):
    """A copy of it."""
    folder = tmp_path / "minari"
    shutil.copytree(whole, folder)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    return folder


def data(root):
    return root / ID / "data"


def change_metadata(root, change):
    file = data(root) / "metadata.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def big_space(content):
    space = json.loads(content["action_space"])
    space |= {"shape": [1 << 30], "low": 0.0, "high": 1.0}
    content["action_space"] = json.dumps(space)


def deep_space(content):
    space = json.loads(content["observation_space"])
    space["subspaces"]["cup"]["shape"] = [1 << 30]
    content["observation_space"] = json.dumps(space)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (big_space, "'low' of action_space has 1 numbers, but shape"),
        (deep_space, r"'low' of observation_space\['cup'\] has 1 numbers"),
        (lambda c: c.update(total_episodes=1 << 34), "17179869184 episodes, .* has 3"),
        (lambda c: c.update(total_episodes="3"), "'total_episodes' is '3'"),
        (lambda c: c.update(action_space=3), "run the dataset's environment"),
        (lambda c: c.update(minari_version="99.0"), "does not support"),
        (lambda c: c.clear(), "'observation_space' is None"),
    ],
)
def test_metadata_that_would_allocate_or_run(change, match, root):
    change_metadata(root, change)
    tracemalloc.start()
    try:
        with pytest.raises(UnreadableFileError, match=match) as error:
            open_minari(ID)
        assert tracemalloc.get_traced_memory()[1] < 32 << 20
    finally:
        tracemalloc.stop()
    assert str(data(root)) in str(error.value)


def test_the_environment_of_a_dataset_is_not_run(root, tmp_path):
    """Its entry point is a text in the metadata, and could be any function."""
    marker = tmp_path / "marker"
    spec = {
        "id": "Evil-v0",
        "entry_point": "os:mkdir",
        "kwargs": {"path": str(marker)},
        "additional_wrappers": [],
    }

    def plant(content):
        content["env_spec"] = json.dumps(spec)
        del content["action_space"]

    change_metadata(root, plant)
    with pytest.raises(UnreadableFileError, match="run the dataset's environment"):
        load_minari(ID, tmp_path / "rows", progress=False)
    assert not marker.exists()
    # Minari itself runs it, and then misses an environment.
    with pytest.raises(TypeError, match=r"must inherit from the gymnasium\.Env"):
        minari.MinariDataset(data(root))
    assert marker.is_dir()


def replace_array(group, name, **options):
    del group[name]
    return group.create_dataset(name, **options)


def unwritten(episode):
    replace_array(episode, "actions", shape=(3, 2), dtype="f8", chunks=(1, 2))[:2] = 1


def sparse(episode):
    shape = (3, 1 << 40)
    replace_array(episode, "actions", shape=shape, dtype="f8", chunks=(1, 1024))


def bomb(episode):
    options = {"chunks": (1 << 20,), "compression": "gzip", "maxshape": (None,)}
    array = replace_array(
        episode["infos"], "clock", shape=(4 << 20,), dtype="f8", **options
    )
    array.id.set_extent((1 << 40,))


def linked(episode):
    del episode["rewards"]
    episode["rewards"] = h5py.ExternalLink("elsewhere.hdf5", "/rewards")


def elsewhere(episode):
    place = [(os.path.abspath("elsewhere.bin"), 0, 24)]
    replace_array(episode, "rewards", shape=(3,), dtype="f8", external=place)


def more_steps(episode):
    episode.attrs["total_steps"] = 1 << 40


def text_steps(episode):
    episode.attrs["total_steps"] = "3"


def no_rewards(episode):
    del episode["rewards"]


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (unwritten, "episode_0/actions .*parts of it were not written"),
        (sparse, "episode_0/actions .*parts of it were not written"),
        (bomb, "episode_0/infos/clock .*parts of it were not written"),
        (linked, "episode_0/rewards is a link"),
        (elsewhere, "episode_0/rewards .*stored in another file"),
        (more_steps, "has 3 rewards, but 'total_steps'"),
        (text_steps, "has 3 rewards, but 'total_steps' is '3'"),
        (no_rewards, "main_data.hdf5 is not a readable"),
    ],
)
def test_arrays_that_are_not_whole(spoil, match, root, tmp_path):
    with h5py.File(data(root) / "main_data.hdf5", "r+") as stored:
        spoil(stored["episode_0"])
    with pytest.raises(UnreadableFileError, match=match):
        load_minari(ID, tmp_path / "rows", progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["minari"]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunks": (3, 2), "maxshape": (None, 5)},
        {"chunks": True, "maxshape": (None, 5)},
        {"compression": "gzip"},
        {"compression": "lzf", "shuffle": True, "maxshape": (None, 5)},
    ],
)
@pytest.mark.parametrize("shape", [(7, 5), (0, 5), (4000, 5)])
def test_whole_arrays_pass(options, shape, tmp_path):
    file = tmp_path / "a.hdf5"
    with h5py.File(file, "w") as stored:
        stored.create_dataset("a", data=np.zeros(shape), **options)
        stored["scalar"] = 3.0
        stored["texts"] = ["a", "bc"]
        for name in stored:
            check_hdf5_array(stored[name], file)


@settings(max_examples=100)
@given(st.randoms(use_true_random=False))
def test_damaged_metadata_are_read_or_refused_by_name(whole, tmp_path_factory, rng):
    folder = tmp_path_factory.mktemp("damaged")
    shutil.copytree(whole, folder / "minari")
    mutate_file(data(folder / "minari") / "metadata.json", rng)
    try:
        dataset = open_minari(ID, folder / "minari")
        load_minari(dataset, folder / "rows", progress=False)
    except (UnreadableFileError, FileNotFoundError) as error:
        assert str(folder) in str(error)
    except ValueError as error:  # an empty dataset
        assert "has no steps" in str(error)
