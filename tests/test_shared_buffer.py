"""Buffers that several processes sample and extend."""

from __future__ import annotations

import multiprocessing
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.caiac_buffer import CAIACReplayBuffer
from torchrl_caiac.transforms import HindsightGoal

LAYOUT = EntityLayout(
    {"arm": [0], "cup": [1]},
    goal={"cup": [0]},
    achieved={"cup": [1]},
    fixed=["arm"],
)


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return -(achieved != desired).any(-1).float()


def transitions(first: float, rows: int = 20) -> TensorDict:
    """One trajectory, whose numbers are those of its rows from ``first`` on.

    The arm influences the cup in every fifth row.
    """
    state = (first + torch.arange(rows)).float().unsqueeze(-1).expand(-1, 2).clone()
    done = torch.zeros(rows, 1, dtype=torch.bool)
    done[-1] = True
    score = torch.zeros(rows, 2)
    score[4::5, 1] = 1.0
    return TensorDict(
        {
            "observation": state,
            "desired_goal": -torch.ones(rows, 1),
            "episode": torch.full((rows,), int(first)),
            "caiac": {"score": score},
            "next": {
                "observation": state + 1,
                "reward": -torch.ones(rows, 1),
                "done": done,
            },
        },
        [rows],
    )


def make(**kwargs: Any) -> CAIACReplayBuffer:
    settings = {
        "augmentation": partial(CAIACTransform, LAYOUT, 0.5, 0.0),
        "goals": partial(HindsightGoal, LAYOUT, reward, future=1.0),
        "batch_size": 512,
        **kwargs,
    }
    settings.setdefault("shared", not settings.get("prefetch"))
    rb = CAIACReplayBuffer(partial(LazyMemmapStorage, 20), **settings)
    rb.extend(transitions(0.0))
    rb.sample()  # builds the indices here
    return rb


AHEAD = partial(CAIACTransform, LAYOUT, 0.5, lookahead=1)
BUFFERS: dict[str, dict[str, Any]] = {
    "goals": {},
    "donors": {"augmentation": partial(CAIACTransform, LAYOUT, 0.5), "donors": "self"},
    "lookahead": {"augmentation": AHEAD},
    "donors and lookahead": {"augmentation": AHEAD, "donors": "self"},
}


def assert_right(name: str, batch: TensorDictBase, first: float) -> None:
    """Raises unless goals, swaps and donors are those of the rows from ``first`` on."""
    arm, cup = batch["observation"].unbind(-1)
    assert ((arm >= first) & (arm < first + 20)).all()
    assert ((cup >= first) & (cup < first + 20)).all()
    swapped = batch["caiac", "swapped"][:, 1]
    kept = ~batch["caiac", "counterfactual"].flatten()
    real = batch["hindsight", "relabeled"].flatten() & kept
    goal = batch["desired_goal"][real, 0]
    assert len(goal) and ((goal > arm[real]) & (goal <= first + 20)).all()
    if name == "goals":
        assert not swapped.any()
        return
    own, donor = (arm - first) % 5, (cup - first)[swapped] % 5
    assert swapped.any() and set(own[swapped].tolist()) >= {0, 1, 2}
    locked = [3, 4] if "lookahead" in name else [4]
    assert not torch.isin(own[swapped], torch.tensor(locked)).any()
    assert not torch.isin(donor, torch.tensor(locked)).any()


def sampled(rb: Any, seed: int | None) -> tuple[dict[str, Any], list[str]]:
    if seed is not None:
        torch.manual_seed(seed)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        batch = rb.sample()
    leaves = {str(key): leaf.tolist() for key, leaf in batch.items(True, True)}
    return leaves, [str(x.message) for x in seen if "forked" in str(x.message)]


def extended(rb: Any, name: str) -> None:
    assert_right(name, rb.sample(), 0.0)
    rb.extend(transitions(1000.0))
    assert_right(name, rb.sample(), 1000.0)


def grown(rb: ReplayBuffer) -> int:
    rb.extend(transitions(1000.0))
    return len(rb)


def sampled_and_grown(rb: ReplayBuffer) -> None:
    for _ in range(200):
        rb.sample()
        rb.extend(transitions(0.0))


def reseeded(rb: CAIACReplayBuffer) -> tuple[dict[str, Any], list[str]]:
    rb.set_rng(torch.Generator().manual_seed(7))
    return sampled(rb, None)


def work(answers: Any, jobs: list[Callable[[], Any]]) -> None:
    for job in jobs:
        try:
            answers.put(job())
        except BaseException as error:
            answers.put(error)


