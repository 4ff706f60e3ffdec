"""Plans of swaps: made once for each structure of a batch, by the leaves there are."""

from __future__ import annotations

import pickle
from contextlib import nullcontext

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import LazyStackedTensorDict, TensorClass, TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac._sampling import only_torch
from torchrl_caiac.trajectories import trajectory_index
from torchrl_caiac.transforms.draws import SwapDraw
from torchrl_caiac.transforms.swap import SwapPlanner, apply_swap

FLAT = EntityLayout(
    {"arm": [0], "cup": [1, 2]},
    goal={"cup": [0, 1]},
    achieved={"cup": [1, 2]},
    fixed=["arm"],
)
NESTED = EntityLayout.from_keys(
    {"arm": ("s", "arm"), "cup": ("s", "cup")}, goal={"cup": "g"}, fixed=["arm"]
)


def flat(rows: int, dtype: torch.dtype = torch.float32, **more: int) -> TensorDict:
    state = torch.arange(4 * rows).view(rows, 4).to(dtype)
    td = TensorDict({"observation": state, "next": {"observation": -state}}, [rows])
    for key, width in more.items():
        td[key] = torch.zeros(rows, width)
    return td


def nested(rows: int, **more: torch.Tensor) -> TensorDict:
    cup = {"x": torch.zeros(rows), "pose": {"r": torch.zeros(rows, 2, 2)}, **more}
    state = {"arm": torch.zeros(rows, 1), "cup": cup}
    return TensorDict(
        {"s": state, "next": {"s": state}, "g": torch.zeros(rows)}, [rows]
    )


def test_one_plan_for_each_structure() -> None:
    planner = SwapPlanner(FLAT)
    plan = planner(flat(3))[0]
    assert planner(flat(5))[0] is plan  # whatever the number of rows
    others = [
        flat(3, torch.float64),
        flat(3, desired_goal=2),
        flat(3, achieved_goal=2),
        flat(3, unrelated=2),
    ]
    plans = [planner(td)[0] for td in others]
    assert plans[-1] is plan
    assert len({id(p) for p in [plan, *plans]}) == 4
    assert pickle.loads(pickle.dumps(planner))(flat(3))[0].states == plan.states
    planner = SwapPlanner(NESTED)
    plan = planner(nested(3))[0]
    assert planner(nested(4))[0] is plan
    assert planner(nested(3, y=torch.zeros(3)))[0] is not plan


def test_leaves_of_a_plan() -> None:
    plan, values = SwapPlanner(FLAT)(flat(3, desired_goal=2))
    assert [leaf.key for leaf in plan.leaves] == [
        "observation",
        ("next", "observation"),
        "desired_goal",
    ]
    assert [leaf.is_desired for leaf in plan.leaves] == [False, False, True]
    assert [leaf.group for leaf in plan.leaves] == [0, 0, 1]
    # One more entity owns what nobody does: column 3.
    assert plan.leaves[0].owner.tolist() == [0, 1, 1, 2]
    assert plan.leaves[2].owner.tolist() == [1, 1]
    assert values[plan.leaves[1].place][1, 1] == -5
    plan, values = SwapPlanner(NESTED)(nested(3))
    keys = {leaf.key for leaf in plan.leaves}
    cup = {("s", "cup", "x"), ("s", "cup", "pose", "r")}
    assert keys == {"g", *cup, *(("next", *key) for key in cup)}
    assert {leaf.owner for leaf in plan.leaves} == {1}
    assert {("s", "arm"), ("next", "s", "arm")} < set(plan.states)
    for leaf in plan.leaves:
        assert values[leaf.place].shape == nested(3)[leaf.key].shape


def test_integer_states_are_swapped_and_not_checked() -> None:
    plan, _ = SwapPlanner(FLAT)(flat(3, torch.int64))
    assert plan.states == () and len(plan.leaves) == 2


@pytest.mark.parametrize("has_donors", [False, True])
def test_nothing_follows_a_swap_if_all_entities_are_fixed(has_donors: bool) -> None:
    layout = EntityLayout.from_keys({"arm": "arm"}, fixed=["arm"])
    state = {"arm": torch.arange(4.0).view(4, 1)}
    td = TensorDict({**state, "next": state, ("caiac", "score"): torch.zeros(4, 1)}, 4)
    rb = ReplayBuffer(storage=LazyTensorStorage(4))
    rb.extend(td)
    transform = CAIACTransform(layout, donors=rb if has_donors else None)
    out = transform(td)
    assert torch.equal(out["arm"], td["arm"]) and not out["caiac", "swapped"].any()


