"""CoDATransform against a slow oracle, on the data of CAIACTransform's tests."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from tests.transforms.oracle import (
    DONORS,
    FLAT,
    FLAT_FREE,
    FORMS,
    KINDS,
    NESTED,
    STRIDE,
    Case,
    check_samples,
    chosen_windows,
    draw_buffer,
    make_data,
    owner_of,
    score,
    slices,
    stored,
    time_windows,
)
from torchrl_caiac import CAIACTransform, CoDATransform, EntityLayout
from torchrl_caiac._torchrl import add_revision, storage_data
from torchrl_caiac.transforms import HindsightGoal, TransformKeys, WindowGoal

THRESHOLD = 0.25
N = 3
Window = tuple[int, ...]


def with_graphs(data: TensorDict, share: float, generator: torch.Generator) -> Any:
    """Adds graphs, each link on with some probability."""
    graphs = torch.rand(len(data), N + 1, N, generator=generator)
    off = torch.rand(graphs.shape, generator=generator) >= share
    data["coda", "graph"] = torch.where(off, 0.0, graphs)
    return data.exclude(("caiac", "score"))


def free_components(layout: EntityLayout, graphs: torch.Tensor) -> list[frozenset[int]]:
    """The components of a window ``[window, N + 1, N]`` that may be swapped."""
    groups = [{i} for i in range(N + 1)]  # the last one is the action
    for graph in graphs:
        for i in range(N + 1):
            for j in range(N):
                if graph[i, j] > THRESHOLD:
                    joined = next(g for g in groups if i in g) | next(
                        g for g in groups if j in g
                    )
                    groups = [g for g in groups if not g & joined] + [joined]
    never = {N, *(layout.index(name) for name in layout.fixed)}
    return [frozenset(g) for g in groups if not g & never]


def donor_windows(case: Case) -> dict[frozenset[int], set[Window]]:
    """The row names of all windows that have each component, one by one."""
    data, found = stored(case.donors), {}
    for part in time_windows(case.donors, case.window):
        names = tuple(data["row"][part].tolist())
        if not case.stale & set(names):
            graphs = data["coda", "graph"][part]
            for component in free_components(case.layout, graphs):
                found.setdefault(component, set()).add(names)
    return found


def origins(
    case: Case, batch: TensorDict, rows: TensorDict, windows: int
) -> dict[tuple[int, int], set[Window]]:
    """Which windows the values of each entity come from, its own in the first place."""
    found: dict[tuple[int, int], set[Window]] = {}
    for key in rows.keys(True, True):
        path = key if isinstance(key, tuple) else (key,)
        value, real = batch[key], rows[key]
        assert value.dtype == real.dtype and value.shape == real.shape
        owner = owner_of(case.layout, path)
        if owner is None:
            torch.testing.assert_close(value, real, rtol=0, atol=0, equal_nan=True)
            continue
        value, real = (x.reshape(len(x), -1).double() for x in (value, real))
        if path[0] == "next":
            value, real = value - STRIDE, real - STRIDE
        assert torch.equal(value % STRIDE, real % STRIDE), key  # of the same column
        names = (value // STRIDE).long().unflatten(0, (windows, case.window))
        for column in range(value.shape[1]):
            name = owner if isinstance(owner, str) else owner[column]
            if name is None:
                assert torch.equal(value[:, column], real[:, column])
                continue
            for b in range(windows):
                origin = tuple(names[b, :, column].tolist())
                found.setdefault((b, case.layout.index(name)), set()).add(origin)
    return found


def check_batch(case: Case, batch: TensorDict, missing: list[int]) -> None:
    """Raises where the batch is anything that section 3's invariants forbid."""
    layout, window = case.layout, case.window
    windows = len(batch) // window
    chosen = chosen_windows(case, batch)
    raw = stored(case.rb)
    place = {int(row): i for i, row in enumerate(raw["row"])}
    rows = raw[torch.tensor([place[row] for row in batch["row"].tolist()])]
    names = [tuple(part) for part in batch["row"].unflatten(0, (-1, window)).tolist()]
    graphs = rows["coda", "graph"].unflatten(0, (windows, window))
    free = [
        [] if case.stale & set(own) else free_components(layout, part)
        for own, part in zip(names, graphs, strict=True)
    ]
    marks = batch["caiac", "swapped"].unflatten(0, (windows, window))
    assert marks.shape == (windows, window, N)
    assert torch.equal(marks, marks[:, :1].expand_as(marks))
    found = origins(case, batch, rows, windows)
    allowed = None if case.donors is None else donor_windows(case)
    for b in range(windows):
        swapped = {n for n in range(N) if marks[b, 0, n]}
        for n in set(range(N)) - swapped:
            assert found.get((b, n), {names[b]}) == {names[b]}
        if not chosen[b]:
            assert not swapped
            continue
        for component in free[b]:
            options = (
                {names[c] for c in range(windows) if c != b and component in free[c]}
                if allowed is None
                else allowed.get(component, set())
            )
            if not options:
                for n in component:
                    missing[n] += case.swap_prob == 1.0
            # A component is swapped whole or not at all, and from one window.
            done = component & swapped
            assert done == component or not done
            assert bool(done) <= bool(options)
            if options and case.swap_prob == 1.0:
                assert done
            if done:
                sources = set.union(*(found.get((b, n), set()) for n in component))
                assert len(sources) == 1 and sources <= options
            swapped -= component
        assert not swapped


