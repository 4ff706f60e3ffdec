"""CAIACTransform against a slow oracle that recomputes what each row may be."""

from __future__ import annotations

import math
import pickle
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    ReplayBufferEnsemble,
    TensorDictReplayBuffer,
)

from tests.pretend_cuda import nothing_waits
from tests.transforms.oracle import (
    DONORS,
    FLAT,
    FLAT_FREE,
    FORMS,
    KINDS,
    NESTED,
    STRIDE,
    THRESHOLD,
    Case,
    N,
    check_samples,
    chosen_windows,
    draw_buffer,
    make_data,
    owner_of,
    slices,
    small,
    stored,
    time_windows,
)
from torchrl_caiac import EntityLayout
from torchrl_caiac.transforms import CAIACTransform, TransformKeys


def limit(case: Case, entity: int) -> float:
    """The largest score of an uninfluenced entity."""
    threshold = case.transform.threshold
    if isinstance(threshold, float):
        return threshold
    return threshold.get(case.layout.names[entity], -math.inf)


def donor_windows(case: Case, entity: int) -> set[tuple[int, ...]]:
    """The row names of all windows that may donate an entity, one by one."""
    data, found, theta = stored(case.donors), set(), limit(case, entity)
    for part in time_windows(case.donors, case.window):
        names = tuple(data["row"][part].tolist())
        # `<=` in float32, as the scores are stored
        free = all(bool(data["caiac", "score"][i, entity] <= theta) for i in part)
        may = case.layout.names[entity] not in case.layout.fixed
        if may and free and not case.stale & set(names):
            found.add(names)
    return found


