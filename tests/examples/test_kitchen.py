from __future__ import annotations

import functools
import importlib
import json

import numpy as np
import pytest
import torch

from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KITCHEN_TASKS, KitchenEnv
from torchrl_caiac.envs.kitchen import (
    PLAY_ANY_START_ID,
    PLAY_ANY_START_ORDERS,
    PLAY_ID,
    PLAY_ORDERS,
)

METHODS = ["none", "caiac", "coda", "coda_action", "oracle", "relabel_only"]


@pytest.fixture(scope="module")
def cfg(steps, compose, tmp_path_factory):
    """A small run up to the scores."""
    out = tmp_path_factory.mktemp("kitchen")
    cfg = compose(f"method=[{','.join(METHODS)}]", out=out)
    steps.collect.collect(cfg)
    steps.score.score(cfg)
    return cfg


@pytest.fixture(scope="module")
def environment(steps, cfg):
    return steps.parts.make_environment(cfg)


def test_cabinet_and_task_go_together_in_the_demonstrations(environment):
    data = environment.rows()
    cabinet = data["observation"][:, KitchenEnv.layout.columns["slide_cabinet"][0]]
    microwave = data["task"] == KITCHEN_TASKS.index("microwave")
    assert microwave.any()
    assert not microwave.all()
    assert (cabinet[microwave] > 0.3).all()
    assert (cabinet[~microwave] < 0.05).all()
    # The last state of each demonstration has its task done.
    last = data[data["next", "done"].squeeze(-1)]
    for task in ("microwave", "kettle"):
        column = torch.tensor(KitchenEnv.layout.columns[task])
        own = last["task"] == KITCHEN_TASKS.index(task)
        goal = torch.as_tensor(KitchenEnv.solved(task), dtype=torch.float32)
        reached = last["next", "observation"][own][:, column]
        assert ((reached - goal).norm(dim=-1) < 0.3).all()


def test_random_actions_are_as_many_rows(environment):
    demonstrations, data = environment.model_rows()
    assert abs(len(data) - len(demonstrations)) < 4
    assert data["action"].abs().max() <= 1


def test_scores_and_their_report(environment):
    data = environment.rows()
    assert data["caiac", "score"].isfinite().all()
    report = json.loads((environment.out / "influence.json").read_text())
    assert list(report) == ["smoothing 1"]
    assert list(report["smoothing 1"]) == list(KitchenEnv.layout.names)
    # The oracle's score: whether the action moves the entity.
    truth = environment.simulator(2)(data) > 0.5
    cabinet = KitchenEnv.layout.index("slide_cabinet")
    assert truth.shape == data["caiac", "score"].shape
    assert torch.equal(data["oracle", "score"].bool(), truth)
    assert not truth[:, cabinet].any()
    assert truth[:, KitchenEnv.layout.index("microwave")].any()


@pytest.mark.parametrize("method", METHODS)
def test_buffers_of_the_methods(method, cfg, steps):
    learner = steps.parts.make_learner(cfg, method)
    batch = learner.make_buffer(learner.rows()).sample()
    assert batch["desired_goal"].shape == (320, 21)  # two batches of 16 windows
    if method == "none":
        assert ("caiac", "swapped") not in batch.keys(True)
    else:
        assert batch["caiac", "counterfactual"].float().mean() == 0.5
    if method == "relabel_only":
        assert not batch["caiac", "swapped"].any()
    if method == "coda":
        assert batch["coda", "graph"].shape == (320, 11, 10)
    if method == "coda_action":
        held = batch["coda", "action"] > cfg.env.augmentation.attention_threshold
        held = held.unflatten(0, (-1, cfg.learner.window)).any(1)
        swapped = batch["caiac", "swapped"][:: cfg.learner.window]
        assert not (swapped & held).any()


