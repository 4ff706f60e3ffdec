"""robomimic and LIBERO files, laid out as their own scripts write them."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import h5py
import numpy as np
import pytest

from torchrl_caiac.data import UnreadableFileError, action_bounds, load_robomimic
from torchrl_caiac.data.digests import data_source

LENGTHS = {"demo_0": 5, "demo_2": 4, "demo_10": 3}


def demo(name: str, length: int) -> dict[str, np.ndarray]:
    """The entries of a demonstration, ``[length, ...]``; states have one more."""
    random = np.random.default_rng(int(name.removeprefix("demo_")))
    return {
        "actions": random.uniform(-1, 1, (length, 7)),
        "rewards": (np.arange(length) == length - 1).astype(float),
        "dones": (np.arange(length) >= length - 2).astype(np.int64),
        "states": random.normal(size=(length, 6)),
        "object": random.normal(size=(length + 1, 4)),
        "robot0_eef_pos": random.normal(size=(length + 1, 3)),
        "robot0_gripper": random.normal(size=length + 1),
        "agentview_image": random.integers(
            0, 255, (length + 1, 8, 8, 3), dtype=np.uint8
        ),
    }


OBS = ("object", "robot0_eef_pos", "robot0_gripper", "agentview_image")


def write(path, *, next_obs=True, compression=None, edit=None):
    """Writes a file in the order and the types of ``dataset_states_to_obs.py``."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        for name in ("demo_10", "demo_0", "demo_2"):
            parts, group = demo(name, LENGTHS[name]), data.create_group(name)
            for key in ("actions", "states", "rewards", "dones"):
                group.create_dataset(key, data=parts[key])
            for key in OBS:
                group.create_dataset(
                    f"obs/{key}", data=parts[key][:-1], compression=compression
                )
                if next_obs:
                    group.create_dataset(
                        f"next_obs/{key}", data=parts[key][1:], compression=compression
                    )
            group.attrs["num_samples"] = LENGTHS[name]
        file.create_dataset("mask/train", data=np.array([b"demo_10", b"demo_0"]))
        file.create_dataset("mask/valid", data=np.array([b"demo_2"]))
        data.attrs["total"] = sum(LENGTHS.values())
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1})
        if edit is not None:
            edit(file)
    return path


@pytest.fixture
def file(tmp_path):
    return write(tmp_path / "low_dim.hdf5")


def load(file, **options):
    return load_robomimic(file, file.with_name("rows"), progress=False, **options)


def stacked(key, rows=slice(None), names=LENGTHS):
    return np.concatenate([demo(name, LENGTHS[name])[key][rows] for name in names])


def test_entries_become_leaves_in_the_order_of_the_numbers(file):
    data = load(file)
    assert data["episode"].tolist() == [0] * 5 + [1] * 4 + [2] * 3
    assert set(data["observation"].keys()) == set(OBS) - {"agentview_image"}
    for key in ("object", "robot0_eef_pos"):
        for rows, leaf in ((slice(0, -1), data), (slice(1, None), data["next"])):
            expected = stacked(key, rows).astype(np.float32)
            assert np.array_equal(leaf["observation", key], expected)
    assert data["observation", "robot0_gripper"].shape == (12, 1)
    assert np.array_equal(data["action"], stacked("actions").astype(np.float32))
    assert np.array_equal(data["next", "reward"][:, 0], stacked("rewards"))


def test_the_last_rows_are_truncated_and_no_others(file):
    data = load(file)
    last = [row in (4, 8, 11) for row in range(12)]
    assert data["next", "truncated"].squeeze(1).tolist() == last
    assert data["next", "done"].squeeze(1).tolist() == last
    assert not data["next", "terminated"].any()


@pytest.mark.parametrize("compression", [None, "gzip"])
def test_without_next_observations_the_last_action_is_left_out(
    tmp_path, caplog, compression
):
    file = write(tmp_path / "a.hdf5", next_obs=False, compression=compression)
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        data = load(file, infos=["states", "dones"])
    assert "the last row of each demonstration is left out" in caplog.text
    assert len(data) == 9
    for rows, leaf in ((slice(0, -2), data), (slice(1, -1), data["next"])):
        expected = stacked("object", rows).astype(np.float32)
        assert np.array_equal(leaf["observation", "object"], expected)
    assert np.array_equal(data["action"], stacked("actions", slice(0, -1)).astype("f"))
    # Infos keep their types.
    assert np.array_equal(data["info", "states"], stacked("states", slice(0, -1)))
    assert np.array_equal(data["info", "dones"], stacked("dones", slice(0, -1)))