def check_batch(case: Case, batch: TensorDict, missing: list[int]) -> None:
    """Raises where the batch is anything that section 3's invariants forbid.

    Adds to ``missing`` how often each entity lacked a donor.
    """
    layout, window = case.layout, case.window
    total = batch.shape[0] // window
    chosen = chosen_windows(case, batch)
    names = [
        tuple(batch["row"][b * window : (b + 1) * window].tolist())
        for b in range(total)
    ]
    raw = stored(case.rb)
    place = {int(row): i for i, row in enumerate(raw["row"])}
    rows = raw[torch.tensor([place[row] for part in names for row in part])]
    score, swapped = rows["caiac", "score"], batch["caiac", "swapped"]
    assert swapped.shape == (total * window, N) and swapped.dtype == torch.bool
    free = [
        [
            layout.names[n] not in layout.fixed
            and not case.stale & set(names[b])
            and all(
                bool(score[b * window + k, n] <= limit(case, n)) for k in range(window)
            )
            for n in range(N)
        ]
        for b in range(total)
    ]
    allowed = [] if case.donors is None else [donor_windows(case, n) for n in range(N)]
    keys = [key if isinstance(key, tuple) else (key,) for key in rows.keys(True, True)]
    assert {("caiac", "swapped"), ("caiac", "counterfactual")} == {
        key if isinstance(key, tuple) else (key,) for key in batch.keys(True, True)
    } - set(keys)
    sources: dict[tuple[int, int], set[tuple[int, ...]]] = {}
    for key in keys:
        value, real = batch[key], rows[key]
        assert value.dtype == real.dtype and value.shape == real.shape
        owner = owner_of(layout, key)
        if owner is None:
            torch.testing.assert_close(value, real, rtol=0, atol=0, equal_nan=True)
            continue
        value, real = value.reshape(len(value), -1), real.reshape(len(real), -1)
        for column in range(value.shape[1]):
            name = owner if isinstance(owner, str) else owner[column]
            for b in range(total):
                part = slice(b * window, (b + 1) * window)
                n = None if name is None else layout.names.index(name)
                if not chosen[b] or n is None or not bool(swapped[b * window, n]):
                    assert torch.equal(value[part, column], real[part, column]), key
                    continue
                coded, own = value[part, column].double(), real[part, column].double()
                shift = STRIDE if key[0] == "next" else 0
                origin = tuple(((coded - shift) // STRIDE).long().tolist())
                # the same column as before, of another row
                assert torch.equal(coded % STRIDE, own % STRIDE)
                sources.setdefault((b, n), set()).add(origin)
    for b in range(total):
        part = slice(b * window, (b + 1) * window)
        for n in range(N):
            here = swapped[part, n]
            assert bool(here.all()) == bool(here.any())
            if not chosen[b] or not free[b][n]:
                assert not here.any()
                continue
            if case.donors is None:
                options = {names[c] for c in range(total) if c != b and free[c][n]}
            else:
                options = allowed[n]
            if not options:
                missing[n] += case.swap_prob == 1.0
                assert not here.any()
            elif case.swap_prob == 1.0:
                assert here.all()
            if here.any():
                assert len(sources[b, n]) == 1
                assert next(iter(sources[b, n])) in options


@st.composite
def cases(draw: st.DrawFn) -> Case:
    window = draw(st.integers(1, 5))
    layout = draw(st.sampled_from([FLAT, FLAT_FREE, NESTED]))
    dtype = draw(
        st.sampled_from([torch.float32, torch.float64, torch.float16, torch.int64])
    )
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    kind = draw(st.sampled_from(KINDS))
    stale: set[int] = set()

    def buffer(first: int, form: str, **kwargs: Any) -> ReplayBuffer:
        def data(*args: Any) -> TensorDict:
            return make_data(layout, *args, generator, dtype, layout is not FLAT_FREE)

        key = ("caiac", "score")
        return draw_buffer(
            draw, data, layout, key, first, form, window, kind, stale, **kwargs
        )

    batch = draw(st.integers(1, 8))
    rb = buffer(0, "in order", batch_size=batch * window, sampler=slices(window))
    rb.set_rng(generator)  # a failure can be repeated
    form = draw(st.sampled_from(FORMS))
    donors = None if form is None else buffer(DONORS, form, batch_size=1)
    ratio = draw(st.sampled_from([0.0, 0.3, 0.5, 0.9, 1.0]))
    swap_prob = draw(st.sampled_from([0.0, 0.5, 1.0]))
    chosen = draw(st.sampled_from(["random", "last"]))
    # A storage may be given as well.
    source = donors.storage if donors is not None and draw(st.booleans()) else donors
    names = [name for name in layout.names if name not in layout.fixed]
    each = {name: draw(st.sampled_from([-1.0, THRESHOLD, 0.4, 9.0])) for name in names}
    transform = CAIACTransform(
        layout,
        threshold=draw(st.sampled_from([THRESHOLD, each])),
        counterfactual_ratio=ratio,
        rows=chosen,
        swap_prob=swap_prob,
        window=window,
        donors=source,
        unscored="keep" if kind == "written later" else "raise",
        generator=generator,
    )
    return Case(layout, rb, transform, donors, window, ratio, swap_prob, chosen, stale)


@settings(
    max_examples=100,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(case=cases())
def test_invariants(case: Case) -> None:
    check_samples(case, check_batch)


# --- small fixed data ----------------------------------------------------------------


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("layout", [FLAT, NESTED])
def test_reading_a_full_storage_changes_nothing_in_it(layout, storage) -> None:
    rb = small(layout, storage)
    before = rb.storage[:].clone()
    rb.append_transform(CAIACTransform(layout))
    out = rb[:]
    assert out["caiac", "swapped"].any()
    assert (rb.storage[:] == before).all()
    assert ("caiac", "swapped") not in rb.storage[:].keys(True, True)


@pytest.mark.parametrize("donor", [False, True])
def test_same_generator_state_gives_the_same_batch(donor: bool) -> None:
    donors = small() if donor else None
    batches = []
    for _ in range(2):
        generator = torch.Generator().manual_seed(3)
        rb = small()
        rb.set_rng(torch.Generator().manual_seed(5))
        transform = CAIACTransform(FLAT, swap_prob=0.5, donors=donors)
        transform.set_generator(generator)
        rb.append_transform(transform)
        batches.append([rb.sample() for _ in range(3)])
    for one, other in zip(*batches, strict=True):
        assert (one == other).all()


def test_global_generator_without_one() -> None:
    rb = small()
    td = rb.sample()
    transform = CAIACTransform(FLAT, swap_prob=0.5)
    torch.manual_seed(0)
    one = transform(td)
    torch.manual_seed(0)
    assert (transform(td) == one).all()


def test_draw_and_apply_are_apart() -> None:
    td = small(batch=6).sample()
    transform = CAIACTransform(FLAT, counterfactual_ratio=1.0)
    draw = transform.generate_parameters(td["caiac", "score"])
    assert draw.donors.shape == draw.swapped.shape == (6, N)
    one = transform.apply_parameters(td, draw)
    assert (transform.apply_parameters(td, draw) == one).all()


def test_donors_of_one_row_are_independent() -> None:
    rb = small(FLAT_FREE, batch=20)
    transform = CAIACTransform(
        FLAT_FREE,
        counterfactual_ratio=1.0,
        generator=torch.Generator().manual_seed(0),
    )
    scores = torch.zeros(20, N)
    draws = torch.stack(
        [transform.generate_parameters(scores).donors for _ in range(2000)]
    ).float()
    # uniform over the 19 other rows, for each row and entity, and uncorrelated
    for row in (0, 7, 19):
        counts = torch.bincount(draws[:, row, 1].long(), minlength=20)
        assert counts[row] == 0
        expected = 2000 / 19
        chi2 = ((counts.float() - expected) ** 2 / expected).sum() - expected
        assert chi2 < 43.8  # 18 degrees of freedom, p = 0.0006
    flat = draws.reshape(-1, N)
    assert torch.corrcoef(flat.T)[0, 1].abs() < 0.03
    assert rb is not None


def test_swap_prob_is_a_probability() -> None:
    transform = CAIACTransform(
        FLAT,
        counterfactual_ratio=1.0,
        swap_prob=0.3,
        generator=torch.Generator().manual_seed(1),
    )
    swapped = transform.generate_parameters(torch.zeros(20_000, N)).swapped
    share = swapped.float().mean(0)
    assert share[0] == 0.0  # fixed
    assert (share[1:] - 0.3).abs().max() < 0.015


def test_rewards_of_counterfactual_rows_come_from_next_achieved_goals() -> None:
    seen = {}

    def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
        seen["achieved"], seen["desired"] = achieved, desired
        return (achieved - desired).abs().sum(-1)

    for layout in (FLAT, NESTED):
        rb = small(layout, batch=6)
        raw = rb.sample()
        out = CAIACTransform(layout, reward_fn=reward, rows="last")(raw)
        achieved, desired = ("achieved_goal", "desired_goal")
        if layout is NESTED:
            achieved, desired = ("got", "cup"), ("goal", "cup")
        path = (achieved,) if isinstance(achieved, str) else achieved
        assert torch.equal(seen["achieved"], out[("next", *path)][3:])
        assert torch.equal(seen["desired"], out[desired][3:])
        wanted = (out[("next", *path)] - out[desired]).abs().sum(-1, keepdim=True)
        assert torch.equal(out["next", "reward"][3:], wanted[3:])
        assert torch.equal(out["next", "reward"][:3], raw["next", "reward"][:3])
        assert (out["next", "reward"][3:] != raw["next", "reward"][3:]).any()


def test_rewards_of_random_rows_are_their_own() -> None:
    rb = small(window=2, batch=9)
    raw = rb.sample()
    out = CAIACTransform(
        FLAT,
        0.05,
        0.4,
        window=2,
        reward_fn=lambda a, d: (a - 2 * d).sum(-1),
        generator=torch.Generator().manual_seed(4),
    )(raw)
    marked = out["caiac", "counterfactual"][:, 0]
    assert marked.sum() == 8 and not marked[-8:].all()
    wanted = (out["next", "achieved_goal"] - 2 * out["desired_goal"]).sum(-1, True)
    wanted = torch.where(marked.unsqueeze(-1), wanted, raw["next", "reward"])
    assert torch.equal(out["next", "reward"], wanted)


def test_rewards_from_observation_columns() -> None:
    td = small(batch=4).sample()
    td = td.exclude("achieved_goal", ("next", "achieved_goal"))
    out = CAIACTransform(
        FLAT, counterfactual_ratio=1.0, reward_fn=lambda a, d: (a + d).sum(-1)
    )(td)
    columns = [2, 7, 1]  # mirrored by the goal's columns 0, 1, 2
    wanted = out["next", "observation"][:, columns] + out["desired_goal"]
    assert torch.equal(out["next", "reward"][:, 0], wanted.sum(-1))


def test_rewards_of_goals_that_are_subtensordicts() -> None:
    layout = EntityLayout.from_keys(
        {"box": ("s", "box"), "cup": ("s", "cup")},
        goal={"cup": ("g", "cup"), "box": ("g", "box")},
        achieved={"cup": ("s", "cup"), "box": ("s", "box")},
    )
    column = torch.arange(6.0)

    def state(sign: int) -> dict:
        cup = {"z": sign * column, "a": sign * column.view(6, 1, 1) - 1}
        return {"box": sign * column, "cup": cup}

    td = TensorDict(
        {
            "s": state(1),
            "g": state(-1),
            "next": {"s": state(1), "reward": torch.zeros(6, 1)},
            ("caiac", "score"): torch.zeros(6, 2),
        },
        [6],
    )
    out = CAIACTransform(
        layout, counterfactual_ratio=1.0, reward_fn=lambda a, d: a[:, 0] - d[:, 2]
    )(td)
    # in layout order: the box, then the cup's a and z
    wanted = out["next", "s", "box"] - out["g", "cup", "z"]
    assert torch.equal(out["next", "reward"][:, 0], wanted)
    assert (out["s", "box"] != column).all()


def test_reward_errors() -> None:
    td = small(batch=4).sample()
    with pytest.raises(ValueError, match=r"reward_fn returned \[\].*expected \[4\]"):
        CAIACTransform(FLAT, reward_fn=lambda a, d: (a - d).sum())(td)
    with pytest.raises(KeyError, match="no desired goals"):
        CAIACTransform(FLAT, reward_fn=lambda a, d: a)(
            td.exclude("desired_goal", ("next", "desired_goal"))
        )
    with pytest.raises(KeyError, match=r"has no .*r.*: name the"):
        CAIACTransform(FLAT, reward_fn=lambda a, d: a, keys=TransformKeys(reward="r"))(
            td
        )
    with pytest.raises(TypeError, match="reward_fn must be a function"):
        CAIACTransform(FLAT, reward_fn=1.0)


def test_renamed_keys() -> None:
    td = small(batch=4).sample()
    td = td.rename_key_(("caiac", "score"), ("a", "b", "s"))
    out = CAIACTransform(
        FLAT,
        score_key=("a", "b", "s"),
        keys=TransformKeys(counterfactual="cf", swapped=("x", "y")),
    )(td)
    assert out["cf"].sum() == 2
    assert out["x", "y"].shape == (4, N)


def test_works_under_prefetch_and_in_a_tensordict_buffer() -> None:
    source = small()
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(20), batch_size=6, prefetch=2)
    rb.extend(source.storage[:])
    rb.append_transform(CAIACTransform(FLAT))
    for _ in range(5):
        batch = rb.sample()
        marked = batch["caiac", "counterfactual"]
        assert marked.sum() == 3
        assert torch.equal(batch["caiac", "swapped"][:, 1:], marked.expand(-1, 2))


# --- bad input -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("threshold", -0.1, ValueError),
        ("threshold", math.nan, ValueError),
        ("threshold", math.inf, ValueError),
        ("threshold", "0.1", TypeError),
        ("threshold", None, TypeError),
        ("counterfactual_ratio", 1.5, ValueError),
        ("counterfactual_ratio", -0.5, ValueError),
        ("counterfactual_ratio", True, TypeError),
        ("swap_prob", 1.01, ValueError),
        ("swap_prob", math.nan, ValueError),
        ("swap_prob", None, TypeError),
        ("window", 0, ValueError),
        ("window", 2.0, TypeError),
        ("window", True, TypeError),
        ("generator", 0, TypeError),
    ],
)
def test_arguments_out_of_range(name: str, value: object, error: type) -> None:
    with pytest.raises(error, match=name):
        CAIACTransform(FLAT, **{name: value})
    with pytest.raises(TypeError, match="layout must be an EntityLayout"):
        CAIACTransform({"arm": [0]})


