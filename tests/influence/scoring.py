"""Episodes, buffers and estimators to test scores with, and a slow definition."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer

from torchrl_caiac import EntityLayout

KEY = ("caiac", "score")
LAYOUT = EntityLayout({"arm": [0], "cup": [1], "pot": [2]})


class Read(nn.Module):
    """Each entity's score is a simple function of its column, row by row."""

    def __init__(self, scale=1.0, layout=LAYOUT):
        super().__init__()
        self.layout = layout
        self.register_buffer("scale", torch.tensor(float(scale)))
        self.rows = []

    def forward(self, td):
        self.rows.append(len(td))
        return (self.layout.read(td).float() * self.scale).square()

    def extra_repr(self):
        return ""  # what it counts is not a setting


class Graph(Read):
    in_keys = ("observation", "action")

    def forward(self, td):
        x = self.layout.read(td)
        return x[:, None, :] * torch.ones(4, 1) + td["action"][:, :1, None]


def ready(model):
    """Has a world model count as fitted: unit variances, actions in [-1, 1]."""
    model.fit_statistics(torch.tensor([[-1.0], [1.0]]).expand(2, model.predict_dim))
    model.set_action_bounds(-1.0, 1.0)
    return model


class Failing(Read):
    """Is interrupted at call number ``calls``; its settings are those of ``Read``."""

    def __init__(self, calls):
        super().__init__()
        self.calls = calls

    def forward(self, td):
        if len(self.rows) == self.calls:
            raise KeyboardInterrupt
        return super().forward(td)


def episodes(lengths, *, width=3, seed=0, first_id=0):
    g = torch.Generator().manual_seed(seed)
    out = []
    for i, n in enumerate(lengths):
        x = torch.randn(n + 1, width, generator=g)
        done = torch.zeros(n, 1, dtype=torch.bool)
        done[-1] = True
        out.append(
            TensorDict(
                {
                    "observation": x[:-1],
                    "action": torch.randn(n, 2, generator=g),
                    "episode": torch.full((n,), first_id + i),
                    "next": {"observation": x[1:], "done": done},
                },
                [n],
            )
        )
    return torch.cat(out)


def storage_of(kind, size, tmp_path, **kwargs):
    if kind == "memory":
        return LazyTensorStorage(size, **kwargs)
    if kind == "memmap":
        return LazyMemmapStorage(size, scratch_dir=tmp_path / "data", **kwargs)
    return LazyMemmapStorage(size, **kwargs)


def filled(rows, kind="memory", size=None, tmp_path=None, **kwargs):
    rb = ReplayBuffer(
        storage=storage_of(kind, size or len(rows), tmp_path), batch_size=4, **kwargs
    )
    rb.extend(rows)
    return rb


def trajectories_of(rows, order=None):
    """Lists of row numbers, split by ids and end flags, in the given order."""
    order = list(range(len(rows))) if order is None else order
    result = [[]]
    for t in order:
        if result[-1]:
            last = result[-1][-1]
            if (
                rows["episode"][last] != rows["episode"][t]
                or rows["next", "done"][last]
            ):
                result.append([])
        result[-1].append(t)
    return result


def definition(rows, score, smoothing, lookahead, order=None):
    """The definition in the docstring, one number at a time."""
    out = [None] * len(rows)
    for trajectory in trajectories_of(rows, order):
        states = [rows["observation"][t].tolist() for t in trajectory]
        states.append(rows["next", "observation"][trajectory[-1]].tolist())
        n = len(trajectory)
        raw = [[score(x) for x in state] for state in states]
        smooth = []
        for k in range(n + 1):
            window = [
                m
                for m in range(n + 1)
                if k - smoothing // 2 <= m <= k + (smoothing - 1) // 2
            ]
            smooth.append(
                [sum(raw[m][j] for m in window) / len(window) for j in range(3)]
            )
        for i, t in enumerate(trajectory):
            ahead = range(i, min(i + lookahead, n) + 1)
            out[t] = [max(smooth[k][j] for k in ahead) for j in range(3)]
    return torch.tensor(out)


def square(x):
    return x * x


def scores(rb, key=KEY):
    return rb.storage[:][key].clone()
