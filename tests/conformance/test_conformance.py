"""Every invariant of the transforms, over storages, buffers, samplers and layouts.

By default each pair of values of two axes occurs. ``CONFORMANCE=full`` runs the whole
product, in a few minutes.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from pathlib import Path
from typing import Any

import pytest
import torch
from allpairspy import AllPairs
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer, TensorStorage

from tests.conformance.world import (
    AXES,
    EPISODES,
    LENGTH,
    NAMES,
    WINDOW,
    Case,
    Known,
    ensemble,
    influenced,
    layout_of,
    origin,
    stored,
)
from torchrl_caiac import CAIACTransform, CoDATransform
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.transforms import HindsightGoal, WindowGoal

REAL = 0.5


def is_possible(case: Case) -> bool:
    """Whether TorchRL can store and sample like this; ours may still refuse it."""
    flat_storage = case.storage not in ("ndim", "interleaved")
    if case.buffer == "her":
        # One-dimensional, flat goals, transitions; writes between samples crash it.
        return (
            case.window == 1
            and flat_storage
            and case.layout != "nested"
            and case.goals
            and case.sampler == "replacement"
            and case.storage not in ("ring", "loaded")
        )
    if case.window > 1 and case.storage == "interleaved":
        return False  # slices are of rows that lie together
    if case.buffer == "ensemble":
        # Its members draw no goals for it, and prefetch for themselves.
        if case.storage in ("loaded", "ndim") or case.prefetch or case.goals:
            return False
        return case.sampler == "replacement"
    if case.buffer == "prioritized":
        if case.sampler != "replacement":
            return False
        return flat_storage or case.window == 1
    if case.sampler == "no replacement":
        # Without replacement TorchRL samples one-dimensional storages.
        return case.storage != "ndim"
    return True


def valid(values: list[Any]) -> bool:
    if len(values) < len(AXES):
        return True
    return is_possible(Case(*values))


def cases(*, may_be_full: bool = False) -> list[Case]:
    if may_be_full and os.environ.get("CONFORMANCE") == "full":
        product = (Case(*values) for values in itertools.product(*AXES.values()))
        return [case for case in product if is_possible(case)]
    return [
        Case(*values) for values in AllPairs(list(AXES.values()), filter_func=valid)
    ]


def name_of(case: Case) -> str:
    return "-".join(str(value) for value in dataclasses.astuple(case))


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return -(achieved - desired).abs().sum(-1)


class Setup:
    """A buffer with scores and transforms."""

    def __init__(self, case: Case, folder: Path) -> None:
        self.case = case
        self.layout = layout_of(case.layout)
        self.key = ("coda", "graph") if case.transform == "coda" else ("caiac", "score")
        size = 8 * case.window
        generator = torch.Generator().manual_seed(0)
        goals: Any = None
        if case.goals and case.window == 1:
            future = 0.0 if case.buffer == "her" else 0.5
            goals = HindsightGoal(
                self.layout, reward, future=future, generator=generator
            )
        elif case.goals:
            goals = WindowGoal(self.layout, case.window, generator=generator)
        self.goals = goals
        arguments: dict[str, Any] = {"goals": goals}
        if goals is not None and case.buffer != "her":
            arguments["sample_unit"] = goals
        self.parts: list[ReplayBuffer]
        every = list(range(EPISODES))
        if case.buffer == "ensemble":
            members = dataclasses.replace(case, buffer="tensordict")
            halves = [every[::2], every[1::2]]
            self.parts = [
                stored(members, folder / str(i), half, size)
                for i, half in enumerate(halves)
            ]
        else:
            self.parts = [stored(case, folder, every, size, **arguments)]
        for part in self.parts:
            self.score(part)
        self.rb = (
            ensemble(self.parts, size) if case.buffer == "ensemble" else self.parts[0]
        )
        donors: Any = None
        if case.donors == "buffer":
            other = dataclasses.replace(case, buffer="tensordict", prefetch=0)
            donors = stored(other, folder / "donors", every, size)
            self.score(donors)
        kind: Any = CAIACTransform if case.transform == "caiac" else CoDATransform
        window_goals = goals if case.window > 1 and donors is not None else None
        self.transform = kind(
            self.layout,
            0.5,
            REAL,
            rows=case.rows,
            window=case.window,
            donors=donors,
            reward_fn=None if goals is not None and case.window == 1 else reward,
            goals=window_goals,
            generator=generator,
        )
        self.generator = generator
        if case.window > 1 and goals is not None:
            self.rb.append_transform(goals)
        self.rb.append_transform(self.transform)
        if case.window == 1 and goals is not None:
            self.rb.append_transform(goals)

    def score(self, rb: ReplayBuffer) -> None:
        estimator = Known(self.layout, graphs=self.case.transform == "coda")
        score_buffer(rb, estimator, 16, lookahead=0, key=self.key, progress=False)

    def storages(self) -> list[TensorStorage]:
        return [part.storage for part in self.parts]

    def state(self, td: TensorDictBase, *, after: bool = False) -> torch.Tensor:
        return self.layout.read(td, next=after)

    def desired(self, td: TensorDictBase) -> torch.Tensor:
        if self.layout.is_flat:
            return td["desired_goal"]
        return torch.cat([td["goal", name] for name in NAMES[1:]], -1)


def check_batch(setup: Setup, batch: TensorDictBase) -> None:
    """Compares a batch with what its numbers say about it."""
    case, window = setup.case, setup.case.window
    batch = batch.reshape(-1)
    _, episode, step = origin(batch["action"])
    flags = batch["caiac", "counterfactual"].view(-1, window)
    swapped = batch["caiac", "swapped"].view(-1, window, 3)
    assert (flags == flags[:, :1]).all() and (swapped == swapped[:, :1]).all()
    assert flags[:, 0].sum() == round(REAL * len(flags))
    if case.rows == "last":
        assert flags[len(flags) // 2 :].all()
    # Windows are successive rows of one episode.
    if window > 1:
        assert (episode.view(-1, window).diff() == 0).all()
        assert (step.view(-1, window).diff() == 1).all()
    here, there = setup.state(batch), setup.state(batch, after=True)
    for i in range(3):
        is_swapped = batch["caiac", "swapped"][:, i]
        entity, from_episode, from_step = origin(here[:, i, None])
        entity_after, episode_after, step_after = origin(there[:, i, None])
        assert (entity == i).all() and (entity_after == i).all()
        # State and next state come from one row.
        assert torch.equal(from_episode, episode_after)
        assert torch.equal(from_step + 1, step_after)
        own = (from_episode == episode) & (from_step == step)
        assert own[~is_swapped].all()
        # Neither the row nor its donor is influenced, in the whole window.
        held = influenced(episode, step, i) | influenced(from_episode, from_step, i)
        assert not held[is_swapped].any()
        if window > 1:  # a whole window of one trajectory
            assert (from_episode.view(-1, window).diff() == 0).all()
            assert (from_step.view(-1, window).diff() == 1).all()
    assert not (swapped & ~flags.unsqueeze(-1)).any()
    check_goals(setup, batch, episode, step)


def check_goals(
    setup: Setup, batch: TensorDictBase, episode: torch.Tensor, step: torch.Tensor
) -> None:
    case, window = setup.case, setup.case.window
    there, desired = setup.state(batch, after=True), setup.desired(batch)
    if setup.layout.is_flat:
        here = setup.state(batch)
        assert torch.equal(batch["achieved_goal"], here[:, 1:])
        assert torch.equal(batch["next", "achieved_goal"], there[:, 1:])
    flags = batch["caiac", "counterfactual"].flatten()
    rewards = batch["next", "reward"].flatten()
    relabeled = batch.get(("hindsight", "relabeled"), None)
    is_new = flags if relabeled is None else flags | relabeled.flatten()
    expected = reward(there[:, 1:], desired).to(rewards)
    assert torch.equal(rewards[is_new], expected[is_new])
    assert (rewards[~is_new] == -1).all()
    for i, name in enumerate(("cup", "box"), 1):
        entity, goal_episode, goal_step = origin(desired[:, i - 1, None])
        assert (entity == i).all(), name
        _, own_episode, own_step = origin(there[:, i, None])
        if not case.goals:  # as stored, by the episode that the entity comes from
            assert torch.equal(goal_episode, own_episode) and (goal_step == 99).all()
        elif window > 1:  # later in the trajectory of the entity
            assert torch.equal(goal_episode, own_episode)
            ends = own_step.view(-1, window)[:, -1:].expand(-1, window).flatten()
            assert (goal_step >= ends).all() and (goal_step <= LENGTH).all()
        else:
            assert relabeled is not None
            real = relabeled.flatten() & ~flags
            assert torch.equal(goal_episode[real], own_episode[real])
            assert (goal_step[real] >= own_step[real]).all()
            assert (goal_step[~relabeled.flatten()] == 99).all()


@pytest.mark.parametrize("case", cases(may_be_full=True), ids=name_of)
def test_invariants(case: Case, tmp_path: Path) -> None:
    setup = Setup(case, tmp_path)
    if case.buffer == "her" and case.rows == "random":
        with pytest.raises(RuntimeError, match="rows='last'"):
            setup.rb.sample()
        return
    before = [storage[:].clone() for storage in setup.storages()]
    swaps = 0
    for _ in range(12):
        batch = setup.rb.sample()
        check_batch(setup, batch)
        swaps += int(batch["caiac", "swapped"].sum())
    assert swaps
    for storage, known in zip(setup.storages(), before, strict=True):
        assert (storage[:] == known).all()
    # A score is used only for the state that it was computed from.
    for storage in setup.storages():
        key = setup.layout.in_keys[-1]
        storage[:][key][..., -1:].sub_(500)
    with pytest.raises(ValueError, match=r"other states|do not follow"):
        for _ in range(4):  # batches may have been prefetched
            setup.rb.sample()


@pytest.mark.parametrize(
    "case", [case for case in cases() if case.buffer != "her"], ids=name_of
)
def test_the_same_generators_give_the_same_batch(case: Case, tmp_path: Path) -> None:
    if case.prefetch > 1:
        case = dataclasses.replace(case, prefetch=0)
    batches = []
    for i in range(2):
        setup = Setup(case, tmp_path / str(i))
        setup.generator.manual_seed(5)
        torch.manual_seed(3)
        if case.buffer != "ensemble":
            setup.rb.set_rng(torch.Generator().manual_seed(4))
        batches.append(setup.rb.sample())
    assert (batches[0] == batches[1]).all()


@pytest.mark.parametrize("storage", ["memory", "ndim"])
@pytest.mark.parametrize("sampler", ["replacement", "no replacement"])
def test_single_transitions_are_no_windows(
    storage: str, sampler: str, tmp_path: Path
) -> None:
    if (storage, sampler) == ("ndim", "no replacement"):
        storage = "ring"
    case = Case(
        storage, "tensordict", sampler, "flat", 1, False, "batch", "random", 0, "caiac"
    )
    setup = Setup(case, tmp_path)
    rb = stored(case, tmp_path / "again", list(range(EPISODES)), 8 * WINDOW)
    setup.score(rb)
    rb.append_transform(CAIACTransform(setup.layout, 0.5, window=WINDOW))
    with pytest.raises(ValueError, match=r"crosses|do not follow"):
        rb.sample()
