from __future__ import annotations

import json
import os
import pickle
from functools import partial

import pytest
import torch
from omegaconf import OmegaConf

from torchrl_caiac.envs import fetch_push_reward

METHODS = ["caiac", "coda", "coda_action", "relabel_only", "none", "oracle"]


@pytest.fixture(scope="module")
def cfg(steps, compose, tmp_path_factory):
    """A small run up to the scores."""
    cfg = compose(
        *("env=fetch_push", "learner=td3"),
        f"method=[{','.join(METHODS)}]",
        out=tmp_path_factory.mktemp("fetch_push"),
    )
    steps.collect.collect(cfg)
    steps.score.score(cfg)
    return cfg


@pytest.fixture(scope="module")
def environment(steps, cfg):
    return steps.parts.make_environment(cfg)


def test_rows_are_three_to_seven(cfg, environment, steps):
    rows = environment.rows()
    assert len(rows) == 1000
    assert (rows["source"] == 0).sum() == 300
    assert rows["next", "done"].sum() == 10
    # The demonstrations end at their first success.
    demonstrations = environment.demonstrations()
    assert (demonstrations["next", "reward"] == 0).sum() == 3
    assert demonstrations["next", "done"].sum() == 3
    fewer = cfg.copy()
    fewer.env.demonstrations = 1
    steps.collect.collect(fewer)
    rows = steps.parts.make_environment(fewer).rows()
    assert len(rows) == 300
    assert (rows["source"] == 0).sum() == 100


def test_demonstrations_of_other_data_are_refused(cfg, environment, monkeypatch):
    digest = f"{type(environment).__module__}.data_digest"
    monkeypatch.setattr(digest, lambda folder: "another")
    with pytest.raises(ValueError, match="expert"):
        environment.collect()


@pytest.mark.parametrize("seeds", [(5, 5), (5, 6), (6, 5)])
def test_splits_have_no_start_in_common(seeds, cfg, steps):
    cfg = cfg.copy()
    cfg.env.evaluate.seed, cfg.env.evaluate.validation_seed = seeds
    cfg.env.evaluate.episodes = cfg.env.evaluate.validation_episodes = 2
    environment = steps.parts.make_environment(cfg)
    with pytest.raises(ValueError, match="change validation_seed"):
        environment.play(None, 0, None, split="test")


def test_held_out_episodes_are_other_ones(environment):
    rows, held_out = environment.rows(), environment.held_out()
    assert len(held_out) == 200
    gaps = torch.cdist(held_out["desired_goal"], rows["desired_goal"])
    assert gaps.min() > 1e-4


def test_scores_and_their_report(environment):
    rows = environment.rows()
    assert rows["caiac", "score"].isfinite().all()
    truth = rows["oracle", "score"]
    assert ((truth == 0) | (truth == 1)).all()
    assert (truth[:, 0] == 1).all()
    expert = rows["source"] == 0
    assert truth[expert][:, 1:].any()
    assert truth[expert][:, 1:].mean() > truth[~expert][:, 1:].mean()
    graph = rows["coda", "graph"]
    assert graph.shape == (1000, 4, 3)
    assert (graph.sum(-2) < 1.001).all() and (graph >= 0).all()
    torch.testing.assert_close(rows["coda", "action"], graph[:, -1])
    report = json.loads((environment.folder / "influence.json").read_text())
    assert list(report) == ["smoothing 1", "smoothing 3"]
    assert list(report["smoothing 3"]) == ["gripper", "cube0", "cube1"]


@pytest.mark.parametrize("method", METHODS)
def test_buffers_of_the_methods(method, cfg, environment, steps):
    cfg = cfg.copy()
    # So small a fit pays all tokens about the same attention.
    threshold = environment.rows()["coda", "graph"].quantile(0.9).item()
    cfg.env.augmentation.attention_threshold = threshold
    learner = steps.parts.make_learner(cfg, method)
    torch.manual_seed(0)
    batch = learner.make_buffer(learner.rows()).sample(2000)
    achieved = environment.layout.achieved_goal(batch, next=True)
    reward = fetch_push_reward(achieved, batch["desired_goal"])
    assert torch.equal(batch["next", "reward"], reward[:, None])
    relabeled = batch["hindsight", "relabeled"].float().mean().item()
    if method == "none":
        assert relabeled == pytest.approx(0.75, abs=0.05)
        assert ("caiac", "swapped") not in batch.keys(True)
        return
    assert relabeled == pytest.approx(0.5, abs=0.05)
    assert batch["caiac", "counterfactual"].float().mean() == 0.5
    swapped = batch["caiac", "swapped"]
    assert not swapped[:, 0].any()
    assert swapped.any() == (method != "relabel_only")
    if method == "oracle":
        assert not swapped[batch["oracle", "score"] > 0.5].any()
    if method == "coda_action":
        assert not swapped[batch["coda", "action"] > threshold].any()
    if method == "coda":
        assert not swapped[batch["coda", "graph"][:, -1] > threshold].any()


