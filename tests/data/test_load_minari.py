from __future__ import annotations

from functools import partial

import gymnasium
import h5py
import minari
import numpy as np
import pytest
import torch
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from torchrl.data import SliceSampler

from tests.killing import run_killed
from torchrl_caiac import EntityLayout
from torchrl_caiac._files import whole_folder
from torchrl_caiac.data import (
    action_bounds,
    load_minari,
    load_transitions,
    offline_buffer,
)
from torchrl_caiac.influence import score_buffer

LENGTHS = (4, 1, 6)


def box(*shape: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape, np.float64)


def arrays(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape)


def flat(rng: np.random.Generator, length: int) -> np.ndarray:
    return arrays(rng, length + 1, 3)


def goal_env(rng: np.random.Generator, length: int) -> dict:
    return {
        "observation": arrays(rng, length + 1, 5),
        "achieved_goal": {"kettle": arrays(rng, length + 1, 2)},
        "desired_goal": {"kettle": arrays(rng, length + 1, 2)},
    }


def foreign_goals(rng: np.random.Generator, length: int) -> dict:
    """A goal environment without achieved goals, with entries of its own."""
    return {
        "observation": arrays(rng, length + 1, 5),
        "desired_goal": arrays(rng, length + 1, 2),
        "camera": rng.integers(0, 256, (length + 1, 4, 4, 1), dtype=np.uint8),
        "phase": rng.integers(0, 3, length + 1),
    }


def parts(rng: np.random.Generator, length: int) -> dict:
    return {"arm": arrays(rng, length + 1, 2), "cup": arrays(rng, length + 1, 1)}


def taken(rng: np.random.Generator, length: int) -> dict:
    return {
        "observation": arrays(rng, length + 1, 2),
        "episode": arrays(rng, length + 1, 1),
    }


def reward(rng: np.random.Generator, length: int) -> dict:
    return {
        "observation": arrays(rng, length + 1, 2),
        "reward": arrays(rng, length + 1, 1),
    }


SPACES = {
    reward: spaces.Dict({"observation": box(2), "reward": box(1)}),
    foreign_goals: spaces.Dict(
        {
            "observation": box(5),
            "desired_goal": box(2),
            "camera": spaces.Box(0, 255, (4, 4, 1), np.uint8),
            "phase": spaces.Discrete(3),
        }
    ),
    taken: spaces.Dict({"observation": box(2), "episode": box(1)}),
    flat: box(3),
    goal_env: spaces.Dict(
        {
            "observation": box(5),
            "achieved_goal": spaces.Dict({"kettle": box(2)}),
            "desired_goal": spaces.Dict({"kettle": box(2)}),
        }
    ),
    parts: spaces.Dict({"arm": box(2), "cup": box(1)}),
}


