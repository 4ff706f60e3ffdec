from __future__ import annotations

import functools
import importlib
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import hydra
import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KITCHEN_TASKS, KitchenEnv, create_kitchen_play

FOLDER = Path(__file__).parents[2] / "examples" / "franka_kitchen"
ARMS = ["none", "caiac", "coda", "coda_action", "oracle"]
SMALL = {
    "collect": {"episodes": 2, "held_out": 1, "workers": 1},
    "world_model": {"steps": 60, "eval_every": 30, "hidden_sizes": [32]},
    "transformer": {"steps": 10, "eval_every": 5, "layers": 1, "width": 16},
    "score": {"truth_actions": 2, "oracle_actions": 2, "num_actions": 8},
    "train": {
        "steps": 12,
        "windows": 16,
        "hidden_size": 16,
        "checkpoint_every": 6,
        "log_every": 6,
    },
    "evaluate": {"episodes": 2, "tasks": ["kettle"]},
}


@pytest.fixture(scope="module")
def steps():
    """The scripts of the example, as modules."""
    names = ("collect", "fit_world_model", "score", "train", "evaluate", "demo")
    names = (*names, "compare_influence")
    before = set(sys.modules)
    sys.path.insert(0, str(FOLDER))
    yield {name: importlib.import_module(name) for name in names}
    sys.path.remove(str(FOLDER))
    for name in set(sys.modules) - before & set(names):
        del sys.modules[name]


@pytest.fixture(scope="module")
def cfg(steps, tmp_path_factory):
    """A small run up to the scores."""
    cfg = OmegaConf.merge(OmegaConf.load(FOLDER / "config.yaml"), SMALL)
    cfg.out = str(tmp_path_factory.mktemp("kitchen"))
    cfg.demo.arms = ARMS
    cfg.evaluate.strips = 0
    steps["collect"].collect(cfg)
    steps["score"].score(cfg)
    return cfg


def test_cabinet_and_task_go_together_in_the_demonstrations(cfg):
    data = load_transitions(Path(cfg.out) / "demonstrations")
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


def test_random_actions_are_as_many_rows(cfg):
    data = load_transitions(Path(cfg.out) / "random")
    demonstrations = load_transitions(Path(cfg.out) / "demonstrations")
    assert abs(len(data) - len(demonstrations)) < 4
    assert data["action"].abs().max() <= 1


def test_scores_and_their_report(cfg):
    data = load_transitions(Path(cfg.out) / "demonstrations")
    assert data["caiac", "score"].isfinite().all()
    report = json.loads((Path(cfg.out) / "influence.json").read_text())
    assert list(report) == list(KitchenEnv.layout.names)
    truth = torch.load(Path(cfg.out) / "truth.pt", weights_only=True)
    cabinet = KitchenEnv.layout.index("slide_cabinet")
    assert truth.shape == data["caiac", "score"].shape
    # The oracle's score: whether the action moves the entity now or later on.
    for episode in data["episode"].unique():
        rows = data["episode"] == episode
        later = truth[rows].flip(0).cummax(0).values.flip(0)
        assert torch.equal(data["oracle", "score"][rows].bool(), later)
    assert not truth[:, cabinet].any()
    assert truth[:, KitchenEnv.layout.index("microwave")].any()


@pytest.mark.parametrize("arm", ARMS)
def test_buffers_of_the_arms(arm, cfg, steps):
    data = load_transitions(Path(cfg.out) / "demonstrations")
    batch = steps["train"].make_buffer(data, cfg, arm).sample()
    assert batch["desired_goal"].shape == (160, 21)
    if arm == "none":
        assert ("caiac", "swapped") not in batch.keys(True)
    else:
        assert batch["caiac", "counterfactual"].float().mean() == 0.5
    if arm == "coda":
        assert batch["coda", "graph"].shape == (160, 11, 10)
    if arm == "coda_action":
        held = batch["coda", "action"] > cfg.coda.threshold
        held = held.unflatten(0, (-1, cfg.train.window)).any(1)
        swapped = batch["caiac", "swapped"][:: cfg.train.window]
        assert not (swapped & held).any()