def test_score_errors() -> None:
    transform = CAIACTransform(FLAT)
    td = small(batch=4).sample()
    with pytest.raises(KeyError, match=r"no scores in \('caiac', 'score'\).*score_buf"):
        transform(td.exclude("caiac"))
    bad = td.copy()
    bad["caiac", "score"] = torch.zeros(4, 2)
    with pytest.raises(ValueError, match=r"shape \[4, 2\], expected \[4, 3\].*'arm'"):
        transform(bad)
    bad["caiac", "score"] = torch.zeros(4, N)
    bad["caiac", "score"][1, 2] = math.nan
    with pytest.raises(ValueError, match=r"not scored\) in 1 of 4 rows for \['box'\]"):
        transform(bad)
    bad["caiac", "score"][1, 2] = math.inf
    with pytest.raises(ValueError, match=r"infinite for \['box'\]"):
        transform(bad)
    # without checks such a row is neither swapped nor a donor
    bad["caiac", "score"][1, 2] = math.nan
    out = CAIACTransform(FLAT, counterfactual_ratio=1.0, check=False)(bad)
    assert out["caiac", "swapped"][:, 2].tolist() == [True, False, True, True]


def test_layout_that_does_not_fit() -> None:
    td = small(batch=4).sample()
    with pytest.raises(ValueError, match=r"8 columns.*at least 9"):
        CAIACTransform(EntityLayout({"a": [8], "b": [0], "c": [1]}))(td)
    with pytest.raises(KeyError, match="the layout reads"):
        CAIACTransform(
            EntityLayout({"a": [0], "b": [1], "c": [2]}, observation_key="state")
        )(td)
    with pytest.raises(KeyError, match="next"):
        CAIACTransform(FLAT)(td.exclude(("next", "observation")))
    with pytest.raises(KeyError, match="arm"):
        CAIACTransform(NESTED)(td)
    with pytest.raises(ValueError, match="'achieved_goal', which must follow"):
        CAIACTransform(FLAT_FREE)(td)
    bad = td.copy()
    bad["desired_goal"] = torch.zeros(4, 2)
    with pytest.raises(ValueError, match=r"'desired_goal' has shape \[4, 2\].* 3 col"):
        CAIACTransform(FLAT)(bad)
    with pytest.raises(ValueError, match=r"goal lacks \['cup'\]"):
        EntityLayout({"arm": [0], "cup": [1]}, goal={"arm": [0]})
    with pytest.raises(TypeError, match="made of tensors"):
        bad = small(NESTED, batch=4).sample()
        bad.set_non_tensor(("state", "cup", "name"), "mug")
        CAIACTransform(NESTED)(bad)


