"""A small dataset in which every number tells where it comes from, in any storage."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import (
    HERReplayBuffer,
    LazyMemmapStorage,
    LazyTensorStorage,
    PrioritizedSliceSampler,
    RandomSampler,
    ReplayBuffer,
    ReplayBufferEnsemble,
    SamplerWithoutReplacement,
    SliceSampler,
    SliceSamplerWithoutReplacement,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)

from torchrl_caiac import EntityLayout
from torchrl_caiac.data import load_transitions, offline_buffer

EPISODES, LENGTH, WINDOW = 8, 15, 10
ROWS = EPISODES * LENGTH
NAMES = ("arm", "cup", "box")


@dataclasses.dataclass(frozen=True)
class Case:
    """One way of storing and sampling the dataset."""

    storage: str
    buffer: str
    sampler: str
    layout: str
    window: int
    goals: bool
    donors: str
    rows: str
    prefetch: int
    transform: str


AXES: dict[str, list[Any]] = {
    "storage": ["memory", "memmap", "folder", "ring", "loaded", "interleaved", "ndim"],
    "buffer": ["plain", "tensordict", "prioritized", "her", "ensemble"],
    "sampler": ["replacement", "no replacement"],
    "layout": ["flat", "nested", "float64"],
    "window": [1, WINDOW],
    "goals": [False, True],
    "donors": ["batch", "buffer"],
    "rows": ["random", "last"],
    "prefetch": [0, 2],
    "transform": ["caiac", "coda"],
}


def layout_of(kind: str) -> EntityLayout:
    if kind == "nested":
        return EntityLayout.from_keys(
            {name: ("state", name) for name in NAMES},
            goal={"cup": ("goal", "cup"), "box": ("goal", "box")},
            achieved={"cup": ("state", "cup"), "box": ("state", "box")},
            fixed=["arm"],
        )
    return EntityLayout(
        {"arm": [0], "cup": [1], "box": [2]},
        goal={"cup": [0], "box": [1]},
        achieved={"cup": [1], "box": [2]},
        fixed=["arm"],
    )


def value(episode: torch.Tensor, step: torch.Tensor, entity: int) -> torch.Tensor:
    """A number that names the entity, its episode and its step."""
    return (1000 * entity + 100 * episode + step).float().unsqueeze(-1)


def origin(number: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The entity, the episode and the step of a number."""
    whole = number.round().long().squeeze(-1)
    return whole // 1000, whole % 1000 // 100, whole % 100


def influenced(episode: torch.Tensor, step: torch.Tensor, entity: int) -> torch.Tensor:
    """Two thirds of the episodes leave an entity alone, the others in their half."""
    if entity == 0:
        return torch.ones_like(step, dtype=torch.bool)
    return (episode % 3 == entity) & (step >= 8)


def transitions(kind: str, episodes: list[int]) -> TensorDict:
    episode = torch.tensor(episodes).repeat_interleave(LENGTH)
    step = torch.arange(LENGTH).repeat(len(episodes))
    done = (step == LENGTH - 1).unsqueeze(-1)

    def state(step: torch.Tensor) -> dict[str, Any]:
        parts = [value(episode, step, i) for i in range(3)]
        if kind == "nested":
            return {"state": dict(zip(NAMES, parts, strict=True))}
        # The last column has no owner.
        whole = torch.cat([*parts, episode.float().unsqueeze(-1)], -1)
        whole = whole.double() if kind == "float64" else whole
        return {"observation": whole, "achieved_goal": whole[:, 1:3].clone()}

    # The desired goals name the episode, at a step that no state has.
    desired = [value(episode, torch.full_like(step, 99), i) for i in (1, 2)]
    wide = torch.float64 if kind == "float64" else torch.float32
    goal = (
        {"goal": dict(zip(NAMES[1:], desired, strict=True))}
        if kind == "nested"
        else {"desired_goal": torch.cat(desired, -1).to(wide)}
    )
    return TensorDict(
        {
            **state(step),
            **goal,
            # Names the row.
            "action": value(episode, step, 7),
            "episode": episode,
            "next": {
                **state(step + 1),
                "reward": -torch.ones(len(step), 1),
                "done": done,
                "terminated": torch.zeros_like(done),
            },
        },
        [len(step)],
    )


