"""Data whose values name their rows, and what the rows of a sample may be.

The tests of both augmentations draw buffers here and compare samples with slow Python.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    SliceSampler,
    TensorStorage,
)

from torchrl_caiac import EntityLayout
from torchrl_caiac._fingerprints import fingerprint_key
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.transforms.counterfactual import CounterfactualTransform

THRESHOLD = 0.25
# Every value names the row and the column it comes from: row * STRIDE + column. Next
# states are named like the states of the row after them.
STRIDE = 16
DONORS = 64  # the name of the first row of donor buffers

FLAT = EntityLayout(
    {"arm": [0, 4], "cup": [5, 1, 2], "box": [7]},  # columns 3 and 6 are nobody's
    goal={"cup": [2, 0], "box": [1]},
    achieved={"cup": [1, 2], "box": [7]},
    fixed=["arm"],
)
FLAT_FREE = EntityLayout({"arm": [0, 4], "cup": [5, 1, 2], "box": [7]})
NESTED = EntityLayout.from_keys(
    {"arm": ("state", "arm"), "cup": ("state", "cup"), "box": ("state", "box")},
    goal={"cup": ("goal", "cup"), "box": None},
    achieved={"cup": ("got", "cup"), "box": None},
    fixed=["arm"],
)
N = 3


def leaf(rows: torch.Tensor, *shape: int, first: int = 0) -> torch.Tensor:
    """Values that tell their row and column."""
    value = rows.view(-1, 1) * STRIDE
    value = value + torch.arange(first, first + math.prod(shape))
    return value.view(-1, *shape)


def make_data(
    layout: EntityLayout,
    rows: torch.Tensor,
    lengths: list[int],
    generator: torch.Generator,
    dtype: torch.dtype = torch.float32,
    goals: bool = True,
) -> TensorDict:
    """Rows of trajectories whose every value names its row."""
    total = len(rows)
    episode = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    end = torch.zeros(total, 1, dtype=torch.bool)
    end[torch.tensor(lengths).cumsum(0) - 1] = True
    score = torch.rand(total, N, generator=generator)
    score[torch.rand(total, N, generator=generator) < 0.6] = 0.0
    td = TensorDict(
        {
            "row": rows,
            "episode": episode + 10 * int(rows[0]),
            "action": leaf(rows, 2).to(torch.float32),
            "next": {
                "reward": rows.to(torch.float32).unsqueeze(-1),
                "done": end,
                "terminated": torch.zeros_like(end),
                "truncated": end.clone(),
            },
            ("caiac", "score"): score,
        },
        [total],
    )
    for names, where in ((rows, ()), (rows + 1, ("next",))):
        if layout.is_flat:
            parts = {"observation": leaf(names, 8)}
            if goals:
                parts["achieved_goal"] = leaf(names, 3, first=8)
                parts["desired_goal"] = leaf(names, 3, first=11)
        else:
            parts = {
                ("state", "arm"): leaf(names, 2),
                ("state", "cup", "pos"): leaf(names, 3, first=2),
                ("state", "cup", "pose", "rot"): leaf(names, 2, 2, first=5),
                ("state", "box"): leaf(names, first=9),
            }
            if goals:
                parts["got", "cup"] = leaf(names, 2, first=10)
                parts["goal", "cup"] = leaf(names, 2, first=12)
        for key, value in parts.items():
            path = (key,) if isinstance(key, str) else key
            td[(*where, *path)] = value.to(dtype)
    return td


def owner_of(
    layout: EntityLayout, key: tuple[str, ...]
) -> list[str | None] | str | None:
    """Which entity a leaf, or each column of it, must follow."""
    if key[0] == "next":
        key = key[1:]
    if not layout.is_flat:
        return key[1] if key[0] in ("state", "got", "goal") else None
    if key == ("observation",):
        owner: list[str | None] = [None] * 8
        for name, columns in layout.columns.items():
            for column in columns:
                owner[column] = name
        return owner
    if key in (("achieved_goal",), ("desired_goal",)):
        owner = [None] * 3
        for name, columns in layout.goal.items():
            for column in columns:
                owner[column] = name
        return owner
    return None


class KnownScores:
    """Scores each state by the row that its values name."""

    in_keys = None

    def __init__(self, layout: EntityLayout, scores: dict[int, torch.Tensor]) -> None:
        self.layout = layout
        self.scores = scores
        shape = next(iter(scores.values())).shape
        self.last = torch.zeros(shape)  # of the states after the last row

    def __call__(self, td: TensorDict) -> torch.Tensor:
        arm = td["observation"] if self.layout.is_flat else td["state", "arm"]
        names = (arm[:, 0] // STRIDE).long().tolist()
        return torch.stack([self.scores.get(name, self.last) for name in names])

    def __repr__(self) -> str:
        return "KnownScores()"  # the same estimator, whatever it knows

    def __getstate__(self) -> dict[str, object]:
        return {}


def score(rb: ReplayBuffer, layout: EntityLayout, key: tuple[str, ...]) -> None:
    """Replaces stored scores by the same scores with fingerprints."""
    data = stored(rb)
    known = dict(zip(data["row"].tolist(), data[key].clone(), strict=True))
    score_buffer(
        rb,
        KnownScores(layout, known),
        lookahead=0,
        key=key,
        overwrite=True,
        check=False,  # the values of goals name rows and columns of their own
        progress=False,
    )


def write_later(
    rb: ReplayBuffer, later: TensorDict, key: tuple[str, ...], with_leaves: bool
) -> set[int]:
    """Adds rows that have no scores, or those of other states; returns their names."""
    if with_leaves:
        other = stored(rb)[torch.zeros(len(later), dtype=torch.int64)]
        for where in (key, fingerprint_key(key)):
            later[where] = other[where].clone()
        later[key] = torch.zeros_like(later[key])
    else:
        later = later.exclude(key)
    rb.extend(later)
    return set(later["row"].tolist())


@dataclass
class Case:
    layout: EntityLayout
    rb: ReplayBuffer
    transform: CounterfactualTransform
    donors: ReplayBuffer | None
    window: int
    ratio: float
    swap_prob: float
    rows: str
    stale: set[int]  # the rows whose scores must not be used

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        names = [stored(rb)["row"].tolist() for rb in (self.rb, self.donors) if rb]
        printer.text(f"{self.transform} on rows {names}, stale {self.stale}")


def stored(rb: ReplayBuffer) -> TensorDict:
    """The stored rows ``[T]``."""
    return rb.storage[:].reshape(-1)


def assert_same(td: TensorDict, other: TensorDict) -> None:
    """Raises where any value of two tensordicts differs; NaN equals NaN."""
    torch.testing.assert_close(
        td.to_dict(), other.to_dict(), rtol=0, atol=0, equal_nan=True
    )


def time_order(rb: ReplayBuffer) -> list[int]:
    """The storage's rows from the oldest to the newest: their names increase."""
    return stored(rb)["row"].argsort().tolist()


