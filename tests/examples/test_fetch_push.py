from __future__ import annotations

import csv
import importlib
import json
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import fetch_push_reward
from torchrl_caiac.experiments import claim_folder

FOLDER = Path(__file__).parents[2] / "examples" / "fetch_push"
ARMS = ["caiac", "coda", "coda_action", "relabel_only", "none", "oracle"]
SMALL = {
    "collect": {"expert": 3, "random": 7, "held_out": 2, "steps": 40, "workers": 1},
    "world_model": {"steps": 60, "eval_every": 30, "hidden_sizes": [32]},
    "transformer": {"steps": 20, "eval_every": 10, "layers": 1, "width": 16},
    "score": {"num_actions": 8},
    "truth": {"actions": 4, "oracle_actions": 3},
    "train": {
        "steps": 12,
        "batch_size": 64,
        "batches_at_once": 2,
        "hidden_sizes": [16, 16],
        "log_every": 4,
        "checkpoint_every": 6,
        "keep_every": 4,
    },
    "evaluate": {"episodes": 3, "last": 2, "curve_every": 4},
}


@pytest.fixture(scope="module")
def steps():
    """The scripts of the example, as modules."""
    names = ("collect", "fit_world_model", "score", "train", "evaluate", "study")
    names = (*names, "compare_influence", "compare_precision")
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
    cfg.out = str(tmp_path_factory.mktemp("fetch_push"))
    cfg.study.arms = ARMS
    steps["collect"].collect(cfg)
    steps["score"].score(cfg)
    return cfg


def test_rows_are_three_to_seven(cfg, steps):
    rows = steps["collect"].load_rows(cfg)
    assert len(rows) == 400
    assert (rows["source"] == 0).sum() == 120
    assert rows["next", "done"].sum() == 10
    half = cfg.copy()
    half.fraction = 0.5
    steps["collect"].collect(half)
    rows = steps["collect"].load_rows(half)
    # Whole episodes of both kinds: 1 or 2 of 3, 3 or 4 of 7.
    assert len(rows) == 200
    assert (rows["source"] == 0).any()


def test_held_out_episodes_are_other_ones(cfg, steps):
    rows = steps["collect"].load_rows(cfg)
    held_out = load_transitions(Path(cfg.out) / "held_out")
    assert len(held_out) == 80
    gaps = torch.cdist(held_out["desired_goal"], rows["desired_goal"])
    assert gaps.min() > 1e-4


def test_scores_and_their_report(cfg, steps):
    rows = steps["collect"].load_rows(cfg)
    assert rows["caiac", "score"].isfinite().all()
    truth = rows["oracle", "score"]
    assert ((truth == 0) | (truth == 1)).all()
    assert (truth[:, 0] == 1).all()
    expert = rows["source"] == 0
    assert truth[expert][:, 1:].any()
    assert truth[expert][:, 1:].mean() > truth[~expert][:, 1:].mean()
    graph = rows["coda", "graph"]
    assert graph.shape == (400, 4, 3)
    assert (graph.sum(-2) < 1.001).all() and (graph >= 0).all()
    torch.testing.assert_close(rows["coda", "action"], graph[:, -1])
    path = steps["collect"].rows_folder(cfg) / "influence.json"
    report = json.loads(path.read_text())
    assert list(report) == ["smoothing 1", "smoothing 3"]
    assert list(report["smoothing 3"]) == ["gripper", "cube0", "cube1"]


@pytest.mark.parametrize("arm", ARMS)
def test_buffers_of_the_arms(arm, cfg, steps):
    train = steps["train"]
    stored = steps["collect"].load_rows(cfg)
    rows = train.training_rows(stored, arm)
    cfg = cfg.copy()
    # So small a fit pays all tokens about the same attention.
    cfg.coda.threshold = stored["coda", "graph"].quantile(0.9).item()
    torch.manual_seed(0)
    batch = train.make_buffer(rows, cfg, arm).sample(2000)
    achieved = train.LAYOUT.achieved_goal(batch, next=True)
    reward = fetch_push_reward(achieved, batch["desired_goal"])
    assert torch.equal(batch["next", "reward"], reward[:, None])
    relabeled = batch["hindsight", "relabeled"].float().mean().item()
    if arm == "none":
        assert relabeled == pytest.approx(0.75, abs=0.05)
        assert ("caiac", "swapped") not in batch.keys(True)
        return
    assert relabeled == pytest.approx(0.5, abs=0.05)
    assert batch["caiac", "counterfactual"].float().mean() == 0.5
    swapped = batch["caiac", "swapped"]
    assert not swapped[:, 0].any()
    assert swapped.any() == (arm != "relabel_only")
    if arm == "oracle":
        assert not swapped[batch["oracle", "score"] > 0.5].any()
    if arm == "coda_action":
        assert not swapped[batch["coda", "action"] > cfg.coda.threshold].any()
    if arm == "coda":
        assert not swapped[batch["coda", "graph"][:, -1] > cfg.coda.threshold].any()


