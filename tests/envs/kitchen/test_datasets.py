"""The kitchen's datasets: schema, restored states, rows, refusals."""

from __future__ import annotations

import functools
import json
import os
import shutil

import h5py
import minari
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from minari.data_collector import EpisodeBuffer
from tensordict import TensorDict

from torchrl_caiac.data.minari_files import open_minari
from torchrl_caiac.envs.kitchen.datasets import (
    DEMONSTRATIONS_ID,
    PLAY_ID,
    PLAY_ORDERS,
    RANDOM_ID,
    Demonstrations,
    create_kitchen_demonstrations,
    create_kitchen_play,
    create_kitchen_random,
    kitchen_transitions,
    load_d4rl_kitchen,
)
from torchrl_caiac.envs.kitchen.env import KITCHEN_TASKS, KitchenEnv

GROUPS = (
    Demonstrations("microwave", 1, {"slide_cabinet": 0.37}),
    Demonstrations("kettle", 2),
)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("minari")


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def demonstrations(root, work):
    before = os.environ.get("MINARI_DATASETS_PATH")
    dataset, report = create_kitchen_demonstrations(
        demonstrations=GROUPS, root=root, work=work, workers=1, progress=False
    )
    assert os.environ.get("MINARI_DATASETS_PATH") == before
    assert report.collected == 3
    assert not list(root.glob(".partial-*"))
    return dataset


@pytest.fixture(scope="module")
def random_actions(demonstrations, root, work):
    return create_kitchen_random(
        demonstrations,
        ratio=0.5,
        steps=4,
        simulator_states=True,
        starts_per_file=8,
        root=root,
        work=work,
        workers=1,
        progress=False,
    )


def test_minari_itself_finds_the_datasets(
    demonstrations, random_actions, root, monkeypatch
):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    assert set(minari.list_local_datasets()) == {DEMONSTRATIONS_ID, RANDOM_ID}
    dataset = minari.load_dataset(DEMONSTRATIONS_ID)
    assert dataset.total_episodes == 3
    env = dataset.recover_environment()
    observation, _ = env.reset(seed=0)
    assert dataset.observation_space.contains(observation)
    env.close()
    assert open_minari(RANDOM_ID).total_episodes == random_actions.total_episodes


def test_demonstrations_end_in_success_and_keep_the_truth(demonstrations):
    goals = {"microwave": -0.75, "kettle": 0.75}
    metadata = demonstrations.storage.get_episode_metadata(range(3))
    for episode, known in zip(demonstrations.iterate_episodes(), metadata, strict=True):
        task = known["options"]["task"]
        start = json.loads(known["options"]["start"])
        length = len(episode.actions)
        observation = episode.observations["observation"]
        assert observation.shape == (length + 1, 59)
        assert episode.actions.shape == (length, 9)
        assert episode.truncations.tolist() == [False] * (length - 1) + [True]
        assert not episode.terminations.any()
        for kind in ("achieved_goal", "desired_goal"):
            goal = episode.observations[kind]
            assert goal["microwave"].shape == (length + 1, 1)
            assert goal["kettle"].shape == (length + 1, 7)
        distance = np.linalg.norm(
            episode.observations["achieved_goal"][task][-1]
            - episode.observations["desired_goal"][task][-1]
        )
        assert distance < 0.3
        assert episode.rewards[-1] == 1.0
        assert episode.rewards[0] == 0.0
        qpos = episode.infos["qpos"]
        assert qpos.shape == (length + 1, 30)
        assert episode.infos["qvel"].shape == (length + 1, 29)
        seen = observation[:, [*range(9), *range(18, 39)]]
        np.testing.assert_allclose(seen, qpos, atol=2e-3)
        assert np.abs(seen - qpos).max() > 0
        np.testing.assert_allclose(
            qpos[:, 19], start.get("slide_cabinet", 0.0), atol=0.01
        )
        moved = {"microwave": qpos[-1, 22], "kettle": qpos[-1, 24]}
        assert abs(moved[task] - goals[task]) < 0.3


def test_random_episodes_begin_in_states_of_demonstrations(
    demonstrations, random_actions
):
    states = np.concatenate(
        [
            np.concatenate([e.infos["qpos"], e.infos["qvel"]], 1)
            for e in demonstrations.iterate_episodes()
        ]
    )
    rows = demonstrations.total_steps
    assert random_actions.total_episodes == round(rows * 0.5 / 4)
    assert random_actions.total_steps == 4 * random_actions.total_episodes
    actions, starts = [], []
    for episode in random_actions.iterate_episodes():
        start = np.concatenate([episode.infos["qpos"][0], episode.infos["qvel"][0]])
        hits = np.flatnonzero((states == start).all(1))
        # Demonstrations of one task share their first state.
        assert len(hits)
        starts.append(int(hits[0]))
        actions.append(episode.actions)
        assert episode.truncations.tolist() == [False, False, False, True]
    assert len(set(starts)) == len(starts)
    drawn = np.concatenate(actions)
    assert drawn.min() > -1 and drawn.max() < 1
    assert np.abs(drawn.mean(0)).max() < 0.25
    assert np.abs(drawn.std(0) - 1 / np.sqrt(3)).max() < 0.15