@pytest.fixture(autouse=True)
def _root(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def make_dataset(
    observe, lengths=LENGTHS, spoil=None, name="caiac/test-v0", actions=None
):
    rng = np.random.default_rng(0)
    buffers = []
    for number, length in enumerate(lengths):
        ends = np.zeros(length, bool)
        ends[-1] = number == 0
        buffer = EpisodeBuffer(
            observations=observe(rng, length),
            actions=rng.uniform(-1, 1, (length, 2)),
            rewards=arrays(rng, length),
            terminations=ends,
            truncations=np.zeros(length, bool),
            infos={"clock": np.arange(length + 1.0)},
        )
        if spoil is not None:
            spoil(number, buffer)
        buffers.append(buffer)
    return minari.create_dataset_from_buffers(
        name,
        buffer=buffers,
        observation_space=SPACES[observe],
        action_space=actions or spaces.Box(-1, 1, (2,), np.float64),
    ), buffers


def test_flat_rows_agree_with_a_loop(tmp_path):
    dataset, buffers = make_dataset(flat)
    rows = load_minari(dataset, tmp_path / "rows", infos=["clock"], progress=False)
    assert rows.is_memmap()
    assert rows.batch_size == (sum(LENGTHS),)
    row = 0
    for number, (buffer, length) in enumerate(zip(buffers, LENGTHS, strict=True)):
        for step in range(length):
            td = rows[row]
            for key, value in (
                ("observation", buffer.observations[step]),
                (("next", "observation"), buffer.observations[step + 1]),
                ("action", buffer.actions[step]),
                (("next", "reward"), buffer.rewards[step : step + 1]),
            ):
                torch.testing.assert_close(td[key], torch.tensor(value).float())
            last = step == length - 1
            assert td["episode"] == number
            assert td["next", "done"].item() is last
            assert td["next", "terminated"].item() is (last and number == 0)
            assert td["next", "truncated"].item() is (last and number != 0)
            assert td["info", "clock"] == step
            row += 1
    assert rows["next", "done"].shape == (sum(LENGTHS), 1)


def test_by_id_and_opened_again(tmp_path):
    make_dataset(flat)
    rows = load_minari("caiac/test-v0", tmp_path / "rows", progress=False)
    assert (load_transitions(tmp_path / "rows") == rows).all()


def test_goal_environment(tmp_path):
    dataset, buffers = make_dataset(goal_env)
    rows = load_minari(dataset, tmp_path / "rows", columns=[4, 0], progress=False)
    assert rows["observation"].shape == (11, 2)
    expected = buffers[0].observations["observation"]
    torch.testing.assert_close(
        rows["next", "observation"][3], torch.tensor(expected[4, [4, 0]]).float()
    )
    assert rows["achieved_goal", "kettle"].dtype == torch.float32
    assert rows["next", "achieved_goal", "kettle"].shape == (11, 2)


def test_a_goal_environment_without_achieved_goals(tmp_path):
    dataset, buffers = make_dataset(foreign_goals)
    rows = load_minari(dataset, tmp_path / "rows", progress=False)
    assert "achieved_goal" not in rows
    assert rows["desired_goal"].shape == rows["next", "desired_goal"].shape == (11, 2)
    assert rows["camera"].dtype == torch.uint8
    assert rows["next", "camera"].shape == (11, 4, 4, 1)
    states = [buffer.observations for buffer in buffers]
    for key, dtype in (("phase", torch.int64), ("observation", torch.float32)):
        now = np.concatenate([s[key][:-1] for s in states])
        after = np.concatenate([s[key][1:] for s in states])
        assert torch.equal(rows[key], torch.tensor(now).to(dtype))
        assert torch.equal(rows["next", key], torch.tensor(after).to(dtype))


def test_entities_as_dict(tmp_path):
    dataset, _ = make_dataset(parts)
    rows = load_minari(dataset, tmp_path / "rows", progress=False)
    layout = EntityLayout.from_keys(
        {"arm": ("observation", "arm"), "cup": ("observation", "cup")}
    )
    assert layout.read(rows, next=True).shape == (11, 3)


def test_windows_and_scores(tmp_path):
    dataset, _ = make_dataset(flat, lengths=(8, 8))
    rows = load_minari(dataset, tmp_path / "rows", progress=False)
    sampler = SliceSampler(slice_len=4, traj_key="episode", cache_values=True)
    rb = offline_buffer(rows, batch_size=8, sampler=sampler)

    class Height:
        layout = EntityLayout({"arm": [0, 1], "cup": [2]})

        def __call__(self, td):
            return td["observation"][:, 1:]

    score_buffer(rb, Height(), lookahead=0, progress=False)
    batch = rb.sample()
    torch.testing.assert_close(batch["caiac", "score"], batch["observation"][:, 1:])
    windows = batch["episode"].view(-1, 4)
    assert (windows == windows[:, :1]).all()
    opened = load_transitions(tmp_path / "rows")
    torch.testing.assert_close(opened["caiac", "score"], rows["observation"][:, 1:])


def nan_observation(number, buffer):
    if number == 1:
        buffer.observations[1, 0] = np.nan


def inf_action(number, buffer):
    if number == 2:
        buffer.actions[0, 0] = np.inf


def missing_state(number, buffer):
    if number == 2:
        object.__setattr__(buffer, "observations", buffer.observations[:-1])  # frozen


def overflow(number, buffer):
    if number == 2:
        buffer.actions[0, 0] = 1e300


def narrow_action(number, buffer):
    if number == 1:
        object.__setattr__(buffer, "actions", buffer.actions[:, :1])


def wide_goal(number, buffer):
    if number == 2:
        buffer.observations["desired_goal"] = np.zeros((7, 3))


def no_goal(number, buffer):
    if number == 1:
        del buffer.observations["desired_goal"]


def another_type(number, buffer):
    if number == 1:
        buffer.observations["phase"] = buffer.observations["phase"].astype(float)


@pytest.mark.parametrize(
    ("spoil", "key"),
    [(wide_goal, "desired_goal"), (no_goal, "desired_goal"), (another_type, "phase")],
)
def test_episodes_of_different_kinds(spoil, key, tmp_path):
    dataset, _ = make_dataset(foreign_goals, spoil=spoil)
    with pytest.raises(ValueError, match=rf"episode \d .*differ.*'{key}'"):
        load_minari(dataset, tmp_path / "rows", progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["minari"]


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (overflow, "'action' in episode 2 .*infinite"),
        (narrow_action, r"episode 1 .*differ.*\['action'\]"),
        (nan_observation, "'observation' in episode 1 .*NaN"),
        (inf_action, "'action' in episode 2 .*infinite"),
        (missing_state, "'observation' in episode 2 .*has 6 entries, expected 7"),
    ],
)
def test_bad_episodes_leave_nothing(spoil, match, tmp_path):
    dataset, _ = make_dataset(flat, spoil=spoil)
    with pytest.raises(ValueError, match=match):
        load_minari(dataset, tmp_path / "rows", progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["minari"]


@pytest.mark.parametrize(("observe", "name"), [(taken, "episode"), (reward, "reward")])
def test_an_entry_named_as_a_key_of_transitions(observe, name, tmp_path):
    dataset, _ = make_dataset(observe)
    with pytest.raises(ValueError, match=rf"entries named \['{name}'\]"):
        load_minari(dataset, tmp_path / "rows", progress=False)


def mission(rng: np.random.Generator, length: int) -> dict:
    return {
        "observation": arrays(rng, length + 1, 2),
        "mission": ["push"] * (length + 1),
        "deep": {"name": ["cup"] * (length + 1), "place": arrays(rng, length + 1, 1)},
    }


SPACES[mission] = spaces.Dict(
    {
        "observation": box(2),
        "mission": spaces.Text(9),
        "deep": spaces.Dict({"name": spaces.Text(9), "place": box(1)}),
    }
)


def named_infos(number, buffer):
    length = len(buffer.actions)
    # Text of one length is stored as bytes, of several as objects.
    buffer.infos["name"] = np.array([b"cup"] * (length + 1))
    buffer.infos["deep"] = {
        "label": np.array(["a" * i for i in range(length + 1)], dtype=object),
        "size": np.arange(length + 1),
    }


class TestTextAndObjects:
    @pytest.mark.parametrize(
        ("exclude", "infos", "match"),
        [
            (["deep"], [], r"'mission' in episode 0 .* text, .*exclude=\['mission'\]"),
            (["mission"], [], r"\('deep', 'name'\) in episode 0 .* text"),
            (["mission", "deep"], ["name"], r"\('info', 'name'\) in .* bytes"),
            (
                ["mission", "deep"],
                ["deep"],
                r"\('info', 'deep', 'label'\) in .* Python objects",
            ),
        ],
    )
    def test_key_and_episode_are_named(self, exclude, infos, match, tmp_path):
        dataset, _ = make_dataset(mission, spoil=named_infos)
        options = {"exclude": exclude, "infos": infos, "progress": False}
        with pytest.raises(ValueError, match=match):
            load_minari(dataset, tmp_path / "rows", **options)
        assert [path.name for path in tmp_path.iterdir()] == ["minari"]

    def test_what_is_excluded_is_left_out(self, tmp_path):
        dataset, _ = make_dataset(mission, spoil=named_infos)
        rows = load_minari(
            dataset,
            tmp_path / "rows",
            infos=["deep", "clock"],
            exclude=["mission", ("deep", "name"), ("info", "deep", "label")],
            progress=False,
        )
        keys = {key for key in rows.keys(True, True) if "next" not in key}
        assert keys == {
            "observation",
            ("deep", "place"),
            "action",
            "episode",
            ("info", "deep", "size"),
            ("info", "clock"),
        }
        assert rows["next", "deep"].keys() == {"place"}

    def test_an_unknown_entry_is_named(self, tmp_path):
        dataset, _ = make_dataset(flat)
        with pytest.raises(KeyError, match=r"no \[\('errand',\)\].*'observation'"):
            load_minari(dataset, tmp_path / "x", exclude=["errand"], progress=False)


class TestActionBounds:
    def test_bounded_actions(self, tmp_path):
        space = spaces.Box(np.array([-1.0, 0.1]), np.array([1.0, 2.0]), (2,))
        dataset, _ = make_dataset(flat, actions=space)
        rows = load_minari(dataset, tmp_path / "rows", progress=False)
        low, high = action_bounds(rows)
        assert torch.equal(low, torch.tensor([-1.0, 0.1]))
        assert torch.equal(high, torch.tensor([1.0, 2.0]))

    def test_unbounded_actions(self, tmp_path):
        space = spaces.Box(np.array([-1.0, -np.inf]), np.ones(2), (2,), np.float64)
        dataset, _ = make_dataset(flat, actions=space)
        rows = load_minari(dataset, tmp_path / "rows", progress=False)
        assert action_bounds(rows) is None


class TestDigests:
    def test_leaves_and_source_have_them(self, tmp_path, caplog):
        make_dataset(flat)
        load = partial(load_minari, "caiac/test-v0", tmp_path / "rows", progress=False)
        load()
        load_transitions(tmp_path / "rows", verify=True)
        load(overwrite=True)
        assert "other data" not in caplog.text
        (file,) = (tmp_path / "minari").rglob("main_data.hdf5")
        with h5py.File(file, "r+") as stored:
            stored["episode_1/rewards"][0] += 1
        load(overwrite=True)
        assert "other data than caiac/test-v0 has" in caplog.text

    @pytest.mark.parametrize("content", ["", "[]", '{"format": "other"}'])
    def test_damaged_ones_are_replaced(self, content, tmp_path, caplog):
        make_dataset(flat)
        load = partial(load_minari, "caiac/test-v0", tmp_path / "rows", progress=False)
        load()
        (tmp_path / "rows" / "digests.json").write_text(content)
        load(overwrite=True)
        assert "it cannot be known what" in caplog.text
        load_transitions(tmp_path / "rows", verify=True)

    def test_a_read_only_dataset(self, tmp_path, read_only):
        make_dataset(flat)
        read_only(tmp_path / "minari")
        rows = load_minari("caiac/test-v0", tmp_path / "rows", progress=False)
        assert len(rows) == sum(LENGTHS)


def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path, small_disk):
    dataset, _ = make_dataset(flat, lengths=(60_000, 60_000))
    with pytest.raises(OSError, match=r"the disk is full: .*\.memmap needs \d+ bytes"):
        load_minari(dataset, small_disk / "rows", progress=False)
    assert not list(small_disk.iterdir())