@pytest.mark.parametrize("stack", [False, True])
def test_leaves_of_lazy_stacks_keep_their_names(stack: bool) -> None:
    """A lazy stack orders its leaves differently in keys() and in items()."""

    def row(i: int) -> TensorDict:
        box = {"vel": torch.full((3,), float(i)), "pos": torch.full((3,), 100.0 + i)}
        state = {"arm": torch.zeros(1), "box": box}
        return TensorDict({**state, "next": state})

    td = LazyStackedTensorDict(*map(row, range(8)))
    if not stack:
        td = td.contiguous()
    layout = EntityLayout.from_keys({"arm": "arm", "box": "box"}, fixed=["arm"])
    plan, values = SwapPlanner(layout)(td)
    for leaf in plan.leaves:
        assert torch.equal(values[leaf.place], td[leaf.key])
    td["caiac", "score"] = torch.zeros(8, 2)
    out = CAIACTransform(layout, counterfactual_ratio=1.0)(td)
    assert (out["box", "pos"] - out["box", "vel"] == 100).all()
    assert (out["box", "vel"] != td["box", "vel"]).any()


class Pose(TensorClass):
    x: torch.Tensor


def test_what_entities_are_made_of() -> None:
    td = nested(4)
    td.set_non_tensor(("s", "name"), "kitchen")  # nobody's
    planner = SwapPlanner(EntityLayout.from_keys({"pose": "pose"}))
    pose = Pose(x=torch.arange(4.0), batch_size=[4])
    td["pose"] = td["next", "pose"] = pose
    plan, _ = planner(td)
    assert [leaf.key for leaf in plan.leaves] == [("pose", "x"), ("next", "pose", "x")]
    # A fixed entity may have a name: it is not swapped.
    layout = EntityLayout.from_keys({"pose": "pose", "arm": "arm"}, fixed=["arm"])
    for where in (td, td["next"]):
        where["arm"] = TensorDict({"q": torch.zeros(4)}, [4])
        where["arm"].set_non_tensor("name", "left")
    plan, _ = SwapPlanner(layout)(td)
    assert ("arm", "q") in plan.states and len(plan.leaves) == 2
    layout = EntityLayout.from_keys({"pose": "pose", "arm": "arm"})
    with pytest.raises(TypeError, match=r"\('arm', 'name'\) is a .*made of tensors"):
        SwapPlanner(layout)(td)


def test_old_plans_are_dropped() -> None:
    planner = SwapPlanner(EntityLayout({"arm": [0]}))
    for width in range(1, 100):
        state = torch.zeros(2, width)
        td = TensorDict({"observation": state, "next": {"observation": state}}, [2])
        plan, _ = planner(td)
        assert plan.leaves[0].width == width
    assert len(pickle.dumps(planner)) < 10_000


@pytest.mark.parametrize(
    ("ids", "newest", "start", "rows"),
    [
        ([0, 0, 0, 1, 1], None, 3, [3, 4]),
        ([0, 1, 1, 1, 0], 0, 4, [4, 0]),  # a ring goes on at its first row
        ([0, 1, 0, 1, 1], None, 1, [1, 3]),  # of two environments in turn
    ],
)
@pytest.mark.parametrize("chosen", [None, 0, 1])
def test_rows_of_donor_windows(
    ids: list[int],
    newest: int | None,
    start: int,
    rows: list[int],
    chosen: int | None,
) -> None:
    td = flat(4)
    plan, values = SwapPlanner(FLAT)(td)
    rb = ReplayBuffer(storage=LazyTensorStorage(5 if newest is not None else 6))
    order = torch.tensor(ids)
    if newest is not None:  # write the row that is replaced first
        order = torch.cat([torch.tensor([9]), order[1:], order[:1]])
    for number in order:
        rb.extend(TensorDict({"episode": number.view(1)}, [1]))
    source = 100 + torch.arange(24.0).view(6, 4)
    is_chosen = torch.tensor([True]) if chosen is None else torch.arange(2) == chosen
    draw = SwapDraw(
        donors=torch.tensor([[0, start]]).expand(len(is_chosen), 2),
        swapped=torch.stack([torch.zeros_like(is_chosen), is_chosen], -1),
        no_donor=torch.tensor([0, 0]),
        chosen=None if chosen is None else is_chosen,
    )
    trajectories = trajectory_index(rb, done_key=None)
    out = apply_swap(
        td,
        plan,
        values,
        draw,
        window=2,
        sources=[source, -source],
        trajectories=trajectories,
    )
    expected = td["observation"].clone()
    first = 0 if chosen == 0 else 2
    expected[first : first + 2, 1:3] = source[rows, 1:3]
    assert torch.equal(out["observation"], expected)
    assert torch.equal(out["next", "observation"], -expected)