def test_keys_join_entries_to_a_flat_observation(file, caplog):
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        data = load(file, keys=["robot0_gripper", "object"])
    parts = [stacked("robot0_gripper", slice(0, -1))[:, None]]
    parts.append(stacked("object", slice(0, -1)))
    assert np.array_equal(data["observation"], np.concatenate(parts, 1).astype("f"))
    columns = data_source(file.with_name("rows"))["columns"]
    assert columns == {"robot0_gripper": [0, 1], "object": [1, 5]}
    assert "robot0_gripper 0 to 0, object 1 to 4" in caplog.text


def test_images_are_kept_by_name_and_said_to_be_left_out(file, caplog):
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        load(file)
    assert "the images ['agentview_image'] of demo_0" in caplog.text
    data = load(file, images=["agentview_image"], exclude=["object"], overwrite=True)
    images = data["observation", "agentview_image"].numpy()
    assert np.array_equal(images, stacked("agentview_image", slice(0, -1)))
    assert "object" not in set(data["observation"].keys())


def test_masks_select_demonstrations(file):
    data = load(file, mask="train")
    names = ["demo_0", "demo_10"]
    assert np.array_equal(data["action"], stacked("actions", names=names).astype("f"))
    with pytest.raises(KeyError, match=r"no mask/test, .*\['train', 'valid'\]"):
        load(file, mask="test", overwrite=True)


def test_the_environment_is_a_remark(file):
    load(file)
    assert data_source(file.with_name("rows"))["env_name"] == "Lift"


CONTROLLER = {"type": "OSC_POSE", "input_max": 1, "input_min": -1, "kp": 150}


@pytest.mark.parametrize(
    "settings",
    [
        {"controller_configs": CONTROLLER},  # of robosuite 1.4
        {"controller_configs": {"type": "BASIC", "body_parts": {"right": CONTROLLER}}},
        {"controller_configs": {"input_max": [1.0] * 6, "input_min": [-1.0] * 6}},
    ],
)
def test_bounds_of_actions_are_those_of_the_controllers(tmp_path, settings):
    def edit(file):
        args = {"env_name": "Lift", "type": 1, "env_kwargs": settings}
        file["data"].attrs["env_args"] = json.dumps(args)

    load(write(tmp_path / "a.hdf5", edit=edit))
    low, high = action_bounds(tmp_path / "rows")
    assert low.tolist() == [-1] * 7 and high.tolist() == [1] * 7


@pytest.mark.parametrize("change", [None, "limits", "actions", "text"])
def test_bounds_that_are_not_sure_are_unknown(tmp_path, change, caplog):
    def edit(file):
        controllers = {"left": CONTROLLER, "right": CONTROLLER}
        if change == "limits":
            controllers["left"] = {"input_max": 0.5, "input_min": -0.5}
        if change == "actions":
            file["data/demo_2/actions"][1, 3] = 1.5
        args = json.dumps({"env_kwargs": {"controller_configs": controllers}})
        if change is not None:
            text = args[:10] if change == "text" else args
            file["data"].attrs["env_args"] = text

    load(write(tmp_path / "a.hdf5", edit=edit))
    assert action_bounds(tmp_path / "rows") is None
    said = "but the actions of demo_2 are outside" in caplog.text
    assert said == (change == "actions")


def test_a_last_observation_without_action_is_used(tmp_path, caplog):
    def edit(file):
        for name, length in LENGTHS.items():
            group, parts = file["data"][name], demo(name, length)
            del group["next_obs"]
            for key in OBS:
                del group[f"obs/{key}"]
                group[f"obs/{key}"] = parts[key]

    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        data = load(write(tmp_path / "a.hdf5", edit=edit))
    assert "of each demonstration is left out" not in caplog.text
    expected = stacked("object", slice(1, None)).astype("f")
    assert np.array_equal(data["next", "observation", "object"], expected)


def libero(file):
    """As LIBERO writes: observations after the actions, no next ones, uint8 rewards."""
    for name, length in LENGTHS.items():
        group, parts = file["data"][name], demo(name, length)
        del group["next_obs"]
        for key in OBS:
            del group[f"obs/{key}"]
            group[f"obs/{key}"] = parts[key][1:]
        del group["rewards"]
        group["rewards"] = parts["rewards"].astype(np.uint8)
    file["data"].attrs["bddl_file_name"] = "pick.bddl"