class Known:
    """Scores or graphs from the numbers of the states."""

    def __init__(self, layout: EntityLayout, graphs: bool) -> None:
        self.layout, self.graphs = layout, graphs

    def __repr__(self) -> str:
        return f"Known(graphs={self.graphs})"

    def __call__(self, td: TensorDictBase) -> torch.Tensor:
        states = self.layout.read(td)
        scores = torch.stack(
            [influenced(*origin(states[:, i, None])[1:], i).float() for i in range(3)],
            -1,
        )
        if not self.graphs:
            return scores
        # Entities do not influence each other; the action is the last row.
        return torch.cat([torch.zeros(len(td), 3, 3), scores.unsqueeze(1)], 1)


def sampler_of(case: Case) -> Any:
    whole = case.sampler == "no replacement"
    if case.buffer == "prioritized":
        if case.window == 1:
            return None
        return PrioritizedSliceSampler(
            max_capacity=ROWS,
            alpha=0.7,
            beta=0.5,
            slice_len=case.window,
            traj_key="episode",
        )
    if case.window == 1:
        return SamplerWithoutReplacement() if whole else RandomSampler()
    kind = SliceSamplerWithoutReplacement if whole else SliceSampler
    return kind(slice_len=case.window, traj_key="episode")


def stored(
    case: Case,
    folder: Path,
    episodes: list[int],
    batch_size: int,
    sample_unit: Any = None,
    goals: Any = None,
) -> ReplayBuffer:
    """Creates a buffer of some episodes."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = transitions(case.layout, episodes)
    count = len(rows)
    arguments: dict[str, Any] = {"batch_size": batch_size, "prefetch": case.prefetch}
    sampler = sampler_of(case)
    if sampler is not None and case.buffer != "her":
        arguments["sampler"] = sampler
    if sample_unit is not None:
        arguments["sample_unit"] = sample_unit
    make: Any = TensorDictReplayBuffer
    if case.buffer == "plain":
        make = ReplayBuffer
    elif case.buffer == "prioritized" and case.window == 1:
        make = TensorDictPrioritizedReplayBuffer
        arguments |= {"alpha": 0.7, "beta": 0.5}
    elif case.buffer == "her":
        make = HERReplayBuffer
        arguments |= {
            "reward_fn": goals.her_reward,
            "her_ratio": 0.25,
            "achieved_goal_key": ("next", "achieved_goal"),
        }
    if case.storage == "folder":
        rows.memmap(folder / "rows")
        data = load_transitions(folder / "rows")
        if make is TensorDictReplayBuffer:
            return offline_buffer(data, **arguments)
        storage: Any = LazyMemmapStorage(count)
    elif case.storage == "memmap":
        storage = LazyMemmapStorage(count, scratch_dir=folder / "storage")
    elif case.storage == "ndim":
        storage = LazyTensorStorage(count, ndim=2)
        arguments["dim_extend"] = 0
    else:
        storage = LazyTensorStorage(count)
    rb: ReplayBuffer = make(storage=storage, **arguments)
    if case.storage == "ndim":  # two environments, one episode after another
        columns = [rows[: count // 2], rows[count // 2 :]]
        rb.extend(torch.stack(columns, 1))
    elif case.storage == "interleaved":
        order = torch.arange(count).view(-1, LENGTH).t().reshape(-1)
        rb.extend(rows[order])
    elif case.storage in ("ring", "loaded"):
        other = transitions(case.layout, [9, 9, 9])
        rb.extend(other[: count // 2 - 7])
        rb.extend(rows)
    else:
        rb.extend(rows)
    if case.storage == "loaded":
        rb.dumps(folder / "saved")
        del arguments["batch_size"]
        again: ReplayBuffer = make(
            storage=LazyTensorStorage(count), batch_size=batch_size, **arguments
        )
        again.loads(folder / "saved")
        return again
    return rb


def ensemble(parts: list[ReplayBuffer], batch_size: int) -> ReplayBufferEnsemble:
    return ReplayBufferEnsemble(*parts, sample_from_all=True, batch_size=batch_size)