@st.composite
def cases(draw: st.DrawFn) -> Case:
    window = draw(st.integers(1, 4))
    layout = draw(st.sampled_from([FLAT, FLAT_FREE, NESTED]))
    dtype = draw(st.sampled_from([torch.float32, torch.float64, torch.int64]))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    share = draw(st.sampled_from([0.0, 0.05, 0.3]))
    kind = draw(st.sampled_from(KINDS))
    stale: set[int] = set()

    def buffer(first: int, form: str, **kwargs: Any) -> ReplayBuffer:
        def data(*args: Any) -> TensorDict:
            made = make_data(layout, *args, generator, dtype, layout is not FLAT_FREE)
            return with_graphs(made, share, generator)

        key = ("coda", "graph")
        return draw_buffer(
            draw, data, layout, key, first, form, window, kind, stale, **kwargs
        )

    batch = draw(st.integers(1, 8))
    rb = buffer(0, "in order", batch_size=batch * window, sampler=slices(window))
    rb.set_rng(generator)  # a failure can be repeated
    form = draw(st.sampled_from(FORMS))
    donors = None if form is None else buffer(DONORS, form, batch_size=1)
    ratio = draw(st.sampled_from([0.0, 0.3, 0.5, 1.0]))
    swap_prob = draw(st.sampled_from([0.0, 0.5, 1.0]))
    chosen = draw(st.sampled_from(["random", "last"]))
    # A storage may be given as well.
    source = donors.storage if donors is not None and draw(st.booleans()) else donors
    transform = CoDATransform(
        layout,
        THRESHOLD,
        ratio,
        rows=chosen,
        window=window,
        donors=source,
        swap_prob=swap_prob,
        unscored="keep" if kind == "written later" else "raise",
        generator=generator,
    )
    return Case(layout, rb, transform, donors, window, ratio, swap_prob, chosen, stale)


