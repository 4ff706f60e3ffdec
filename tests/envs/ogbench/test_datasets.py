from __future__ import annotations

import functools
import sys

import numpy as np
import pytest
import torch
from ogbench.utils import load_dataset

from tests.envs.ogbench.names import NAMES, STEPS
from torchrl_caiac.data import load_ogbench, mix_trajectories
from torchrl_caiac.envs import random_transitions
from torchrl_caiac.envs.ogbench import (
    OGBenchSimulator,
    create_ogbench_play,
    make_ogbench_env,
    ogbench_states,
)

TYPES = {
    "observations": np.float32,
    "actions": np.float32,
    "terminals": np.bool_,
    "qpos": np.float32,
    "qvel": np.float32,
    "button_states": np.int64,
}


@pytest.mark.parametrize("name", NAMES)
def test_the_arrays_are_those_of_ogbench(name, arrays):
    own = arrays[name]
    expected = set(TYPES) - ({"button_states"} if name == "cube-double" else set())
    assert set(own) == expected
    assert {key: value.dtype for key, value in own.items()} == {
        key: np.dtype(TYPES[key]) for key in expected
    }
    assert {len(value) for value in own.values()} == {2 * (STEPS + 1)}
    assert np.flatnonzero(own["terminals"]).tolist() == [STEPS, 2 * STEPS + 1]
    assert np.abs(own["actions"]).max() <= 1
    # The two episodes start in different states.
    assert np.abs(own["qpos"][0] - own["qpos"][STEPS + 1]).max() > 0.01


def test_ogbench_reads_the_file(files, arrays):
    read = load_dataset(str(files["scene"]), add_info=True)
    own = arrays["scene"]
    assert len(read["observations"]) == 2 * STEPS
    first = slice(1, STEPS + 1)
    assert np.array_equal(read["next_observations"][:STEPS], own["observations"][first])
    assert read["terminals"].sum() == 2
    assert np.array_equal(read["button_states"][:STEPS], own["button_states"][:STEPS])


def test_rows_are_a_continuous_run_of_the_environment(arrays):
    # The simulator's joint angles and the cubes are columns of the observation.
    own = arrays["cube-double"]
    assert np.allclose(own["observations"][:, :6], own["qpos"][:, :6])
    assert np.allclose(own["observations"][:, 6:12], own["qvel"][:, :6])
    cubes = (own["observations"][:, 19:22] / 10) + [0.425, 0, 0]
    assert np.allclose(cubes, own["qpos"][:, 14:17], atol=1e-6)


def test_a_cube_is_moved(arrays):
    own = arrays["cube-double"]["qpos"][: STEPS + 1]
    moved = np.abs(own[:, [14, 15, 16, 21, 22, 23]] - own[0, [14, 15, 16, 21, 22, 23]])
    assert moved.max() > 0.02


def test_equal_seeds_give_equal_files_and_other_global_seeds_do_not_matter(
    files, tmp_path
):
    np.random.seed(1)
    before = np.random.get_state()[1].copy()
    again = create_ogbench_play(
        tmp_path / "again.npz",
        episodes=2,
        steps=STEPS,
        seed=3,
        num_workers=1,
        progress=False,
    )
    assert np.array_equal(np.random.get_state()[1], before)
    with np.load(files["cube-double"]) as one, np.load(again) as other:
        for key in one.files:
            assert np.array_equal(one[key], other[key])


def test_an_interrupted_collection_resumes(tmp_path, monkeypatch):
    options = {"episodes": 2, "steps": 3, "num_workers": 1, "progress": False}
    whole = create_ogbench_play(tmp_path / "whole.npz", **options)
    work, path = tmp_path / "work", tmp_path / "play.npz"

    def full(*args, **kwargs):
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", full)
        with pytest.raises(OSError, match="disk full"):
            create_ogbench_play(path, work=work, **options)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["whole.npz", "work"]
    create_ogbench_play(path, work=work, **options)
    with np.load(whole) as one, np.load(path) as other:
        assert np.array_equal(one["observations"], other["observations"])


