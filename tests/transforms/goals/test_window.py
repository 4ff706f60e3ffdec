"""WindowGoal: reading, and the way through a replay buffer."""

from __future__ import annotations

import math
import pickle
from contextlib import nullcontext

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    SliceSampler,
    TensorStorage,
)

from torchrl_caiac import EntityLayout
from torchrl_caiac._sampling import is_native, only_torch
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.transforms import (
    CAIACTransform,
    HindsightGoal,
    TransformKeys,
    WindowGoal,
)
from torchrl_caiac.transforms.goals.future import FutureGoal
from torchrl_caiac.transforms.goals.offsets import draw_goal_offset

LAYOUT = EntityLayout(
    {"arm": [0], "cup": [1, 2]},
    goal={"cup": [1, 0]},
    achieved={"cup": [1, 2]},
    fixed=["arm"],
)
NESTED = EntityLayout.from_keys(
    {"arm": ("s", "arm"), "cup": ("s", "cup")},
    goal={"cup": ("g", "cup")},
    achieved={"cup": ("s", "cup")},
    fixed=["arm"],
)


def make(lengths: list[int], nested: bool = False) -> TensorDict:
    total = sum(lengths)
    rows = torch.arange(total)
    done = torch.zeros(total, 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    state = rows.view(-1, 1) * 10.0 + torch.arange(3)
    td = TensorDict(
        {
            "row": rows,
            "episode": torch.repeat_interleave(
                torch.arange(len(lengths)), torch.tensor(lengths)
            ),
            "next": {"done": done},
            ("caiac", "score"): torch.zeros(total, 2),
        },
        [total],
    )
    if nested:
        for where, value in (((), state), (("next",), state + 10)):
            td[(*where, "s", "arm")] = value[:, :1]
            td[(*where, "s", "cup", "x")] = value[:, 1]
            td[(*where, "s", "cup", "y")] = value[:, 2:]
    else:
        td["observation"] = state
        td["next", "observation"] = state + 10
    return td


def buffer(
    goals: WindowGoal,
    lengths: list[int],
    size: int | None = None,
    batch: int = 6,
    storage=LazyTensorStorage,
    nested: bool = False,
    traj: bool = True,
    **kwargs,
) -> ReplayBuffer:
    data = make(lengths, nested)
    sampler = None
    if goals.window > 1:
        key = {"traj_key": "episode"} if traj else {"end_key": ("next", "done")}
        sampler = SliceSampler(slice_len=goals.window, **key)
    if not traj:
        data = data.exclude("episode")
    size = size or len(data)
    rb = ReplayBuffer(
        storage=storage(size),
        sampler=sampler,
        sample_unit=goals,
        batch_size=batch * goals.window,
        **kwargs,
    )
    rb.append_transform(goals)
    for begin in range(0, len(data), 3):
        rb.extend(data[begin : begin + 3])
    return rb


# --- through a buffer ----------------------------------------------------------------


@pytest.mark.parametrize("window", [1, 3])
@pytest.mark.parametrize("nested", [False, True])
def test_goals_in_a_storage_of_parallel_environments(window: int, nested: bool) -> None:
    goals = WindowGoal(NESTED if nested else LAYOUT, window, mixture={"last": 1.0})
    sampler = SliceSampler(slice_len=window, traj_key="episode")
    rb = ReplayBuffer(
        storage=LazyTensorStorage(20, ndim=2),
        sampler=None if window == 1 else sampler,
        sample_unit=goals,
        batch_size=40 * window,
    )
    rb.extend(make([3, 7, 6, 4], nested).view(2, 10))  # two trajectories each
    rb.append_transform(goals)
    rb.append_transform(CAIACTransform(goals.layout, window=window, threshold=0.1))
    seen = set()
    for _ in range(5):
        batch = rb.sample()
        assert batch.batch_size == (40 * window,)
        cup = batch["s", "cup", "x"] if nested else batch["observation"][:, 1]
        names = ((cup - 1) / 10).long()  # where the cup is from, perhaps a donor
        goal = batch["g", "cup", "x"] if nested else batch["desired_goal"][:, 1]
        ends = torch.tensor([3, 10, 16, 20])
        wanted = ends[torch.searchsorted(ends, names, right=True)]
        assert torch.equal(((goal - 1) / 10).long(), wanted)
        steps = names.view(-1, window)
        assert torch.equal(steps, steps[:, :1] + torch.arange(window))
        assert batch["caiac", "swapped"][:, 1].sum() == 20 * window
        seen |= set(wanted.tolist())
    assert seen == {3, 10, 16, 20}


@settings(max_examples=40, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=4),
    window=st.integers(1, 4),
    seed=st.integers(0, 2**31),
    nested=st.booleans(),
    memmap=st.booleans(),
    ring=st.booleans(),
    traj=st.booleans(),
)
def test_goals_are_later_states_of_the_same_trajectory(
    lengths, window, seed, nested, memmap, ring, traj
) -> None:
    lengths = [*lengths, window + 2]
    total = sum(lengths)
    size = max(window + 2, (2 * total) // 3) if ring else total + 3
    layout = NESTED if nested else LAYOUT
    goals = WindowGoal(
        layout,
        window,
        mixture={"last": 1, "uniform": 1, "geometric": 1},
        generator=torch.Generator().manual_seed(seed),
        keys=TransformKeys() if traj else TransformKeys(trajectory=None),
    )
    rb = buffer(
        goals,
        lengths,
        size,
        storage=LazyMemmapStorage if memmap else LazyTensorStorage,
        nested=nested,
        traj=traj,
    )
    rb.set_rng(torch.Generator().manual_seed(seed))
    raw = rb.storage[:].clone()
    batch = rb.sample()
    # rows are written in the order of their names, so a name tells what is behind
    end = torch.tensor(lengths).cumsum(0) - 1
    if nested:
        goal = torch.stack([batch["g", "cup", "x"], batch["g", "cup", "y"][:, 0]], -1)
    else:
        goal = batch["desired_goal"].flip(-1)  # goal columns 1, 0 mirror 1, 2
    goal = goal.view(-1, window, 2)
    assert (goal == goal[:, :1]).all()
    for names, (first, second) in zip(
        batch["row"].view(-1, window).tolist(), goal[:, 0].tolist(), strict=True
    ):
        reached = (int(first) - 1) // 10 - 1  # the row whose next state it is
        assert (first, second) == (reached * 10 + 11, reached * 10 + 12)
        last = min(int(e) for e in end if e >= names[-1])
        assert names[-1] <= reached <= last
    assert (rb.storage[:] == raw).all()


@settings(max_examples=150, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=5),
    window=st.integers(1, 4),
    mixture=st.dictionaries(
        st.sampled_from(["last", "uniform", "geometric"]),
        st.floats(0, 3),
        min_size=1,
    ).filter(lambda mixture: sum(mixture.values()) > 0.01),
    p=st.floats(0.05, 1.0),
    seed=st.integers(0, 2**31),
    dtype=st.sampled_from([torch.float32, torch.float64, torch.float16]),
    size=st.integers(0, 20),
    twisted=st.booleans(),
    default=st.sampled_from([torch.float32, torch.float64]),
)
def test_goals_in_c_are_those_of_torch(
    lengths, window, mixture, p, seed, dtype, size, twisted, default
) -> None:
    data = make([*lengths, window + 2])
    data["next", "observation"] = data["next", "observation"].to(dtype)
    layout = LAYOUT
    if twisted:  # columns in several runs
        layout = EntityLayout(
            {"arm": [0], "cup": [1, 2]},
            goal={"arm": [2], "cup": [1, 0]},
            achieved={"arm": [0], "cup": [2, 1]},
        )
    storage = LazyTensorStorage(max(window + 2, len(data) - size))
    rb = ReplayBuffer(storage=storage)
    for begin in range(0, len(data), 3):  # perhaps a ring
        rb.extend(data[begin : begin + 3])
    generator = torch.Generator().manual_seed(seed)
    goals = WindowGoal(layout, window, mixture=mixture, p=p, generator=generator)
    _, trajectories = goals.stored(storage)
    starts = (trajectories.left >= window - 1).nonzero()
    first = starts[torch.randint(len(starts), (15,), generator=generator)]
    rows = ((first + torch.arange(window)) % len(storage)).flatten()
    assert is_native(rows)
    batch, found = storage[:][rows], []
    for context in (nullcontext(), only_torch()):
        generator.manual_seed(seed)
        torch.set_default_dtype(default)
        try:
            with context:
                goals.expand(rows, {}, storage)
        finally:
            torch.set_default_dtype(torch.float32)
        found.append(goals(batch))
    for key in ("desired_goal", ("hindsight", "steps")):
        assert found[0][key].dtype == found[1][key].dtype
        assert torch.equal(found[0][key], found[1][key])