def test_batches_of_one_sample_are_alike(cfg, steps):
    learner = steps.parts.make_learner(cfg, "caiac")
    learner.setup(learner.rows(), seed=0)
    stream = learner.batches()
    for batch in (next(stream) for _ in range(4)):
        assert len(batch) == 64
        flags = batch["caiac", "counterfactual"]
        assert not flags[:32].any() and flags[32:].all()
    other = cfg.copy()
    other.learner.checkpoint_every = 5
    with pytest.raises(ValueError, match=r"checkpoint_every is 5, expected a multiple"):
        steps.train.train(other, "caiac", seed=0)
    other.learner.batches_at_once = 0
    with pytest.raises(
        ValueError, match=r"batches_at_once is 0, but it should be .* 1"
    ):
        steps.train.train(other, "caiac", seed=0)


def test_an_interrupted_training_ends_as_one_that_was_not(cfg, steps, monkeypatch):
    train, parts = steps.train, steps.parts
    whole = train.train(cfg, "caiac", seed=3).loss_module.state_dict()
    policy = train.load_policy(cfg, "caiac", 3, 12).state_dict()
    adam_step, calls = torch.optim.Adam.step, []

    def interrupted(self, *args, **kwargs):
        calls.append(None)
        if len(calls) == 13:  # in step 9: a policy step follows every second one
            raise KeyboardInterrupt
        return adam_step(self, *args, **kwargs)

    folder = parts.run_folder(cfg, "caiac", 3)
    folder.rename(folder.with_name("whole"))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(torch.optim.Adam, "step", interrupted)
        train.train(cfg, "caiac", seed=3)
    # More steps than before are no other settings.
    shorter = cfg.copy()
    shorter.learner.steps = 10
    train.train(shorter, "caiac", seed=3)
    resumed = train.train(cfg, "caiac", seed=3).loss_module.state_dict()
    assert resumed.keys() == whole.keys()
    for key, value in whole.items():
        torch.testing.assert_close(resumed[key], value, rtol=0, atol=0)
    kept = train.load_policy(cfg, "caiac", 3, 12).state_dict()
    for key, value in policy.items():
        torch.testing.assert_close(kept[key], value, rtol=0, atol=0)
    # The log too, byte for byte.
    files = list((folder / "log").rglob("*.csv"))
    assert len(files) > 4
    for file in files:
        there = folder.with_name("whole") / file.relative_to(folder)
        assert file.read_text() == there.read_text()
        lines = [line.split(",")[0] for line in file.read_text().split()]
        assert lines == ["4", "8", "12"]


def test_kept_policies_are_those_of_the_loss(cfg, environment, steps):
    loss_module = steps.train.train(cfg, "none", seed=5).loss_module
    actor = steps.train.load_policy(cfg, "none", 5, 12)
    rows = environment.rows()[:7].select("observation", "desired_goal")
    with (
        torch.no_grad(),
        loss_module.actor_network_params.to_module(loss_module.actor_network),
    ):
        expected = loss_module.actor_network(rows.clone())["action"]
    with torch.no_grad():
        assert torch.equal(actor(rows.clone())["action"], expected)
    earlier = steps.train.load_policy(cfg, "none", 5, 4)
    with torch.no_grad():
        assert not torch.equal(earlier(rows.clone())["action"], expected)