def in_process(method: str, *jobs: Callable[[], Any]) -> list[Any]:
    """Calls functions in one process, which ``fork`` or ``spawn`` starts."""
    context = multiprocessing.get_context(method)
    answers = context.Queue()
    process = context.Process(target=work, args=(answers, list(jobs)))
    process.start()
    try:
        found = [answers.get(timeout=120) for _ in jobs]
    finally:
        process.kill()
        process.join()
    for answer in found:
        if isinstance(answer, BaseException):
            raise answer
    return found


@contextmanager
def repeated(call: Callable[[], Any]) -> Iterator[None]:
    """Calls a function again and again in a thread.

    It must not draw from torch's default generator, whose lock a process that is forked
    meanwhile may inherit. Nothing releases it there.
    """
    ended = threading.Event()

    def run() -> None:
        while not ended.is_set():
            call()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_buffers_follow_what_another_process_writes(method: str) -> None:
    """And one with a seed goes on from its state, unless it gets a new one."""
    buffers = {name: make(**settings) for name, settings in BUFFERS.items()}
    seeded = make(seed=0)
    *_, (batch, seen), (new, unseen) = in_process(
        method,
        *(partial(extended, rb, name) for name, rb in buffers.items()),
        partial(sampled, seeded, 5),
        partial(reseeded, seeded),
    )
    for name, rb in buffers.items():
        assert_right(name, rb.sample(), 1000.0)
    assert "set_generator" in seen[0]
    assert batch == sampled(seeded, None)[0]
    assert not unseen
    assert new == reseeded(seeded)[0]


def test_forked_processes_with_the_same_numbers_are_warned_of() -> None:
    rb = make()
    (one,), (other,) = (in_process("fork", partial(sampled, rb, None)) for _ in "ab")
    assert one[0] == other[0]
    assert "torch.manual_seed" in one[1][0]
    (seeded,), (again,) = (
        in_process("fork", partial(sampled, rb, 10**6 + seed)) for seed in range(2)
    )
    assert seeded[0] != again[0]
    assert not seeded[1]


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_threads_of_a_buffer_are_those_of_its_process(method: str) -> None:
    rb = make(prefetch=2)
    with pytest.raises(RuntimeError, match="leave out prefetch"):
        in_process(method, partial(sampled, rb, 0))
    assert_right("goals", rb.sample(), 0.0)


def test_a_forked_process_does_not_wait_for_threads_of_its_parent() -> None:
    building = CAIACReplayBuffer(
        partial(LazyTensorStorage, 10**5), augmentation=AHEAD, batch_size=4, seed=0
    )
    building.extend(transitions(0.0, 10**5))
    settings = {**BUFFERS["lookahead"], "donors": "self"}
    rb = make(**settings)

    def build() -> None:
        building.storage.set(0, building.storage[0])
        building.sample()

    with repeated(build):
        for _ in range(10):
            in_process("fork", partial(extended, rb, "lookahead"))
            rb.extend(transitions(0.0))


def test_a_forked_process_does_not_wait_for_donors_of_its_parents_threads() -> None:
    donors = ReplayBuffer(storage=LazyTensorStorage(20))
    donors.extend(transitions(0.0))
    others = [
        CAIACReplayBuffer(
            partial(LazyTensorStorage, 20),
            augmentation=partial(CAIACTransform, LAYOUT, 0.5, donors=donors),
            batch_size=256,
            seed=seed,
        )
        for seed in range(2)
    ]
    for rb in others:
        rb.extend(transitions(0.0))
        rb.sample()
    with repeated(others[0].sample):
        for _ in range(10):
            in_process("fork", partial(sampled, others[1], 0))
            in_process("fork", partial(grown, donors))


def test_processes_with_the_donors_of_each_other_do_not_wait_for_ever() -> None:
    buffers = [
        ReplayBuffer(storage=LazyMemmapStorage(20), batch_size=64, shared=True)
        for _ in range(2)
    ]
    for rb, donors in zip(buffers, reversed(buffers), strict=True):
        rb.extend(transitions(0.0))
        donors.extend(transitions(0.0))
        rb.append_transform(
            CAIACTransform(LAYOUT, 0.5, donors=donors, lookahead="next")
        )
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=sampled_and_grown, args=(rb,)) for rb in buffers]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    codes = [worker.exitcode for worker in workers]
    for worker in workers:
        worker.kill()
    assert codes == [0, 0]


def test_a_loaded_state_goes_on_as_the_saved_one() -> None:
    one, other = make(seed=0), make(seed=1)
    other.load_state_dict(one.state_dict())
    for _ in range(2):
        assert sampled(one, None) == sampled(other, None)
