"""What is checked late, and that nothing on the way of a sample waits for a device."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, RandomSampler, ReplayBuffer

from tests.pretend_cuda import nothing_waits
from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.transforms import HindsightGoal, WindowGoal
from torchrl_caiac.transforms.checks import LateCheck

FLAT = EntityLayout(
    {"arm": [0], "cup": [1, 2], "box": [4]},  # column 3 is nobody's
    goal={"cup": [2, 0], "box": [1]},
    achieved={"cup": [1, 2], "box": [4]},
    fixed=["arm"],
)
NESTED = EntityLayout.from_keys(
    {"arm": ("s", "arm"), "cup": ("s", "cup"), "box": ("s", "box")},
    goal={"cup": ("g", "cup"), "box": ("g", "box")},
    achieved={"cup": ("s", "cup"), "box": ("s", "box")},
    fixed=["arm"],
)
EPISODES, LENGTH, WINDOW = 6, 10, 4


# --- what is remembered --------------------------------------------------------------

numbers = st.sampled_from([0.0, 1.5, -3e38, 3e38, math.nan, math.inf, -math.inf])


@given(
    batches=st.lists(st.lists(numbers, min_size=3, max_size=3), max_size=6),
    asked=st.sets(st.integers(0, 5)),
)
def test_finds_what_was_not_finite_since_it_was_asked(
    batches: list[list[float]], asked: set[int]
) -> None:
    late, bad = LateCheck(), set()
    for i, values in enumerate(batches):
        late.add(torch.tensor(values))
        bad |= {place for place, value in enumerate(values) if not math.isfinite(value)}
        if i in asked:
            assert late.found() == sorted(bad)
            bad = set()
    assert late.found() == sorted(bad)
    assert late.found() == []


def test_other_values_start_anew_and_copies_are_empty() -> None:
    late = LateCheck()
    late.add(torch.tensor([math.nan]))
    assert pickle.loads(pickle.dumps(late)).found() == []
    late.add(torch.zeros(2))
    assert late.found() == []


def test_only_accelerators_are_looked_at_late() -> None:
    assert LateCheck.needed(torch.device("cuda", 1))
    assert not LateCheck.needed(torch.device("cpu"))


# --- buffers -------------------------------------------------------------------------


class EqualWindows(RandomSampler):
    """Draws windows where the storage lies; SliceSampler looks at lengths."""

    def sample(self, storage: Any, batch_size: int) -> tuple[torch.Tensor, dict]:
        device = storage.device
        shape = (batch_size // WINDOW, 1)
        episode = torch.randint(EPISODES, shape, device=device)
        start = torch.randint(LENGTH - WINDOW + 1, shape, device=device)
        steps = torch.arange(WINDOW, device=device)
        return (episode * LENGTH + start + steps).flatten(), {}


class Uninfluenced:
    """Scores every state with zeros, so that rows have fingerprints."""

    def __init__(self, layout: EntityLayout, shape: tuple[int, ...]) -> None:
        self.layout, self.shape = layout, shape

    def __call__(self, td: TensorDict) -> torch.Tensor:
        return torch.zeros(len(td), *self.shape)


def rows(layout: EntityLayout) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    total = EPISODES * LENGTH
    walk = torch.rand(EPISODES, LENGTH + 1, 5, generator=generator)
    state, after = walk[:, :-1].reshape(total, 5), walk[:, 1:].reshape(total, 5)
    goal = torch.rand(total, 3, generator=generator)
    td = TensorDict(
        {
            "action": torch.rand(total, 2, generator=generator),
            "episode": torch.arange(total) // LENGTH,
            "next": {"reward": -torch.ones(total, 1)},
        },
        [total],
    )
    for where, now in (((), state), (("next",), after)):
        if layout.is_flat:
            td[(*where, "observation")] = now
            td[(*where, "achieved_goal")] = now[:, [2, 4, 1]]
        else:
            td[(*where, "s", "arm")] = now[:, :1]
            td[(*where, "s", "cup", "x")] = now[:, 1:2]
            td[(*where, "s", "cup", "y")] = now[:, 2]
            td[(*where, "s", "box")] = now[:, 4:]
    if layout.is_flat:
        td["desired_goal"] = goal
    else:
        td["g", "cup", "x"], td["g", "cup", "y"] = goal[:, 2:], goal[:, 0]
        td["g", "box"] = goal[:, 1:2]
    rb = ReplayBuffer(storage=LazyTensorStorage(total))
    rb.extend(td)
    for key, shape in ((("caiac", "score"), (3,)), (("coda", "graph"), (4, 3))):
        score_buffer(rb, Uninfluenced(layout, shape), key=key, progress=False)
    return rb.storage[:].clone()


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return -(achieved - desired).abs().sum(-1)


def buffer(
    layout: EntityLayout,
    kind: type,
    window: int,
    donors: str,
    goals: bool,
    device: str = "cpu",
    **kwargs: Any,
) -> ReplayBuffer:
    """A buffer that samples 6 windows, with an augmentation and perhaps goals."""
    storage = LazyTensorStorage(EPISODES * LENGTH, device=device)
    source = None
    if goals:
        source = (
            HindsightGoal(layout, reward, random=0.2, strategy="uniform")
            if window == 1
            else WindowGoal(
                layout, WINDOW, mixture={"last": 1, "uniform": 1, "geometric": 1}
            )
        )
    rb = ReplayBuffer(
        storage=storage,
        sampler=EqualWindows() if window > 1 else None,
        sample_unit=source,
        batch_size=6 * window,
    )
    rb.extend(rows(layout).to(device))
    augment = kind(
        layout,
        window=window,
        donors=storage if donors == "buffer" else None,
        goals=WindowGoal(layout, WINDOW) if donors == "buffer" and window > 1 else None,
        swap_prob=0.9,
        reward_fn=reward if window == 1 else None,
        **kwargs,
    )
    order = [augment] if source is None else [augment, source]
    for transform in order if window == 1 else order[::-1]:
        rb.append_transform(transform)
    return rb


every_setting = [
    pytest.mark.parametrize("layout", [FLAT, NESTED], ids=["flat", "nested"]),
    pytest.mark.parametrize("kind", [CAIACTransform, CoDATransform]),
    pytest.mark.parametrize("window", [1, WINDOW]),
    pytest.mark.parametrize("donors", ["batch", "buffer"]),
    pytest.mark.parametrize("goals", [False, True], ids=["", "goals"]),
]


def in_every_setting(test: Callable[..., None]) -> Callable[..., None]:
    for mark in every_setting:
        test = mark(test)
    return test


# --- on the CPU, as if it were an accelerator ----------------------------------------


@pytest.fixture
def late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has values on the CPU checked like those of an accelerator."""
    monkeypatch.setattr(LateCheck, "needed", staticmethod(lambda device: True))


