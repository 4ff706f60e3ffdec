"""Studies of an environment and a learner that take no time."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.killing import run_killed

EXAMPLES = Path(__file__).parents[2] / "examples"
STUDIES = sorted(path.stem for path in (EXAMPLES / "conf" / "study").glob("*.yaml"))
# A run's weight is the number of its steps. Its policy of 20 steps is the best one in
# validation, and later ones are better in the test.
MODULE = '''
import os
import time

import torch
from environments.base import Environment
from learners.base import Learner
from methods.none import NoAugmentation
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_caiac import EntityLayout
from torchrl_caiac.data import load_transitions, write_transitions


class Tiny(Environment):
    """Rows that nobody looks at; success depends on the policy's weight alone."""

    layout = EntityLayout({"robot": [0], "cup": [1]}, fixed=["robot"])
    action_dim = 1

    def collect(self, *, progress=False):
        if (self.out / "rows").exists():
            return
        torch.manual_seed(self.settings.collect.seed)
        n = self.settings.collect.rows
        state = torch.rand(n + 1, 2)
        done = torch.zeros(n, 1, dtype=torch.bool)
        done[-1] = True
        after = {"observation": state[1:], "done": done, "terminated": done}
        data = {"observation": state[:-1], "action": torch.zeros(n, 1)}
        data |= {"episode": torch.zeros(n, dtype=torch.int64), "next": after}
        write_transitions(
            TensorDict(data, [n]), self.out / "rows", action_bounds=([-1.0], [1.0])
        )
        with (self.out / "collected").open("a") as file:  # each time
            print("collected", file=file)

    def rows(self):
        return load_transitions(self.out / "rows")

    def simulator(self, num_actions):
        raise NotImplementedError

    distance_rule = simulator

    def play(self, actor, seed, folder, *, split="test"):
        settings = self.settings.evaluate
        number = {
            "test": settings.episodes,
            "validation": settings.validation_episodes,
        }[split]
        weight = round(actor.module.weight.item())
        # The policy of 20 steps is the best one in validation, not in the test.
        good = {20: 3, 30: 2}.get(weight, 1) if split == "validation" else weight // 10
        return [{"task": t, "success": i < good} for t in "ab" for i in range(number)]

    def measures(self, episodes):
        return [
            {"task": task, "measure": "success", "episodes": len(own), "value": mean}
            for task in "ab"
            if (own := [e["success"] for e in episodes if e["task"] == task])
            for mean in [sum(own) / len(own)]
        ]


class Other(NoAugmentation):
    """Nothing else."""


class Counting(Learner):
    """A weight that grows by one in each step."""

    def check(self, further=0):
        super().check(further)
        if isinstance(self.method, Other) and self.augmentation.swap_prob < 1:
            raise ValueError("other needs swap_prob=1")

    def make_buffer(self, rows):
        raise NotImplementedError

    def setup(self, rows, seed):
        self.network = torch.nn.Linear(1, 1, bias=False)
        torch.nn.init.zeros_(self.network.weight)
        self.parts = {"network": self.network}

    def batches(self):
        while True:
            yield None

    def step(self, batch, step):
        time.sleep(float(os.environ.get("TINY_SLEEP", "0")))
        if self.settings.fails and isinstance(self.method, Other):
            raise ArithmeticError("it diverges")
        self.network.weight.data += 1
        return {}

    def policy_state(self):
        return self.network.state_dict()

    def load_policy(self, state):
        network = torch.nn.Linear(1, 1, bias=False)
        network.load_state_dict(state)
        return TensorDictModule(network, ["observation"], ["action"])