@pytest.mark.parametrize("mixture", [{}, {"last": 0.0}, {"first": 1.0}])
def test_a_mixture_that_is_replaced_is_checked(mixture: dict[str, float]) -> None:
    goals = WindowGoal(LAYOUT, 1)
    storage = buffer(goals, [5]).storage
    goals.mixture = mixture
    for context in (nullcontext(), only_torch()):
        with context, pytest.raises(ValueError, match="mixture"):
            goals.expand(torch.tensor([0]), {}, storage)


def test_the_mixture_is_read_once_for_a_sample() -> None:
    class Changing(WindowGoal):
        @property
        def mixture(self) -> dict[str, float]:
            self.times = self.__dict__.get("times", 0) + 1
            return {"uniform" if self.times % 2 else "last": 1.0}

        @mixture.setter
        def mixture(self, value: dict[str, float]) -> None:
            """The constructor sets it."""

    goals = Changing(LAYOUT, 1)
    storage = buffer(goals, [5]).storage
    before = goals.__dict__.get("times", 0)
    goals.expand(torch.tensor([0]), {}, storage)
    assert goals.times == before + 1


def zeros(base: type[FutureGoal]) -> type[FutureGoal]:
    """A subclass that reads its own goals."""

    class Zeros(base):
        def read_goals(self, data, rows=None):
            found = super().read_goals(data, rows)
            return {key: torch.zeros_like(goal) for key, goal in found.items()}

    return Zeros


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize(
    ("base", "options"),
    [
        (WindowGoal, {"window": 1}),
        (HindsightGoal, {"future": 1.0}),
        (HindsightGoal, {"future": 0.0, "random": 1.0}),
    ],
)
def test_a_subclass_reads_its_own_goals(
    base: type[FutureGoal], options: dict[str, float], native: bool
) -> None:
    data = make([9])
    data["desired_goal"] = torch.ones(9, 2)
    data["next", "reward"] = torch.zeros(9, 1)
    if base is HindsightGoal:
        options = {"reward_fn": lambda achieved, goal: achieved[:, 0] - 1, **options}
    goals = zeros(base)(LAYOUT, **options)
    rb = offline_buffer(data, 30, sample_unit=goals)
    rb.append_transform(goals)
    with nullcontext() if native else only_torch():
        for _ in range(3):  # the second batch is relabelled by fewer calls
            batch = rb.sample()
            assert not batch["desired_goal"].any()
            if base is HindsightGoal:
                assert (batch["next", "reward"] == -1).all()