@pytest.mark.parametrize("content", [None, b"", b"PK foreign"])
def test_truncated_files_are_refused(content, cfg, steps):
    train, parts = steps.train, steps.parts
    train.train(cfg, "none", seed=7)
    path = parts.run_folder(cfg, "none", 7) / "checkpoint.zip"
    policy = parts.policy_file(cfg, "none", 7, 12)
    for file, act, message in (
        (
            path,
            lambda: train.train(cfg, "none", 7),
            r"\.zip is not a readable",
        ),
        (
            policy,
            lambda: train.load_policy(cfg, "none", 7, 12),
            "not a readable policy",
        ),
    ):
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2] if content is None else content)
        with pytest.raises(ValueError, match=message):
            act()
        file.write_bytes(whole)
        act()


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder):
        self.folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self.folder,)


def test_no_file_of_a_run_can_run_code(cfg, environment, steps, tmp_path):
    steps.train.train(cfg, "none", seed=8)
    steps.evaluate.evaluate(cfg, "none", 8)
    folder = steps.parts.run_folder(cfg, "none", 8)
    for name, act in (
        ("checkpoint.zip", steps.train.train),
        ("policies/8.pt", partial(steps.train.load_policy, step=8)),
        ("train.json", steps.evaluate.evaluate),
        ("evaluation/validation-8.json", steps.evaluate.evaluate),
    ):
        file = folder / name
        whole = file.read_bytes()
        torch.save({"a": Payload(tmp_path / "marker")}, file)
        if file.suffix == ".json":
            file.write_bytes(pickle.dumps(Payload(tmp_path / "marker")))
        with pytest.raises(ValueError, match=file.name):
            act(cfg, "none", seed=8)
        assert not (tmp_path / "marker").exists()
        file.write_bytes(whole)
        act(cfg, "none", seed=8)


def test_other_settings_are_not_mixed(cfg, steps):
    steps.train.train(cfg, "caiac", seed=1)
    for change, name in (
        ({"learner": {"lr": 1.0}}, r"\['lr'\]"),
        ({"env": {"augmentation": {"threshold": 0.1}}}, "augmentation.threshold"),
        ({"method": {"caiac": {"threshold": 0.1}}}, "method.threshold"),
    ):
        other = OmegaConf.merge(cfg, change)
        with pytest.raises(ValueError, match=f"other settings.*{name}.* differ"):
            steps.train.train(other, "caiac", seed=1)
        with pytest.raises(ValueError, match=f"other settings.*{name}.* differ"):
            steps.train.load_policy(other, "caiac", 1, 12)
        with pytest.raises(ValueError, match=f"other settings.*{name}.* differ"):
            steps.evaluate.evaluate(other, "caiac", 1)
    other = cfg.copy()
    other.env.truth.actions = 5
    with pytest.raises(ValueError, match=r"other settings.*truth\.json"):
        steps.score.score(other)


@pytest.mark.parametrize(
    ("key", "name"),
    [
        ("observation", r"data\.(0\.)?observation"),
        (("caiac", "score"), r"data\.caiac\.score"),
    ],
)
def test_other_data_are_not_mixed(key, name, cfg, environment, steps):
    steps.train.train(cfg, "caiac", seed=12)
    steps.train.train(cfg, "caiac", seed=12)
    value = environment.rows()[key][7, 1:2]
    before = value.clone()
    value += 0.25
    others = [(steps.train.train, (cfg, "caiac", 12))]
    others.append((steps.train.load_policy, (cfg, "caiac", 12, 12)))
    others.append((steps.evaluate.evaluate, (cfg, "caiac", 12)))
    if key == "observation":
        others.append((steps.fit.fit_model, (cfg, "world_model")))
        others.append((steps.score.score, (cfg,)))
    try:
        for step, args in others:
            with pytest.raises(ValueError, match=rf"other settings.*{name}"):
                step(*args)
        if key == "observation":
            return
        # The scores of another method are no part of the data of this one.
        steps.train.train(cfg, "oracle", seed=12)
    finally:
        value.copy_(before)
    steps.train.train(cfg, "caiac", seed=12)


def test_another_policy_is_not_taken_for_the_one_that_played(cfg, steps):
    steps.train.train(cfg, "none", seed=13)
    steps.evaluate.evaluate(cfg, "none", 13)
    policy = steps.parts.policy_file(cfg, "none", 13, 8)
    policy.write_bytes(steps.parts.policy_file(cfg, "none", 13, 12).read_bytes())
    with pytest.raises(ValueError, match=r"policy-8\.json.*sha256"):
        steps.evaluate.evaluate(cfg, "none", 13)