@pytest.mark.usefixtures("late")
def test_window_goals_tell_late_that_rows_are_no_windows() -> None:
    rb = buffer(FLAT, CAIACTransform, WINDOW, "batch", goals=True)
    goals = rb.transform[0]
    for wrong in ([0, 1, 2, 4], [7, 8, 9, 10], [8, 9, 10, 11]):
        goals.expand(torch.tensor(wrong), {}, rb.storage)
        with pytest.raises(ValueError, match="not consecutive rows"):
            goals.expand(torch.arange(4), {}, rb.storage)
        goals.expand(torch.arange(4), {}, rb.storage)


# --- on a GPU ------------------------------------------------------------------------


@pytest.mark.gpu
@in_every_setting
def test_no_sample_waits_on_the_gpu(
    layout: EntityLayout, kind: type, window: int, donors: str, goals: bool
) -> None:
    rb = buffer(layout, kind, window, donors, goals, device="cuda")
    for _ in range(2):
        rb.sample()  # builds what is built once
    with nothing_waits():
        batches = [rb.sample() for _ in range(3)]
    assert any(batch["caiac", "swapped"].any() for batch in batches)
    leaves = batches[0].values(include_nested=True, leaves_only=True)
    assert all(leaf.is_cuda for leaf in leaves)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", [CAIACTransform, CoDATransform])
