"""A method and a learner from one Python file and one YAML file each."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
METHOD = '''
from dataclasses import dataclass

from methods.base import Method

from torchrl_caiac import CAIACTransform, EntityLayout


class Anything:
    """Nothing is ever influenced."""

    def __init__(self, layout):
        self.layout = layout

    def __call__(self, td):
        return td["observation"].new_zeros(*td.batch_size, len(self.layout))

    def __repr__(self):
        return "Anything()"


@dataclass
class SwapAnything(Method):
    """Swaps whatever is not fixed."""

    score_key = ("anything", "score")
    threshold: float

    def estimator(self, scoring):
        return Anything(scoring.environment.layout)

    def transform(self, layout, counterfactual_ratio=0.5, **options):
        return CAIACTransform(
            layout,
            self.threshold,
            counterfactual_ratio,
            score_key=self.score_key,
            **options,
        )
'''
LEARNER = '''
import torch
from learners.base import Learner
from learners.settings import Count
from tensordict.nn import TensorDictModule

from torchrl_caiac.data import offline_buffer


class Cloning(Learner):
    """Behaviour cloning, linear."""

    class Settings(Learner.Settings):
        batch_size: Count

    def make_buffer(self, rows):
        rb = offline_buffer(rows, batch_size=self.settings.batch_size)
        transform = self.method.transform(self.environment.layout)
        if transform is not None:
            rb.append_transform(transform)
        return rb

    def make_network(self):
        width = sum(self.environment.layout.widths().values())
        return torch.nn.Linear(width, self.environment.action_dim)

    def setup(self, rows, seed):
        torch.manual_seed(seed)
        self.network = self.make_network()
        self.optimizer = torch.optim.Adam(self.network.parameters())
        self.rb = self.make_buffer(rows.select(
            "observation", "action", "episode", "next", self.method.score_key))
        self.parts = {"network": self.network, "optimizer": self.optimizer}

    def batches(self):
        while True:
            yield self.rb.sample()

    def step(self, batch, step):
        error = self.network(batch["observation"]) - batch["action"]
        loss = error.square().mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return {"loss": loss.detach(), **self.share_swapped(batch)}

    def policy_state(self):
        return self.network.state_dict()

    def load_policy(self, state):
        network = self.make_network()
        network.load_state_dict(state)
        return TensorDictModule(network, ["observation"], ["action"])
'''
METHOD_YAML = """
swap_anything:
  _target_: my_method.SwapAnything
  threshold: 0.5
"""
LEARNER_YAML = """
_target_: my_learner.Cloning
name: cloning
steps: 20
batch_size: 32
log_every: 10
checkpoint_every: 10
keep_every: null
logger: csv
"""


@pytest.mark.slow
def test_a_method_and_a_learner_of_one_file_each(tmp_path):
    """Through all steps, by the script, in processes of their own."""
    for name, text in (
        ("my_method.py", METHOD),
        ("my_learner.py", LEARNER),
        ("conf/method/swap_anything.yaml", METHOD_YAML),
        ("conf/learner/cloning.yaml", LEARNER_YAML),
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    out = tmp_path / "out"
    run = subprocess.run(
        [
            sys.executable,
            str(EXAMPLES / "study.py"),
            f"hydra.searchpath=[file://{tmp_path}/conf]",
            "env=fetch_push",
            "learner=cloning",
            "method=[caiac,swap_anything]",
            "size=quick",
            *(f"root={out}", "workers=1", "processes=1", "env.demonstrations=null"),
            "env.collect.random_ratio=2.0",
            *("env.collect.expert=2", "env.collect.random=4", "env.collect.held_out=2"),
            *("env.collect.steps=100", "env.world_model.steps=20"),
            *("env.world_model.eval_every=10", "env.evaluate.episodes=1"),
        ],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": f"{EXAMPLES.parent}:{tmp_path}"},
    )
    assert run.returncode == 0, run.stdout + run.stderr
    # Stages, the table, the answer: no notice of any library.
    assert run.stderr == ""
    lines = run.stdout.rstrip().splitlines()
    assert all(line.startswith(f"[{n}/5] ") for n, line in enumerate(lines[:5], 1))
    assert lines[-1].startswith("two cubes pushed to their goals: ")
    assert lines[-1].endswith("/1 (swap_anything)")
    table = out / "studies" / "fetch_push_cloning_quick" / "fetch_push_cloning.csv"
    with table.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["measure"] == "full"]
    assert {r["method"] for r in rows} == {"caiac", "swap_anything"}
    assert [(r["seed"], r["step"], r["split"]) for r in rows] == [
        ("0", "20", "test")
    ] * 2