def test_noisy_episodes_have_independent_noise(tmp_path):
    options = {
        "name": "cube-single",
        "episodes": 1,
        "steps": 30,
        "noisy": True,
        "random_actions": 0.0,
        "num_workers": 1,
        "progress": False,
    }
    quiet, loud = (
        np.load(create_ogbench_play(tmp_path / f"{n}.npz", action_noise=n, **options))
        for n in (0.0, 1.0)
    )
    assert np.array_equal(quiet["qpos"][0], loud["qpos"][0])
    # Without noise, the oracle opens the gripper all the way to the cube.
    assert (quiet["actions"][:5, 4] == -1).all()
    assert (loud["actions"][:, 4] > 0).any()


def test_a_share_of_noisy_actions_is_random(tmp_path):
    def actions(name, **options):
        file = create_ogbench_play(
            tmp_path / f"{len(list(tmp_path.iterdir()))}.npz",
            name,
            episodes=1,
            steps=400,
            noisy=True,
            action_noise=0.0,
            num_workers=1,
            progress=False,
            **options,
        )
        return np.load(file)["actions"]

    def random(rows):
        # The oracle opens or closes the gripper all the way.
        return np.abs(rows[:, 4]) < 1

    shares = [random(actions("cube-single")).mean()]
    shares.append(random(actions("puzzle-3x3")).mean())
    assert 0.05 < shares[0] < 0.15 < shares[1] < 0.28
    drawn = actions("cube-single", random_actions=1.0)
    assert random(drawn).all()
    assert (np.abs(drawn.mean(0)) < 0.12).all()
    assert np.allclose(drawn.std(0), 3**-0.5, atol=0.08)


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"name": "cube-double-play-v0"}, "expected one of.*cube-double"),
        ({"path": "data.hdf5"}, r"ends in \.npz"),
        ({"episodes": 0}, "episodes is 0"),
        ({"steps": 0}, "steps is 0"),
        ({"noisy": True, "action_noise": float("nan")}, "action_noise"),
        ({"noisy": True, "random_actions": float("nan")}, "random_actions"),
        ({"noisy": True, "random_actions": 1.5}, "random_actions"),
        ({"random_actions": 0.1}, "noisy is False"),
    ],
)
def test_bad_input(wrong, match, tmp_path):
    arguments = {"path": "data.npz", **wrong}
    path = tmp_path / arguments.pop("path")
    with pytest.raises(ValueError, match=match):
        create_ogbench_play(path, **arguments)
    assert not list(tmp_path.iterdir())


def test_a_file_is_not_replaced_unasked(tmp_path):
    path = tmp_path / "data.npz"
    path.write_bytes(b"mine")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        create_ogbench_play(path)
    assert path.read_bytes() == b"mine"


def test_environments_collect_and_do_not_end_at_a_goal():
    env = make_ogbench_env("cube-single", max_episode_steps=7)
    _, info = env.reset(seed=0)
    assert "privileged/target_task" in info
    ends = [env.step(np.zeros(5))[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]
    env.close()


def test_random_rows_mix_with_the_loaded_data(files, tmp_path):
    data = load_ogbench(files["scene"], tmp_path / "data", progress=False)
    states = ogbench_states(data)
    random = random_transitions(
        functools.partial(OGBenchSimulator, "scene"),
        states[::30],
        2,
        observations=data["observation"][::30],
        num_workers=1,
        progress=False,
    )
    mixed = mix_trajectories([data, random])
    assert len(mixed) == len(data) + len(random)
    assert torch.equal(random["observation"][::2], data["observation"][::30])
    assert torch.equal(ogbench_states(random)[::2], states[::30])


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ogbench.manipspace", None)
    with pytest.raises(ImportError, match=r"torchrl-caiac\[ogbench\]"):
        make_ogbench_env("scene")
