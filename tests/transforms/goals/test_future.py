"""What all goals share: offsets, and reading goals from data of any form."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer

from torchrl_caiac import EntityLayout
from torchrl_caiac._sampling import only_torch
from torchrl_caiac.transforms import HindsightGoal, WindowGoal
from torchrl_caiac.transforms.goals.future import FutureGoal
from torchrl_caiac.transforms.goals.offsets import draw_goal_offset

FLAT = EntityLayout(
    {"arm": [0], "cup": [3, 1]},
    goal={"cup": [1, 0]},
    achieved={"cup": [1, 3]},
    fixed=["arm"],
)
NESTED = EntityLayout.from_keys(
    {"lid": "lid", "cup": "cup"},
    goal={"cup": ("goal", "cup"), "lid": "lid_goal"},
    achieved={"cup": "cup", "lid": "lid"},
)


# --- draws ---------------------------------------------------------------------------


@given(
    remaining=st.lists(st.integers(0, 50), min_size=1, max_size=20),
    weights=st.tuples(*[st.floats(0, 3)] * 3).filter(lambda w: sum(w) > 0.01),
    p=st.floats(0.01, 1.0),
    seed=st.integers(0, 2**31),
)
def test_offsets_stay_in_the_trajectory(remaining, weights, p, seed) -> None:
    mixture = dict(zip(("last", "uniform", "geometric"), weights, strict=True))
    left = torch.tensor(remaining)
    drawn = [
        draw_goal_offset(
            left, mixture, p=p, generator=torch.Generator().manual_seed(seed)
        )
        for _ in range(2)
    ]
    assert torch.equal(*drawn)
    assert ((drawn[0] >= 0) & (drawn[0] <= left)).all()
    if mixture["uniform"] == mixture["geometric"] == 0:
        assert torch.equal(drawn[0], left)


def shares(mixture: dict[str, float], left: int, p: float = 0.3) -> torch.Tensor:
    drawn = draw_goal_offset(
        torch.full((200_000,), left),
        mixture,
        p=p,
        generator=torch.Generator().manual_seed(0),
    )
    return torch.bincount(drawn, minlength=left + 1) / 200_000


def test_distributions() -> None:
    left, p = 6, 0.3
    uniform = torch.full((7,), 1 / 7)
    geometric = torch.tensor([p * (1 - p) ** k for k in range(7)])
    geometric[-1] += 1 - geometric.sum()  # clipped to the last state
    last = torch.zeros(7)
    last[-1] = 1.0
    assert (shares({"uniform": 2.0}, left) - uniform).abs().max() < 0.004
    assert (shares({"geometric": 0.1}, left, p) - geometric).abs().max() < 0.004
    mixed = 0.5 * last + 0.3 * geometric + 0.2 * uniform
    drawn = shares({"last": 5, "geometric": 3, "uniform": 2}, left, p)
    assert (drawn - mixed).abs().max() < 0.004
    assert shares({"geometric": 1.0}, left, 1.0)[0] == 1.0


# --- reading -------------------------------------------------------------------------


def both(layout: EntityLayout) -> list[FutureGoal]:
    return [WindowGoal(layout, 1), HindsightGoal(layout, lambda a, d: a[:, 0])]


@pytest.mark.parametrize("kind", ["contiguous", "columns of more", "memmap"])
@pytest.mark.parametrize("chosen", [None, [2, 0, 2]])
def test_flat_goals(kind: str, chosen: list[int] | None, tmp_path) -> None:
    state = torch.arange(12.0).view(3, 4)
    if kind == "columns of more":
        state = torch.cat([state, state], 1)[:, :4]
    data = TensorDict({("next", "observation"): state}, [3])
    if kind == "memmap":
        data = data.memmap(tmp_path)
    rows = None if chosen is None else torch.tensor(chosen)
    wanted = [[4.0 * row + 3, 4.0 * row + 1] for row in chosen or [0, 1, 2]]
    for goals in both(FLAT):
        assert goals.read_goals(data, rows)["desired_goal"].tolist() == wanted


@pytest.mark.parametrize("written", [5, 7, 9])  # of 7: part of a storage, and a ring
@pytest.mark.parametrize("mapped", [False, True])
def test_goals_ahead_end_with_the_trajectory(
    written: int, mapped: bool, tmp_path
) -> None:
    storage = LazyMemmapStorage(7, scratch_dir=tmp_path)
    rb = ReplayBuffer(storage=storage if mapped else LazyTensorStorage(7))
    for row in range(written):
        state = torch.full((1, 4), float(row))
        done = torch.tensor([[row == 3]])
        after = {"observation": state, "done": done}
        rb.extend(TensorDict({"episode": torch.tensor([row > 3]), "next": after}, [1]))
    for goals in both(FLAT):
        data, trajectories = goals.stored(rb.storage)
        rows = torch.arange(len(rb)).repeat(2)
        time = data["next", "observation"][rows, 0].int()
        ends = torch.where(time < 4, 3, written - 1)
        for steps in (torch.zeros_like(rows), rows % 3, rows + 99):
            wanted = torch.minimum(time + steps, ends)[:, None].expand(-1, 2)
            for block in (nullcontext(), only_torch()):
                with block:
                    for kind in (torch.int64, torch.int32):
                        found = goals.read_goals_ahead(
                            data, trajectories, rows, steps.to(kind)
                        )
                        assert torch.equal(found["desired_goal"], wanted.float())
        for bad in ([7, 0], [-1, 0], [0, -1]):
            row, step = (torch.tensor([number]) for number in bad)
            with pytest.raises((IndexError, RuntimeError)):
                goals.read_goals_ahead(data, trajectories, row, step)


@pytest.mark.parametrize("chosen", [None, [2, 0, 2]])
def test_nested_goals(chosen: list[int] | None) -> None:
    row = torch.arange(3.0)
    after = {"lid": row[:, None], "cup": {"y": {"a": -row}, "x": row.view(3, 1, 1)}}
    data = TensorDict({"next": after}, [3])
    rows = None if chosen is None else torch.tensor(chosen)
    wanted = [float(row) for row in chosen or [0, 1, 2]]
    for goals in both(NESTED):
        found = goals.read_goals(data, rows)
        # in layout order, and leaves of one entity by name
        assert list(found) == [
            "lid_goal",
            ("goal", "cup", "x"),
            ("goal", "cup", "y", "a"),
        ]
        values = [leaf.flatten().tolist() for leaf in found.values()]
        assert values == [wanted, wanted, [-value for value in wanted]]


# --- the rows that were drawn --------------------------------------------------------


def sampling(kind: str, transform, *, after: bool = False, **options) -> ReplayBuffer:
    """A buffer that draws goals, with a transform before them, or after them."""
    goals = (
        WindowGoal(FLAT, 1, **options)
        if kind == "window"
        else HindsightGoal(FLAT, lambda a, b: -(a != b).any(-1).float(), **options)
    )
    state = torch.arange(80, dtype=torch.float64).view(20, 4)
    data = TensorDict(
        {
            "observation": state,
            "desired_goal": torch.zeros(20, 2, dtype=torch.float64),
            "episode": torch.zeros(20, dtype=torch.int64),
            "next": {"observation": state + 4, "reward": -torch.ones(20, 1)},
        },
        [20],
    )
    data["next", "done"] = torch.arange(20).view(20, 1) == 19
    rb = ReplayBuffer(
        storage=LazyTensorStorage(20), sample_unit=goals, batch_size=16, transform=None
    )
    rb.extend(data)
    for one in (goals, transform) if after else (transform, goals):
        rb.append_transform(one)
    return rb


def normalised(td: TensorDict) -> TensorDict:
    for key in ("observation", ("next", "observation")):
        td[key] = td[key] / 3
    return td


@pytest.mark.parametrize("kind", ["window", "hindsight"])
@pytest.mark.parametrize("change", [normalised, lambda td: td.flip(0)])
def test_goals_are_not_those_of_other_states(kind, change) -> None:
    rb = sampling(kind, change)
    with pytest.raises(ValueError, match="Goal before transforms that change or"):
        rb.sample()
    sampling(kind, change, after=True).sample()


@pytest.mark.parametrize("kind", ["window", "hindsight"])
def test_states_may_be_cast_first(kind) -> None:
    rb = sampling(kind, lambda td: td.float())
    assert rb.sample()["desired_goal"].shape == (16, 2)


def test_rewards_compare_goals_that_are_rounded_alike() -> None:
    """Goals in single precision, and states in double precision."""

    def single(td: TensorDict) -> TensorDict:
        td["desired_goal"] = td["desired_goal"].float()
        return td

    rb = sampling("hindsight", single, future=1.0, p=1.0)
    rb.storage[:]["next", "observation"].add_(0.1)
    assert (rb.sample()["next", "reward"] == 0).all()


@pytest.mark.parametrize("kind", ["window", "hindsight"])
def test_batches_may_lack_what_goals_are_read_from(kind) -> None:
    def without(td: TensorDict) -> TensorDict:
        return td.exclude(("next", "observation"))

    if kind == "window":
        assert "desired_goal" in sampling(kind, without).sample()
        return
    with pytest.raises(KeyError, match=r"next.*observation"):  # which rewards need
        sampling(kind, without).sample()


@pytest.mark.parametrize("kind", ["window", "hindsight"])
def test_a_sample_that_failed_is_not_compared_later(kind) -> None:
    fails = [False] * 9 + [True]

    def sometimes(td: TensorDict) -> TensorDict:
        if fails and fails.pop(0):
            raise ArithmeticError
        return td

    rb = sampling(kind, sometimes)
    for _ in range(9):
        rb.sample()
    with pytest.raises(ArithmeticError):
        rb.sample()
    rb.sample()


def test_batches_may_be_reshaped_first() -> None:
    rb = sampling("hindsight", lambda td: td.reshape(4, 4), future=1.0)
    assert rb.sample()["desired_goal"].shape == (4, 4, 2)