def test_observations_of_libero_are_those_after_the_actions(tmp_path, caplog):
    file = write(tmp_path / "a.hdf5", edit=libero)
    with caplog.at_level(logging.INFO, "torchrl_caiac"):
        data = load(file, infos=["states"])
    assert "the first row of each demonstration is left out" in caplog.text
    for rows, leaf in ((slice(1, -1), data), (slice(2, None), data["next"])):
        expected = stacked("object", rows).astype(np.float32)
        assert np.array_equal(leaf["observation", "object"], expected)
    assert np.array_equal(
        data["action"], stacked("actions", slice(1, None)).astype("f")
    )
    assert np.array_equal(data["info", "states"], stacked("states", slice(1, None)))
    assert np.array_equal(
        data["next", "reward"][:, 0], stacked("rewards", slice(1, None))
    )
    assert data["next", "reward"].is_floating_point()
    # Rewritten files may have the attribute and the usual order.
    usual = load(file, observed="before", overwrite=True)
    expected = stacked("actions", slice(0, -1)).astype("f")
    assert np.array_equal(usual["action"], expected)


def test_observations_after_the_actions_contradict_next_observations(file):
    with pytest.raises(ValueError, match=r"demo_0 of .* has next_obs"):
        load(file, observed="after")


def without(*keys):
    def edit(file):
        for key in keys:
            del file["data/demo_2"][key]

    return edit


def replaced(key, value):
    def edit(file):
        del file[key]
        file[key] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "options", "error", "message"),
    [
        (without("actions"), {}, KeyError, r"demo_2 of .*low.hdf5 has no 'actions', "),
        (without("obs"), {}, KeyError, r"demo_2 .*has no obs/\*, it has \['actions', "),
        (without("obs/object"), {"keys": ["object"]}, KeyError, "no .'object'., it"),
        (without("obs/object"), {}, ValueError, "demo_2 of .*only one of .*'object'"),
        (None, {"keys": ["cup"]}, KeyError, r"no \['cup'\], it has \['agentview_im"),
        (None, {"images": ["cup"]}, KeyError, "correct images="),
        (None, {"exclude": ["cup"]}, KeyError, "correct exclude="),
        (None, {"infos": ["cup"]}, KeyError, "no 'cup', .*correct the file or infos="),
        (None, {"keys": ["agentview_image"]}, ValueError, "keys="),
        (None, {"keys": []}, ValueError, "at least one"),
        (None, {"keys": ["object", "object"]}, ValueError, "an entry twice"),
        (None, {"keys": ["object"], "exclude": ["object"]}, ValueError, "do not apply"),
        (None, {"observed": "then"}, ValueError, "'then', expected 'before'"),
        (
            lambda file: file.move("data", "rollouts"),
            {},
            KeyError,
            r"no data/demo_\*, it has \['mask', 'rollouts'\]",
        ),
        (
            replaced("data/demo_2/obs/object", np.zeros((4, 5))),
            {},
            ValueError,
            r"'object'. in demo_2 of .*low.hdf5 has shape .4, 5. .* and .4, 4.",
        ),
        (
            replaced("data/demo_2/actions", np.zeros((4, 6))),
            {},
            ValueError,
            "demo_2 of .*demo_0 of .*'action'",
        ),
        (
            replaced("data/demo_2/rewards", np.full(4, np.nan)),
            {},
            ValueError,
            "'reward'.* of .*demo_2.*NaN|demo_2.*NaN|'reward'.*demo_2",
        ),
        (
            replaced("mask/train", np.array([b"demo_7"])),
            {"mask": "train"},
            KeyError,
            "7",
        ),
    ],
)
def test_errors_name_file_and_key_and_leave_nothing(
    tmp_path, edit, options, error, message
):
    file = write(tmp_path / "low.hdf5", edit=edit)
    with pytest.raises(error, match=message):
        load(file, **options)
    assert os.listdir(tmp_path) == ["low.hdf5"]


def one_row(file):
    group = file["data/demo_2"]
    del group["next_obs"]
    for key in ("actions", "states", "rewards", "dones", *(f"obs/{k}" for k in OBS)):
        value = group[key][:1]
        del group[key]
        group[key] = value