def test_batches_of_one_sample_are_alike(cfg, steps):
    train = steps["train"]
    rows = train.training_rows(steps["collect"].load_rows(cfg), "caiac")
    torch.manual_seed(0)
    stream = train.batches(train.make_buffer(rows, cfg, "caiac"), at_once=2)
    for batch in (next(stream) for _ in range(4)):
        assert len(batch) == 64
        marks = batch["caiac", "counterfactual"]
        assert not marks[:32].any() and marks[32:].all()
    other = cfg.copy()
    other.train.checkpoint_every = 5
    with pytest.raises(ValueError, match=r"checkpoint_every is 5, wanted a multiple"):
        train.train(other, "caiac", seed=0)


def test_a_killed_training_ends_as_one_that_was_not(cfg, steps, monkeypatch):
    train = steps["train"]
    whole = train.train(cfg, "caiac", seed=3).state_dict()
    policy = train.load_policy(cfg, "caiac", 3, 12).state_dict()
    adam_step, calls = torch.optim.Adam.step, []

    def killed(self, *args, **kwargs):
        calls.append(None)
        if len(calls) == 13:  # in step 9: a policy step follows every second one
            raise KeyboardInterrupt
        return adam_step(self, *args, **kwargs)

    monkeypatch.setattr(
        train, "run_folder", lambda cfg, arm, seed: Path(cfg.out) / "runs" / "killed"
    )
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(torch.optim.Adam, "step", killed)
        train.train(cfg, "caiac", seed=3)
    # More steps than before are no other settings.
    shorter = cfg.copy()
    shorter.train.steps = 10
    train.train(shorter, "caiac", seed=3)
    resumed = train.train(cfg, "caiac", seed=3).state_dict()
    assert resumed.keys() == whole.keys()
    for key, value in whole.items():
        torch.testing.assert_close(resumed[key], value, rtol=0, atol=0)
    kept = train.load_policy(cfg, "caiac", 3, 12).state_dict()
    for key, value in policy.items():
        torch.testing.assert_close(kept[key], value, rtol=0, atol=0)
    # Means over the steps since the last log, or since going on at step 6.
    (path,) = (Path(cfg.out) / "runs" / "killed").rglob("share_relabeled.csv")
    logged = [line.split(",") for line in path.read_text().split()]
    assert [int(step) for step, _ in logged] == [4, 8, 8, 12]
    for _, mean in logged:
        assert float(mean) == pytest.approx(0.5, abs=0.2)


def test_kept_policies_are_those_of_the_loss(cfg, steps):
    train = steps["train"]
    loss_module = train.train(cfg, "none", seed=5)
    actor = train.load_policy(cfg, "none", 5, 12)
    rows = steps["collect"].load_rows(cfg)[:7].select("observation", "desired_goal")
    with (
        torch.no_grad(),
        loss_module.actor_network_params.to_module(loss_module.actor_network),
    ):
        expected = loss_module.actor_network(rows.clone())["action"]
    with torch.no_grad():
        assert torch.equal(actor(rows.clone())["action"], expected)
    earlier = train.load_policy(cfg, "none", 5, 4)
    with torch.no_grad():
        assert not torch.equal(earlier(rows.clone())["action"], expected)


@pytest.mark.parametrize("content", [None, b"", b"PK foreign"])
def test_truncated_files_are_refused(content, cfg, steps):
    train = steps["train"]
    train.train(cfg, "none", seed=7)
    path = train.run_folder(cfg, "none", 7) / "checkpoint.zip"
    policy = train.policy_file(cfg, "none", 7, 12)
    for file, act, message in (
        (
            path,
            lambda: train.train(cfg, "none", 7),
            r"checkpoint\.zip is not a readable",
        ),
        (policy, lambda: train.load_policy(cfg, "none", 7, 12), "no readable policy"),
    ):
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2] if content is None else content)
        with pytest.raises(ValueError, match=message):
            act()
        file.write_bytes(whole)
        act()


def test_other_settings_are_not_mixed(cfg, steps):
    steps["train"].train(cfg, "none", seed=0)
    other = cfg.copy()
    other.train.lr = 1.0
    with pytest.raises(ValueError, match=r"other settings.*\['lr'\] differ"):
        steps["train"].train(other, "none", seed=0)
    other = cfg.copy()
    other.truth.threshold = 0.01
    with pytest.raises(ValueError, match=r"other settings.*truth\.json"):
        steps["score"].score(other)


