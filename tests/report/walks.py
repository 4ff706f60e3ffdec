"""Random walks of a robot and two objects, with random scores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from torchrl_caiac import EntityLayout
from torchrl_caiac.scored import ScoredDataset

LAYOUT = EntityLayout(
    {"arm": [0, 1, 2], "cup": [3, 4, 5, 6], "box": [7, 8, 9, 10]},
    fixed=["arm"],
    positions={"arm": [0, 1, 2], "cup": [3, 4, 5], "box": [7, 8, 9]},
    variance_floor=0.01,
)


def transitions(episodes: int, length: int, width: int, seed: int = 0) -> TensorDict:
    """Random walks, without scores."""
    generator = torch.Generator().manual_seed(seed)
    steps = torch.randn(episodes, length + 1, width, generator=generator)
    # What is not in the first columns rests in three of four steps.
    moves = torch.rand(episodes, length + 1, 1, generator=generator) < 0.25
    steps[:, :, 3:] *= moves
    walk = steps.cumsum(1)
    end = torch.zeros(episodes, length, 1, dtype=torch.bool)
    end[:, -1] = True
    data = TensorDict(
        {
            "observation": walk[:, :-1],
            "action": steps[:, 1:, :2],
            "episode": torch.arange(episodes)[:, None].expand(-1, length),
            "next": {"observation": walk[:, 1:], "done": end},
        },
        [episodes, length],
    )
    return data.reshape(-1).contiguous()


def scored_dataset(
    data: TensorDict, layout: EntityLayout, *, seed: int = 1, **changes: Any
) -> ScoredDataset:
    """Gives transitions random scores in runs of some steps; threshold 0.5."""
    generator = torch.Generator().manual_seed(seed)
    runs = torch.rand(-(-len(data) // 7), len(layout), generator=generator)
    data["caiac", "score"] = runs.repeat_interleave(7, 0)[: len(data)]
    names = [name for name in layout.names if name not in layout.fixed]
    content: dict[str, Any] = {
        "path": Path("walks"),
        "data": data,
        "layout": layout,
        "estimator": "motion",
        "settings": {"smoothing": 1, "motion": {"tolerance": 0.01}},
        "thresholds": dict.fromkeys(names, 0.5),
        "confidence": dict.fromkeys(names, "two clear modes"),
        "reasons": dict.fromkeys(names, "a wide gap"),
        "free": dict.fromkeys(names, 0.5),
    }
    return ScoredDataset(**{**content, **changes})
