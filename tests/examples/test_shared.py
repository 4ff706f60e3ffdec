from __future__ import annotations

import copy
import csv
import doctest
import os
import sys
import tempfile
from itertools import product
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from torchrl_caiac._files import write_json

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.sampled_from([0.5, 1.0, "a", ""]),
    lambda x: st.lists(x, max_size=2) | st.dictionaries(st.sampled_from("ab"), x),
    max_leaves=4,
)
mappings = st.dictionaries(st.sampled_from("abc"), values, max_size=3)


@pytest.mark.parametrize("module", ["settings", "tables"])
def test_examples_of_the_docstrings(steps, module):
    shared = getattr(steps, module)
    names = {name: getattr(shared, name) for name in shared.__all__}
    result = doctest.testmod(shared, extraglobs=names)
    assert result.attempted and not result.failed


class TestKeepSettings:
    @settings(max_examples=60, deadline=None)
    @given(mappings, mappings)
    def test_only_the_same_again(self, steps, first, second):
        keep_settings = steps.settings.keep_settings
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "train.json"
            keep_settings(folder, "train", first)
            keep_settings(folder, "train", OmegaConf.create(first))
            kept = path.read_bytes()
            if first == second:
                keep_settings(folder, "train", second)
            else:
                with pytest.raises(ValueError) as error:
                    keep_settings(folder, "train", second)
                for name in "abc":
                    differs = first.get(name, "-") != second.get(name, "-")
                    named = f"'{name}'" in str(error.value)
                    # Nested settings are named by their whole path.
                    assert differs == (named or f"'{name}." in str(error.value))
            assert path.read_bytes() == kept

    def test_tuples_are_lists(self, steps, tmp_path):
        keep_settings = steps.settings.keep_settings
        keep_settings(tmp_path / "new", "a", {"sizes": (3, 4)})
        keep_settings(tmp_path / "new", "a", {"sizes": [3, 4]})
        with pytest.raises(ValueError, match=r"new contains results of other settings"):
            keep_settings(tmp_path / "new", "a", {"sizes": [4, 3]})

    def test_foreign_files(self, steps, tmp_path):
        keep_settings = steps.settings.keep_settings
        path = tmp_path / "a.json"
        path.write_text("[1, 2]")
        with pytest.raises(ValueError, match=r"\(all differ\)"):
            keep_settings(tmp_path, "a", {"a": 1})
        write_json(path, {"a": 1})
        for content in (path.read_bytes()[:-4], b"", b"\xff\xfe"):
            path.write_bytes(content)
            with pytest.raises(ValueError, match=r"a\.json contains no settings"):
                keep_settings(tmp_path, "a", {"a": 1})
            assert path.read_bytes() == content


