from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KITCHEN_TASKS, KitchenEnv

FOLDER = Path(__file__).parents[2] / "examples" / "franka_kitchen"
SMALL = {
    "collect": {"episodes": 2, "held_out": 1, "workers": 1},
    "world_model": {"steps": 60, "eval_every": 30, "hidden_sizes": [32]},
    "score": {"truth_actions": 2, "num_actions": 8},
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
    names = ("settings", "collect", "fit_world_model", "score", "train", "evaluate")
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
    cfg.arm = "oracle"
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


@pytest.mark.parametrize("arm", ["none", "caiac", "oracle"])
def test_buffers_of_the_arms(arm, cfg, steps):
    data = load_transitions(Path(cfg.out) / "demonstrations")
    batch = steps["train"].make_buffer(data, cfg, arm).sample()
    assert batch["desired_goal"].shape == (160, 21)
    if arm == "none":
        assert ("caiac", "swapped") not in batch.keys(True)
    else:
        assert batch["caiac", "counterfactual"].float().mean() == 0.5


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
    with pytest.raises(ValueError, match=r"checkpoint\.zip is no readable checkpoint"):
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
    assert json.loads(written.read_text()) == results
    for result in results:
        assert result["success"] or result["steps"] == 280
        assert "kettle" not in result["wrong_tasks"]