def test_windows_that_do_not_fit() -> None:
    rb = small(window=2, batch=4)
    td = rb.sample()
    with pytest.raises(ValueError, match="8 rows, not a multiple of the window 3"):
        CAIACTransform(FLAT, window=3)(td)
    with pytest.raises(ValueError, match="window 0 of 4 rows crosses"):
        CAIACTransform(FLAT, window=4)(rb.storage[8:16])
    # without ids, end flags tell
    with pytest.raises(ValueError, match="window 0 of 4 rows crosses"):
        CAIACTransform(FLAT, window=4)(rb.storage[8:16].exclude("episode"))
    out = CAIACTransform(FLAT, window=4)(rb.storage[2:10].exclude("episode"))
    assert out["caiac", "swapped"][:, 1:].sum() == 8
    with pytest.raises(ValueError, match="no rows: sample from a buffer that is not"):
        CAIACTransform(FLAT)(td[:0])


@pytest.mark.parametrize("window", [1, 2])
@pytest.mark.parametrize("shape", [(12,), (3, 4), (2, 3, 2)])
def test_batches_with_several_dimensions(window: int, shape: tuple[int, ...]) -> None:
    td = small(window=2, batch=6).sample()
    found = []
    for part in (td, td.view(shape)):
        transform = CAIACTransform(FLAT, window=window, swap_prob=0.5)
        transform.set_generator(torch.Generator().manual_seed(2))
        found.append(transform(part))
    assert found[1].batch_size == shape and found[0]["caiac", "swapped"].any()
    assert found[1]["caiac", "swapped"].shape == (*shape, N)
    assert (found[1].reshape(-1) == found[0]).all()