def test_a_killed_training_ends_as_one_that_was_not(cfg, steps, monkeypatch):
    train = steps["train"]
    whole = train.train(cfg, "caiac", seed=3).state_dict()
    adam_step, calls = torch.optim.Adam.step, []

    def killed(self, *args, **kwargs):
        calls.append(None)
        if len(calls) == 9:
            raise KeyboardInterrupt
        return adam_step(self, *args, **kwargs)

    other = cfg.copy()
    monkeypatch.setattr(
        train, "run_folder", lambda cfg, arm, seed: Path(cfg.out) / "runs" / "killed"
    )
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(torch.optim.Adam, "step", killed)
        train.train(other, "caiac", seed=3)
    resumed = train.train(other, "caiac", seed=3).state_dict()
    for key, value in whole.items():
        torch.testing.assert_close(resumed[key], value, rtol=0, atol=0)


@pytest.mark.parametrize("content", [None, b"", b"PK foreign"])
def test_a_truncated_checkpoint_is_refused(content, cfg, steps):
    train = steps["train"]
    train.train(cfg, "none", seed=7)
    path = train.run_folder(cfg, "none", 7) / "checkpoint.zip"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(ValueError, match=r"\.zip is not a readable checkpoint"):
        train.train(cfg, "none", seed=7)
    path.write_bytes(whole)
    train.train(cfg, "none", seed=7)


def test_other_settings_are_not_mixed(cfg, steps):
    steps["train"].train(cfg, "none", seed=0)
    other = cfg.copy()
    other.train.lr = 1.0
    with pytest.raises(ValueError, match="other settings"):
        steps["train"].train(other, "none", seed=0)


def test_evaluation(cfg, steps):
    results = steps["evaluate"].evaluate(cfg, "none", seed=0)
    assert [result["episode"] for result in results] == [0, 1]
    written = steps["train"].run_folder(cfg, "none", 0) / "evaluation.json"
    kept = json.loads(written.read_text())
    assert kept["results"] == results
    # It is not played again, unless something else is asked for.
    kept["results"] = ["kept"]
    written.write_text(json.dumps(kept))
    assert steps["evaluate"].evaluate(cfg, "none", seed=0) == ["kept"]
    other = cfg.copy()
    other.evaluate.episodes = 1
    assert len(steps["evaluate"].evaluate(other, "none", seed=0)) == 1
    for result in results:
        assert result["success"] or result["steps"] == 280
        assert "kettle" not in result["wrong_tasks"]


def test_truth_between_the_rows_that_were_asked_about(tmp_path, steps, monkeypatch):
    """Against every row looked at on its own, trajectories of all lengths around 4."""
    generator = torch.Generator().manual_seed(0)
    lengths = torch.tensor([9, 1, 4, 5, 2, 8])
    episode = torch.arange(6).repeat_interleave(lengths)
    state = torch.arange(len(episode), dtype=torch.float64)
    data = TensorDict(
        {
            "episode": episode,
            "sim": {"qpos": state.unsqueeze(-1), "qvel": state.unsqueeze(-1)},
        },
        [len(episode)],
    )
    entities = len(KitchenEnv.layout)
    whole = torch.rand(len(data), entities, generator=generator) < 0.3
    asked = []

    def simulator(env, states, **_):
        asked.append(states[:, 0].long())
        return SimpleNamespace(influenced=whole[asked[-1]])

    monkeypatch.setattr(steps["score"], "true_influence", simulator)
    cfg = OmegaConf.create({"collect": {"workers": 1}})
    first = 0
    wanted, rows = [], []
    for length in lengths.tolist():
        for step in range(length):
            left = step - step % 4
            around = {left, left + 4 if step % 4 and left + 4 < length else left}
            wanted.append(whole[[first + place for place in around]].any(0))
        rows += range(first, first + length, 4)
        first += length
    truth = steps["score"].simulator_truth(data, tmp_path / "four.pt", cfg, 2, 4)
    assert asked[0].tolist() == rows
    assert torch.equal(truth, torch.stack(wanted))
    truth = steps["score"].simulator_truth(data, tmp_path / "one.pt", cfg, 2)
    assert torch.equal(truth, whole)