def test_rows(demonstrations, random_actions, tmp_path):
    rows = kitchen_transitions(demonstrations, progress=False)
    total = demonstrations.total_steps
    assert rows.batch_size == (total,)
    assert rows["observation"].shape == (total, 30)
    assert rows["observation"].dtype == torch.float32
    assert rows["action"].shape == (total, 9)
    assert rows["next", "reward"].shape == (total, 1)
    assert rows["episode"].dtype == torch.int64
    episodes = list(demonstrations.iterate_episodes())
    lengths = torch.tensor([len(e.actions) for e in episodes])
    assert rows["episode"].bincount().tolist() == lengths.tolist()
    ends = torch.zeros(total, 1, dtype=torch.bool)
    ends[lengths.cumsum(0) - 1] = True
    assert torch.equal(rows["next", "done"], ends)
    assert torch.equal(rows["next", "truncated"], ends)
    assert not rows["next", "terminated"].any()
    same = rows["episode"][1:] == rows["episode"][:-1]
    assert torch.equal(
        rows["next", "observation"][:-1][same], rows["observation"][1:][same]
    )
    first = episodes[0].observations["observation"]
    np.testing.assert_array_equal(
        rows["observation"][0, :9], first[0, :9].astype(np.float32)
    )
    np.testing.assert_array_equal(
        rows["observation"][0, 9:], first[0, 18:39].astype(np.float32)
    )
    np.testing.assert_array_equal(
        rows["next", "observation"][lengths[0] - 1, 9:], first[-1, 18:39].astype("f4")
    )
    assert {KITCHEN_TASKS[t] for t in rows["task"].unique()} == {"microwave", "kettle"}
    opened = rows["observation"][:, 19] > 0.2
    assert torch.equal(opened, rows["task"] == KITCHEN_TASKS.index("microwave"))
    np.testing.assert_array_equal(rows["sim", "qpos"][0], episodes[0].infos["qpos"][0])

    path = tmp_path / "rows"
    stored = kitchen_transitions(demonstrations, path, progress=False)
    assert stored.is_memmap()
    assert (stored == rows).all()
    assert (TensorDict.load_memmap(path) == rows).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["rows"]
    with pytest.raises(FileExistsError, match="overwrite=True"):
        kitchen_transitions(demonstrations, path, progress=False)
    other = kitchen_transitions(random_actions, path, overwrite=True, progress=False)
    assert len(other) == random_actions.total_steps
    assert (other["task"] == -1).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["rows"]


def test_play_does_its_tasks_one_after_another(tmp_path):
    orders = (("kettle", "slide cabinet"), ("bottom burner",))
    options = {"orders": orders, "episodes": 1, "seed": 3, "progress": False}
    dataset, report = create_kitchen_play(
        root=tmp_path / "minari", work=tmp_path / "work", workers=1, **options
    )
    assert dataset.id == PLAY_ID
    assert report.collected == 2
    rows = kitchen_transitions(dataset, progress=False)
    metadata = dataset.storage.get_episode_metadata(range(2))
    default = KitchenEnv.default_state()
    for number, (order, known) in enumerate(zip(orders, metadata, strict=True)):
        assert json.loads(known["options"]["tasks"]) == list(order)
        own = rows[rows["episode"] == number]
        np.testing.assert_allclose(own["sim", "qpos"][0], default, atol=1e-6)
        names = [name.replace(" ", "_") for name in order]
        played = own["task"].unique_consecutive()
        assert [KITCHEN_TASKS[task] for task in played] == names
        # Tasks that are done are done; everything else stays where it was.
        last = own["next", "observation"][-1]
        moved = (own["sim", "qpos"] - torch.as_tensor(default)).abs().amax(0)
        for name, columns in KitchenEnv.layout.columns.items():
            where = torch.tensor(columns)
            if name in names:
                goal = torch.as_tensor(KitchenEnv.solved(name)).float()
                assert (last[where] - goal).norm() < 0.3
                # It moves while its task is played, not before.
                first = int((own["task"] == KITCHEN_TASKS.index(name)).nonzero()[0])
                way = (own["sim", "qpos"] - own["sim", "qpos"][0])[:, where].abs()
                assert way[: first + 1].max() < 0.02
                assert way.max() > 0.2
            elif name != "robot":
                assert moved[where].max() < 0.02
    # A collection that is there already is not made again, whatever made it.
    again, report = create_kitchen_play(
        root=tmp_path / "minari", work=tmp_path / "work", overwrite=True, **options
    )
    assert (report.collected, report.reused) == (0, 2)
    assert (kitchen_transitions(again, progress=False) == rows).all()