@settings(
    max_examples=80,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(case=cases())
def test_invariants(case: Case) -> None:
    check_samples(case, check_batch)


# --- small fixed data ----------------------------------------------------------------


def small(
    layout: EntityLayout = FLAT, batch: int = 8, share: float = 0.0, window: int = 1
) -> ReplayBuffer:
    generator = torch.Generator().manual_seed(0)
    rows = torch.arange(20)
    data = make_data(layout, rows, [10, 10], generator, goals=layout is not FLAT_FREE)
    rb = ReplayBuffer(
        storage=LazyTensorStorage(20),
        sampler=slices(window),
        batch_size=batch * window,
    )
    rb.extend(with_graphs(data, share, generator))
    return rb


@pytest.mark.parametrize("donor", [False, True])
def test_same_generator_state_gives_the_same_batch(donor: bool) -> None:
    batches = []
    for _ in range(2):
        rb = small(share=0.1)
        rb.set_rng(torch.Generator().manual_seed(5))
        transform = CoDATransform(
            FLAT, swap_prob=0.5, donors=small(share=0.1) if donor else None
        )
        transform.set_generator(torch.Generator().manual_seed(3))
        rb.append_transform(transform)
        batches.append([rb.sample() for _ in range(3)])
    for one, other in zip(*batches, strict=True):
        assert (one == other).all()


def test_draw_and_apply_are_apart() -> None:
    td = small(batch=6).sample()
    transform = CoDATransform(FLAT, counterfactual_ratio=1.0)
    draw = transform.generate_parameters(td["coda", "graph"])
    assert draw.donors.shape == draw.swapped.shape == (6, N)
    one = transform.apply_parameters(td, draw)
    assert (transform.apply_parameters(td, draw) == one).all()


def test_without_links_it_is_caiac() -> None:
    """Nothing but the action's links: both transforms may do the same."""
    rb = small(FLAT_FREE, batch=50)
    td = rb.sample()
    td["coda", "graph"][:, N] = torch.rand(50, N)
    td["action score"] = td["coda", "graph"][:, N]
    for rows in ("random", "last"):
        coda = CoDATransform(FLAT_FREE, 0.4, rows=rows)
        caiac = CAIACTransform(FLAT_FREE, 0.4, score_key="action score", rows=rows)
        found = []
        for transform in (coda, caiac):
            transform.set_generator(torch.Generator().manual_seed(6))
            found.append(transform(td))
        for key in ("counterfactual", "swapped"):
            assert torch.equal(found[0]["caiac", key], found[1]["caiac", key])


def test_nested_keys_and_options() -> None:
    rb = small(NESTED)
    td = rb.sample().rename_key_(("coda", "graph"), ("my", "own", "graph"))
    transform = CoDATransform(
        NESTED,
        graph_key=("my", "own", "graph"),
        keys=TransformKeys(counterfactual=("marks", "row"), swapped="swaps"),
        reward_fn=lambda achieved, desired: achieved.sum(-1),
    )
    assert transform.graph_key == ("my", "own", "graph")
    out = transform(td)
    marked = out["marks", "row"]
    assert marked.sum() == 4
    assert torch.equal(out["swaps"][:, 1:], marked.expand(-1, 2))
    gained = out["next", "got", "cup"].sum(-1, keepdim=True)
    assert torch.equal(
        out["next", "reward"], torch.where(marked, gained, td["next", "reward"])
    )
    assert ("caiac", "swapped") not in out.keys(True, True)
    assert "threshold=0.2" in repr(transform) and "CoDATransform" in repr(transform)


def test_entities_of_a_component_share_the_goal_of_their_donor() -> None:
    layout = EntityLayout(
        {"cup": [0], "lid": [1]},
        goal={"cup": [0], "lid": [1]},
        achieved={"cup": [0], "lid": [1]},
    )
    state = torch.arange(100.0).unsqueeze(-1).expand(100, 2).clone()
    graph = torch.zeros(100, 3, 2)
    graph[:, 0, 1] = 1.0
    data = TensorDict(
        {
            "observation": state,
            "next": {"observation": state + 1},
            "episode": torch.arange(100) // 50,
            "desired_goal": torch.zeros(100, 2),
            ("coda", "graph"): graph,
        },
        [100],
    )
    donors = ReplayBuffer(storage=LazyTensorStorage(100))
    donors.extend(data)
    goals = WindowGoal(layout, window=2, mixture={"geometric": 1.0}, p=0.1)
    transform = CoDATransform(layout, 0.2, 1.0, window=2, donors=donors, goals=goals)
    out = transform(data[:20])
    assert out["caiac", "swapped"].all()
    for key in ("observation", "desired_goal"):
        assert torch.equal(out[key][:, 0], out[key][:, 1])
    ahead = out["desired_goal"] - out["observation"]
    assert (ahead.view(10, 2, 2)[:, 1] >= 1).all() and len(ahead.unique()) > 3


def test_with_hindsight_goals() -> None:
    def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
        return -(achieved != desired).any(-1).float()

    rb = small(FLAT)
    goals = HindsightGoal(FLAT, reward, future=0.0, counterfactual=1.0)
    coda = CoDATransform(FLAT)
    for transform in (coda, goals):
        rb.append_transform(transform)
    batch = rb.sample()
    marked = batch["caiac", "counterfactual"]
    assert marked.sum() == 4
    assert torch.equal(batch["caiac", "swapped"][:, 1:], marked.expand(-1, 2))
    assert torch.equal(batch["hindsight", "relabeled"], marked)
    chosen = marked[:, 0]
    # As `achieved` names them.
    achieved = batch["next", "observation"][chosen][:, [7, 1, 2]]
    wanted = batch["desired_goal"][chosen][:, [1, 2, 0]]
    for goal in wanted:
        assert (achieved == goal).all(-1).any()


def test_rows_written_later_are_not_scored() -> None:
    rb = small()
    score(rb, FLAT, ("coda", "graph"))
    rb.append_transform(CoDATransform(FLAT, 1.0))
    rb[:]
    names = 30 + torch.arange(3)
    later = make_data(FLAT, names, [3], torch.Generator().manual_seed(0))
    rb.extend(later.exclude(("caiac", "score")))
    message = r"3 of 20 rows have graphs in \('coda', 'graph'\) of other states than"
    with pytest.raises(ValueError, match=message):
        rb[:]
    score(rb, FLAT, ("coda", "graph"))
    rb[:]


def test_the_index_of_donors_follows_writes() -> None:
    donors, td = small(), small().sample()
    transform = CoDATransform(FLAT, 1.5, 1.0, donors=donors)
    assert transform(td)["caiac", "swapped"][:, 1:].all()
    held = donors.storage[:].clone()
    held["coda", "graph"].fill_(2.0)
    donors.extend(held)
    assert not transform(td)["caiac", "swapped"].any()
    donors.storage[:]["coda", "graph"].zero_()  # behind the buffer's back
    assert not transform(td)["caiac", "swapped"].any()
    transform.refresh_donors()
    assert transform(td)["caiac", "swapped"][:, 1:].all()
    assert transform.no_donor_count.tolist() == [0, 16, 16]
    transform.reset_no_donor_count()
    assert transform.no_donor_count.sum() == 0


def test_copies_and_pickles() -> None:
    transform = CoDATransform(FLAT, 0.3, donors=small(), window=2)
    td = small(window=2).sample()
    for twin in (copy.deepcopy(transform), pickle.loads(pickle.dumps(transform))):
        torch.manual_seed(0)
        one = transform(td)
        torch.manual_seed(0)
        assert (twin(td) == one).all()


# --- bad input -----------------------------------------------------------------------


def layout_of(entities: int) -> EntityLayout:
    return EntityLayout({f"e{i}": [i] for i in range(entities)})


def test_at_most_64_entities() -> None:
    with pytest.raises(
        ValueError, match=r"the layout has 65 entities, but.*at most 64"
    ):
        CoDATransform(layout_of(65))
    layout = layout_of(64)
    state = torch.arange(4.0).unsqueeze(-1).expand(4, 64)
    graph = torch.zeros(4, 65, 64)
    graph[:, 0, 63] = graph[:, 64, 5] = 1.0
    td = TensorDict(
        {
            "observation": state,
            "next": {"observation": state},
            ("coda", "graph"): graph,
        },
        [4],
    )
    out = CoDATransform(layout, rows="last")(td)
    swapped = out["caiac", "swapped"]
    assert swapped[2:].sum(1).tolist() == [63, 63] and not swapped[:, 5].any()
    assert torch.equal(out["observation"][:, 0], out["observation"][:, 63])


def test_graphs_of_the_wrong_shape() -> None:
    td = small().sample()
    graph = td["coda", "graph"]
    message = (
        r"expected \[8, 4, 3\]: a score from each entity and the action to each of"
    )
    for wrong in (graph[:, :N], graph.mT, graph[:, N], graph[..., None]):
        with pytest.raises(ValueError, match=message):
            CoDATransform(FLAT)(td.copy().set(("coda", "graph"), wrong))
    with pytest.raises(KeyError, match=r"no graphs.* is given by graph_key"):
        CoDATransform(FLAT)(td.exclude(("coda", "graph")))
    donors = small()
    transform = CoDATransform(FLAT, donors=donors, graph_key="other")
    with pytest.raises(
        KeyError, match=r"donor buffer has no graphs in 'other'.*graph_"
    ):
        transform(td.copy().set("other", graph))
    storage_data(donors.storage)["other"] = torch.zeros(20, N, N)
    add_revision(donors.storage)
    with pytest.raises(ValueError, match=r"shape \[20, 3, 3\], expected \[20, 4, 3\]"):
        transform(td.copy().set("other", graph))


def test_graphs_that_are_not_finite() -> None:
    td = small().sample()
    td["coda", "graph"][2, 3, 1] = torch.nan
    with pytest.raises(ValueError, match=r"is NaN.*in 1 of 8 rows for \['cup'\]"):
        CoDATransform(FLAT)(td)
    out = CoDATransform(FLAT, 1.5, 1.0, check=False)(td)
    # Unscored is linked: to the action here.
    assert not out["caiac", "swapped"][2, 1] and out["caiac", "swapped"][2, 2]
    td["coda", "graph"][2, 3, 1] = torch.inf
    with pytest.raises(ValueError, match=r"infinite for \['cup'\]"):
        CoDATransform(FLAT)(td)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"threshold": -0.1}, ValueError, "threshold must be finite, at least 0"),
        ({"counterfactual_ratio": 2}, ValueError, "counterfactual_ratio must be in"),
        ({"swap_prob": "1"}, TypeError, "swap_prob must be a number"),
        ({"window": 0}, ValueError, "window must be at least 1 row"),
        ({"donors": [1]}, TypeError, "donors must be a ReplayBuffer"),
        ({"goals": WindowGoal(FLAT, 1)}, ValueError, "there is none"),
        ({"generator": 1}, TypeError, "generator must be a torch.Generator"),
    ],
)
def test_wrong_arguments(kwargs: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        CoDATransform(FLAT, **kwargs)


@pytest.mark.gpu
def test_on_an_accelerator() -> None:
    td = small(batch=200, share=0.1).sample().to("cuda")
    transform = CoDATransform(FLAT, 0.25, 1.0)
    out = transform(td)
    masks = transform.swappable(td["coda", "graph"])
    assert torch.equal(masks.cpu(), transform.swappable(td["coda", "graph"].cpu()))
    assert not (out["caiac", "swapped"] & (masks == 0)).any()
    assert out["caiac", "swapped"].any() and out["observation"].is_cuda
    donors = CoDATransform(FLAT, 0.25, 1.0, donors=small(share=0.1))(td)
    assert donors["caiac", "swapped"].any()