def test_experiments_share_the_published_table(steps, tmp_path):
    publish_comparison = steps.tables.publish_comparison
    common = {"estimator": "rule", "threshold": 0.5, "auc": 1.0}
    rates = {"true_positive_rate": 0.9, "false_positive_rate": 0.1}
    table = [
        {**common, **rates, "entity": entity, "infeasible": float("nan")}
        for entity in ("all", "cup", "box")
    ]
    for experiment in ("push", "kitchen", "push"):
        publish_comparison(tmp_path, table, experiment=experiment)
    with (tmp_path / "influence.csv").open() as file:
        found = [(r["experiment"], r["entity"]) for r in csv.DictReader(file)]
    assert found == list(product(("push", "kitchen"), ("all", "cup", "box")))
    assert (tmp_path / "influence.png").stat().st_size > 1000
    lines = (tmp_path / "influence.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines if line.strip()] == [
        *("push", "θ", "rule"),
        *("kitchen", "θ", "rule"),
    ]
    assert lines[2].split()[1:5] == ["0.5", "1", "0.9", "0.1"]
    other = [{**row, "estimator": "other"} for row in table]
    publish_comparison(tmp_path, other, experiment="push")
    publish_comparison(tmp_path, other, experiment="push")
    with (tmp_path / "influence.csv").open() as file:
        found = [(r["experiment"], r["estimator"]) for r in csv.DictReader(file)]
    assert found == [
        *[("push", "rule")] * 3,
        *[("push", "other")] * 3,
        *[("kitchen", "rule")] * 3,
    ]
    (tmp_path / "influence.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"columns \['a', 'b'\]"):
        publish_comparison(tmp_path, table, experiment="push")


def test_precisions_are_compared_over_the_steps_that_all_seeds_have(steps, tmp_path):
    rows = [(1, 20, 0.5), (0, 10, 0.1), (0, 20, 0.2), (1, 10, 0.3)]
    table = ["fraction,method,seed,step,full"]
    table += [f"1.0,caiac,{seed},{step},{full}" for seed, step, full in rows]
    for name in ("a", "b"):
        (tmp_path / f"fetch_push_{name}.csv").write_text("\n".join(table))
    read_curves = steps.compare_precision.read_curves
    curves = read_curves(tmp_path / "fetch_push_a.csv")
    assert curves == ([10, 20], [[0.1, 0.2], [0.3, 0.5]])
    steps.compare_precision.main(["--results", str(tmp_path), "--names", "a", "b"])
    assert (tmp_path / "fetch_push_precision.png").stat().st_size > 10_000
    (tmp_path / "fetch_push_a.csv").write_text("\n".join(table[:-1]))
    with pytest.raises(ValueError, match=r"lacks steps of the seeds \[1\]"):
        read_curves(tmp_path / "fetch_push_a.csv")


class TestConsole:
    def test_only_stages_and_results_are_printed(self, steps, tmp_path, capfd):
        with steps.console.Console(tmp_path, stages=2) as console:
            with console.stage("noise"):
                print("printed")
                print("an error", file=sys.stderr)
                os.system("echo of a process; echo error of a process >&2")
                steps.console.logging.getLogger("some").info("logged")
            with console.stage("quiet"):
                assert not steps.console.progress()
            console.print("the answer")
        out, err = capfd.readouterr()
        assert err == ""
        assert out == "[1/2] noise ... 0 s\n[2/2] quiet ... 0 s\nthe answer\n"
        log = (tmp_path / "log.txt").read_text()
        for text in ("of a process", "error of a process", "logged", "[1/2] noise"):
            assert text in log
        print("as before")
        assert capfd.readouterr().out == "as before\n"

    def test_a_failure_names_the_log(self, steps, tmp_path, capfd):
        with (
            pytest.raises(ZeroDivisionError),
            steps.console.Console(tmp_path) as console,
            console.stage("division"),
        ):
            raise ZeroDivisionError
        out = capfd.readouterr().out
        assert out == f"[1/1] division ... failed, see {tmp_path / 'log.txt'}\n"


def test_a_script_claims_its_folder(steps, compose, tmp_path):
    cfg = compose(out=tmp_path)
    with (
        steps.console.start(cfg),
        pytest.raises(RuntimeError, match=r"process \d+ on .* is using"),
        steps.console.start(cfg),
    ):
        pass


class TestScalarLog:
    def log(self, steps, folder, *, until, since=0, state=None):
        log = steps.log.ScalarLog("csv", folder)
        if state is not None:
            log.load_state_dict(state)
        log.resume(since)
        states = {}
        for step in range(since + 1, until + 1):
            log.add({"loss": torch.tensor(float(step)), "q": torch.tensor(0.1 * step)})
            if step % 3 == 0:
                log.write(step)
            states[step] = copy.deepcopy(log.state_dict())
        return states

    def contents(self, folder):
        return {file.name: file.read_bytes() for file in folder.rglob("*.csv")}

    @settings(max_examples=30)
    @given(st.integers(0, 10), st.integers(0, 12), st.booleans())
    def test_an_interrupted_log_is_that_of_one_run(
        self, steps, saved, killed, half_a_line
    ):
        killed = max(saved, killed)
        with tempfile.TemporaryDirectory() as folder:
            whole, other = Path(folder, "whole"), Path(folder, "other")
            self.log(steps, whole, until=12)
            states = self.log(steps, other, until=killed)
            if half_a_line and killed > saved and killed >= 3:
                with (other / "log/scalars/loss.csv").open("a") as file:
                    file.write("1")
            state = states.get(saved)
            self.log(steps, other, since=saved, until=12, state=state)
            assert self.contents(other) == self.contents(whole) != {}

    def test_means(self, steps, tmp_path):
        self.log(steps, tmp_path, until=6)
        content = (tmp_path / "log/scalars/loss.csv").read_text()
        assert content == "3,2.0\n6,5.0\n"


def test_settings_that_were_never_kept(steps, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no .*train\.json: run the step"):
        steps.settings.check_settings(tmp_path, "train", {})
    assert not list(tmp_path.iterdir())