def test_orders_of_play_are_narrow_and_hold_all_tasks():
    tasks = {task.replace(" ", "_") for order in PLAY_ORDERS for task in order}
    assert tasks == set(KITCHEN_TASKS)
    assert {len(order) for order in PLAY_ORDERS} == {4}
    # What is done when a task begins: few of the 64 combinations of six others.
    for task in {task for order in PLAY_ORDERS for task in order}:
        begun = {
            frozenset(order[: order.index(task)])
            for order in PLAY_ORDERS
            if task in order
        }
        assert len(begun) <= 5
    # No counterfactual shows what never rests once it was moved.
    early = {task.replace(" ", "_") for order in PLAY_ORDERS for task in order[:-1]}
    assert early == tasks


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"orders": [["toaster"]]}, KeyError, "toaster"),
        ({"orders": [["kettle", "kettle"]]}, ValueError, "each only once"),
        ({"orders": [[]]}, ValueError, "at least one task"),
        ({"orders": []}, ValueError, "no demonstrations"),
        ({"episodes": 0}, ValueError, "no demonstrations"),
        ({"speeds": (0.5, 0.2)}, ValueError, "lowest"),
        ({"speeds": (0.0, 0.2)}, ValueError, "lowest"),
    ],
)
def test_wrong_orders_of_play(wrong, error, message, tmp_path):
    with pytest.raises(error, match=message):
        create_kitchen_play(root=tmp_path, **wrong)
    assert not any(tmp_path.iterdir())


def test_a_dataset_is_not_replaced_unasked(demonstrations, root, work):
    with pytest.raises(FileExistsError, match="overwrite=True"):
        create_kitchen_demonstrations(root=root)
    again, report = create_kitchen_demonstrations(
        demonstrations=GROUPS,
        root=root,
        work=work,
        workers=1,
        overwrite=True,
        progress=False,
    )
    assert (report.collected, report.reused) == (0, 3)
    assert again.total_steps == demonstrations.total_steps
    for left, right in zip(
        again.iterate_episodes(), demonstrations.iterate_episodes(), strict=True
    ):
        np.testing.assert_array_equal(left.actions, right.actions)


