"""The code in README.md, CONTRIBUTING.md and docs runs, on small datasets."""

from __future__ import annotations

import ast
import builtins
import importlib
import re
import warnings
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import minari
import numpy as np
import pytest
import torch
from minari.data_collector import EpisodeBuffer
from tensordict import TensorDictBase
from torchrl.data import HERReplayBuffer, SliceSampler, TensorStorage
from torchrl.objectives import SoftUpdate

from tests.influence.scoring import ready
from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac.data import (
    load_transitions,
    mix_trajectories,
    offline_buffer,
    select_successful,
)
from torchrl_caiac.evaluation import (
    Candidate,
    compare_influence,
)
from torchrl_caiac.influence import (
    CAI,
    AttentionInfluence,
    MotionInfluence,
    score_buffer,
)
from torchrl_caiac.modules import (
    GaussianWorldModel,
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalFeatures,
    TransformerWorldModel,
)
from torchrl_caiac.objectives import GoalConditionedTD3Loss
from torchrl_caiac.transforms import HindsightGoal, TransformKeys, WindowGoal

ROOT = Path(__file__).parents[1]


def python_blocks(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


def make_dataset(name: str, episodes: int = 4, steps: int = 30) -> None:
    """Creates a dataset with the README's 34 observation and 4 action columns."""
    rng = np.random.default_rng(0)
    buffers = []
    for index in range(episodes):
        observations = rng.normal(size=(steps + 1, 34)).cumsum(0).astype(np.float32)
        ends = np.arange(steps) == steps - 1
        buffers.append(
            EpisodeBuffer(
                id=index,
                observations=list(observations),
                actions=list(rng.uniform(-1, 1, (steps, 4)).astype(np.float32)),
                rewards=[0.0] * steps,
                terminations=[False] * steps,
                truncations=ends.tolist(),
            )
        )
    minari.create_dataset_from_buffers(
        name,
        buffers,
        observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (34,), np.float32),
        action_space=gymnasium.spaces.Box(-1, 1, (4,), np.float32),
    )


def test_from_arrays_to_a_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    readme = (ROOT / "README.md").read_text()
    (code,) = [b for b in python_blocks(readme) if "MotionInfluence(" in b]
    lines = [x for x in code.splitlines() if x.strip() and not x.startswith("#")]
    assert len(lines) <= 15
    (shown,) = re.findall(r"```text\ntensor\(\[ *0, *(\d+)\]\)\n```", readme)
    counts = []
    for _ in range(2):  # the second run opens what the first one wrote
        exec(compile(code, "README.md", "exec"), {})
        printed = capsys.readouterr().out
        counts += re.findall(r"^tensor\(\[ *0, *(\d+)\]\)$", printed, re.MULTILINE)
    assert len(counts) == 2
    for count in (int(shown), *map(int, counts)):
        assert 85 <= count <= 118  # about 0.8 of 128, the cups that nothing carries


def test_home_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = python_blocks((ROOT / "docs" / "index.md").read_text())
    exec(compile(code, "index.md", "exec"), {})
    (count,) = re.findall(r"^tensor\(\[ *0, *(\d+)\]\)$", capsys.readouterr().out, re.M)
    assert 85 <= int(count) <= 118  # about 0.8 of 128


def test_quick_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "get_started" / "quick_start.md").read_text()
    code = "\n".join(python_blocks(page)).replace("range(500)", "range(20)")
    scope: dict[str, object] = {}
    exec(compile(code, "quick_start.md", "exec"), scope)
    swapped = scope["batch"]["caiac", "swapped"]
    assert not swapped[:, 0].any() and swapped[:, 1:].any(0).all()
    assert scope["loss"].isfinite()


def test_bring_your_own_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a dataset without an author
        make_dataset("my/pushing-v0")
    page = (ROOT / "docs" / "get_started" / "from_files.md").read_text()
    (code,) = [block for block in python_blocks(page) if "load_minari" in block]
    code, changed = re.subn(r"steps=[\d_]+", "steps=20, eval_every=10", code)
    assert changed == 1
    scope: dict[str, object] = {}
    exec(compile(code, "from_files.md", "exec"), scope)
    batch = scope["batch"]
    assert batch["caiac", "swapped"].shape == torch.Size([512, 3])
    assert batch["caiac", "counterfactual"].sum() == 256


