"""Data and buffers for tests of HindsightGoal, and what the rows of a sample may be."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import HERReplayBuffer, LazyTensorStorage, ReplayBuffer
from torchrl.envs.transforms import Transform

from torchrl_caiac import EntityLayout
from torchrl_caiac.transforms import CAIACTransform, HindsightGoal, TransformKeys

# Goal columns 2, 0 are the cup's, column 1 the box's; observation column 4 is nobody's.
FLAT = EntityLayout(
    {"arm": [0], "cup": [1, 2], "box": [3]},
    goal={"cup": [2, 0], "box": [1]},
    achieved={"cup": [1, 2], "box": [3]},
    fixed=["arm"],
)
NESTED = EntityLayout.from_keys(
    {"arm": ("s", "arm"), "cup": ("s", "cup"), "box": ("s", "box")},
    goal={"cup": ("g", "cup"), "box": ("g", "box")},
    achieved={"cup": ("s", "cup"), "box": ("s", "box")},
    fixed=["arm"],
)
THRESHOLD = 0.5
STRIDE = 8


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    """Whole numbers, so that no rounding is in the way."""
    return -(achieved - desired).abs().sum(-1)


def make(
    lengths: list[int],
    layout: EntityLayout = FLAT,
    *,
    stale: bool = False,
    achieved: bool = False,
    dtype: torch.dtype = torch.float32,
    seed: int = 0,
) -> TensorDict:
    """Rows that name themselves: column c of row r holds ``r * STRIDE + c``.

    Next states hold the same of row r + 1, desired goals are negative. With ``stale``
    all rewards are 0.5, which ``reward`` never returns; with ``achieved``, flat data
    hold the achieved goals as well.
    """
    total = sum(lengths)
    rows = torch.arange(total)
    done = torch.zeros(total, 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    state = (rows.view(-1, 1) * STRIDE + torch.arange(5)).to(dtype)
    goal = -1 - (rows.view(-1, 1) * STRIDE + torch.tensor([2, 3, 1])).to(dtype)
    generator = torch.Generator().manual_seed(seed)
    td = TensorDict(
        {
            "row": rows,
            "episode": torch.repeat_interleave(
                torch.arange(len(lengths)), torch.tensor(lengths)
            ),
            "action": torch.rand(total, 2, generator=generator),
            "next": {"done": done, "terminated": torch.zeros_like(done)},
            ("caiac", "score"): torch.rand(total, 3, generator=generator),
        },
        [total],
    )
    if layout is FLAT:
        td.update({"observation": state, "desired_goal": goal})
        td["next", "observation"] = state + STRIDE
        td["next", "desired_goal"] = goal.clone()
        if achieved:
            td["achieved_goal"] = state[:, [2, 3, 1]]
            td["next", "achieved_goal"] = state[:, [2, 3, 1]] + STRIDE
    else:
        for where, value in (((), state), (("next",), state + STRIDE)):
            td[(*where, "s", "arm")] = value[:, :1]
            td[(*where, "s", "cup", "x")] = value[:, 1:2]
            td[(*where, "s", "cup", "y")] = value[:, 2]
            td[(*where, "s", "box")] = value[:, 3:4]
            td[(*where, "g", "cup", "x")] = goal[:, 2:]
            td[(*where, "g", "cup", "y")] = goal[:, 0]
            td[(*where, "g", "box")] = goal[:, 1:2]
    gained = reward(vectors(td, "next"), vectors(td)).unsqueeze(-1)
    td["next", "reward"] = torch.full_like(gained, 0.5) if stale else gained
    return td


def vectors(td: TensorDictBase, which: str = "goal") -> torch.Tensor:
    """Cup's two and box's one value ``[B, 3]`` of goals, states or next states."""
    if "observation" in td:
        if which == "goal":
            return td["desired_goal"][:, [2, 0, 1]]
        source = td["observation"] if which == "now" else td["next", "observation"]
        return source[:, 1:4]
    td = td["next"] if which == "next" else td
    td = td["g"] if which == "goal" else td["s"]
    return torch.cat([td["cup", "x"], td["cup", "y"].unsqueeze(-1), td["box"]], -1)


@dataclass
class Case:
    rb: ReplayBuffer
    goals: HindsightGoal
    lengths: list[int]
    caiac: CAIACTransform | None


def build_case(
    lengths: list[int],
    layout: EntityLayout = FLAT,
    *,
    order: str = "augment, relabel",
    storage: type = LazyTensorStorage,
    size: int | None = None,
    batch: int = 8,
    ids: bool = True,
    seed: int = 0,
    caiac: dict | None = None,
    data: dict | None = None,
    prefetch: int | None = None,
    kind: type[ReplayBuffer] = ReplayBuffer,
    rb_kwargs: dict | None = None,
    **kwargs,
) -> Case:
    """A buffer that is filled piece by piece and has the transforms in some order."""
    content = make(lengths, layout, seed=seed, **(data or {}))
    if not ids:
        content = content.exclude("episode")
    keys = TransformKeys() if ids else TransformKeys(trajectory=None)
    generator = torch.Generator().manual_seed(seed)
    goals = HindsightGoal(layout, reward, generator=generator, keys=keys, **kwargs)
    augment = CAIACTransform(
        layout,
        THRESHOLD,
        generator=torch.Generator().manual_seed(seed + 1),
        keys=keys,
        **(caiac or {}),
    )
    rb_kwargs = rb_kwargs or {}
    if kind is HERReplayBuffer:
        rb_kwargs = {"reward_fn": goals.her_reward, **rb_kwargs}
    rb = kind(
        storage=storage(size or len(content)),
        sample_unit=goals if goals.future else None,
        batch_size=batch,
        prefetch=prefetch,
        **rb_kwargs,
    )
    for begin in range(0, len(content), 3):
        rb.extend(content[begin : begin + 3])
    rb.set_rng(torch.Generator().manual_seed(seed + 2))
    known: dict[str, Transform] = {"augment": augment, "relabel": goals}
    for name in order.split(", "):
        rb.append_transform(known[name])
    return Case(rb, goals, lengths, augment if "augment" in order else None)


def check_batch(
    case: Case, batch: TensorDictBase, stored: TensorDictBase, *, her: int = 0
) -> None:
    """Raises where a row is anything that it may not be.

    ``stored`` are the batch's rows as they lie in the storage; the first ``her`` rows
    were relabelled by HERReplayBuffer.
    """
    goals, rows = case.goals, batch.shape[0]
    relabeled = batch["hindsight", "relabeled"]
    assert relabeled.shape == (rows, 1) and relabeled.dtype == torch.bool
    if case.caiac is None:
        assert ("caiac", "counterfactual") not in leaves(batch)
        flags = [False] * rows
    else:
        flags = batch["caiac", "counterfactual"][:, 0].tolist()
        assert sum(flags) == case.caiac.num_counterfactual(rows)
    ends = torch.tensor(case.lengths).cumsum(0).sub(1).tolist()
    goal, kept = vectors(batch).tolist(), vectors(stored).tolist()
    reached, origin = vectors(batch, "next").tolist(), vectors(batch, "now").tolist()
    gained, before = batch["next", "reward"], stored["next", "reward"]
    new = {("hindsight", "relabeled")}
    if case.caiac is not None:
        new |= {("caiac", "counterfactual"), ("caiac", "swapped")}
    assert leaves(batch) - leaves(stored) - {("index",)} == new
    assert leaves(stored) <= leaves(batch)
    follows = ("desired_goal", "g", "reward")
    for b in range(rows):
        again = bool(relabeled[b])
        if not flags[b]:
            for key in leaves(stored):  # invariant 3
                if not again or not any(name in follows for name in key):
                    assert torch.equal(batch[key][b], stored[key][b]), (b, key)
        if again and flags[b]:
            options = [reached[i] for i in range(rows) if flags[i]]
            assert goals.counterfactual > 0 and goal[b] in options
        elif again:
            name = int(stored["row"][b])
            last = next(end for end in ends if end >= name)
            options = [
                [(later + 1) * STRIDE + column for column in (1, 2, 3)]
                for later in range(name, last + 1)
            ]
            if b >= her:
                options = options if goals.future else []
                if goals.random:
                    options += [reached[i] for i in range(rows) if not flags[i]]
            assert goal[b] in options
        elif flags[b]:
            # each entity's goal is the one that was stored beside its state
            assert goal[b] == [-1 - value for value in origin[b]]
        else:
            assert goal[b] == kept[b]
        wanted = -sum(abs(x - y) for x, y in zip(reached[b], goal[b], strict=True))
        if again or flags[b] or float(before[b]) != 0.5:
            assert float(gained[b]) == wanted
        else:
            assert float(gained[b]) == 0.5
    if ("next", "desired_goal") in leaves(batch):
        assert torch.equal(batch["next", "desired_goal"], batch["desired_goal"])
    if ("next", "g", "box") in leaves(batch):
        assert (batch["next", "g"] == batch["g"]).all()


def leaves(td: TensorDictBase) -> set[tuple[str, ...]]:
    return {k if isinstance(k, tuple) else (k,) for k in td.keys(True, True)}


def stored_rows(rb: ReplayBuffer, batch: TensorDictBase) -> TensorDictBase:
    raw = rb.storage[:]
    place = {int(row): i for i, row in enumerate(raw["row"])}
    return raw[torch.tensor([place[row] for row in batch["row"].tolist()])]