def test_an_interrupted_training_ends_as_one_that_was_not(cfg, steps, monkeypatch):
    whole = steps.train.train(cfg, "caiac", seed=3).policy_state()
    adam_step, calls = torch.optim.Adam.step, []

    def interrupted(self, *args, **kwargs):
        calls.append(None)
        if len(calls) == 9:
            raise KeyboardInterrupt
        return adam_step(self, *args, **kwargs)

    folder = steps.parts.run_folder(cfg, "caiac", 3)
    folder.rename(folder.with_name("whole"))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(torch.optim.Adam, "step", interrupted)
        steps.train.train(cfg, "caiac", seed=3)
    resumed = steps.train.train(cfg, "caiac", seed=3).policy_state()
    assert resumed.keys() == whole.keys()
    for key, value in whole.items():
        torch.testing.assert_close(resumed[key], value, rtol=0, atol=0)
    # The cosine schedule depends on the steps, so a finished run is not extended.
    longer = cfg.copy()
    longer.learner.steps = 20
    with pytest.raises(ValueError, match=r"other settings.*\['steps'\] differ"):
        steps.train.train(longer, "caiac", seed=3)


def test_evaluation(cfg, steps):
    steps.train.train(cfg, "none", seed=0)
    (evaluation,) = steps.evaluate.evaluate(cfg, "none", seed=0)
    assert (evaluation.method, evaluation.seed, evaluation.step) == ("none", 0, 12)
    assert [episode["episode"] for episode in evaluation.episodes] == [0, 1]
    for episode in evaluation.episodes:
        assert episode["success"] or episode["steps"] == 280
        assert "kettle" not in episode["wrong_tasks"]
    # It is not played again.
    written = steps.parts.run_folder(cfg, "none", 0) / "evaluation" / "test-12.json"
    kept = json.loads(written.read_text())
    assert kept["episodes"] == evaluation.episodes
    kept["episodes"][0]["steps"] = -1
    written.write_text(json.dumps(kept))
    (again,) = steps.evaluate.evaluate(cfg, "none", seed=0)
    assert again.episodes == kept["episodes"]
    other = cfg.copy()
    other.env.evaluate.episodes = 1
    with pytest.raises(ValueError, match=r"other settings.*\['episodes'\] differ"):
        list(steps.evaluate.evaluate(other, "none", seed=0))


def test_starts_of_the_splits_and_the_runs_differ(cfg, steps):
    environment = steps.parts.make_environment(cfg)
    environment.settings.evaluate.validation_episodes = 3
    seeds = [
        seed
        for run in range(20)
        for split in ("validation", "test")
        for seed in environment.start_seeds(run, split)
    ]
    assert len(seeds) == len(set(seeds)) == 20 * (3 + 2)
    environment.settings.evaluate.validation_seed = 1005
    environment.start_seeds(1, "test")
    with pytest.raises(ValueError, match=r"1004 to 1005.*raise env.*is 1005"):
        environment.start_seeds(2, "test")


class Hesitant:
    """Acts from the second step on, to check what is carried from step to step."""

    def __call__(self, tensordict):
        started = ~tensordict["is_init"] if "is_init" in tensordict else None
        waited = tensordict.get("waited", started)
        tensordict["action"] = 0.3 * tensordict["observation"][:, :9] * waited
        tensordict["next", "waited"] = torch.ones_like(waited)
        return tensordict


def test_episodes_are_those_of_kitchens_that_play_alone(
    tmp_path, steps, compose, monkeypatch
):
    short = functools.partial(KitchenEnv, max_episode_steps=60)
    monkeypatch.setattr("environments.kitchen.KitchenEnv", short)
    cfg = compose("env=kitchen_all_tasks")
    environment = steps.parts.make_environment(cfg)
    settings = environment.settings.evaluate
    settings.tasks, settings.validation_episodes = ["kettle", "light_switch"], 2
    episodes = environment.play(Hesitant(), 1, tmp_path, split="validation")
    assert [(e["task"], e["episode"]) for e in episodes] == [
        (task, number) for task in settings.tasks for number in (0, 1)
    ]
    for episode in episodes:
        kitchen = short(episode["task"], start="random")
        seed = environment.start_seeds(1, "validation")[episode["episode"]]
        state, _ = kitchen.reset(seed=seed)
        over, step, done = False, 0, False
        while not over:
            action = 0.3 * state["observation"][:9] * (step > 0)
            state, _, terminated, truncated, info = kitchen.step(action)
            over, step = terminated or truncated, step + 1
            done |= bool(info["task_success"])
        assert (episode["steps"], episode["task_success"]) == (step, done)
        assert episode["success"] == info["success"]
        assert episode["wrong_tasks"] == [
            task
            for task, wrong in zip(KITCHEN_TASKS, info["wrong_tasks"], strict=True)
            if wrong
        ]
        kitchen.close()