def test_windows_lie_along_the_last_dimension() -> None:
    td = small(window=2, batch=6).sample()
    message = r"shape \[4, 3\], whose last dimension is not a multiple of the window 2"
    with pytest.raises(ValueError, match=message):
        CAIACTransform(FLAT, window=2)(td.view(4, 3))
    with pytest.raises(ValueError, match=r"shape \[\], a single transition"):
        CAIACTransform(FLAT)(td[0])


@pytest.mark.parametrize("window", [1, 3])
def test_an_ensemble_of_buffers(window: int) -> None:
    buffers = [small(window=window, batch=4) for _ in range(2)]
    rb = ReplayBufferEnsemble(*buffers, batch_size=8 * window)
    rb.append_transform(CAIACTransform(FLAT, window=window))
    batch = rb.sample()
    # TorchRL adds a dimension to slices of an ensemble.
    assert batch.batch_size in ((2, 4 * window), (2, 4 * window, 1))
    marked = batch["caiac", "counterfactual"].view(-1, window)
    assert marked.sum() == 4 * window and torch.equal(marked.all(1), marked.any(1))
    assert batch["caiac", "swapped"].sum() == 8 * window
    # Donors are windows of both buffers, as one batch.
    own = batch["row"].view(-1, window)
    source = (batch["observation"][..., 5] // STRIDE).long().view(-1, window)
    assert torch.equal(source[~marked[:, 0]], own[~marked[:, 0]])
    assert all(row in own.tolist() for row in source.tolist())


def test_trajectories_shorter_than_the_window_and_empty_buffers() -> None:
    rb = small(window=11, batch=2)
    rb.append_transform(CAIACTransform(FLAT, window=11))
    with pytest.raises(RuntimeError, match="sufficient length"):
        rb.sample()
    rb = ReplayBuffer(storage=LazyTensorStorage(3), batch_size=2)
    rb.append_transform(CAIACTransform(FLAT))
    with pytest.raises(RuntimeError, match="empty"):
        rb.sample()


# --- writing, copying ----------------------------------------------------------------


def test_pickle_and_clone() -> None:
    donors = small()
    transform = CAIACTransform(FLAT, donors=donors, counterfactual_ratio=1.0)
    td = small(batch=4).sample()
    transform(td)
    for copy in (pickle.loads(pickle.dumps(transform)), transform.clone()):
        torch.manual_seed(0)
        one = transform(td)
        torch.manual_seed(0)
        assert (copy(td) == one).all()
    assert "threshold=0.05" in repr(transform) and "donors=ReplayBuffer" in repr(
        transform
    )
    assert CAIACTransform(FLAT).donors is None
    assert transform.share_memory_().no_donor_count.sum() == 0


@pytest.mark.gpu
@pytest.mark.parametrize("layout", [FLAT, NESTED])
def test_on_the_gpu(layout: EntityLayout) -> None:
    td = small(layout, batch=8).sample().to("cuda")
    transform = CAIACTransform(layout, check=False, rows="last")
    transform(td)
    with nothing_waits():
        out = transform(td)
    assert out["caiac", "swapped"][4:, 1:].all()
