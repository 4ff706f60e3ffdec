"""Fetch-Push datasets can be replayed and loaded as transitions."""

from __future__ import annotations

import re

import minari
import numpy as np
import pytest
import torch

from torchrl_caiac.data import load_minari, mix_trajectories
from torchrl_caiac.data.minari_files import open_minari
from torchrl_caiac.envs.fetch_push import (
    FetchPushCubes,
    FetchPushExpert,
    create_fetch_push_expert,
    create_fetch_push_random,
)

STEPS = 45
NOISE = 0.1


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("minari")


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def expert(root, work):
    return create_fetch_push_expert(
        episodes=5,
        steps=STEPS,
        action_noise=NOISE,
        episodes_per_file=2,
        root=root,
        work=work,
        workers=1,
        progress=False,
    )


@pytest.fixture(scope="module")
def random_actions(root):
    return create_fetch_push_random(
        episodes=7,
        steps=STEPS,
        episodes_per_file=4,
        root=root,
        workers=1,
        progress=False,
    )


def seeds(dataset):
    known = dataset.storage.get_episode_metadata(dataset.episode_indices)
    return [meta["seed"] for meta in known]


def test_minari_itself_finds_the_datasets(expert, random_actions, root, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    names = {"fetch-push-2/expert-v0", "fetch-push-2/random-v0"}
    assert set(minari.list_local_datasets()) == names
    assert (expert.total_episodes, random_actions.total_episodes) == (5, 7)
    assert len({*seeds(expert), *seeds(random_actions)}) == 12
    assert not list(root.glob(".partial-*"))
    env = minari.load_dataset("fetch-push-2/expert-v0").recover_environment()
    observation, _ = env.reset(seed=0)
    assert expert.observation_space == env.observation_space
    assert expert.observation_space.contains(observation)
    assert env.unwrapped.max_episode_steps == STEPS
    env.close()


@pytest.mark.parametrize("name", ["expert", "random_actions"])
def test_episodes_can_be_played_again(name, request):
    dataset = request.getfixturevalue(name)
    env = FetchPushCubes(2, max_episode_steps=STEPS)
    first = set()
    for episode, seed in zip(dataset.iterate_episodes(), seeds(dataset), strict=True):
        observation, info = env.reset(seed=seed)
        first.add(tuple(observation["observation"]))
        states = episode.observations
        assert {key: value.dtype for key, value in states.items()} == {
            key: np.dtype("f4") for key in observation
        }
        assert len(episode.actions) == STEPS
        for step in range(STEPS + 1):
            for key, value in observation.items():
                np.testing.assert_array_equal(states[key][step], value)
            np.testing.assert_array_equal(
                episode.infos["simulator"][step], env.simulator_state()
            )
            assert episode.infos["success"][step] == info["success"]
            if step == STEPS:
                break
            observation, reward, _, _, info = env.step(episode.actions[step])
            assert reward == episode.rewards[step]
        assert episode.truncations.tolist() == [False] * (STEPS - 1) + [True]
        assert not episode.terminations.any()
    assert len(first) == dataset.total_episodes


def test_the_expert_acts_with_the_requested_noise(expert):
    noise = []
    policy = FetchPushExpert(2)
    for episode in expert.iterate_episodes():
        states = {key: value[:-1] for key, value in episode.observations.items()}
        noise.append(
            (episode.actions - policy.act(states))[np.abs(episode.actions) < 1]
        )
    noise = np.concatenate(noise)
    assert abs(noise.mean()) < 0.02
    # A little less, since actions are clipped.
    assert 0.8 * NOISE < noise.std() < 1.05 * NOISE


def test_random_actions_are_uniform(random_actions):
    actions = np.concatenate([e.actions for e in random_actions.iterate_episodes()])
    assert actions.min() >= -1 and actions.max() <= 1
    assert np.abs(actions.mean(0)).max() < 0.15
    assert np.abs(actions.std(0) - 1 / np.sqrt(3)).max() < 0.06


def test_success_is_in_the_description(expert, random_actions):
    for dataset in (expert, random_actions):
        success = [e.infos["success"] for e in dataset.iterate_episodes()]
        shares = np.mean([s.any() for s in success]), np.mean([s[-1] for s in success])
        told = re.findall(r"([\d.]+)%", dataset.storage.metadata["description"])
        assert [float(share) for share in told] == pytest.approx(
            [100 * share for share in shares], abs=0.05
        )
        assert (shares[0] > 0.5) == (dataset is expert)


def test_rows_and_their_mixture(expert, random_actions, tmp_path):
    sources = [
        load_minari(
            dataset, tmp_path / name, infos=("simulator", "success"), progress=False
        )
        for name, dataset in (("expert", expert), ("random", random_actions))
    ]
    rows = sources[0]
    assert rows.batch_size == (5 * STEPS,)
    for key, width in (
        ("observation", 34),
        ("achieved_goal", 6),
        ("desired_goal", 6),
        ("action", 4),
    ):
        assert rows[key].shape == (len(rows), width)
        assert rows[key].dtype == torch.float32
    assert rows["info", "simulator"].dtype == torch.float64
    assert rows["info", "success"].dtype == torch.bool
    ends = torch.arange(1, len(rows) + 1) % STEPS == 0
    assert torch.equal(rows["next", "done"], ends[:, None])
    assert torch.equal(rows["next", "truncated"], ends[:, None])
    achieved = rows["next", "achieved_goal"]
    columns = [10, 11, 12, 22, 23, 24]
    assert torch.equal(achieved, rows["next", "observation"][:, columns])
    # A row's state is the one its action was taken in.
    env = FetchPushCubes(2)
    for row in (0, 17, STEPS, len(rows) - 1):
        env.reset(seed=0)
        goal = rows["desired_goal"][row].double().numpy()
        env.set_simulator_state(rows["info", "simulator"][row].numpy(), goal=goal)
        observation, *_ = env.step(rows["action"][row].numpy())
        np.testing.assert_array_equal(
            observation["observation"], rows["next", "observation"][row]
        )
    mixed = mix_trajectories(sources, shares=(0.3, 0.7), path=tmp_path / "mixed")
    assert (mixed["source"].bincount() / STEPS).tolist() == [3, 7]


def test_a_dataset_is_replaced_only_with_overwrite(expert, root, work):
    with pytest.raises(FileExistsError, match="overwrite=True"):
        create_fetch_push_expert(root=root)
    arguments = {
        "episodes": 5,
        "action_noise": NOISE,
        "episodes_per_file": 2,
        "root": root,
        "work": work,
        "workers": 1,
        "overwrite": True,
        "progress": False,
    }
    with pytest.raises(ValueError, match="has another collection"):
        create_fetch_push_expert(steps=STEPS + 1, **arguments)
    # A missing file is collected again, and is the same.
    (work / "fetch-push-2-expert-v0" / "episode_000001.npz").unlink()
    again = create_fetch_push_expert(steps=STEPS, **arguments)
    for left, right in zip(
        again.iterate_episodes(), expert.iterate_episodes(), strict=True
    ):
        np.testing.assert_array_equal(left.actions, right.actions)
        np.testing.assert_array_equal(left.infos["simulator"], right.infos["simulator"])
    assert open_minari(expert.id, root).total_episodes == 5


def test_another_number_of_cubes_without_states(tmp_path):
    for create, name in (
        (create_fetch_push_expert, "expert"),
        (create_fetch_push_random, "random"),
    ):
        dataset = create(
            episodes=1,
            num_cubes=3,
            steps=2,
            simulator_states=False,
            root=tmp_path,
            workers=1,
            progress=False,
        )
        assert dataset.id == f"fetch-push-3/{name}-v0"
        assert dataset[0].observations["observation"].shape == (3, 46)
        assert set(dataset[0].infos) == {"success"}
        with pytest.raises(KeyError, match="simulator"):
            load_minari(dataset, tmp_path / "rows", infos=["simulator"], progress=False)


@pytest.mark.slow
def test_two_workers_collect_the_same(random_actions, tmp_path):
    dataset = create_fetch_push_random(
        episodes=7,
        steps=STEPS,
        episodes_per_file=4,
        root=tmp_path,
        workers=2,
        progress=False,
    )
    for left, right in zip(
        dataset.iterate_episodes(), random_actions.iterate_episodes(), strict=True
    ):
        np.testing.assert_array_equal(left.actions, right.actions)
        np.testing.assert_array_equal(left.infos["simulator"], right.infos["simulator"])


@pytest.mark.parametrize(
    "name", ["episodes", "num_cubes", "steps", "episodes_per_file"]
)
@pytest.mark.parametrize("create", [create_fetch_push_expert, create_fetch_push_random])
def test_numbers_out_of_range(create, name, tmp_path):
    with pytest.raises(ValueError, match=f"{name} is 0, expected at least 1"):
        create(root=tmp_path, **{name: 0})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("noise", [-0.1, float("nan"), float("inf")])
def test_noise_out_of_range(noise, tmp_path):
    with pytest.raises(ValueError, match="action_noise is"):
        create_fetch_push_expert(action_noise=noise, root=tmp_path)
