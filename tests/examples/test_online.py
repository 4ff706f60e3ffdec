"""Training offline, then collecting, scoring and training in turn."""

from __future__ import annotations

import csv

import pytest
from omegaconf import OmegaConf

from torchrl_caiac.data import load_transitions


@pytest.fixture(scope="module")
def cfg(steps, compose, tmp_path_factory):
    """A small configuration, after the preparation."""
    cfg = compose(config="online", out=tmp_path_factory.mktemp("online"))
    online = {"rounds": 2, "episodes": 2, "steps": 3, "workers": 1}
    cfg = OmegaConf.merge(cfg, {"online": online})
    steps.collect.collect(cfg)
    steps.score.score(cfg)
    return cfg


def test_rounds_collect_score_and_resume(cfg, steps, monkeypatch):
    one = OmegaConf.merge(cfg, {"online": {"rounds": 1}})
    found = [*steps.online.run(one, "caiac", 0)]
    assert [(row["round"], row["split"]) for row in found] == [
        (0, "validation"),
        (0, "test"),
        (1, "validation"),
        (1, "test"),
    ]
    folder = steps.parts.run_folder(cfg, "caiac", 0) / "online-2"
    rows = load_transitions(folder / "round-1")
    assert len(rows) == 200 and rows["next", "done"].sum() == 2
    assert rows["caiac", "score"].isfinite().all()
    # The second round has the episodes of both, and repeats nothing of the first.
    collected = []
    collect = steps.online.collect_episodes
    monkeypatch.setattr(
        steps.online,
        "collect_episodes",
        lambda *args: collected.append(args) or collect(*args),
    )
    more = [*steps.online.run(cfg, "caiac", 0)]
    assert len(collected) == 1
    assert [row["round"] for row in more] == [0, 0, 1, 2, 2]
    assert more[:3] == found[:3]
    assert [*steps.online.run(cfg, "caiac", 0)] == more
    assert len(collected) == 1


def test_the_learning_rate_must_not_rise_again_online(compose, steps, tmp_path):
    cfg = compose("learner=iql", config="online", out=tmp_path)
    cfg.learner.update({"steps": 8, "decay_steps": 8})
    cfg.online.update({"rounds": 2, "steps": 3})
    with pytest.raises(ValueError, match=r"decay_steps is 8, expected .* at least 14"):
        next(steps.online.run(cfg, "none", 0))


def test_results_of_a_run_replace_those_before(steps, tmp_path):
    row = dict.fromkeys(steps.online.COLUMNS, 1)
    other = row | {"seed": 2}
    path = tmp_path / "online.csv"
    steps.online.write_results(path, [row])
    steps.online.write_results(path, [other])
    steps.online.write_results(path, [row | {"value": 0.5}])
    steps.online.draw(path)
    assert path.with_suffix(".png").stat().st_size > 0
    with path.open(newline="") as file:
        values = [(r["seed"], r["value"]) for r in csv.DictReader(file)]
    assert values == [("2", "1"), ("1", "0.5")]


@pytest.mark.parametrize(
    ("learner", "options", "match"),
    [
        ("td3_bc", ["online.episodes=3"], "online.episodes is 3, expected a multiple"),
        ("td3_bc", ["online.rounds=null"], "online.rounds is None"),
        ("td3_bc", ["online.steps=1.5"], "online.steps is 1.5"),
        ("td3_bc", ["online.offline_fraction=2"], "online.offline_fraction is 2"),
        ("td3_bc", ["learner.lr=-1"], "learner.lr is -1"),
        ("iql", ["learner.steps=2000"], "learner.keep_every is 4000, .* or null"),
        ("td3_bc", ["online.offline_fraction=1"], "online.offline_fraction is 1"),
        ("td3_bc", ["seeds=[0,-1]"], "seeds is .*, but element 1: it should be"),
        ("td3_bc", ["env=kitchen"], "collects in Fetch-Push only"),
        ("td3_bc", ["env=fetch_push_sliding"], "collects in Fetch-Push only"),
        ("td3", ["method=[oracle]"], "method=oracle reads states of the simulator"),
        ("td3", ["online=5"], "online is 5, but it should be a group"),
        ("bc", [], "learner=bc learns from demonstrations only"),
        ("lmp", [], "learner=lmp learns from demonstrations only"),
    ],
)
def test_wrong_settings_are_refused_first(
    learner, options, match, compose, steps, tmp_path
):
    cfg = compose(f"learner={learner}", *options, config="online")
    cfg.out = str(tmp_path)
    with pytest.raises(ValueError, match=match):
        next(steps.online.run(cfg, next(iter(cfg.method)), 0))
    assert not [*tmp_path.iterdir()]