def test_what_a_killed_call_left_is_removed(tmp_path):
    dataset, _ = make_dataset(flat)

    def half():
        with whole_folder(tmp_path / "rows") as folder:
            folder.mkdir()
            yield

    run_killed(half)
    load_minari(dataset, tmp_path / "rows", progress=False)
    assert {path.name for path in tmp_path.iterdir()} == {"minari", "rows"}


def test_arguments(tmp_path):
    dataset, _ = make_dataset(flat)
    with pytest.raises(KeyError, match=r"no 'force' in its infos.*clock"):
        load_minari(dataset, tmp_path / "rows", infos=["force"], progress=False)
    with pytest.raises(ValueError, match=r"columns range from 0 to 3.*3 columns"):
        load_minari(dataset, tmp_path / "rows", columns=[0, 3], progress=False)
    for none in ([], (), np.array([], int)):
        with pytest.raises(ValueError, match=r"columns is empty.*leave out columns="):
            load_minari(dataset, tmp_path / "rows", columns=none, progress=False)
    first = load_minari(dataset, tmp_path / "rows", progress=False)
    again = load_minari(dataset, tmp_path / "rows", progress=False)
    assert (first == again).all()
    with pytest.raises(FileExistsError, match=r"arguments differ.*overwrite=True"):
        load_minari(dataset, tmp_path / "rows", columns=[0], progress=False)
    again = load_minari(dataset, tmp_path / "rows", overwrite=True, progress=False)
    assert len(again) == sum(LENGTHS)
    with pytest.raises(FileNotFoundError, match="absent-v0"):
        load_minari("caiac/absent-v0", tmp_path / "other", progress=False)
    assert isinstance(dataset.observation_space, gymnasium.spaces.Box)