'''
FILES = {
    "tiny.py": MODULE,
    "conf/env/tiny.yaml": """
_target_: tiny.Tiny
name: tiny
folder: tiny
title: nothing
collect: {rows: 4, seed: 0}
score: {batch_size: 1, smoothing: 1}
world_model: {steps: 1}
augmentation: {counterfactual_ratio: 0.5, swap_prob: 1.0, threshold: 0.5}
evaluate: {episodes: 5, validation_episodes: 4}
""",
    "conf/learner/counting.yaml": """
_target_: tiny.Counting
name: counting
steps: 40
fails: false
log_every: 10
checkpoint_every: 10
keep_every: 10
logger: csv
""",
    "conf/method/other.yaml": """
other:
  _target_: tiny.Other
""",
}
STUDY = {
    "name": "try",
    "title": "trying",
    "settings": {
        "4": ["env=tiny"],
        "8": ["env=tiny", "env.folder=tiny8", "env.collect.rows=8"],
    },
    "arms": [
        {"learner": "counting", "methods": ["none", "other"], "seeds": [0, 1]},
    ],
    "answer": {"text": "cups", "task": "a", "setting": "4"},
}


class Study:
    """A study in a folder, run by its script in this or another process."""

    def __init__(self, folder, steps):
        self.folder, self.steps = folder, steps
        self.file = folder / "try.yaml"
        self.root, self.results = folder / "outputs", folder / "results"
        self.write()
        for name, text in FILES.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    def write(self, **changes):
        self.file.write_text(yaml.safe_dump({**STUDY, **changes}))

    def arguments(self, *more):
        search = f"hydra.searchpath=[file://{self.folder}/conf]"
        own = (f"study={self.file}", f"root={self.root}", f"publish={self.results}")
        return [*own, search, *more]

    def run(self, *more, processes=0):
        self.steps.study.main(self.arguments(f"processes={processes}", *more))

    def start(self, *more, sleep=0.0):
        return subprocess.Popen(
            [sys.executable, str(EXAMPLES / "study.py"), *self.arguments(*more)],
            env={
                **os.environ,
                "PYTHONPATH": f"{EXAMPLES.parent}:{self.folder}",
                "TINY_SLEEP": str(sleep),
            },
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    @property
    def table(self):
        return self.results / "try.csv"

    def rows(self):
        with self.table.open(newline="") as file:
            return list(csv.DictReader(file))

    def collections(self):
        files = self.root.rglob("collected")
        return sum(len(file.read_text().splitlines()) for file in files)


@pytest.fixture
def study(tmp_path, steps, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "tiny", raising=False)
    yield Study(tmp_path, steps)
    sys.modules.pop("tiny", None)


def expected(settings=("4", "8"), methods=("none", "other"), seeds=(0, 1)):
    """The cells of the table that do not differ between two computations."""
    found = []
    for setting, method, seed in product(settings, methods, seeds):
        run = (setting, "counting", method, str(seed))
        for task in "ab":
            for step, value in zip((10, 20, 30, 40), (1, 3, 2, 1), strict=True):
                cells = (str(step), "validation", task, "success", "4", value / 4)
                found.append((*run, *cells))
            found.append((*run, "20", "test", task, "success", "5", 2 / 5))
    return Counter(found)


def cells(rows):
    """The same cells of a table."""
    names = list(rows[0])[:9]
    return Counter((*(r[n] for n in names), float(r["value"])) for r in rows)


def test_the_best_policy_of_validation_is_tested(study, capfd):
    study.run()
    rows = study.rows()
    assert list(rows[0]) == [
        *("setting", "learner", "method", "seed", "step", "split", "task", "measure"),
        *("episodes", "value", "train_seconds", "evaluate_seconds", "commit"),
        "settings",
    ]
    assert cells(rows) == expected()
    # One hash for each setting, learner and method.
    assert len({row["settings"] for row in rows}) == 4
    lines = capfd.readouterr().out.splitlines()
    assert lines[0].startswith("[1/3] preparation of 2 settings ... ")
    assert lines[1].startswith("[2/3] training and evaluation, 8 runs ... ")
    assert lines[-1] == "cups: 4/10 (none), 4/10 (other)"
    report = (study.results / "try.md").read_text().splitlines()
    assert report[2] == "| 4 | counting | none | 2 | 0.40 [0.40, 0.40] |  |"
    assert report[3].endswith("| 2 | 0.40 [0.40, 0.40] | +0.00 [+0.00, +0.00] |")
    assert report[-1] == "All 8 runs are done."
    assert (study.results / "try.png").stat().st_size > 5000
    # A second time, nothing is done.
    before = study.table.read_bytes()
    study.run()
    assert study.table.read_bytes() == before
    assert study.collections() == 2


def test_some_runs_first(study, capfd):
    study.run("settings=4", "methods=other", "seeds=[1]")
    assert cells(study.rows()) == expected(["4"], ["other"], [1])
    assert "7 of 8 runs are missing." in capfd.readouterr().out
    study.run()
    assert cells(study.rows()) == expected()
    with pytest.raises(ValueError, match=r"no run of \{'methods': \['caiac'\]\}"):
        study.run("methods=caiac")


def test_a_clone_without_outputs_has_nothing_to_do(study):
    study.run()
    before = study.table.read_bytes()
    shutil.rmtree(study.root)
    study.run()
    assert study.table.read_bytes() == before
    assert study.collections() == 0
    # A missing run is computed, the others are not.
    kept = [row for row in study.rows() if row["seed"] == "0"]
    with study.table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(kept[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(kept)
    study.run("settings=8")
    assert study.rows()[: len(kept)] == kept
    assert cells(study.rows()) == expected() - expected(["4"], seeds=[1])
    assert study.collections() == 1


class TestAnEditedStudy:
    def test_is_refused_or_computed_again(self, study):
        study.run()
        before = study.table.read_bytes()
        arm = {**STUDY["arms"][0], "overrides": ["learner.steps=30"]}
        study.write(arms=[arm])
        for more in ((), ("seeds=0",)):
            with pytest.raises(ValueError, match=r"8 runs .* stale=recompute"):
                study.run(*more)
        with pytest.raises(ValueError, match="8 runs with other settings"):
            figures = study.steps.figures
            loaded = study.steps.study.read_arguments(study.arguments()).study
            figures.report_study(loaded, loaded.runs(), study.results)
        assert study.table.read_bytes() == before
        study.write()
        study.run()  # undone
        assert study.table.read_bytes() == before
        study.write(arms=[arm])
        study.run("stale=recompute")
        rows = study.rows()
        assert {row["step"] for row in rows} == {"10", "20", "30"}
        assert len(rows) == 8 * 2 * 4

    def test_wrong_settings_remove_no_results(self, study):
        study.run()
        before = study.table.read_bytes()
        study.write(arms=[{**STUDY["arms"][0], "overrides": ["learner.log_every=0"]}])
        with pytest.raises(ValueError, match=r"4, .*, seed 0: learner.log_every is 0"):
            study.run("stale=recompute")
        assert study.table.read_bytes() == before

    def test_wrong_settings_of_runs_that_are_not_asked_for_remove_none(self, study):
        study.run()
        before = study.table.read_bytes()
        arms = [
            {
                **STUDY["arms"][0],
                "methods": ["none"],
                "overrides": ["learner.steps=30"],
            },
            {
                **STUDY["arms"][0],
                "methods": ["other"],
                "overrides": ["learner.steps=0"],
            },
        ]
        study.write(arms=arms)
        with pytest.raises(ValueError, match=r"other, seed 0: learner.steps is 0"):
            study.run("methods=none", "stale=recompute")
        assert study.table.read_bytes() == before

    def test_some_settings_and_seeds(self, study):
        study.run()
        settings = {
            **STUDY["settings"],
            "8": ["env=tiny", "env.folder=tiny9", "env.collect.rows=9"],
        }
        study.write(settings=settings)
        with pytest.raises(ValueError, match="4 runs"):
            study.run()
        kept = [row for row in study.rows() if row["setting"] == "4"]
        study.run("stale=recompute")
        assert [row for row in study.rows() if row["setting"] == "4"] == kept
        assert cells(study.rows()) == expected()
        # No seed is dropped without a word.
        study.write(settings=settings, arms=[{**STUDY["arms"][0], "seeds": [0]}])
        with pytest.raises(ValueError, match="4 runs that the study try does not have"):
            study.run()

    def test_other_starts_for_the_same_policies(self, study):
        study.run("settings=4")
        study.write(test={"episodes": 10}, validation={"policies": 2})
        study.run("settings=4", "stale=recompute")
        rows = study.rows()
        assert {row["step"] for row in rows} == {"30", "40"}
        tests = [row for row in rows if row["split"] == "test"]
        assert {(r["step"], r["episodes"], r["value"]) for r in tests} == {
            ("30", "10", "0.3")
        }
        checkpoints = list(study.root.rglob("checkpoint.zip"))
        assert len(checkpoints) == 4  # not trained again


def test_methods_with_the_same_data_may_have_other_augmentations(study):
    """Both are scored with the settings of the first, which the second refuses."""
    arm = STUDY["arms"][0]
    swaps = "env.augmentation.swap_prob=0.5"
    study.write(
        arms=[
            {**arm, "methods": ["none"], "overrides": [swaps]},
            {**arm, "methods": ["other"]},
        ]
    )
    study.run()
    assert cells(study.rows()) == expected()
    assert study.collections() == 2  # of two settings


def test_a_run_that_fails_leaves_the_others(study):
    study.write(arms=[{**STUDY["arms"][0], "overrides": ["learner.fails=true"]}])
    with pytest.raises(RuntimeError, match=r"4 runs failed.*ArithmeticError: it div"):
        study.run()
    assert cells(study.rows()) == expected(methods=["none"])


@pytest.mark.slow
def test_a_killed_study_resumes(study):
    process = study.start("processes=0", sleep=0.02)
    try:
        deadline = time.monotonic() + 120
        # In the middle of the runs: the first one has results.
        while not study.table.exists():
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    begun = cells(study.rows())
    assert begun <= expected() and begun != expected()
    study.run()
    assert cells(study.rows()) == expected()
    assert study.collections() == 2
    assert not list(study.folder.rglob("*.partial*"))


@pytest.mark.slow
def test_two_processes_share_a_study(study):
    processes = [study.start("processes=0", sleep=0.02) for _ in range(2)]
    outputs = [process.communicate(timeout=240)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    assert cells(study.rows()) == expected()
    assert study.collections() == 2
    # Each run was trained once.
    for log in study.root.rglob("log/scalars/*.csv"):
        steps = [line.split(",")[0] for line in log.read_text().splitlines()]
        assert steps == sorted(set(steps), key=int)


class TestTable:
    def row(self, **changes):
        cells = {"setting": "s", "learner": "l", "method": "m", "seed": 0, "step": 10}
        cells |= {"split": "test", "task": "t", "measure": "success", "episodes": 5}
        cells |= {"value": 1 / 3, "train_seconds": 1.5, "evaluate_seconds": 2}
        return {**cells, "commit": "abc", "settings": "def", **changes}

    def test_rows_are_replaced_by_those_of_the_same_evaluation(self, steps, tmp_path):
        path, results = tmp_path / "folder" / "a.csv", steps.results
        assert results.read_rows(path) == []
        results.add_rows(path, [self.row(), self.row(seed=1)])
        results.add_rows(path, [self.row(value=0.5), self.row(task="u, v")])
        rows = results.read_rows(path)
        assert [(r["seed"], r["task"], r["value"]) for r in rows] == [
            *(("1", "t", "0.333333"), ("0", "t", "0.5"), ("0", "u, v", "0.333333")),
        ]
        results.remove_runs(path, [("s", "l", "m", "0")])
        assert [row["seed"] for row in results.read_rows(path)] == ["1"]

    def test_a_killed_process_leaves_the_table_whole(self, steps, tmp_path):
        path = tmp_path / "a.csv"
        steps.results.add_rows(path, [self.row()])
        before = path.read_bytes()

        def killed():
            steps.results.csv.DictWriter.writerows = lambda self, rows: os.kill(
                os.getpid(), signal.SIGKILL
            )
            steps.results.add_rows(path, [self.row(seed=1)])
            yield

        run_killed(killed)
        assert path.read_bytes() == before
        steps.results.add_rows(path, [self.row(seed=2)])
        assert [row["seed"] for row in steps.results.read_rows(path)] == ["0", "2"]

    @pytest.mark.parametrize(
        ("damage", "message"),
        [
            (lambda text: text.replace("split", "part"), "has the columns"),
            (lambda text: text[:-12], "line 3, is damaged"),
            (lambda text: text.replace("0.333333", "nan", 1), "line 2, is damaged"),
            (lambda text: "<<<<<<< HEAD\n" + text, "has the columns"),
            (lambda text: text + text.splitlines()[1] + "\n", "line 4, repeats"),
        ],
    )
    def test_a_damaged_table_is_refused(self, steps, tmp_path, damage, message):
        path = tmp_path / "a.csv"
        steps.results.add_rows(path, [self.row(), self.row(seed=1)])
        path.write_text(damage(path.read_text()))
        before = path.read_bytes()
        with pytest.raises(ValueError, match=rf"a\.csv.* {message}"):
            steps.results.add_rows(path, [self.row(seed=2)])
        assert path.read_bytes() == before

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), "success"])
    def test_results_are_finite_numbers(self, steps, tmp_path, value):
        path = tmp_path / "a.csv"
        steps.results.add_rows(path, [self.row()])
        before = path.read_bytes()
        with pytest.raises(ValueError, match="a result has no finite number"):
            steps.results.add_rows(path, [self.row(seed=2, value=value)])
        assert path.read_bytes() == before


class TestFiles:
    @pytest.mark.parametrize("name", STUDIES)
    def test_all_runs_of_a_study_have_a_configuration(self, steps, name):
        study = steps.studies.load_study(name)
        runs = study.runs()
        assert len({run.key for run in runs}) == len(runs)
        assert {run.setting for run in runs} == set(study.settings)
        # A baseline has the same budget as what it is compared with.
        budgets = {}
        for run in runs:
            budget = str(run.cfg.learner)
            budgets.setdefault((run.setting, run.learner), set()).add(budget)
        assert all(len(found) == 1 for found in budgets.values())
        small = study.quick().runs()
        assert {(run.learner, run.method) for run in small} == {
            (run.learner, run.method) for run in runs
        }
        assert all(run.cfg.out.endswith("_quick") for run in small)
        if study.publish is not None:  # what is committed is of the settings of today
            results = steps.results
            rows = results.read_rows(EXAMPLES.parent / study.publish / f"{name}.csv")
            assert rows and not results.unlisted(runs, rows)
            assert "stale" not in {results.state_of(run, rows) for run in runs}

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"seeds": [0]}, r"it has \['seeds'\]"),
            ({"settings": {}}, "no settings or no arms"),
            ({"settings": ["a"]}, "settings is a list"),
            ({"arms": [{"learner": "counting"}]}, r"lacks \['methods', 'seeds'\]"),
            ({"arms": [{**STUDY["arms"][0], "seeds": [0.5]}]}, r"seeds are \[0\.5\]"),
            ({"arms": [{**STUDY["arms"][0], "settings": ["5"]}]}, r"settings \['5'\]"),
            ({"arms": STUDY["arms"] * 2}, "twice"),
            ({"test": {"starts": 5}}, "test has 'starts'"),
            ({"validation": {"episodes": 0}}, r"validation\.episodes is 0"),
            ({"answer": {}}, r"answer lacks \['text'\]"),
            ({"name": "other"}, "its name is 'other'"),
        ],
    )
    def test_what_is_not_a_study_is_refused(self, study, changes, message):
        study.write(**changes)
        with pytest.raises(ValueError, match=message):
            study.run()

    def test_names(self, steps, study):
        with pytest.raises(FileNotFoundError, match=r"no study 'dmeo'.*'demo'"):
            steps.study.main(["study=dmeo"])
        for argument, message in (
            ("demo", "has no value"),
            ("stale=yes", "refuse or recompute"),
            ("processes=-1", "expected an integer from 0"),
            ("learner=lmp", "has its own"),
        ):
            with pytest.raises(ValueError, match=message):
                study.run(argument)

    def test_the_hash_is_of_what_results_depend_on(self, steps):
        digest, run_settings = steps.studies.digest, steps.studies.run_settings

        def of(method, *overrides):
            names = "method=[none,caiac,coda,oracle]"
            cfg = steps.studies.compose("env=fetch_push", names, *overrides)
            return digest(run_settings(cfg, method))

        for method, override, same in (
            ("none", "env.world_model.steps=1", True),
            ("caiac", "env.world_model.steps=1", False),
            ("caiac", "env.transformer.steps=1", True),
            ("coda", "env.transformer.steps=1", False),
            ("caiac", "env.augmentation.threshold=0.1", False),
            ("caiac", "env.score.batch_size=1", True),
            ("none", "env.score.num_actions=1", True),
            ("oracle", "env.truth.oracle_actions=1", False),
            ("none", "env.collect.seed=1", False),
            ("none", "+env.new=null", True),
            ("none", "+env.new=1", False),
            ("none", "learner.lr=1", False),
        ):
            assert (of(method) == of(method, override)) == same, (method, override)


def test_intervals_are_those_of_a_bootstrap_stratified_by_task(steps):
    rng = np.random.default_rng(0)
    values = rng.uniform(size=(4, 3)) + np.array([0, 10, 20])
    found = steps.figures.estimate(values)
    means = []
    for _ in range(4000):  # a seed of its own for each task
        means.append(np.mean([rng.choice(column, len(values)) for column in values.T]))
    assert found.mean == pytest.approx(values.mean())
    width = np.ptp(means)
    assert found.low == pytest.approx(np.percentile(means, 2.5), abs=0.05 * width)
    assert found.high == pytest.approx(np.percentile(means, 97.5), abs=0.05 * width)
    assert steps.figures.estimate(values) == found
    one = steps.figures.estimate(values[:1])
    assert one.text() == f"{values[0].mean():.2f}" and np.isnan(one.low)


def test_differences_are_paired_by_seed(steps, study):
    study.run()
    rows = study.rows()
    for row in rows:
        if row["split"] == "test" and row["setting"] == "4":
            row["value"] = 0.2 * int(row["seed"]) + 0.5 * (row["method"] == "other")
    steps.results.add_rows(study.table, rows)
    study.run()
    report = (study.results / "try.md").read_text()
    assert "| none | 2 | 0.10 [0.00, 0.20] |  |" in report
    assert "| other | 2 | 0.60 [0.50, 0.70] | +0.50 [+0.50, +0.50] |" in report


def test_settings_may_have_measures_of_their_own(steps, study, capfd):
    study.write(answer={"text": "all", "learner": "counting"})
    study.run("seeds=0")
    rows = study.rows()
    for row in rows:
        if row["setting"] == "8":
            row["measure"] = "full"
    study.table.unlink()
    steps.results.add_rows(study.table, rows)
    study.run("seeds=0")
    lines = (study.results / "try.md").read_text().splitlines()
    assert lines[0].endswith("| seeds | success | full | success, minus none |")
    assert lines[3] == "| 4 | counting | other | 1 | 0.40 |  | +0.00 |"
    assert lines[5] == "| 8 | counting | other | 1 |  | 0.40 | +0.00 |"
    assert lines[13] == "| 8 | counting | none | 0.40 | 0.40 |"
    out = capfd.readouterr().out
    assert out.splitlines()[-1] == "all: 8/20 (none), 8/20 (other)"