def test_a_demonstration_of_one_row_is_refused(tmp_path):
    file = write(tmp_path / "a.hdf5", edit=one_row)
    with pytest.raises(ValueError, match=r"demo_2 of .*a.hdf5 has one row only"):
        load(file)
    assert os.listdir(tmp_path) == ["a.hdf5"]


def test_a_file_cut_short_is_refused(file):
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(UnreadableFileError, match=r"low_dim.hdf5 is not a readable"):
        load(file)
    file.write_bytes(b"")
    with pytest.raises(UnreadableFileError, match=r"low_dim.hdf5"):
        load(file)
    with pytest.raises(FileNotFoundError, match=r"no file .*other.hdf5"):
        load(file.with_name("other.hdf5"))
    assert os.listdir(file.parent) == [file.name]


def test_parts_that_were_never_written_are_refused(tmp_path):
    def edit(file):
        del file["data/demo_2/actions"]
        file["data/demo_2"].create_dataset("actions", (4, 7), "f8", chunks=(1, 7))

    with pytest.raises(UnreadableFileError, match=r"actions .*were not written"):
        load(write(tmp_path / "a.hdf5", edit=edit))


def test_links_to_other_files_are_refused(tmp_path):
    write(tmp_path / "other.hdf5")

    def edit(file):
        del file["data/demo_2/actions"]
        file["data/demo_2/actions"] = h5py.ExternalLink(
            str(tmp_path / "other.hdf5"), "data/demo_2/actions"
        )

    with pytest.raises(UnreadableFileError, match=r"demo_2.*link"):
        load(write(tmp_path / "a.hdf5", edit=edit))


@contextmanager
def robosuite_on_this_mujoco() -> Iterator[None]:
    """robosuite 1.5.1 computes inertias of its controllers as older MuJoCo did."""
    import mujoco
    from robosuite.utils import binding_utils

    with pytest.MonkeyPatch.context() as patch:
        inertia = lambda model, out, matrix: np.copyto(out, np.eye(len(out)))  # noqa: E731
        patch.setattr(mujoco, "mj_fullM", inertia)
        patch.setattr(binding_utils.MjData, "qM", None, raising=False)
        yield


@pytest.fixture(scope="module")
def lift(tmp_path_factory):
    """A file with two rollouts of robosuite's Lift, and the observations in them."""
    import robosuite

    def seen(observation):
        kept = {"object": observation["object-state"]}
        kept |= {k: v for k, v in observation.items() if k.startswith("robot0_")}
        return {k: np.array(v) for k, v in kept.items() if "proprio" not in k}

    file, random = (
        tmp_path_factory.mktemp("lift") / "lift.hdf5",
        np.random.default_rng(0),
    )
    rollouts = []
    with robosuite_on_this_mujoco(), h5py.File(file, "w") as stored:
        env = robosuite.make(
            "Lift",
            robots="Panda",
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
        )
        for number, length in enumerate((4, 3)):
            states, actions, simulator = [seen(env.reset())], [], []
            for _ in range(length):
                actions.append(random.uniform(-1, 1, env.action_dim))
                simulator.append(env.sim.get_state().flatten())
                states.append(seen(env.step(actions[-1])[0]))
            group = stored.create_group(f"data/demo_{number}")
            group["actions"], group["states"] = np.stack(actions), np.stack(simulator)
            for key in states[0]:
                group[f"obs/{key}"] = np.stack([state[key] for state in states[:-1]])
                group[f"next_obs/{key}"] = np.stack([s[key] for s in states[1:]])
            rollouts.append(states)
        env.close()
    return file, rollouts


def test_rollouts_of_robosuite_are_read(lift, tmp_path):
    file, rollouts = lift
    keys = ["object", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]
    data = load_robomimic(file, tmp_path / "a", progress=False, infos=["states"])
    flat = load_robomimic(file, tmp_path / "b", progress=False, keys=keys)
    assert flat["observation"].shape == (7, 10 + 3 + 4 + 2)
    row = 0
    for states in rollouts:
        for now, after in pairwise(states):
            for key, value in now.items():
                leaf = data["observation", key][row].numpy()
                assert np.array_equal(leaf, np.atleast_1d(value).astype("f"))
            joined = np.concatenate([after[key] for key in keys]).astype("f")
            assert np.array_equal(flat["next", "observation"][row], joined)
            row += 1