@given(
    windows=st.integers(1, 6),
    window=st.integers(1, 3),
    seed=st.integers(0, 2**31),
    data=st.data(),
)
@pytest.mark.parametrize("layout", [FLAT, NESTED])
def test_any_windows_of_a_batch_are_replaced(
    layout: EntityLayout, windows: int, window: int, seed: int, data: st.DataObject
) -> None:
    rows = windows * window
    td = flat(rows) if layout is FLAT else nested(rows)
    name = torch.arange(float(rows))
    for key in td.keys(True, True):
        shape = td[key].shape
        sign = -1 if key[0] == "next" else 1
        td[key] = sign * name.view(-1, *(1,) * (len(shape) - 1)).expand(shape).clone()
    before = td.clone()
    count = data.draw(st.integers(0, windows))
    chosen = torch.tensor(
        data.draw(st.lists(st.booleans(), min_size=count, max_size=count)),
        dtype=torch.bool,
    )
    generator = torch.Generator().manual_seed(seed)
    shape = (count, 2)
    draw = SwapDraw(
        donors=torch.randint(windows, shape, generator=generator) * window,
        swapped=(torch.rand(shape, generator=generator) < 0.5) & chosen.unsqueeze(-1),
        no_donor=torch.zeros(2, dtype=torch.int64),
        chosen=chosen,
    )
    draw.swapped[:, 0] = False  # the arm is fixed
    plan, values = SwapPlanner(layout)(td)
    out = apply_swap(td, plan, values, draw, window=window)
    cup = name.clone()
    for c, b in enumerate(range(windows - count, windows)):
        if draw.swapped[c, 1]:
            start = int(draw.donors[c, 1])
            cup[b * window : (b + 1) * window] = name[start : start + window]
    for leaf in plan.leaves:
        sign = -1 if leaf.key[0] == "next" else 1
        value = sign * out[leaf.key].reshape(rows, -1)
        for column in range(value.shape[1]):
            of_cup = layout is NESTED or column in (1, 2)
            assert torch.equal(value[:, column], cup if of_cup else name)
    assert (td == before).all()


@pytest.mark.parametrize("row", [-1, 3, 1 << 40, (1 << 63) - 1, -(1 << 63)])
@pytest.mark.parametrize("has_sources", [False, True])
@pytest.mark.parametrize("in_torch", [False, True])
@pytest.mark.parametrize("strided", [False, True])
def test_donors_out_of_range(
    row: int, has_sources: bool, in_torch: bool, strided: bool
) -> None:
    state = torch.zeros(3, 4)[:, ::2] if strided else torch.zeros(3, 2)
    td = TensorDict({"observation": state, ("next", "observation"): state}, [3])
    plan, values = SwapPlanner(EntityLayout({"arm": [0], "cup": [1]}))(td)
    donors = torch.tensor([[0, 0], [0, row]])
    draw = SwapDraw(donors, torch.ones_like(donors).bool(), torch.zeros(2).long())
    sources = [values[leaf.place] for leaf in plan.leaves] if has_sources else None
    context = only_torch() if in_torch else nullcontext()
    with context, pytest.raises(IndexError, match="out of range"):
        apply_swap(td, plan, values, draw, sources=sources)


@pytest.mark.parametrize("row", [-1, 12, 15, 1 << 40, -(1 << 63)])
@pytest.mark.parametrize("oldest", [0, 6])  # in the order of time, and a ring
@pytest.mark.parametrize("strided", [False, True])
def test_donor_windows_out_of_range(row: int, oldest: int, strided: bool) -> None:
    state = torch.arange(48.0).view(12, 4)[:, ::2]
    state = state if strided else state.contiguous()
    source = TensorDict(
        {
            "observation": state,
            "episode": torch.zeros(12, dtype=torch.int64),
            "next": {"observation": state},
        },
        [12],
    )
    planner = SwapPlanner(EntityLayout({"arm": [0], "cup": [1]}))
    td = source[:4]
    (plan, values), (_, stored) = planner(td), planner(source)
    trajectories = trajectory_index(source, done_key=None)._replace(oldest=oldest)
    donors = torch.tensor([[0, 3], [0, row]])
    draw = SwapDraw(donors, torch.ones_like(donors).bool(), torch.zeros(2).long())
    with pytest.raises(IndexError, match="out of range"):
        apply_swap(
            td,
            plan,
            values,
            draw,
            window=2,
            sources=[stored[leaf.place] for leaf in plan.leaves],
            trajectories=trajectories,
        )


def test_places_in_storages_of_more_than_two_billion_values() -> None:
    """Their places do not fit into 32 bits. The source takes the memory of one row."""
    td = flat(1)
    plan, values = SwapPlanner(FLAT)(td)
    rows = (1 << 31) // 4 + 2
    one = torch.arange(4.0).view(1, 4)
    source = one.expand(rows, 4)
    draw = SwapDraw(
        donors=torch.tensor([[0, rows - 1]]),
        swapped=torch.tensor([[False, True]]),
        no_donor=torch.tensor([0, 0]),
    )
    out = apply_swap(td, plan, values, draw, sources=[source, source])
    assert out["observation"].tolist() == [[0.0, 1.0, 2.0, 3.0]]