@pytest.mark.parametrize("window", [1, WINDOW])
@pytest.mark.parametrize("chosen", ["random", "last"])
def test_rows_without_scores_are_kept_on_the_gpu_without_waiting(
    kind: type, window: int, chosen: str
) -> None:
    rb = buffer(
        FLAT, kind, window, "batch", False, "cuda", unscored="keep", rows=chosen
    )
    data = rb.storage[:]
    data["caiac", "score"][::3] = math.nan
    data["coda", "graph"][::3] = math.nan
    rb.sample()
    with nothing_waits():
        batches = [rb.sample() for _ in range(3)]
    key = ("caiac", "score") if kind is CAIACTransform else ("coda", "graph")
    for batch in batches:
        wrong = batch[key].flatten(1).isnan().any(1).view(-1, window).any(1)
        swapped = batch["caiac", "swapped"].any(1).view(-1, window).any(1)
        assert not (wrong & swapped).cpu().any()
    count = [int(batch[key].flatten(1).isnan().any(1).sum()) for batch in batches]
    assert rb.transform[0].unscored_count >= sum(count) > 0


@pytest.mark.gpu
@pytest.mark.parametrize("window", [1, WINDOW])
def test_a_generator_of_the_host_serves_a_gpu(window: int) -> None:
    batches = []
    for _ in range(2):
        generator = torch.Generator().manual_seed(3)
        augment = CAIACTransform(FLAT, window=window, generator=generator)
        td = rows(FLAT).view(EPISODES, LENGTH)[:, :8].reshape(-1).to("cuda")
        augment(td)
        with nothing_waits():
            batches.append(augment(td))
    assert (batches[0] == batches[1]).all()


@pytest.mark.gpu
@pytest.mark.parametrize("layout", [FLAT, NESTED], ids=["flat", "nested"])
@pytest.mark.parametrize("kind", [CAIACTransform, CoDATransform])
@pytest.mark.parametrize("window", [1, WINDOW])
def test_donors_of_the_host_serve_a_gpu(
    layout: EntityLayout, kind: type, window: int
) -> None:
    donors = LazyTensorStorage(EPISODES * LENGTH)
    donors.set(range(EPISODES * LENGTH), rows(layout))
    found = []
    for device in ("cpu", "cuda"):
        augment = kind(layout, window=window, donors=donors, swap_prob=0.9)
        augment.set_generator(torch.Generator().manual_seed(3))
        td = rows(layout).view(EPISODES, LENGTH)[:, :8].reshape(-1)
        found.append(augment(td.to(device)))
    assert all(leaf.is_cuda for leaf in found[1].values(True, True))
    assert found[0]["caiac", "swapped"].any()
    assert (found[1].cpu() == found[0]).all()


@pytest.mark.gpu
def test_errors_come_late_on_the_gpu() -> None:
    transform = CAIACTransform(FLAT)
    good = rows(FLAT)[:8].to("cuda")
    bad = good.clone()
    bad["observation"][5, 3] = math.nan
    transform(good)
    with nothing_waits():
        transform(bad)
    torch.cuda.synchronize()
    with pytest.raises(ValueError, match=r"observation.* in an earlier batch"):
        transform(good)
    transform(good)


@pytest.mark.gpu
@pytest.mark.parametrize("window", [1, 2])
@pytest.mark.parametrize("unscored", ["raise", "keep"])
def test_fingerprints_are_compared_on_the_gpu(window: int, unscored: Any) -> None:
    transform = CAIACTransform(FLAT, 0.05, 1.0, window=window, unscored=unscored)
    good = rows(FLAT)[:8].to("cuda")
    other = good.clone()
    other["observation"][4, 1] += 0.01
    transform(good)
    with nothing_waits():
        out = transform(other)
    torch.cuda.synchronize()
    if unscored == "keep":
        assert transform.unscored_count == 1
        assert not out["caiac", "swapped"][4].cpu().any()
        transform(good)
    else:
        with pytest.raises(ValueError, match=r"\['fingerprints'\] were invalid"):
            transform(good)