@pytest.mark.parametrize("nested", [True, False])
def test_a_subclass_reads_its_own_goals_of_donors(nested: bool) -> None:
    layout = NESTED if nested else LAYOUT
    data, goal = make([9], nested), {"x": torch.ones(9, 1), "y": torch.ones(9, 1)}
    if nested:
        data["g", "cup"] = TensorDict(goal, [9])
    else:
        data["desired_goal"] = torch.ones(9, 2)
    swap = CAIACTransform(
        layout,
        donors=TensorStorage(data),
        goals=zeros(WindowGoal)(layout, 1),
        counterfactual_ratio=1.0,
        check=False,
    )
    out = swap(data)
    assert out["caiac", "swapped"][:, 1].all()
    found = out["g", "cup"].values() if nested else [out["desired_goal"]]
    assert not any(leaf.any() for leaf in found)


def test_last_respects_writes_and_the_cursor() -> None:
    goals = WindowGoal(LAYOUT, 2, mixture={"last": 1.0})
    rb = buffer(goals, [6], size=8, batch=4)
    rb.storage[:]["next", "done"].zero_()  # it goes on
    assert (rb.sample()["desired_goal"][:, 1] == 61).all()
    more = make([9])[6:9]  # the same trajectory goes on; row 0 is overwritten
    rb.extend(more)
    assert len(rb) == 8
    assert (rb.sample()["desired_goal"][:, 1] == 91).all()