def test_nothing_is_left_behind_by_an_error(demonstrations, root, monkeypatch):
    def broken(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(minari, "create_dataset_from_buffers", broken)
    before = sorted(root.rglob("*"))
    with pytest.raises(OSError, match="disk full"):
        create_kitchen_random(
            demonstrations,
            "kitchen/other-v0",
            ratio=0.05,
            root=root,
            workers=1,
            progress=False,
        )
    assert sorted(root.rglob("*")) == before


def test_bad_input(demonstrations, root, tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="no Minari dataset"):
        open_minari("kitchen/none-v0", root)
    with pytest.raises(KeyError, match="toaster"):
        create_kitchen_demonstrations(
            demonstrations=[Demonstrations("toaster")], root=tmp_path
        )
    with pytest.raises(ValueError, match="no demonstrations"):
        create_kitchen_demonstrations(demonstrations=[], root=tmp_path)
    for wrong in ({"ratio": 0}, {"ratio": np.nan}, {"steps": 0}):
        with pytest.raises(ValueError, match="wanted"):
            create_kitchen_random(demonstrations, root=tmp_path, **wrong)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def foreign(name, observation, width=59):
        return minari.create_dataset_from_buffers(
            f"kitchen/{name}-v0",
            [
                EpisodeBuffer(
                    observations={"observation": observation},
                    actions=np.zeros((3, 9)),
                    rewards=np.zeros(3),
                    terminations=np.zeros(3, bool),
                    truncations=np.zeros(3, bool),
                )
            ],
            observation_space=_space(width),
            action_space=demonstrations.action_space,
        )

    narrow = foreign("narrow", np.zeros((4, 12)), 12)
    with pytest.raises(ValueError, match=r"shape \[12\], wanted \[59\]"):
        kitchen_transitions(narrow, progress=False)
    with pytest.raises(KeyError, match="qpos"):
        create_kitchen_random(narrow, root=tmp_path, progress=False)
    values = np.zeros((4, 59))
    values[2, 5] = np.inf
    with pytest.raises(ValueError, match="finite"):
        kitchen_transitions(foreign("infinite", values), progress=False)
    # A file that does not say where its trajectory ends: the last row is the end.
    rows = kitchen_transitions(foreign("open", np.zeros((4, 59))), progress=False)
    assert rows["next", "truncated"].flatten().tolist() == [False, False, True]
    assert "sim" not in rows


TASKS = ["microwave", "kettle", "light switch", "slide cabinet"]


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """A file of the schema of `D4RL/kitchen/mixed-v2`, and its arrays."""
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FrankaKitchen-v1", tasks_to_complete=TASKS)
    rng = np.random.default_rng(0)
    widths = {"microwave": 1, "kettle": 7, "light switch": 2, "slide cabinet": 1}
    episodes = []
    for length in (5, 1, 3):
        goals = {
            kind: {name: rng.normal(size=(length + 1, w)) for name, w in widths.items()}
            for kind in ("achieved_goal", "desired_goal")
        }
        episodes.append(
            {
                "observations": {
                    "observation": rng.normal(size=(length + 1, 59)),
                    **goals,
                },
                "actions": rng.uniform(-1, 1, (length, 9)).astype(np.float32),
                "rewards": rng.integers(0, 5, length).astype(float),
                "terminations": np.arange(length) == 4,
                "truncations": np.zeros(length, bool),
            }
        )
    root = tmp_path_factory.mktemp("remote")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        minari.create_dataset_from_buffers(
            "D4RL/kitchen/mixed-v2",
            [EpisodeBuffer(**episode) for episode in episodes],
            env=env,
        )
    env.close()
    return root, episodes


def _check_foreign(rows, episodes):
    assert len(rows) == 9
    assert set(rows.keys(True, True)) == {
        "observation",
        "action",
        "episode",
        "task",
        *(
            ("next", name)
            for name in ("observation", "reward", "done", "terminated", "truncated")
        ),
    }
    row = 0
    for number, episode in enumerate(episodes):
        full = episode["observations"]["observation"].astype(np.float32)
        for step in range(len(episode["actions"])):
            now, after = (
                np.concatenate([full[t, :9], full[t, 18:39]]) for t in (step, step + 1)
            )
            np.testing.assert_array_equal(rows["observation"][row], now)
            np.testing.assert_array_equal(rows["next", "observation"][row], after)
            np.testing.assert_array_equal(rows["action"][row], episode["actions"][step])
            assert rows["next", "reward"][row] == episode["rewards"][step]
            assert rows["next", "terminated"][row] == (step == 4)
            last = step + 1 == len(episode["actions"])
            assert rows["next", "truncated"][row] == (last and step != 4)
            assert rows["next", "done"][row] == last
            assert (rows["episode"][row], rows["task"][row]) == (number, -1)
            row += 1


def test_a_kitchen_of_minari_loads_as_ours(foreign, tmp_path):
    root, episodes = foreign
    rows = kitchen_transitions("D4RL/kitchen/mixed-v2", root=root, progress=False)
    _check_foreign(rows, episodes)
    stored = kitchen_transitions(
        "D4RL/kitchen/mixed-v2", tmp_path / "rows", root=root, progress=False
    )
    assert stored.is_memmap()
    assert (stored == rows).all()


@pytest.mark.parametrize("named", [True, False])
def test_what_is_not_there_is_downloaded(named, foreign, tmp_path, monkeypatch):
    source, episodes = foreign
    asked = []

    def download(dataset_id):
        asked.append(dataset_id)
        shutil.copytree(source, os.environ["MINARI_DATASETS_PATH"], dirs_exist_ok=True)

    monkeypatch.setattr(minari, "download_dataset", download)
    before = tmp_path / ("other" if named else "wanted")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(before))
    root = tmp_path / "wanted" if named else None
    load = functools.partial(
        kitchen_transitions, "D4RL/kitchen/mixed-v2", root=root, progress=False
    )
    with pytest.raises(FileNotFoundError, match="download=True"):
        load()
    assert not asked
    for _ in range(2):
        _check_foreign(load(download=True), episodes)
    assert asked == ["D4RL/kitchen/mixed-v2"]
    assert os.environ["MINARI_DATASETS_PATH"] == str(before)
    assert (tmp_path / "wanted" / "D4RL/kitchen/mixed-v2/data").exists()


def _d4rl(length=7, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "observations": rng.normal(size=(length, 60)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (length, 9)).astype(np.float32),
        "rewards": rng.integers(0, 5, length).astype(np.float32),
        "terminals": np.zeros(length, bool),
        "timeouts": np.zeros(length, bool),
    }