def test_episodes_of_different_lengths(steps):
    playing = importlib.import_module("environments.playing")
    lengths, seen = [2, 1, 3], []

    class Counting:
        def __call__(self, tensordict):
            fresh = torch.zeros(3, 1, dtype=torch.int64)
            count = tensordict.get("count", fresh) + 1
            seen.append(tensordict["state"].tolist())
            tensordict["action"] = count.expand(3, 2)
            tensordict["next", "count"] = count
            return tensordict

    taken = [[], [], []]

    def step(number, action):
        taken[number].append(action.tolist())
        played = len(taken[number])
        return {"state": np.array(10 * number + played)}, played == lengths[number]

    states = [{"state": np.array(10 * number)} for number in range(3)]
    playing.play_together(Counting(), states, step)
    assert taken == [[[1, 1], [2, 2]], [[1, 1]], [[1, 1], [2, 2], [3, 3]]]
    assert seen == [[0, 10, 20], [1, 11, 21], [2, 11, 22]]
    assert [state["state"] for state in states] == [0, 10, 20]


def test_measures(environment):
    flags = [("kettle", 1, 1), ("kettle", 0, 1), ("kettle", 0, 0), ("microwave", 1, 1)]
    keys = ("task", "success", "task_success")
    episodes = [dict(zip(keys, flag, strict=True)) for flag in flags]
    assert [tuple(row.values()) for row in environment.measures(episodes)] == [
        ("kettle", "success", 3, 1 / 3),
        ("kettle", "task_success", 3, 2 / 3),
        ("microwave", "success", 1, 1.0),
        ("microwave", "task_success", 1, 1.0),
    ]
    rows = environment.measures(episodes)
    assert set(rows[0]) == {"task", "measure", "episodes", "value"}


def test_offline_rl_learns_from_the_same_data(cfg, steps, compose):
    """A learner is not tied to an environment."""
    td3 = compose("learner=td3", "method=[caiac]", out=cfg.out)
    td3.env.truth = cfg.env.truth
    td3.env.evaluate.episodes = 1
    td3.validation.policies = 1
    learner = steps.train.train(td3, "caiac", seed=11)
    batch = next(learner.batches())
    achieved = KitchenEnv.layout.achieved_goal(batch, next=True)
    reward = learner.environment.reward_fn(achieved, batch["desired_goal"])
    relabeled = batch["hindsight", "relabeled"][:, 0]
    assert relabeled.any()
    assert torch.equal(batch["next", "reward"][relabeled, 0], reward[relabeled])
    *_, evaluation = steps.evaluate.evaluate(td3, "caiac", seed=11)
    assert len(evaluation.episodes) == 1


def test_estimators_are_compared_on_unseen_demonstrations(
    cfg, steps, compose, tmp_path
):
    compared = compose(out=cfg.out, config="compare_influence")
    compared.publish = str(tmp_path)
    with steps.console.Console(tmp_path, stages=4) as console:
        rows = steps.compare_influence.compare(compared, console)
    names = ("caiac", "coda", "coda_action", "distance", "distance_action")
    names += ("motion", "residual", "oracle")
    objects = KitchenEnv.layout.names[1:]
    assert [(r["estimator"], r["entity"]) for r in rows] == [
        (name, entity) for name in names for entity in ("all", *objects)
    ]
    by_name = {(r["estimator"], r["entity"]): r for r in rows}
    assert by_name["oracle", "all"]["false_positive_rate"] == 0
    # The hand opens the microwave at its handle.
    assert by_name["distance_action", "microwave"]["auc"] > 0.9
    assert len((tmp_path / "influence.csv").read_text().splitlines()) == 81