def test_transitions_and_next_desired_goals() -> None:
    goals = WindowGoal(LAYOUT, 1, mixture={"last": 1.0})
    rb = ReplayBuffer(storage=LazyTensorStorage(10), sample_unit=goals, batch_size=5)
    rb.append_transform(goals)
    data = make([10])
    data["desired_goal"] = torch.zeros(10, 2)
    data["next", "desired_goal"] = torch.zeros(10, 2)
    rb.extend(data)
    batch = rb.sample()
    for key in ("desired_goal", ("next", "desired_goal")):
        assert (batch[key] == torch.tensor([102.0, 101.0])).all()
        assert (rb.storage[:][key] == 0).all()


def test_goals_from_stored_achieved_goals() -> None:
    layout = EntityLayout({"arm": [0], "cup": [1, 2]}, goal={"arm": (), "cup": [0]})
    goals = WindowGoal(layout, 1, mixture={"last": 1.0})
    rb = ReplayBuffer(storage=LazyTensorStorage(10), sample_unit=goals, batch_size=5)
    rb.append_transform(goals)
    data = make([10])
    data["next", "achieved_goal"] = torch.arange(10.0).unsqueeze(-1)
    rb.extend(data)
    assert (rb.sample()["desired_goal"] == 9.0).all()


def test_goals_follow_the_swap() -> None:
    goals = WindowGoal(LAYOUT, 2, mixture={"last": 1.0})
    rb = buffer(goals, [5, 5, 5, 5], batch=20)
    rb.append_transform(
        CAIACTransform(LAYOUT, window=2, counterfactual_ratio=1.0, threshold=0.1)
    )
    batch = rb.sample()
    # the cup's trajectory, read from its own column, names the goal
    trajectory = (batch["observation"][:, 1] // 50).long()
    assert (trajectory != batch["episode"]).any()
    assert torch.equal(batch["desired_goal"][:, 1], (trajectory + 1) * 50.0 + 1)


def test_prefetch_and_reproducibility() -> None:
    batches = []
    for _ in range(2):
        goals = WindowGoal(LAYOUT, 2)
        goals.set_generator(torch.Generator().manual_seed(0))
        rb = buffer(goals, [8, 8], batch=4, prefetch=1)
        rb.set_rng(torch.Generator().manual_seed(1))
        batches.append([rb.sample() for _ in range(4)])
    for one, other in zip(*batches, strict=True):
        assert (one == other).all()


def test_pickle_and_clone() -> None:
    goals = WindowGoal(LAYOUT, 2, mixture={"last": 1.0})
    for copy in (pickle.loads(pickle.dumps(goals)), goals.clone()):
        assert (buffer(copy, [6]).sample()["desired_goal"][:, 1] == 61).all()
        assert "window=2" in repr(copy)


def test_a_clone_has_its_own_mixture() -> None:
    goals = WindowGoal(LAYOUT, 2, mixture={"last": 1.0})
    goals.clone().mixture["uniform"] = 9.0
    assert goals.mixture == {"last": 1.0}


# --- bad input -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"window": 0}, "window must be at least 1 row"),
        ({"mixture": {}}, "mixture maps strategies"),
        ({"mixture": {"first": 1.0}}, "mixture maps strategies"),
        ({"mixture": {"last": -1.0}}, "weight of 'last' in mixture"),
        ({"mixture": {"last": 0.0}}, "weights of mixture"),
        ({"mixture": {"last": math.nan}}, "weight of 'last' in mixture"),
        ({"mixture": {"last": 1e308, "uniform": 1e308}}, "weights of mixture"),
        ({"mixture": {"last": 10**400}}, "weight of 'last' in mixture"),
        ({"p": 0.0}, r"must be in \(0, 1\]"),
        ({"p": 1.1}, r"must be in \(0, 1\]"),
        ({"layout": EntityLayout({"cup": [0]})}, "no goals"),
        (
            {"layout": EntityLayout.from_keys({"cup": "c"}, goal={"cup": "g"})},
            r"achieved goals of \['cup'\]",
        ),
    ],
)
def test_arguments(arguments: dict, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        WindowGoal(**{"layout": LAYOUT, "window": 2, **arguments})


@pytest.mark.parametrize(
    "arguments",
    [{"mixture": {"last": "1"}}, {"mixture": {"last": None}}, {"p": "1"}, {"p": None}],
)
def test_weights_and_p_are_numbers(arguments: dict) -> None:
    with pytest.raises(TypeError, match="must be a number, got"):
        WindowGoal(LAYOUT, 2, **arguments)


@pytest.mark.parametrize("mixture", ["last", ["last"], 5])
def test_a_mixture_is_a_mapping(mixture) -> None:
    with pytest.raises(TypeError, match="mixture must map strategies"):
        WindowGoal(LAYOUT, 2, mixture=mixture)


@pytest.mark.parametrize("p", [0.0, 2.0, math.nan])
def test_the_parameter_of_drawn_offsets_is_checked(p: float) -> None:
    with pytest.raises(ValueError, match="p"):
        draw_goal_offset(torch.tensor([4]), {"geometric": 1.0}, p=p)


def test_window_is_an_int() -> None:
    for window in (True, 2.0):
        with pytest.raises(TypeError, match="window must be a number of rows, an int"):
            WindowGoal(LAYOUT, window)


def test_without_a_draw_or_after_the_augmentation() -> None:
    goals = WindowGoal(LAYOUT, 2)
    rb = buffer(goals, [6])
    with pytest.raises(RuntimeError, match="sample_unit="):
        rb[:]
    rb = ReplayBuffer(
        storage=LazyTensorStorage(6),
        sampler=SliceSampler(slice_len=2, traj_key="episode"),
        sample_unit=goals,
        batch_size=4,
    )
    rb.extend(make([6]))
    rb.append_transform(CAIACTransform(LAYOUT, window=2))
    rb.append_transform(goals)
    with pytest.raises(RuntimeError, match="append WindowGoal before"):
        rb.sample()
    goals.expand(torch.tensor([0, 1]), {}, rb.storage)
    with pytest.raises(RuntimeError, match="drawn for 2 rows, but the batch has"):
        goals(rb.storage[:])


def test_windows_that_do_not_fit() -> None:
    goals = WindowGoal(LAYOUT, 3)
    storage = buffer(goals, [5, 5]).storage
    with pytest.raises(ValueError, match="4 rows, not a multiple of the window 3"):
        goals.expand(torch.arange(4), {}, storage)
    for rows in ([3, 4, 5], [0, 2, 4], [2, 1, 0], [4, 5, 6], [0, 1, 99], [0, -9, 2]):
        with pytest.raises(ValueError, match="not consecutive rows of one traj"):
            goals.expand(torch.tensor(rows), {}, storage)
    for rows in ([10, 11, 12], [-1, 0, 1]):
        with pytest.raises(IndexError, match="out of range"):
            goals.expand(torch.tensor(rows), {}, storage)
    with pytest.raises(RuntimeError, match="sufficient length"):
        buffer(WindowGoal(LAYOUT, 6), [5, 5]).sample()


def test_data_that_do_not_fit() -> None:
    goals = WindowGoal(LAYOUT, 1)

    def draw(data: TensorDict, goals: WindowGoal = goals) -> None:
        rb = ReplayBuffer(storage=LazyTensorStorage(10))
        rb.extend(data)
        goals.expand(torch.tensor([0]), {}, rb.storage)

    data = make([5])
    with pytest.raises(KeyError, match="lack the trajectory ids"):
        draw(data.exclude("episode", ("next", "done")))
    with pytest.raises(KeyError, match="goals are read from"):
        draw(data.exclude(("next", "observation")))
    with pytest.raises(KeyError, match=r"goals of .*cup.* are read"):
        draw(data, WindowGoal(NESTED, 1))
    strided = TensorDict({("next", "observation"): torch.zeros(5, 6)[:, ::2]}, [5])
    for row in (-1, 5):
        with pytest.raises(IndexError, match="out of range"):
            goals.read_goals(strided, torch.tensor([row]))
    data["next", "observation"] = torch.zeros(5, 2)
    with pytest.raises(ValueError, match=r"2 columns.*at least 3"):
        draw(data)
    with pytest.raises(ValueError, match="buffer is empty"):
        goals.expand(torch.tensor([0]), {}, LazyTensorStorage(3))
    with pytest.raises(TypeError, match="is a ListStorage, expected one"):
        goals.expand(torch.tensor([0]), {}, ListStorage(3))