def _write_d4rl(path, arrays):
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array
        # The original files hold more, which is not read.
        file["infos/goal"] = np.full(3, np.nan)
    return path


@settings(max_examples=60, deadline=None)
@given(ends=st.lists(st.sampled_from("-xtb"), min_size=1, max_size=12))
def test_files_of_d4rl(ends, tmp_path_factory):
    arrays = _d4rl(len(ends))
    arrays["terminals"][:] = [end in "xb" for end in ends]
    arrays["timeouts"][:] = [end in "tb" for end in ends]
    path = _write_d4rl(tmp_path_factory.mktemp("d4rl") / "kitchen.hdf5", arrays)
    # Row by row: episodes of at least two rows, without their last one.
    wanted, first = [], 0
    for row, end in enumerate(ends):
        if end != "-" or row + 1 == len(ends):
            if row > first:
                wanted.append(list(range(first, row)))
            first = row + 1
    if not wanted:
        with pytest.raises(ValueError, match="no rows that are followed"):
            load_d4rl_kitchen(path)
        return
    rows = load_d4rl_kitchen(path)
    taken = [row for episode in wanted for row in episode]
    state = arrays["observations"][:, :30]
    np.testing.assert_array_equal(rows["observation"], state[taken])
    after = [row + 1 for row in taken]
    np.testing.assert_array_equal(rows["next", "observation"], state[after])
    np.testing.assert_array_equal(rows["action"], arrays["actions"][taken])
    np.testing.assert_array_equal(
        rows["next", "reward"][:, 0], arrays["rewards"][taken]
    )
    assert rows["episode"].tolist() == [
        number for number, episode in enumerate(wanted) for _ in episode
    ]
    done = [row == episode[-1] for episode in wanted for row in episode]
    assert rows["next", "done"].flatten().tolist() == done
    assert rows["next", "truncated"].flatten().tolist() == done
    assert not rows["next", "terminated"].any()
    assert (rows["task"] == -1).all()


def test_files_of_d4rl_have_the_rows_of_minari_s(foreign, tmp_path):
    arrays = _d4rl()
    arrays["timeouts"][3] = True
    path = _write_d4rl(tmp_path / "kitchen.hdf5", arrays)
    rows = load_d4rl_kitchen(path)
    theirs = kitchen_transitions(
        "D4RL/kitchen/mixed-v2", root=foreign[0], progress=False
    )
    assert {
        key: (leaf.dtype, leaf.shape[1:]) for key, leaf in rows.items(True, True)
    } == {key: (leaf.dtype, leaf.shape[1:]) for key, leaf in theirs.items(True, True)}
    stored = load_d4rl_kitchen(path, tmp_path / "rows")
    assert stored.is_memmap()
    assert (stored == rows).all()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        load_d4rl_kitchen(path, tmp_path / "rows")
    load_d4rl_kitchen(path, tmp_path / "rows", overwrite=True)


@pytest.mark.parametrize(
    ("name", "value", "error", "message"),
    [
        ("observations", np.zeros((7, 59)), ValueError, r"\(7, 59\), wanted \(7, 60\)"),
        ("actions", np.zeros((7, 8)), ValueError, r"'actions'.*\(7, 8\)"),
        ("rewards", np.zeros(6), ValueError, r"'rewards'.*\(6,\), wanted \(7,\)"),
        ("timeouts", np.zeros((7, 1)), ValueError, r"'timeouts'.*\(7, 1\)"),
        ("actions", np.full((7, 9), np.nan), ValueError, "first in row 0"),
        ("timeouts", None, KeyError, r"lacks \['timeouts'\]"),
    ],
)
def test_wrong_files_of_d4rl(name, value, error, message, tmp_path):
    arrays = _d4rl()
    if value is None:
        del arrays[name]
    else:
        arrays[name] = value
    path = _write_d4rl(tmp_path / "kitchen.hdf5", arrays)
    with pytest.raises(error, match=message):
        load_d4rl_kitchen(path, tmp_path / "rows")
    assert not (tmp_path / "rows").exists()


def test_files_that_are_none_of_d4rl(tmp_path):
    path = tmp_path / "kitchen.hdf5"
    with pytest.raises(FileNotFoundError, match="no file at"):
        load_d4rl_kitchen(path)
    whole = _write_d4rl(path, _d4rl(200)).read_bytes()
    for content in (b"", b"no HDF5", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="no HDF5 file, or a truncated one"):
            load_d4rl_kitchen(path)


def _space(width):
    import gymnasium

    box = gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float64)
    return gymnasium.spaces.Dict({"observation": box})