@pytest.mark.parametrize("name", ["kitchen_all_tasks", "kitchen_any_start"])
def test_chains_that_are_collected(name, tmp_path, steps, compose, monkeypatch):
    cfg = compose(f"env={name}", "size=quick")
    assert cfg.out == f"outputs/{name}_quick"
    assert cfg.env.evaluate.tasks == ["kettle", "hinge_cabinet"]
    assert cfg.env.evaluate.start == "random"
    module = importlib.import_module("environments.kitchen")
    asked = []

    def play(dataset_id, **options):
        asked.append((dataset_id, options["orders"], options["episodes"]))
        raise InterruptedError

    monkeypatch.setattr(module, "create_kitchen_play", play)
    cfg.out = str(tmp_path)
    environment = steps.parts.make_environment(cfg)
    with pytest.raises(InterruptedError):
        environment.collect()
    expected = {
        "kitchen_all_tasks": (PLAY_ID, PLAY_ORDERS, 1),
        "kitchen_any_start": (PLAY_ANY_START_ID, PLAY_ANY_START_ORDERS, 1),
    }
    assert asked == [expected[name]]
    cfg.env.collect.chains = "all"
    with pytest.raises(ValueError, match=r"chains is 'all'.*'play_any_start'"):
        environment.collect()


def test_all_tasks(tmp_path, steps, compose, monkeypatch):
    """Chains instead of single tasks, through all the steps."""
    overrides = ["env=kitchen_all_tasks", "method=[none,caiac,oracle]"]
    cfg = compose(*overrides, out=tmp_path)
    cfg.env.collect.episodes = 1
    cfg.env.influence_episode = 0
    cfg.env.frames = ["kettle"]
    environment = steps.parts.make_environment(cfg)
    module = importlib.import_module("environments.kitchen")
    orders = [("kettle", "slide cabinet")]
    monkeypatch.setitem(module.CHAINS, "play", (PLAY_ID, orders, 400))
    steps.collect.collect(cfg)
    data = load_transitions(tmp_path / "demonstrations")
    order = [KITCHEN_TASKS.index(task) for task in ("kettle", "slide_cabinet")]
    assert data["task"].unique_consecutive().tolist() == order
    report = steps.score.score(cfg)
    for task in ("kettle", "slide_cabinet"):
        assert 0 < report["smoothing 1"][task]["influenced"] < 1
    learner = steps.parts.make_learner(cfg, "oracle")
    batch = learner.make_buffer(learner.rows()).sample()
    # 26 of 32 windows in two batches, the ratio being 0.8.
    assert batch["caiac", "counterfactual"].sum() == 260
    starts = []
    reset = KitchenEnv.reset

    def kept(self, **kwargs):
        result = reset(self, **kwargs)
        starts.append(self.qpos)
        return result

    monkeypatch.setattr(KitchenEnv, "reset", kept)
    cfg.env.evaluate.episodes = 1
    # As on a machine with many cores, whatever this process was given.
    monkeypatch.setattr("torchrl._THREAD_POOL_INIT", 64)
    threads = torch.get_num_threads()
    steps.train.train(cfg, "caiac", seed=0)
    (evaluation,) = steps.evaluate.evaluate(cfg, "caiac", seed=0)
    assert len(evaluation.episodes) == 1
    moved = abs(starts[-1] - KitchenEnv.default_state()) > 1e-3
    columns = KitchenEnv.layout.columns
    assert moved[9:].any()
    assert not moved[list(columns["kettle"])].any()
    assert torch.get_num_threads() == threads
    environment.draw(tmp_path, "small", threshold=0.2)
    assert (tmp_path / "small_influence.png").stat().st_size > 10_000
