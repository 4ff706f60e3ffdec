"""The code that README.md and docs/usage.md show runs, on a small dataset."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium
import minari
import numpy as np
import pytest
import torch
from minari.data_collector import EpisodeBuffer
from tensordict import TensorDictBase
from torchrl.data import SliceSampler

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.transforms import WindowGoal

ROOT = Path(__file__).parents[1]


def python_blocks(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


def make_dataset(name: str, episodes: int = 4, steps: int = 30) -> None:
    """A dataset with the README's 34 observation columns and 4 action columns."""
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


@pytest.mark.filterwarnings("ignore::UserWarning")  # a dataset without an author
def test_bring_your_own_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    make_dataset("my/pushing-v0")
    (code,) = [
        b for b in python_blocks((ROOT / "README.md").read_text()) if "CAI(" in b
    ]
    code, changed = re.subn(r"steps=[\d_]+", "steps=20, eval_every=10", code)
    assert changed == 1
    scope: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), scope)
    batch = scope["batch"]
    assert batch["caiac", "swapped"].shape == torch.Size([512, 3])
    assert batch["caiac", "counterfactual"].sum() == 256


@pytest.mark.parametrize("storage_kind", ["memory"], indirect=True)
def test_windows(flat_data: TensorDictBase) -> None:
    layout = EntityLayout(
        {"robot": range(3), "cup": [3, 4, 5], "jug": [6, 7, 8]},
        goal={"cup": [0, 1], "jug": [2, 3]},
        achieved={"cup": [3, 4], "jug": [6, 7]},
        fixed=["robot"],
    )
    data = flat_data[flat_data["episode"] == 1]  # the one that is long enough
    data["caiac", "score"] = torch.zeros(len(data), 3)
    text = (ROOT / "docs" / "usage.md").read_text()
    (code,) = [b for b in python_blocks(text) if "WindowGoal" in b]
    scope = {
        "CAIACTransform": CAIACTransform,
        "SliceSampler": SliceSampler,
        "WindowGoal": WindowGoal,
        "data": data,
        "layout": layout,
        "offline_buffer": offline_buffer,
    }
    exec(compile(code, "usage.md", "exec"), scope)
    windows = scope["windows"]
    assert windows.batch_size == (128, 10)
    assert windows["caiac", "swapped"].any()