def test_the_study(cfg, steps, tmp_path, monkeypatch):
    study = steps["study"]
    cfg = cfg.copy()
    cfg.study.arms, cfg.study.seeds = ["caiac", "none"], [0, 1]
    cfg.study.publish = str(tmp_path / "published")

    def one_after_the_other(function, jobs, *, processes):
        assert processes == cfg.study.processes
        for number in reversed(range(len(jobs))):
            yield number, function(*jobs[number])

    monkeypatch.setattr(study, "run_side_by_side", one_after_the_other)
    table = study.run_study(cfg)
    names = ("success.png", "curves_1.png")
    names = ("fetch_push.csv", "fetch_push.txt", *(f"fetch_push_{n}" for n in names))
    for name in names:
        content = (Path(cfg.out) / name).read_bytes()
        assert (tmp_path / "published" / name).read_bytes() == content
    assert (Path(cfg.out) / "fetch_push.txt").read_text() == table
    assert "mean of the policies from step 8 to 12" in table
    with (Path(cfg.out) / "fetch_push.csv").open() as file:
        results = list(csv.DictReader(file))
    assert list(results[0]) == [
        *("fraction", "arm", "seed", "step"),
        *("full", "cube0", "cube1", "final"),
    ]
    # In the order of the jobs, whatever their order of finishing.
    assert [(r["seed"], r["arm"], r["step"]) for r in results] == [
        (seed, arm, step)
        for seed in "01"
        for arm in ("caiac", "none")
        for step in ("4", "8", "12")
    ]
    for result in results:
        full, *cubes = (float(result[k]) for k in ("full", "cube0", "cube1"))
        assert float(result["final"]) <= full <= min(cubes)
    # Played once; from then on read.
    monkeypatch.setattr(steps["evaluate"], "play", None)
    again = steps["evaluate"].evaluate(cfg, "none", 1)
    assert [f"{r['full']}" for r in again] == [r["full"] for r in results[-3:]]
    other = cfg.copy()
    other.evaluate.seed = 5
    with pytest.raises(ValueError, match="other settings"):
        steps["evaluate"].evaluate(other, "none", 1)


def test_estimators_are_compared_on_unseen_episodes(cfg, steps, tmp_path):
    cfg = cfg.copy()
    cfg.study.influence = str(tmp_path)
    rows = steps["compare_influence"].compare(cfg)
    names = ("caiac", "coda", "coda_action", "distance", "distance_action", "oracle")
    assert [(r["estimator"], r["entity"]) for r in rows] == [
        (name, entity) for name in names for entity in ("all", "cube0", "cube1")
    ]
    totals = {r["estimator"]: r for r in rows if r["entity"] == "all"}
    # It asks about fewer of the same actions than the truth.
    assert totals["oracle"]["false_positive_rate"] == 0
    assert totals["oracle"]["rows_swapped"] > 0.9
    assert totals["coda"]["auc"] == pytest.approx(totals["coda_action"]["auc"])
    for name in ("caiac", "coda", "coda_action"):
        assert totals[name]["fit_seconds"] > 0
    assert len((tmp_path / "influence.csv").read_text().splitlines()) == 19
    held_out = load_transitions(Path(cfg.out) / "held_out")
    assert held_out.get("score", None) is None


def test_a_run_that_another_process_has_begun(cfg, steps):
    with (
        claim_folder(steps["train"].run_folder(cfg, "none", 9)),
        pytest.raises(RuntimeError, match=r"another process works in .*none-seed9"),
    ):
        steps["study"].run(cfg, "none", 9)


def test_policies_that_are_evaluated(cfg, steps):
    policy_steps = steps["evaluate"].policy_steps
    assert policy_steps(cfg) == [4, 8, 12]
    full = OmegaConf.load(FOLDER / "config.yaml")
    assert policy_steps(full) == [
        *(12_000, 24_000, 36_000, 44_000, 48_000, 52_000, 56_000, 60_000)
    ]
    full.train.steps = 3000
    with pytest.raises(ValueError, match=r"train\.steps is 3000, wanted at least"):
        policy_steps(full)


def test_starts_are_shared_and_fresh(cfg, steps):
    train, evaluate = steps["train"], steps["evaluate"]
    train.train(cfg, "none", seed=0)
    actor = train.load_policy(cfg, "none", 0, 12)
    asked = []

    class Recorder:
        in_keys = actor.in_keys

        def __call__(self, td):
            asked.append(td.clone())
            return actor(td)

    for _ in range(2):
        evaluate.play(Recorder(), episodes=3, steps=1, seed=cfg.evaluate.seed)
    first, second = asked
    assert torch.equal(first["observation"], second["observation"])
    rows = steps["collect"].load_rows(cfg)
    assert torch.cdist(first["desired_goal"], rows["desired_goal"]).min() > 1e-4


def test_precisions_are_compared_over_the_steps_that_all_seeds_have(steps, tmp_path):
    rows = [(1, 20, 0.5), (0, 10, 0.1), (0, 20, 0.2), (1, 10, 0.3)]
    table = ["fraction,arm,seed,step,full"]
    table += [f"1.0,caiac,{seed},{step},{full}" for seed, step, full in rows]
    for name in ("a", "b"):
        (tmp_path / f"fetch_push_{name}.csv").write_text("\n".join(table))
    read_curves = steps["compare_precision"].read_curves
    curves = read_curves(tmp_path / "fetch_push_a.csv")
    assert curves == ([10, 20], [[0.1, 0.2], [0.3, 0.5]])
    steps["compare_precision"].main(["--results", str(tmp_path), "--names", "a", "b"])
    assert (tmp_path / "fetch_push_precision.png").stat().st_size > 10_000
    (tmp_path / "fetch_push_a.csv").write_text("\n".join(table[:-1]))
    with pytest.raises(ValueError, match=r"lacks steps of the seeds \[1\]"):
        read_curves(tmp_path / "fetch_push_a.csv")