def time_windows(rb: ReplayBuffer, window: int) -> list[list[int]]:
    """All windows of one trajectory, as rows of the storage, one by one."""
    order, data, found = time_order(rb), stored(rb), []
    for start in range(len(order) - window + 1):
        part = order[start : start + window]
        names = data["row"][part].tolist()
        assert len(set(names)) == window
        if len(set(data["episode"][part].tolist())) == 1:
            assert names == list(range(names[0], names[0] + window))
            found.append(part)
    return found


def chosen_windows(case: Case, batch: TensorDict) -> list[bool]:
    """Which windows became counterfactual, after checks of their number and place."""
    flags = batch["caiac", "counterfactual"]
    assert flags.shape == (len(batch), 1) and flags.dtype == torch.bool
    marked = flags.view(-1, case.window)
    chosen = marked[:, 0]
    assert torch.equal(marked, chosen.unsqueeze(-1).expand_as(marked))
    count = round(case.ratio * len(chosen))
    assert int(chosen.sum()) == count
    if case.rows == "last":
        assert bool(chosen[len(chosen) - count :].all())
    return chosen.tolist()


# How rows are scored, and where donors lie.
KINDS = ["without fingerprints", "scored", "written later"]
FORMS = [None, "in order", "interleaved", "parallel"]
lengths = st.lists(st.integers(1, 9), min_size=1, max_size=4)