def test_goals_of_play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    states = rng.normal(size=(120, 37)).cumsum(0).astype(np.float32)
    states[:, 28:] = states[::40, 28:].repeat(40, 0)  # a cube that rests
    np.savez(
        "cube-double-play-v0.npz",
        observations=states,
        actions=rng.uniform(-1, 1, (120, 5)).astype(np.float32),
        terminals=np.arange(120) % 40 == 39,
    )
    page = (ROOT / "docs" / "get_started" / "from_files.md").read_text()
    (code,) = [block for block in python_blocks(page) if "ogbench://" in block]
    code = code.replace("ogbench://cube-double-play-v0", "cube-double-play-v0.npz")
    code, changed = re.subn(r"steps=[\d_]+", "steps=20, eval_every=10", code)
    assert changed == 1
    scope: dict[str, object] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # scores of a random walk
        exec(compile(code, "from_files.md", "exec"), scope)
    batch = scope["batch"]
    assert batch["desired_goal"].shape == (256, 6)
    assert batch["caiac", "counterfactual"].sum() == 128


def undefined_names(blocks: list[str]) -> set[str]:
    """Returns the names that code reads and defines nowhere up to there."""
    known, missing = set(dir(builtins)), set()
    for block in blocks:
        nodes = [*ast.walk(ast.parse(block))]
        for node in nodes:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                known |= {(a.asname or a.name).split(".")[0] for a in node.names}
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                known.add(node.id)
            elif isinstance(node, ast.arg):
                known.add(node.arg)
            elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                known.add(node.name)
        missing |= {
            node.id
            for node in nodes
            if isinstance(node, ast.Name) and node.id not in known
        }
    return missing