def test_estimators_are_compared_on_unseen_demonstrations(cfg, steps, tmp_path):
    cfg = cfg.copy()
    cfg.demo.influence = str(tmp_path)
    rows = steps["compare_influence"].compare(cfg)
    names = ("caiac", "coda", "coda_action", "distance", "distance_action", "oracle")
    objects = KitchenEnv.layout.names[1:]
    assert [(r["estimator"], r["entity"]) for r in rows] == [
        (name, entity) for name in names for entity in ("all", *objects)
    ]
    by_name = {(r["estimator"], r["entity"]): r for r in rows}
    assert by_name["oracle", "all"]["false_positive_rate"] == 0
    # The hand opens the microwave at its handle.
    assert by_name["distance_action", "microwave"]["auc"] > 0.9
    assert len((tmp_path / "influence.csv").read_text().splitlines()) == 61


def test_all_tasks(tmp_path, steps, monkeypatch):
    """Chains instead of single tasks, through all the steps."""
    with hydra.initialize_config_dir(str(FOLDER), version_base=None):
        cfg = hydra.compose("config", ["experiment=all_tasks"])
    assert cfg.train.window == 10
    assert set(cfg.evaluate.tasks) == set(KITCHEN_TASKS)
    cfg = OmegaConf.merge(cfg, SMALL)
    cfg.out = str(tmp_path)
    cfg.collect.episodes = 1
    cfg.demo.influence_episode = 0
    play = functools.partial(create_kitchen_play, orders=[("kettle", "slide cabinet")])
    monkeypatch.setattr(steps["collect"], "create_kitchen_play", play)
    steps["collect"].collect(cfg)
    data = load_transitions(tmp_path / "demonstrations")
    order = [KITCHEN_TASKS.index(task) for task in ("kettle", "slide_cabinet")]
    assert data["task"].unique_consecutive().tolist() == order
    report = steps["score"].score(cfg)
    for task in ("kettle", "slide_cabinet"):
        assert 0 < report[task]["influenced"] < 1
    scored = load_transitions(tmp_path / "demonstrations")
    batch = steps["train"].make_buffer(scored, cfg, "oracle").sample()
    # 13 of 16 windows, the ratio being 0.8.
    assert batch["caiac", "counterfactual"].sum() == 130
    starts = []
    reset = KitchenEnv.reset

    def kept(self, **kwargs):
        result = reset(self, **kwargs)
        starts.append(self.qpos)
        return result

    monkeypatch.setattr(KitchenEnv, "reset", kept)
    cfg.evaluate.episodes = 1
    # As on a machine with many cores, whatever this process was given.
    monkeypatch.setattr("torchrl._THREAD_POOL_INIT", 64)
    threads = torch.get_num_threads()
    results = steps["evaluate"].evaluate(cfg, "caiac", seed=0)
    moved = abs(starts[-1] - KitchenEnv.default_state()) > 1e-3
    columns = KitchenEnv.layout.columns
    assert moved[9:].any()
    assert not moved[list(columns["kettle"])].any()
    assert torch.get_num_threads() == threads
    cfg.demo.arms = ["caiac"]
    table = steps["demo"].report_table(cfg, report, 0.5, results, {"collect": 1.0})
    assert "caiac        kettle" in table
    steps["demo"].draw_influence(cfg, tmp_path / "influence.png")
    assert (tmp_path / "influence.png").stat().st_size > 10_000
