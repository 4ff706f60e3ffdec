"""HindsightGoal against a slow oracle that looks at each row of a batch by itself."""

from __future__ import annotations

import math
import pickle

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    HERReplayBuffer,
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.envs.transforms import DoubleToFloat

from tests.pretend_cuda import nothing_waits
from tests.transforms.goals.oracle import (
    FLAT,
    NESTED,
    STRIDE,
    THRESHOLD,
    Case,
    build_case,
    check_batch,
    leaves,
    make,
    reward,
    stored_rows,
    vectors,
)
from torchrl_caiac import EntityLayout
from torchrl_caiac.transforms import CAIACTransform, HindsightGoal, TransformKeys

ORDERS = ["augment, relabel", "relabel"]
shares = st.sampled_from([0.0, 0.3, 0.5, 1.0])


@st.composite
def settings_of_cases(draw: st.DrawFn) -> dict:
    lengths = draw(st.lists(st.integers(1, 9), min_size=1, max_size=5))
    total = sum(lengths)
    future = draw(shares)
    return {
        "lengths": lengths,
        "layout": draw(st.sampled_from([FLAT, NESTED])),
        "order": draw(st.sampled_from(ORDERS)),
        "storage": draw(st.sampled_from([LazyTensorStorage, LazyMemmapStorage])),
        # smaller than the data: a ring that was written past its end
        "size": draw(st.integers(max(3, total // 2), total + 3)),
        "batch": draw(st.integers(1, 12)),
        "ids": draw(st.booleans()),
        "seed": draw(st.integers(0, 2**20)),
        "future": future,
        "random": draw(shares.map(lambda share: min(share, 1 - future))),
        "counterfactual": draw(shares),
        "strategy": draw(st.sampled_from(["geometric", "uniform"])),
        "caiac": {
            "counterfactual_ratio": draw(shares),
            "rows": draw(st.sampled_from(["random", "last"])),
            "swap_prob": draw(st.sampled_from([0.0, 0.5, 1.0])),
            "reward_fn": draw(st.sampled_from([None, reward])),
        },
        "data": {"stale": draw(st.booleans())},
        "prefetch": draw(st.sampled_from([None, 1])),
    }


@settings(max_examples=80, suppress_health_check=[HealthCheck.too_slow])
@given(kwargs=settings_of_cases())
def test_rows_are_what_they_may_be(kwargs: dict) -> None:
    case = build_case(**kwargs)
    raw = case.rb.storage[:].clone()
    twin = build_case(**kwargs)
    for _ in range(2):
        batch = case.rb.sample()
        check_batch(case, batch, stored_rows(case.rb, batch))
        assert (batch == twin.rb.sample()).all()  # the same generators
    assert (case.rb.storage[:] == raw).all()


# --- distributions -------------------------------------------------------------------


def chi2(counts: torch.Tensor, expected: torch.Tensor) -> float:
    return float(((counts - expected) ** 2 / expected).sum())


@pytest.mark.parametrize("strategy", ["geometric", "uniform"])
def test_offsets_of_future_goals(strategy: str) -> None:
    case = build_case([3, 12, 4], future=1.0, strategy=strategy, order="relabel")
    rows = torch.full((40_000,), 5)  # nine more rows of the trajectory follow
    case.goals.expand(rows, {}, case.rb.storage)
    batch = case.goals(case.rb.storage[rows])
    assert batch["hindsight", "relabeled"].all()
    offset = ((vectors(batch)[:, 0] - 1) / STRIDE).long() - 1 - 5
    counts = torch.bincount(offset, minlength=10).double()
    share = torch.full((10,), 0.1, dtype=torch.double)
    if strategy == "geometric":
        share = 0.2 * 0.8 ** torch.arange(10, dtype=torch.double)
        share[-1] += 1 - share.sum()  # cut at the trajectory's end
    assert chi2(counts, share * len(rows)) < 27.9  # 9 degrees of freedom, p = 0.001


def test_shares_and_sources() -> None:
    goals = HindsightGoal(
        FLAT,
        reward,
        future=0.5,
        random=0.2,
        counterfactual=0.4,
        generator=torch.Generator().manual_seed(0),
    )
    flags = torch.arange(40).unsqueeze(-1) % 4 == 3  # anywhere, not only at the end
    future = {"desired_goal": torch.zeros(40, 3)}
    draws = [goals.generate_parameters(flags, future).source for _ in range(2000)]
    source = torch.stack(draws)
    own = torch.arange(40)
    kind = torch.where(source < 40, 0, torch.where(source < 80, 1, 2))
    assert (source[kind == 0] == own.expand_as(source)[kind == 0]).all()
    assert (source[kind == 2] == 80 + own.expand_as(source)[kind == 2]).all()
    mark = flags[:, 0]
    for group, wanted in ((~mark, (0.3, 0.2, 0.5)), (mark, (0.6, 0.4, 0.0))):
        for number, share in enumerate(wanted):
            found = (kind[:, group] == number).double().mean()
            assert found == pytest.approx(share, abs=0.01)
        # a random goal is any of the rows of the same kind, all with the same chance
        picks = source[:, group][kind[:, group] == 1] - 40
        counts = torch.bincount(picks, minlength=40).double()
        assert counts[~group].sum() == 0
        number = int(group.sum())
        expected = torch.full((number,), len(picks) / number, dtype=torch.double)
        assert chi2(counts[group], expected) < 58.3  # at most 29 degrees of freedom


# --- methods -------------------------------------------------------------------------


def test_relabel_only_relabels_the_same_share_and_swaps_nothing() -> None:
    case = build_case([40, 40], batch=4000, caiac={"swap_prob": 0.0})
    batch = case.rb.sample()
    stored = stored_rows(case.rb, batch)
    assert not batch["caiac", "swapped"].any()
    for key in ("observation", ("next", "observation"), "action"):
        assert torch.equal(batch[key], stored[key])
    relabeled = batch["hindsight", "relabeled"][:, 0]
    marked = batch["caiac", "counterfactual"][:, 0]
    assert marked.sum() == 2000
    for half in (marked, ~marked):
        assert relabeled[half].double().mean() == pytest.approx(0.5, abs=0.05)
    # counterfactual goals come from anywhere, real ones from the row's own future
    reached = (vectors(batch)[:, 0] - 1) / STRIDE - 1
    own = torch.where(batch["row"] < 40, 0, 1) == torch.where(reached < 40, 0, 1)
    assert own[relabeled & ~marked].all()
    assert own[relabeled & marked].double().mean() == pytest.approx(0.5, abs=0.06)


def test_without_augmentation_the_same_share_is_random() -> None:
    case = build_case([40, 40], batch=4000, order="relabel", random=0.25)
    batch = case.rb.sample()
    relabeled = batch["hindsight", "relabeled"][:, 0]
    assert relabeled.double().mean() == pytest.approx(0.75, abs=0.04)
    reached = (vectors(batch)[:, 0] - 1) / STRIDE - 1
    earlier = relabeled & (reached < batch["row"])  # no row of the future
    assert 0.08 < earlier.double().mean() < 0.2
    assert ("caiac", "counterfactual") not in leaves(batch)


@pytest.mark.parametrize("layout", [FLAT, NESTED])
def test_goals_of_counterfactual_rows_follow_the_swap(layout: EntityLayout) -> None:
    case = build_case(
        [30, 30],
        layout,
        batch=64,
        counterfactual=1.0,
        caiac={"counterfactual_ratio": 0.5},
    )
    batch = case.rb.sample()
    check_batch(case, batch, stored_rows(case.rb, batch))
    marked = batch["caiac", "counterfactual"][:, 0]
    goal = vectors(batch)[marked]
    # the cup and the box of one goal come from different rows
    assert ((goal[:, 0] // STRIDE) != (goal[:, 2] // STRIDE)).any()
    assert batch["hindsight", "relabeled"][marked].all() and marked.sum() == 32


def test_rewards_of_the_augmentation_are_the_same() -> None:
    for layout in (FLAT, NESTED):
        case = build_case([9, 9], layout, counterfactual=0.0, data={"stale": True})
        raw = case.rb.storage[:]
        case.goals.expand(torch.arange(18), {}, case.rb.storage)
        augment = CAIACTransform(layout, THRESHOLD, reward_fn=reward)
        swapped = augment(raw)
        marked = swapped["caiac", "counterfactual"]
        rewards = swapped["next", "reward"]
        assert torch.equal(rewards != 0.5, marked) and marked.sum() == 9
        out = case.goals(swapped)
        assert torch.equal(out["next", "reward"][marked], rewards[marked])


# --- HERReplayBuffer -----------------------------------------------------------------


def her_case(her_ratio: float, **caiac: object) -> Case:
    return build_case(
        [7, 4, 9],
        batch=16,
        kind=HERReplayBuffer,
        rb_kwargs={
            "her_ratio": her_ratio,
            "achieved_goal_key": ("next", "achieved_goal"),
        },
        caiac=caiac,
        data={"stale": True, "achieved": True},
        future=0.0,
    )


@pytest.mark.parametrize("swap_prob", [0.0, 1.0])
def test_with_her_replay_buffer(swap_prob: float) -> None:
    case = her_case(0.25, swap_prob=swap_prob, rows="last")
    raw = case.rb.storage[:].clone()
    seen = 0
    for _ in range(20):
        batch = case.rb.sample()
        relabeled = batch["hindsight", "relabeled"][:, 0]
        assert relabeled[:4].all() and not relabeled[4:8].any()
        check_batch(case, batch, stored_rows(case.rb, batch), her=4)
        seen += int(relabeled[8:].sum())
    assert 50 < seen < 110
    assert (case.rb.storage[:] == raw).all()
    too_many = her_case(0.75, swap_prob=swap_prob, rows="last")
    with pytest.raises(RuntimeError, match=r"first 12 of 16.*at most .* = 0\.5"):
        too_many.rb.sample()
    # Its own check, for an augmentation that another transform hides.
    flagged = TensorDict(
        {("caiac", "counterfactual"): torch.ones(4, 1, dtype=torch.bool)}, [4]
    )
    with pytest.raises(ValueError, match=r"first 4 rows.* 4 of which are counterfac"):
        too_many.goals.her_reward(flagged)


HER_NEEDS_LAST = (
    r"HERReplayBuffer relabels the first \d+ of 16 rows.*rows='last' to CAIAC.*"
    "at most 1 - counterfactual_ratio"
)


def test_her_replay_buffer_needs_the_last_rows() -> None:
    with pytest.raises(RuntimeError, match=HER_NEEDS_LAST):
        her_case(0.25).rb.sample()


@pytest.mark.parametrize("first", ["sample", "call"])
def test_her_replay_buffer_is_refused_at_every_sample(first: str) -> None:
    case = her_case(0.25)
    if first == "sample":
        with pytest.raises(RuntimeError, match=HER_NEEDS_LAST):
            case.rb.sample()
    else:  # on data of no buffer, to see what it does
        case.caiac(make([8]))
    with pytest.raises(RuntimeError, match=HER_NEEDS_LAST):
        case.rb.sample()


def test_her_replay_buffer_that_relabels_nothing() -> None:
    batch = her_case(0.0).rb.sample()
    assert batch["caiac", "counterfactual"].sum() == 8


# --- what it composes with -----------------------------------------------------------


@pytest.mark.parametrize("form", ["in two dimensions", "in turn"])
def test_rows_of_parallel_environments(form: str) -> None:
    data = make([3, 7, 6, 4])
    goals = HindsightGoal(FLAT, reward, future=1.0, strategy="uniform")
    ndim = 2 if form == "in two dimensions" else 1
    rb = ReplayBuffer(
        storage=LazyTensorStorage(20, ndim=ndim), sample_unit=goals, batch_size=100
    )
    if ndim == 2:
        rb.extend(data.view(2, 10))
    else:
        rb.extend(data.view(2, 10).transpose(0, 1).reshape(-1))
    caiac = CAIACTransform(FLAT, THRESHOLD, 0.3)
    rb.append_transform(caiac)
    rb.append_transform(goals)
    case = Case(rb, goals, [3, 7, 6, 4], caiac)
    seen = set()
    rb.set_rng(torch.Generator().manual_seed(0))
    goals.set_generator(torch.Generator().manual_seed(1))
    caiac.set_generator(torch.Generator().manual_seed(2))
    for _ in range(30):
        batch = rb.sample()
        raw = data[batch["row"]]
        check_batch(case, batch, raw)
        real = ~batch["caiac", "counterfactual"][:, 0]
        assert batch["hindsight", "relabeled"][real].all()
        later = (vectors(batch)[:, 0] - 1) / STRIDE - 1 - batch["row"]
        seen |= set(later[real].tolist())
    assert seen == {0, 1, 2, 3, 4, 5, 6}


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("layout", [FLAT, NESTED])
def test_reading_a_full_storage_changes_nothing_in_it(layout, storage) -> None:
    case = build_case([9, 9], layout, storage=storage, future=0.0, random=1.0)
    raw = case.rb.storage[:].clone()
    out = case.rb[:]
    assert out["hindsight", "relabeled"].any()
    assert (case.rb.storage[:] == raw).all()
    assert "hindsight" not in case.rb.storage[:]


def test_draw_and_apply_are_apart() -> None:
    case = build_case([9, 9])
    td = case.caiac(case.rb.storage[:])
    before = td.clone()
    future = case.goals.read_goals(td, torch.arange(18).flip(0))
    draw = case.goals.generate_parameters(
        td["caiac", "counterfactual"], future, torch.Generator().manual_seed(0)
    )
    one = case.goals.apply_parameters(td, draw)
    assert (case.goals.apply_parameters(td, draw) == one).all()
    assert (td == before).all() and leaves(td) == leaves(before)
    with pytest.raises(ValueError, match="none are given"):
        case.goals.generate_parameters(td["caiac", "counterfactual"])


@pytest.mark.parametrize("shape", [(3, 3), (3, 1, 3)])
def test_batches_with_several_dimensions(shape: tuple[int, ...]) -> None:
    td, found = make([9], achieved=True), []
    for part in (td, td.view(shape)):
        generator = torch.Generator().manual_seed(3)
        goals = HindsightGoal(FLAT, reward, future=0.0, random=0.7, generator=generator)
        found.append(goals(part))
    assert found[0]["hindsight", "relabeled"].any()
    assert found[1].batch_size == shape
    assert found[1]["hindsight", "relabeled"].shape == (*shape, 1)
    assert (found[1].reshape(-1) == found[0]).all()


def test_under_prefetch_and_in_a_tensordict_buffer() -> None:
    for order in ORDERS:
        case = build_case(
            [9, 9, 9], order=order, kind=TensorDictReplayBuffer, prefetch=3, batch=6
        )
        for _ in range(10):
            batch = case.rb.sample()
            check_batch(case, batch, stored_rows(case.rb, batch))


def test_writes_between_samples() -> None:
    case = build_case([9, 9, 9], size=10, future=1.0, order="relabel")
    for begin in range(3):
        batch = case.rb.sample()
        check_batch(case, batch, stored_rows(case.rb, batch))
        more = make([9, 9, 9, 9])[27 + 3 * begin : 30 + 3 * begin]
        case.rb.extend(more)
        case.lengths = [9, 9, 9, 3 * begin + 3]


def test_stored_achieved_goals_and_flat_rewards() -> None:
    layout = EntityLayout({"arm": [0], "cup": [1]}, goal={"arm": (), "cup": [0]})
    keys = TransformKeys(reward="r", trajectory=None)
    goals = HindsightGoal(layout, reward, future=1.0, p=1.0, keys=keys)
    rb = ReplayBuffer(storage=LazyTensorStorage(6), sample_unit=goals, batch_size=6)
    rb.append_transform(goals)
    data = TensorDict(
        {
            "row": torch.arange(6),
            "desired_goal": torch.zeros(6, 1),
            ("next", "achieved_goal"): torch.arange(6.0, dtype=torch.double)[:, None],
            ("next", "done"): torch.zeros(6, 1, dtype=torch.bool),
            "r": torch.full((6,), 0.5),
        },
        [6],
    )
    rb.extend(data)
    batch = rb.sample()
    assert batch["desired_goal"].dtype == torch.float32
    assert torch.equal(batch["desired_goal"][:, 0], batch["row"].float())
    assert batch["r"].shape == (6,) and (batch["r"] == 0).all()
    assert ("next", "desired_goal") not in leaves(batch)


def test_renamed_keys() -> None:
    keys = TransformKeys(counterfactual="cf", relabeled=("a", "b"))
    augment = CAIACTransform(FLAT, keys=keys)
    goals = HindsightGoal(
        FLAT,
        reward,
        future=0.0,
        counterfactual=1.0,
        keys=keys,
    )
    td = make([8])
    td["caiac", "score"].zero_()
    out = goals(augment(td))
    assert torch.equal(out["a", "b"], out["cf"]) and out["cf"].sum() == 4
    with pytest.raises(RuntimeError, match="CAIACTransform first, HindsightGoal after"):
        augment(goals(td))


def test_pickle_and_clone() -> None:
    case = build_case([9, 9], future=1.0, p=1.0)
    for copy in (pickle.loads(pickle.dumps(case.goals)), case.goals.clone()):
        rb = ReplayBuffer(storage=case.rb.storage, sample_unit=copy, batch_size=4)
        rb.append_transform(copy)
        batch = rb.sample()
        assert torch.equal(vectors(batch), vectors(batch, "next"))
        assert "future=1.0, random=0.0" in repr(copy)


# --- bad input -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"future": 1.1}, ValueError, r"future must be in \[0, 1\]"),
        ({"random": -0.1}, ValueError, r"random must be in \[0, 1\]"),
        ({"counterfactual": math.nan}, ValueError, "counterfactual must be in"),
        ({"counterfactual": True}, TypeError, "counterfactual must be a number"),
        ({"future": 0.6, "random": 0.5}, ValueError, "a sum of at most 1"),
        ({"strategy": "last"}, ValueError, "'geometric' or 'uniform'"),
        ({"p": 0.0}, ValueError, r"must be in \(0, 1\]"),
        ({"reward_fn": 1.0}, TypeError, "reward_fn must be a function"),
        ({"generator": 0}, TypeError, "generator must be a torch.Generator"),
        ({"layout": {"cup": [0]}}, TypeError, "layout must be an EntityLayout"),
        ({"layout": EntityLayout({"cup": [0]})}, ValueError, "no goals"),
        (
            {"layout": EntityLayout.from_keys({"cup": "c"}, goal={"cup": "g"})},
            ValueError,
            r"achieved goals of \['cup'\]",
        ),
    ],
)
def test_arguments(arguments: dict, error: type, match: str) -> None:
    with pytest.raises(error, match=match):
        HindsightGoal(**{"layout": FLAT, "reward_fn": reward, **arguments})


def test_without_a_sample_unit() -> None:
    case = build_case([9, 9])
    with pytest.raises(RuntimeError, match="sample_unit="):
        case.rb[:]
    case.goals.expand(torch.arange(3), {}, case.rb.storage)
    with pytest.raises(RuntimeError, match="drawn for 3 rows, but the batch has 18"):
        case.goals(case.rb.storage[:])
    twice = build_case([9, 9], future=0.0, order="augment, relabel, relabel")
    with pytest.raises(RuntimeError, match="already relabelled"):
        twice.rb.sample()


def test_goals_of_a_sample_that_failed_are_not_those_of_other_rows() -> None:
    case = build_case([9, 9], batch=18)
    scores = case.rb.storage[:]["caiac", "score"]
    known = scores.clone()
    scores.fill_(math.nan)
    with pytest.raises(ValueError, match="not scored"):
        case.rb.sample()
    scores.copy_(known)
    with pytest.raises(RuntimeError, match="sample_unit="):
        case.rb[:]
    batch = case.rb.sample()
    check_batch(case, batch, stored_rows(case.rb, batch))


def test_before_the_augmentation_it_is_refused() -> None:
    for between in ([], [DoubleToFloat(in_keys=["desired_goal"])]):
        case = build_case([9, 9], order="relabel", data={"dtype": torch.double})
        for transform in (*between, CAIACTransform(FLAT)):
            case.rb.append_transform(transform)
        with pytest.raises(RuntimeError, match="HindsightGoal after it"):
            case.rb.sample()


def test_data_that_do_not_fit() -> None:
    goals = HindsightGoal(FLAT, reward, future=0.0)
    td = make([9])
    with pytest.raises(KeyError, match="no desired goals in 'desired_goal'"):
        goals(td.exclude("desired_goal"))
    with pytest.raises(KeyError, match=r"no \('next', 'reward'\).*TransformKeys"):
        goals(td.exclude(("next", "reward")))
    with pytest.raises(KeyError, match=r"read from, .*next.*observation"):
        goals(td.exclude(("next", "observation")))
    with pytest.raises(ValueError, match=r"\[9, 2\], expected \[9, 1\]: one reward"):
        goals(td.clone().set(("next", "reward"), torch.zeros(9, 2)))
    with pytest.raises(
        ValueError, match=r"'desired_goal' has shape \[9, 2\].*\[9, 3\]"
    ):
        goals(td.clone().set("desired_goal", torch.zeros(9, 2)))
    with pytest.raises(ValueError, match=r"counterfactual'\) has shape \[9\]"):
        goals(td.clone().set(("caiac", "counterfactual"), torch.zeros(9)))
    with pytest.raises(ValueError, match=r"reward_fn returned \[\].*expected \[9\]"):
        HindsightGoal(FLAT, lambda a, d: (a - d).sum(), future=0.0)(td)
    wide = td.clone().set(("next", "observation"), torch.zeros(9, 1, 5))
    with pytest.raises(ValueError, match="5 columns in 3 dimensions"):
        goals(wide)
    case = build_case([9, 9], NESTED)
    nested = case.rb.storage[:].exclude(("next", "s", "box"))
    with pytest.raises(KeyError, match=r"goals of .*box.* are read"):
        HindsightGoal(NESTED, reward, future=0.0)(nested)
    with pytest.raises(KeyError, match="lack the trajectory ids"):
        rb = ReplayBuffer(storage=LazyTensorStorage(9))
        rb.extend(td.exclude("episode", ("next", "done")))
        HindsightGoal(FLAT, reward).expand(torch.arange(3), {}, rb.storage)


@pytest.mark.gpu
@pytest.mark.parametrize("layout", [FLAT, NESTED])
def test_on_the_gpu(layout: EntityLayout) -> None:
    td = make([8, 8], layout).to("cuda")
    augment = CAIACTransform(layout, check=False)
    goals = HindsightGoal(layout, reward, future=0.0, random=0.5)
    goals(augment(td))
    with nothing_waits():
        out = goals(augment(td))
    assert out["hindsight", "relabeled"].device.type == "cuda"