# What the pages say that the reader has.
GIVEN = {
    "when_it_fails.md": {"rb", "stacked"},
    "augment.md": {
        *("action_dim", "data", "layout", "loss_module", "make_env", "model"),
        *("policy", "rb", "transformer", "truth"),
    },
    "describe_entities.md": {"data"},
    "load_data.md": {
        *("achieved", "actions", "desired", "estimator", "layout", "model"),
        *("observations", "rb", "rewards", "terminals", "timeouts"),
    },
    "score.md": {"layout", "rb"},
    "train.md": {"actor", "critics", "layout", "reward"},
    "layouts.md": {"data"},
    "scaling.md": {"estimator", "layout", "offline", "online", "reward_fn"},
}
PAGES = [
    page
    for page in sorted((ROOT / "docs").rglob("*.md"))
    if python_blocks(page.read_text()) and "auto_tutorials" not in page.parts
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_import_what_they_use(page: Path) -> None:
    blocks = python_blocks(page.read_text())
    assert undefined_names(blocks) == GIVEN.get(page.name, set())
    for block in blocks:
        tree = ast.parse(block)
        imports = [x for x in tree.body if isinstance(x, (ast.Import, ast.ImportFrom))]
        exec(compile(ast.Module(imports, []), page.name, "exec"), {})


HOW_TO = [
    block
    for page in sorted((ROOT / "docs" / "how_to").glob("*.md"))
    for block in python_blocks(page.read_text())
]
LAYOUT = EntityLayout(
    {"gripper": range(3), "cup": [3, 4, 5], "jug": [6, 7, 8]},
    goal={"cup": [0, 1], "jug": [2, 3]},
    achieved={"cup": [3, 4], "jug": [6, 7]},
    fixed=["gripper"],
)


def run_how_to(start: str, **given: object) -> dict[str, object]:
    """Runs the code block of docs/how_to that starts so; returns its variables."""
    (code,) = [block for block in HOW_TO if block.startswith(start)]
    scope = {
        "AttentionInfluence": AttentionInfluence,
        "CAI": CAI,
        "CAIACTransform": CAIACTransform,
        "CoDATransform": CoDATransform,
        "GoalConditionedActor": GoalConditionedActor,
        "GoalConditionedCritic": GoalConditionedCritic,
        "GoalConditionedTD3Loss": GoalConditionedTD3Loss,
        "GoalFeatures": GoalFeatures,
        "HERReplayBuffer": HERReplayBuffer,
        "HindsightGoal": HindsightGoal,
        "SliceSampler": SliceSampler,
        "SoftUpdate": SoftUpdate,
        "TransformKeys": TransformKeys,
        "TensorStorage": TensorStorage,
        "WindowGoal": WindowGoal,
        "layout": LAYOUT,
        "load_transitions": load_transitions,
        "mix_trajectories": mix_trajectories,
        "offline_buffer": offline_buffer,
        "reward": lambda achieved, desired: -(achieved != desired).any(-1).float(),
        "score_buffer": score_buffer,
        **given,
    }
    exec(compile(code, "how_to", "exec"), scope)
    return scope


@pytest.fixture
def scored(flat_data: TensorDictBase) -> TensorDictBase:
    """Returns the shared trajectories with scores: nothing is influenced."""
    flat_data["caiac", "score"] = torch.zeros(len(flat_data), 3)
    return flat_data


in_memory = pytest.mark.parametrize("storage_kind", ["memory"], indirect=True)


@in_memory
def test_motion_as_the_estimator(flat_data: TensorDictBase) -> None:
    rb = offline_buffer(flat_data, batch_size=8)
    scope = run_how_to(
        "estimator = MotionInfluence", rb=rb, MotionInfluence=MotionInfluence
    )
    assert rb.storage[:]["caiac", "score"].shape == (len(flat_data), 3)
    assert scope["estimator"].fitted


@in_memory
def test_windows(scored: TensorDictBase) -> None:
    long_enough = scored[scored["episode"] == 1]
    windows = run_how_to("goals = WindowGoal", data=long_enough)["windows"]
    assert windows.batch_size == (128, 10)
    assert windows["caiac", "swapped"].any()


@in_memory
def test_hindsight_goals_and_td3(scored: TensorDictBase) -> None:
    scope = run_how_to("goals = HindsightGoal(layout, reward)\n", data=scored)
    batch = scope["batch"]
    counterfactual = batch["caiac", "counterfactual"].squeeze(-1)
    assert counterfactual.sum() == 256
    relabeled = batch["hindsight", "relabeled"].squeeze(-1)
    assert relabeled[counterfactual].any()
    assert relabeled[~counterfactual].any()

    scope = run_how_to("features = ", rb=scope["rb"], action_dim=2)
    loss = scope["loss"](batch)
    assert loss["loss_actor"].isfinite()
    assert loss["loss_qvalue"].isfinite()
    cloning = run_how_to(
        "from torchrl_caiac.objectives import GoalConditionedTD3Loss",
        actor=scope["actor"],
        critics=scope["critics"],
    )
    rb = offline_buffer(scored, batch_size=512, sample_unit=cloning["goals"])
    rb.append_transform(CAIACTransform(LAYOUT))
    rb.append_transform(cloning["goals"])
    batch, loss = rb.sample(), cloning["loss"]
    expected = batch["caiac", "counterfactual"] & batch["hindsight", "relabeled"]
    assert torch.equal(batch["no_reason"], expected)
    assert expected.any() and not expected.all()
    loss.make_value_estimator(gamma=0.97)
    SoftUpdate(loss, tau=0.005)
    assert loss(batch)["bc_loss"].isfinite()


@in_memory
def test_cloning(flat_data: TensorDictBase) -> None:
    flat_data["next", "reward"] = -torch.ones(len(flat_data), 1)
    flat_data["next", "reward"][9::10] = 0.0
    data = flat_data
    features = GoalFeatures(LAYOUT)
    features.fit_statistics(data)
    scope = run_how_to(
        "import torch\nfrom torchrl.objectives import BCLoss",
        data=data,
        actor=GoalConditionedActor(features, data["action"].shape[-1]),
    )
    batch = scope["rb"].sample()
    assert batch["caiac", "counterfactual"].sum() == round(0.8 * 256)
    assert scope["loss_module"](batch)["loss_bc"].isfinite()


@in_memory
def test_successful_episodes(flat_data: TensorDictBase) -> None:
    flat_data["next", "reward"] = -torch.ones(len(flat_data), 1)
    flat_data["next", "reward"][9::10] = 0.0
    flat_data["next", "success"] = flat_data["next", "reward"] > -0.5
    scope = run_how_to(
        "demonstrations = ", data=flat_data, select_successful=select_successful
    )
    assert 0 < len(scope["demonstrations"]) < len(flat_data)


@in_memory
def test_replay_buffer_that_relabels_itself(scored: TensorDictBase) -> None:
    rb = run_how_to("goals = HindsightGoal(layout, reward, future=0.0)", data=scored)[
        "rb"
    ]
    batch = rb.sample()
    assert batch["hindsight", "relabeled"][:128].all()
    assert not batch["hindsight", "relabeled"][128:256].any()
    assert batch["hindsight", "relabeled"][256:].any()


@in_memory
def test_mixture(
    scored: TensorDictBase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("expert", "random"):
        # The same four trajectories, ten times.
        rows = torch.cat([scored] * 10)
        rows["episode"] = rows["episode"] + 4 * torch.arange(10).repeat_interleave(
            len(scored)
        )
        rows.memmap(f"data/{name}")
    tenth = run_how_to("expert, random = ")["tenth"]
    # 40 random trajectories are 70 % of 57.
    assert len(tenth["episode"].unique()) == 6
    assert (tenth["source"] == 0).any()
    assert (tenth["source"] == 1).any()


@in_memory
def test_coda(scored: TensorDictBase) -> None:
    rb = offline_buffer(scored, batch_size=8)
    model = ready(TransformerWorldModel(LAYOUT, 2, layers=1, heads=2, width=8))
    run_how_to("attention = ", rb=rb, transformer=model)
    assert rb.sample()["coda", "graph"].shape == (8, 4, 3)
    assert rb.sample()["caiac", "swapped"].shape == (8, 3)


@in_memory
def test_comparison_of_estimators(flat_data: TensorDictBase) -> None:
    transformer = ready(TransformerWorldModel(LAYOUT, 2, layers=1, heads=2, width=8))
    influenced = torch.rand(len(flat_data), 3) < 0.5
    table = run_how_to(
        "table = ",
        data=flat_data,
        truth=SimpleNamespace(influenced=influenced),
        model=ready(GaussianWorldModel(LAYOUT, 2, (16, 16))),
        attention=AttentionInfluence(transformer),
        Candidate=Candidate,
        compare_influence=compare_influence,
    )["table"]
    assert [row["estimator"] for row in table if row["entity"] == "all"] == [
        "caiac",
        "coda",
    ]
    assert all(0 <= row["density"] <= 1 for row in table if row["entity"] == "all")


@in_memory
def test_nested_layout(nested_data: TensorDictBase) -> None:
    layout = run_how_to("from torchrl_caiac import EntityLayout\n")["layout"]
    assert layout.names == ("arm", "kettle")
    nested_data["caiac", "score"] = torch.zeros(len(nested_data), 2)
    rb = offline_buffer(nested_data, batch_size=8)
    rb.append_transform(CAIACTransform(layout))
    assert rb.sample()["caiac", "swapped"].any()


def test_layout_with_goals() -> None:
    layout = run_how_to("layout = EntityLayout(", EntityLayout=EntityLayout)["layout"]
    assert layout.goal_columns() == (2, 3, 4, 5)


def test_names_of_the_how_to_page() -> None:
    scope = run_how_to("from torchrl.collectors import MultiSyncCollector\n")
    goal = torch.zeros(2, 3)
    assert scope["reward"](torch.tensor([[0.0, 0, 0], [1, 0, 0]]), goal).tolist() == [
        0,
        -1,
    ]


@in_memory
def test_rewards_of_transitions(scored: TensorDictBase) -> None:
    rb = offline_buffer(scored, batch_size=8)
    run_how_to("rb.append_transform(\n    CAIACTransform(layout, threshold", rb=rb)
    batch = rb.sample()
    assert batch["caiac", "counterfactual"].sum() == 4


@in_memory
def test_new_estimator(flat_data: TensorDictBase) -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    (code,) = [b for b in python_blocks(text) if "class DisplacementInfluence" in b]
    scope = {
        "EntityLayout": EntityLayout,
        "TensorDictBase": TensorDictBase,
        "torch": torch,
    }
    exec(compile(code, "CONTRIBUTING.md", "exec"), scope)
    rb = offline_buffer(flat_data, batch_size=8)
    score_buffer(
        rb, scope["DisplacementInfluence"](LAYOUT), lookahead=0, progress=False
    )
    score = rb.storage[:]["caiac", "score"]
    moved = (flat_data["next", "observation"] - flat_data["observation"]).abs()
    torch.testing.assert_close(score[:, 1], moved[:, 3:6].amax(-1))


@in_memory
def test_other_keys(flat_data: TensorDictBase) -> None:
    flat_data["collector", "traj_ids"] = flat_data.pop("episode")
    rb = offline_buffer(flat_data, batch_size=8)
    model = ready(GaussianWorldModel(LAYOUT, 2, (16, 16)))
    run_how_to("keys = ", rb=rb, estimator=CAI(model))
    assert rb.sample()["caiac", "counterfactual"].sum() == 4


@pytest.mark.parametrize("page", sorted(ROOT.glob("*.md")), ids=lambda p: p.name)
def test_files_that_pages_refer_to_exist(page: Path) -> None:
    targets = re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text())
    assert not [target for target in targets if not (ROOT / target).exists()]


def test_readme_is_short_and_names_loaders() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    named = re.findall(r"`((?:from|open|load)_\w+)`", text)
    assert named
    assert not set(named) - set(importlib.import_module("torchrl_caiac.data").__all__)


@pytest.mark.gpu
@in_memory
def test_on_a_gpu(flat_data: TensorDictBase) -> None:
    model = ready(GaussianWorldModel(LAYOUT, 2, (16, 16)))
    rb = run_how_to("model.to", data=flat_data, model=model)["rb"]
    batch = rb.sample()
    assert all(leaf.is_cuda for leaf in batch.values(True, True))
    assert batch["caiac", "swapped"].shape == (512, 3)
    scores = rb.storage[:]["caiac", "score"].cpu()
    score_buffer(rb, CAI(model.to("cpu")), overwrite=True, progress=False)
    torch.testing.assert_close(rb.storage[:]["caiac", "score"].cpu(), scores)