def slices(window: int) -> SliceSampler | None:
    """The sampler of windows."""
    if window == 1:
        return None
    return SliceSampler(slice_len=window, traj_key="episode")


def draw_buffer(
    draw: st.DrawFn,
    data: Callable[[torch.Tensor, list[int]], TensorDict],
    layout: EntityLayout,
    key: tuple[str, ...],
    first: int,
    form: str,
    window: int,
    kind: str,
    stale: set[int],
    **kwargs: Any,
) -> ReplayBuffer:
    """Draws a buffer of rows from ``first`` on, and adds unscored ones to ``stale``."""
    parts = [*draw(lengths), draw(st.integers(window, window + 4))]
    later = draw(st.lists(st.integers(1, 3), min_size=1, max_size=2))
    later = later if kind == "written later" and form != "parallel" else []
    total = sum(parts)
    made = data(first + torch.arange(total + sum(later)), parts + later)
    made, more = made[:total], made[total:]
    storage = draw(st.sampled_from([LazyTensorStorage, LazyMemmapStorage]))
    if form == "parallel":  # the second half is another environment
        made["episode"] += 5 * (torch.arange(total) >= total // 2)
        made = made[: total // 2 * 2].view(2, -1)  # environments, then time
        rb = ReplayBuffer(storage=storage(max(2, made.numel()), ndim=2), **kwargs)
        rb.extend(made)
    else:
        if form == "interleaved":
            # a random order of all rows in which each trajectory is in order
            ids = made["episode"]
            mixed = ids[torch.tensor(draw(st.permutations(range(total))))]
            order = torch.empty(total, dtype=torch.int64)
            for number in ids.unique():
                order[mixed == number] = (ids == number).nonzero()[:, 0]
            made = made[order]
        # a storage smaller than the data is a ring that was written past its end
        least = max(window, total // 2)
        rb = ReplayBuffer(
            storage=storage(draw(st.integers(least, total + 2))), **kwargs
        )
        for begin in range(0, total, least):
            rb.extend(made[begin : begin + least])
    if kind != "without fingerprints":
        score(rb, layout, key)
    if len(more):
        stale.update(write_later(rb, more, key, draw(st.booleans())))
    return rb


def check_samples(case: Case, check: Callable[..., Any]) -> None:
    """Raises where two samples, or the storages after them, are not as they must be."""
    if not time_windows(case.rb, case.window):
        return  # the ring left no trajectory as long as the window
    before = case.rb.storage[:].clone()
    others = None if case.donors is None else case.donors.storage[:].clone()
    case.rb.append_transform(case.transform)
    missing, unscored = [0] * N, 0
    for _ in range(2):
        batch = case.rb.sample()
        check(case, batch, missing)
        unscored += sum(row in case.stale for row in batch["row"].tolist())
    if case.swap_prob == 1.0:
        assert case.transform.no_donor_count.tolist() == missing
    assert case.transform.unscored_count == unscored
    assert_same(case.rb.storage[:], before)
    if others is not None:
        assert_same(case.donors.storage[:], others)


def small(
    layout: EntityLayout = FLAT,
    storage: type[TensorStorage] = LazyTensorStorage,
    window: int = 1,
    batch: int = 8,
    size: int = 20,
    free: bool = True,
    **kwargs: Any,
) -> ReplayBuffer:
    """A buffer of two trajectories of ten rows, all of them free of influence."""
    generator = torch.Generator().manual_seed(0)
    data = make_data(
        layout,
        torch.arange(20),
        [10, 10],
        generator,
        goals=layout is not FLAT_FREE,
    )
    if free:
        data["caiac", "score"].zero_()
    rb = ReplayBuffer(
        storage=storage(size),
        sampler=slices(window),
        batch_size=batch * window,
        **kwargs,
    )
    rb.extend(data)
    return rb