def test_rows_mixed_from_other_episodes_are_refused(cfg, environment, steps):
    file = environment.out / "random" / "digests.json"
    content = file.read_text()
    digest = json.loads(content)["sha256"]["action.memmap"]
    file.write_text(content.replace(digest, digest[::-1]))
    try:
        with pytest.raises(ValueError, match=r"rows was mixed from other data"):
            steps.collect.collect(cfg)
    finally:
        file.write_text(content)


def test_motor_plans_learn_from_the_same_data(cfg, steps, compose):
    """A learner is not tied to an environment."""
    lmp = compose("env=fetch_push", "learner=lmp", "method=[caiac]", out=cfg.out)
    steps.score.score(lmp)
    steps.train.train(lmp, "caiac", seed=11)
    (evaluation,) = steps.evaluate.evaluate(lmp, "caiac", seed=11)
    assert evaluation.step == 12
    assert len(evaluation.episodes) == 3


def test_estimators_are_compared_on_unseen_episodes(
    cfg, environment, steps, compose, tmp_path
):
    compared = compose("env=fetch_push", out=cfg.out, config="compare_influence")
    compared.publish = str(tmp_path)
    steps.fit.fit(compared)
    with steps.console.Console(tmp_path, stages=4) as console:
        rows = steps.compare_influence.compare(compared, console)
    names = ("caiac", "coda", "coda_action", "distance", "distance_action")
    names += ("motion", "residual", "oracle")
    assert [(r["estimator"], r["entity"]) for r in rows] == [
        (name, entity) for name in names for entity in ("all", "cube0", "cube1")
    ]
    totals = {r["estimator"]: r for r in rows if r["entity"] == "all"}
    assert [totals[name]["threshold"] for name in names] == [
        *(0.05, 0.2, 0.2, 0.5, 0.5, 0.5, 0.5, 0.5)
    ]
    # It simulates fewer of the same actions than the ground truth.
    assert totals["oracle"]["false_positive_rate"] == 0
    assert totals["oracle"]["rows_swapped"] > 0.9
    assert totals["coda"]["auc"] == pytest.approx(totals["coda_action"]["auc"])
    for name in ("caiac", "coda", "coda_action", "residual"):
        assert totals[name]["fit_seconds"] > 0
    assert len((tmp_path / "influence.csv").read_text().splitlines()) == 25
    assert environment.held_out().get("score", None) is None


def test_suggested_thresholds_are_compared_with_the_best(
    cfg, environment, steps, compose, tmp_path
):
    compared = compose("env=fetch_push", out=cfg.out, config="suggest_thresholds")
    compared.publish = str(tmp_path)
    with steps.console.Console(tmp_path, stages=4) as console:
        rows = steps.suggest_thresholds.compare(compared, console)
    assert {(r["estimator"], r["entity"]) for r in rows} >= {
        ("caiac", "cube0"),
        ("caiac", "cube1"),
    }
    for row in rows:
        if row["confidence"] == "two clear modes":
            assert row["loss"] >= 0
    assert len((tmp_path / "thresholds.csv").read_text().splitlines()) == 1 + len(rows)
    assert environment.held_out().get("suggested", None) is None


def test_policies_that_are_compared(cfg, steps, compose):
    candidates = steps.parts.candidates
    assert candidates(cfg) == [4, 8, 12]
    cfg = cfg.copy()
    for number, found in ((1, [12]), (2, [8, 12]), (5, [4, 8, 12]), (None, [4, 8, 12])):
        cfg.validation.policies = number
        assert candidates(cfg) == found
    assert candidates(compose("env=kitchen", "learner=lmp")) == [2000]


def test_starts_are_shared_and_fresh(cfg, environment, steps):
    steps.train.train(cfg, "none", seed=0)
    actor = steps.train.load_policy(cfg, "none", 0, 12)
    states = []

    class Recorder:
        in_keys = actor.in_keys

        def __call__(self, td):
            states.append(td.clone())
            return actor(td)

    for seed in (0, 1):
        environment.play(Recorder(), seed, environment.out)
    count = cfg.env.collect.steps
    first, second = states[0], states[count]
    assert torch.equal(first["observation"], second["observation"])
    rows = environment.rows()
    assert torch.cdist(first["desired_goal"], rows["desired_goal"]).min() > 1e-4
